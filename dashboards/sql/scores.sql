-- What a checkpoint says of the objects of some scenes' goals. Variables: checkpoint_id, scene_ids.
SELECT
    scene_id, predicate, subject, reference,
    map_from_entries(list({'k': query, 'v': score} ORDER BY query)) AS scores
FROM predictions
WHERE checkpoint_id = getvariable('checkpoint_id')
    AND list_contains(getvariable('scene_ids'), scene_id)
GROUP BY ALL
ORDER BY ALL;
