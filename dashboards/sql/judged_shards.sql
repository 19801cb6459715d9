-- Of a split every so-manieth shard of each family, so that no family is missing. Variables: split
-- ('test' when not set), every (1 when not set).
WITH found AS (SELECT shard, count(*) AS scenes FROM scenes
    WHERE split = coalesce(getvariable('split'), 'test') GROUP BY shard),
numbered AS (
    SELECT shard, family, scenes, row_number() OVER (PARTITION BY family ORDER BY shard) AS place
    FROM found JOIN shard_families USING (shard)
    WHERE split = coalesce(getvariable('split'), 'test')
)
SELECT shard, family, scenes FROM numbered
WHERE (place - 1) % coalesce(getvariable('every'), 1) = 0
ORDER BY shard;
