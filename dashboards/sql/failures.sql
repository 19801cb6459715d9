-- Goals that made no labels, by reason. Variables: splits, families (all when not set).
SELECT status, reason, sum(goals)::BIGINT AS goals
FROM plan_failures
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family)
GROUP BY status, reason
ORDER BY goals DESC, status, reason;
