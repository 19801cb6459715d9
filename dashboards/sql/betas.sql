-- What is kept, and what of the relevant objects, over beta: an object is kept iff its score is
-- over -beta, goal objects always. Variables: checkpoint_id, split, betas.
WITH
queries AS (
    SELECT
        p.scene_id, p.predicate, p.subject, p.reference, p.score, l.relevant, s.n_objects,
        count(*) FILTER (l.relevant) OVER (
            PARTITION BY p.scene_id, p.predicate, p.subject, p.reference
        ) AS wanted
    FROM predictions AS p
    JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
    JOIN scenes AS s USING (split, scene_id)
    WHERE p.checkpoint_id = getvariable('checkpoint_id')
        AND p.split = coalesce(getvariable('split'), 'test')
        AND NOT l.is_goal_object
),
tasks AS (
    SELECT
        any_value(n_objects) AS n_objects, any_value(wanted) AS wanted,
        coalesce(min(score) FILTER (relevant), 'Infinity'::DOUBLE) AS least
    FROM queries
    GROUP BY scene_id, predicate, subject, reference
),
betas AS (
    SELECT unnest(coalesce(
        getvariable('betas'), list_transform(range(-32, 33), lambda quarter: quarter / 4)
    ))::DOUBLE AS beta
),
of_queries AS (
    SELECT
        beta,
        count(*) FILTER (score > -beta) AS kept,
        avg((score > -beta)::INTEGER) FILTER (relevant) AS recall,
        sum((score > -beta)::INTEGER / wanted) FILTER (relevant) AS recalls
    FROM betas, queries
    GROUP BY beta
),
of_tasks AS (
    SELECT
        beta, count(*) AS goals,
        sum(n_objects) AS objects,
        count(*) FILTER (wanted > 0) AS asking,
        avg((least > -beta)::INTEGER) AS whole
    FROM betas, tasks
    GROUP BY beta
)
SELECT
    beta, goals, recall, recalls / nullif(asking, 0) AS set_recall, whole,
    (kept + 2 * goals) / objects AS kept
FROM of_queries JOIN of_tasks USING (beta)
ORDER BY beta;
