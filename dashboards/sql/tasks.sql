-- Planned goals of one split for the grid of scenes: the relevant objects, and the scores of
-- one checkpoint as a map from name to score.
WITH scored AS (
    SELECT
        scene_id, predicate, subject, reference,
        map_from_entries(list({'k': query, 'v': score} ORDER BY query)) AS scores
    FROM predictions
    WHERE checkpoint_id = $checkpoint_id AND split = $split
    GROUP BY ALL
),
labelled AS (
    SELECT plan_id, list(query ORDER BY query) FILTER (relevant) AS relevant
    FROM labels
    WHERE split = $split
    GROUP BY plan_id
)
SELECT
    p.plan_id, p.scene_id, p.shard, p.predicate, p.subject, p.reference,
    p.status, p.reason, p.actions, coalesce(l.relevant, []) AS relevant, s.scores,
    len(list_filter(p.moved, lambda name: name NOT IN (p.subject, p.reference))) AS blockers
FROM plans AS p LEFT JOIN scored AS s USING (scene_id, predicate, subject, reference)
LEFT JOIN labelled AS l USING (plan_id)
LEFT JOIN shard_families AS f ON f.split = p.split AND f.shard = p.shard
WHERE p.split = $split AND p.predicate IN (SELECT unnest($predicates::VARCHAR[]))
    AND f.family IN (SELECT unnest($families::VARCHAR[]))
    AND p.status IN (SELECT unnest($statuses::VARCHAR[]))
ORDER BY md5(p.plan_id);
