-- Checkpoints, the newest first, with what was made with them.
SELECT
    c.checkpoint_id, c.body, c.preset, c.created, c.train_seconds,
    coalesce(c.config ->> 'policy', 'found') AS policy,
    (SELECT count(*) FROM predictions AS p WHERE p.checkpoint_id = c.checkpoint_id) AS predictions,
    (SELECT count(*) FROM evaluations AS e WHERE e.checkpoint_id = c.checkpoint_id) AS reruns
FROM checkpoints AS c
ORDER BY c.created DESC, c.checkpoint_id;
