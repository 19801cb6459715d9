-- Objects by how much of them shows, in tenths. Variables: splits, families (all when not set).
SELECT
    family,
    least(floor(visible_fraction * 10), 9)::INTEGER AS tenth,
    count(*) AS objects
FROM objects
WHERE list_contains(coalesce(getvariable('splits'), ['train', 'validation', 'test']), split)
    AND list_contains(coalesce(getvariable('families'), [family]), family)
GROUP BY family, tenth
ORDER BY family, tenth;
