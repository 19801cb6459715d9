-- A row a search, guide, beta and family. A task that the guide misses costs the guided attempt
-- and then the unguided run; `speedup_both` leaves such tasks out, as the paper does.
WITH tasks AS (
    SELECT
        *, CASE predicate WHEN 'on' THEN 'on' ELSE 'same-plane' END AS family,
        solved_unguided AND NOT solved_guided AS missed
    FROM evaluations
    WHERE checkpoint_id = $checkpoint_id
)
SELECT
    search, guide, beta, family,
    count(*) AS tasks,
    count_if(solved_unguided) AS solvable,
    count_if(missed) AS missed,
    avg(seconds_unguided) FILTER (solved_unguided) AS seconds_unguided,
    avg(seconds_guided + CASE WHEN missed THEN seconds_unguided ELSE 0 END)
        FILTER (solved_unguided) AS seconds_guided,
    avg(seconds_inference) FILTER (solved_unguided) AS seconds_network,
    sum(seconds_unguided) FILTER (solved_unguided)
        / nullif(sum(seconds_guided + CASE WHEN missed THEN seconds_unguided ELSE 0 END)
            FILTER (solved_unguided), 0) AS speedup,
    sum(seconds_unguided) FILTER (solved_unguided AND solved_guided)
        / nullif(sum(seconds_guided) FILTER (solved_unguided AND solved_guided), 0)
        AS speedup_both,
    avg(nlps_unguided) FILTER (solved_unguided) AS nlps_unguided,
    avg(nlps_guided) FILTER (solved_unguided) AS nlps_guided
FROM tasks
GROUP BY search, guide, beta, family
ORDER BY search DESC, guide, beta, family DESC;
