-- Planned goals of one split that fit, some rows of them, and in each how many there are in all.
-- Variables: split, families, predicates, statuses, fewest and most boxes, blocked (only plans that
-- move a query), checkpoint_id, beta, wrong (only goals that the checkpoint misjudges, the worst
-- first), skip and rows.
WITH
judged_wrongly AS (
    SELECT p.scene_id, p.predicate, p.subject, p.reference, count(*) AS wrong
    FROM predictions AS p
    JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
    WHERE p.checkpoint_id = getvariable('checkpoint_id')
        AND p.split = coalesce(getvariable('split'), 'test')
        AND NOT l.is_goal_object
        AND (p.score > -coalesce(getvariable('beta'), 0)) <> l.relevant
    GROUP BY ALL
),
sized AS (
    SELECT split, scene_id, family, n_objects
    FROM scenes
    WHERE split = coalesce(getvariable('split'), 'test')
),
-- (asked twice, and not kept: of the plans that fit only the ids are held, and of those a few)
fitting AS NOT MATERIALIZED (
    SELECT p.plan_id, coalesce(w.wrong, 0) AS wrong
    FROM plans AS p
    JOIN sized AS s USING (split, scene_id)
    LEFT JOIN judged_wrongly AS w USING (scene_id, predicate, subject, reference)
    WHERE list_contains(coalesce(getvariable('families'), [s.family]), s.family)
        AND list_contains(coalesce(getvariable('predicates'), [p.predicate]), p.predicate)
        AND list_contains(coalesce(getvariable('statuses'), [p.status]), p.status)
        AND s.n_objects
            BETWEEN coalesce(getvariable('fewest'), 0) AND coalesce(getvariable('most'), 999)
        AND (
            NOT coalesce(getvariable('blocked'), false)
            OR len(list_filter(p.moved, lambda name: name NOT IN (p.subject, p.reference))) > 0
        )
        AND (NOT coalesce(getvariable('wrong'), false) OR w.wrong > 0)
),
chosen AS (
    SELECT
        plan_id, wrong,
        CASE WHEN coalesce(getvariable('wrong'), false) THEN -wrong ELSE 0 END AS worst
    FROM fitting
    ORDER BY worst, md5(plan_id)
    LIMIT coalesce(getvariable('rows'), 20) OFFSET coalesce(getvariable('skip'), 0)
)
SELECT
    p.plan_id, p.scene_id, p.split, p.shard, s.family, s.n_objects, p.predicate, p.subject,
    p.reference, p.status, p.reason, p.actions, p.holds, c.wrong,
    (SELECT count(*) FROM fitting) AS found
FROM chosen AS c
JOIN plans AS p USING (plan_id)
JOIN sized AS s USING (split, scene_id)
ORDER BY c.worst, md5(p.plan_id);
