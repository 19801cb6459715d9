-- How the goals fared. Variables: splits, families (all when not set).
SELECT
    sum(goals)::BIGINT AS goals,
    sum(solved) / sum(goals) AS solved,
    sum(plans)::BIGINT AS plans,
    sum(replayed)::BIGINT AS replayed,
    sum(replay_ok) / nullif(sum(replayed), 0) AS replay_ok
FROM plan_verdicts
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family);
