-- What is relevant for some goals, by the labels. Variables: plan_ids, shards (those of the plans:
-- the rest is not read).
SELECT plan_id, coalesce(list(query ORDER BY query) FILTER (relevant), []) AS relevant
FROM labels
WHERE list_contains(getvariable('shards'), shard) AND list_contains(getvariable('plan_ids'), plan_id)
GROUP BY plan_id
ORDER BY plan_id;
