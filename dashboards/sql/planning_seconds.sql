-- How long planning took, by family: quantiles at every half per cent, so that the 101st of the
-- list is the median. Variables: splits, families (all when not set).
SELECT
    family, count(*) AS n,
    quantile_cont(seconds, list_transform(range(201), lambda half: half / 200)) AS quantiles
FROM timings LEFT JOIN shard_families USING (split, shard)
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family)
GROUP BY family
ORDER BY family DESC;
