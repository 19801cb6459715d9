-- How long the plans are. Variables: splits, families (all when not set).
SELECT family, n_actions, sum(plans)::BIGINT AS plans
FROM plan_lengths
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family)
GROUP BY family, n_actions
ORDER BY n_actions, family;
