-- The queries of each goal that was rerun, with their scores, and whether they are relevant.
-- Variables: checkpoint_id, split.
SELECT
    p.scene_id, p.predicate, p.subject, p.reference,
    list(p.score ORDER BY p.query) AS scores, list(l.relevant ORDER BY p.query) AS relevant
FROM predictions AS p
JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
WHERE p.checkpoint_id = getvariable('checkpoint_id')
    AND p.split = coalesce(getvariable('split'), 'test')
    AND NOT l.is_goal_object
    AND (p.scene_id, p.predicate, p.subject, p.reference) IN (
        SELECT (e.scene_id, e.predicate, e.subject, e.reference)
        FROM evaluations AS e
        WHERE e.checkpoint_id = getvariable('checkpoint_id')
    )
GROUP BY p.scene_id, p.predicate, p.subject, p.reference
ORDER BY p.scene_id, p.predicate, p.subject, p.reference;
