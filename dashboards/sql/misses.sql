-- The goals in which a relevant object is left out, the ones that are surest of it first.
-- Variables: checkpoint_id, split, beta, rows.
WITH missed AS (
    SELECT
        l.plan_id,
        min(p.score) AS least,
        list(p.query ORDER BY p.score, p.query) AS left_out,
        count(*) OVER () AS found
    FROM predictions AS p
    JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
    WHERE p.checkpoint_id = getvariable('checkpoint_id')
        AND p.split = coalesce(getvariable('split'), 'test')
        AND NOT l.is_goal_object AND l.relevant
        AND p.score <= -coalesce(getvariable('beta'), 0)
    GROUP BY l.plan_id
)
SELECT
    p.plan_id, p.scene_id, p.split, p.shard, p.predicate, p.subject, p.reference, p.actions,
    m.least, m.left_out, m.found
FROM missed AS m JOIN plans AS p USING (plan_id)
ORDER BY m.least, p.plan_id
LIMIT coalesce(getvariable('rows'), 6);
