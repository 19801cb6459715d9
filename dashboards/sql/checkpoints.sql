-- Checkpoints, the newest first, with what was made with them.
WITH
predicted AS (SELECT checkpoint_id, count(*) AS predictions FROM predictions GROUP BY checkpoint_id),
rerun AS (SELECT checkpoint_id, count(*) AS reruns FROM evaluations GROUP BY checkpoint_id)
SELECT
    c.checkpoint_id, c.body, c.preset, c.seed, c.created, c.train_seconds, c.path,
    coalesce(c.config ->> 'policy', 'found') AS policy,
    nullif(c.config ->> 'continues', '') AS continues,
    coalesce(predictions, 0) AS predictions, coalesce(reruns, 0) AS reruns
FROM checkpoints AS c
LEFT JOIN predicted USING (checkpoint_id)
LEFT JOIN rerun USING (checkpoint_id)
ORDER BY c.created DESC, c.checkpoint_id DESC;
