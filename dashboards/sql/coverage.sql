-- The least beta that keeps every relevant object in a share of the goals. Variables:
-- checkpoint_id, split, coverage.
WITH tasks AS (
    SELECT min(p.score) FILTER (l.relevant) AS least
    FROM predictions AS p
    JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
    WHERE p.checkpoint_id = getvariable('checkpoint_id')
        AND p.split = coalesce(getvariable('split'), 'test')
        AND NOT l.is_goal_object
    GROUP BY p.scene_id, p.predicate, p.subject, p.reference
),
ranked AS (
    SELECT
        least,
        row_number() OVER (ORDER BY least DESC NULLS FIRST) / count(*) OVER () AS covered
    FROM tasks
)
-- (kept iff the score is over -beta: a thousandth more than the score that has to be kept)
SELECT ceil(1000 * -max(least) + 1) / 1000 AS beta
FROM ranked
WHERE covered >= coalesce(getvariable('coverage'), 0.9);
