-- How right each checkpoint is on the queries of a split, at its own offsets (beta = 0), by the
-- labels of its policy. Variables: split.
SELECT
    c.body, c.checkpoint_id, c.created, s.family,
    count(*) AS queries,
    avg((p.score > 0)::INTEGER) FILTER (l.relevant) AS true_relevant,
    avg((p.score <= 0)::INTEGER) FILTER (NOT l.relevant) AS true_irrelevant,
    avg(((p.score > 0) = l.relevant)::INTEGER) AS total,
    avg((NOT l.relevant)::INTEGER) AS base_rate
FROM predictions AS p
JOIN checkpoints AS c USING (checkpoint_id)
JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
LEFT JOIN shard_families AS s ON s.split = l.split AND s.shard = l.shard
WHERE p.split = coalesce(getvariable('split'), 'test')
    AND NOT l.is_goal_object
    AND l.policy = coalesce(c.config ->> 'policy', 'found')
GROUP BY c.body, c.checkpoint_id, c.created, s.family
ORDER BY c.created DESC, c.checkpoint_id DESC, s.family DESC;
