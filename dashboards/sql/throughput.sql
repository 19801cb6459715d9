-- How fast each shard was made: scenes, or goals of a predicate, in a second of one process.
-- Variables: splits, families (all when not set).
SELECT stage, split, shard, family, rows, seconds, rows / nullif(seconds, 0) AS rows_per_second
FROM durations LEFT JOIN shard_families USING (split, shard)
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family)
ORDER BY stage = 'scenes' DESC, stage, split, shard;
