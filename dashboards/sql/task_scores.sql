-- Each goal's queries with their scores, and whether they are relevant. Variables: checkpoint_id,
-- split.
SELECT
    p.scene_id, p.predicate, p.subject, p.reference,
    list(p.score ORDER BY p.query) AS scores, list(l.relevant ORDER BY p.query) AS relevant
FROM predictions AS p
JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
WHERE p.checkpoint_id = getvariable('checkpoint_id')
    AND p.split = coalesce(getvariable('split'), 'test')
    AND NOT l.is_goal_object
GROUP BY p.scene_id, p.predicate, p.subject, p.reference
ORDER BY p.scene_id, p.predicate, p.subject, p.reference;
