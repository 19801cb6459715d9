-- How many scenes there are, of which size. Variables: splits, families (all when not set).
SELECT
    count(*) AS scenes, sum(n_objects)::BIGINT AS boxes,
    min(n_objects) AS fewest, max(n_objects) AS most
FROM scenes
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family);
