-- What must hold between the rows of a dataset (data/README.md). Each statement gives the
-- breaches of one rule as (file, "row", "column", message); `relevance check` runs them all over
-- the table views with their columns file and "row".

-- rule: a scene is in one split, once
SELECT s.file, s.row, 'scene_id' AS "column",
    'scene ' || s.scene_id || ': expected in one split only, found in '
    || array_to_string(o.splits, ', ') || ' (' || o.scenes || ' times)' AS message
FROM scenes AS s JOIN split_overlap AS o USING (scene_id);

-- rule: a row says where it is
SELECT file, row, 'shard' AS "column",
    'expected split and shard as in the file name, found ' || split || ' ' || shard AS message
FROM (
    SELECT file, row, split, shard FROM scenes
    UNION ALL SELECT file, row, split, shard FROM plans
    UNION ALL SELECT file, row, split, shard FROM timings
    UNION ALL SELECT file, row, split, shard FROM labels
    UNION ALL SELECT file, row, split, shard FROM beside_plans
    UNION ALL SELECT file, row, split, shard FROM beside_labels
    UNION ALL SELECT file, row, split, shard FROM durations
)
-- (a merged dataset numbers the shards of its sources, which are elsewhere, anew)
WHERE NOT regexp_matches(file, '^(\.\./|/|[a-z0-9]+://)') AND NOT ends_with(
    file, 'split=' || split || '/shard-' || lpad(shard::VARCHAR, 6, '0') || '.parquet'
);

-- rule: visible shares and counts are possible
SELECT file, row, 'objects' AS "column",
    'expected n_objects = ' || len(objects) || ', found ' || n_objects AS message
FROM scenes WHERE n_objects <> len(objects)
UNION ALL
SELECT s.file, s.row, 'objects',
    'visible_fraction of ' || o.name || ': expected 0 to 1, found ' || o.visible_fraction
FROM objects AS o JOIN scenes AS s USING (scene_id)
WHERE o.visible_fraction NOT BETWEEN 0 AND 1 OR o.visible_pixels < 0;

-- rule: a goal is planned once, in a scene of its split
SELECT p.file, p.row, 'plan_id' AS "column", 'expected once, found ' || n || ' times' AS message
FROM plans AS p
JOIN (SELECT plan_id, count(*) AS n FROM plans GROUP BY plan_id) AS c USING (plan_id)
WHERE n > 1
UNION ALL
SELECT p.file, p.row, 'scene_id', 'expected a scene of this shard, found ' || p.scene_id
FROM plans AS p LEFT JOIN scenes AS s USING (scene_id, split, shard)
WHERE s.scene_id IS NULL;

-- rule: a plan names objects of its scene
SELECT p.file, p.row, 'moved' AS "column",
    'expected objects of the scene, found '
    || array_to_string(
        list_filter(
            p.moved || [p.subject, p.reference], lambda n: NOT list_contains(s.names, n)
        ), ', '
    ) AS message
FROM plans AS p
JOIN (SELECT scene_id, list(name) AS names FROM objects GROUP BY scene_id) AS s USING (scene_id)
WHERE NOT list_has_all(s.names, p.moved || [p.subject, p.reference]);

-- rule: a plan is what its status says
SELECT file, row, 'status' AS "column",
    'expected solved, infeasible, limit or refused, found ' || status AS message
FROM plans WHERE status NOT IN ('solved', 'infeasible', 'limit', 'refused')
UNION ALL
SELECT file, row, 'n_actions', 'expected ' || len(actions) || ' actions, found ' || n_actions
FROM plans WHERE n_actions <> len(actions)
UNION ALL
SELECT file, row, 'moved', 'expected the objects of the actions, found ' || moved::VARCHAR
FROM plans
WHERE list_sort(list_distinct(list_transform(actions, lambda a: a[2]))) <> list_sort(moved)
UNION ALL
SELECT file, row, 'final', 'expected a pose for each moved object, found ' || len(final)
FROM plans WHERE list_sort(list_transform(final, lambda f: f.name)) <> list_sort(moved)
UNION ALL
SELECT file, row, 'reason', 'expected a reason for a goal that is not solved, found none'
FROM plans WHERE status <> 'solved' AND reason = '' AND coalesce(replay_reason, '') = ''
UNION ALL
SELECT file, row, 'actions',
    'expected no actions for a goal that is not solved, found ' || n_actions
FROM plans WHERE status NOT IN ('solved', 'refused') AND n_actions > 0
UNION ALL
SELECT file, row, 'cost', 'expected a cost for a solved goal, found null'
FROM plans WHERE status = 'solved' AND cost IS NULL;

-- rule: a plan counts only if it holds
SELECT file, row, 'holds' AS "column",
    'expected solved and check_ok and replay_ok is not false, found ' || holds AS message
FROM plans WHERE holds <> (status = 'solved' AND check_ok AND coalesce(replay_ok, true))
UNION ALL
SELECT file, row, 'max_penetration',
    'expected at most 0.001 m, found ' || coalesce(max_penetration::VARCHAR, 'null')
FROM plans WHERE holds AND coalesce(max_penetration, 1) > 0.001
UNION ALL
SELECT file, row, 'replay_max_penetration',
    'expected at most 0.001 m, found ' || replay_max_penetration
FROM plans WHERE replay_ok AND replay_max_penetration > 0.001;

-- rule: every plan has one timing
SELECT p.file, p.row, 'plan_id' AS "column", 'expected a row in timings, found none' AS message
FROM plans AS p ANTI JOIN timings AS t USING (plan_id)
UNION ALL
SELECT t.file, t.row, 'plan_id', 'expected a row in plans, found none'
FROM timings AS t ANTI JOIN plans AS p USING (plan_id);

-- rule: labels say what their plan says
SELECT l.file, l.row, 'plan_id' AS "column",
    'expected a plan that holds, found one that does not' AS message
FROM labels AS l JOIN plans AS p USING (plan_id) WHERE NOT p.holds
UNION ALL
SELECT l.file, l.row, 'plan_id', 'expected a row in plans, found none'
FROM labels AS l ANTI JOIN plans AS p USING (plan_id)
UNION ALL
SELECT l.file, l.row, 'relevant',
    l.query || ': expected ' || list_contains(p.moved, l.query)
    || ' as the plan says, found ' || l.relevant
FROM labels AS l JOIN plans AS p USING (plan_id)
WHERE l.relevant <> list_contains(p.moved, l.query)
    -- other policies may call relevant what this plan does without, or irrelevant what it moves
    AND l.policy IN ('found', CASE WHEN l.relevant THEN 'necessary' ELSE 'any-minimal' END)
UNION ALL
SELECT l.file, l.row, 'subject', 'expected goal, scene and flags of the plan, found others'
FROM labels AS l JOIN plans AS p USING (plan_id)
WHERE (l.scene_id, l.predicate, l.subject, l.reference, l.ambiguous)
    <> (p.scene_id, p.predicate, p.subject, p.reference, p.ambiguous)
    OR l.is_goal_object <> (l.query IN (p.subject, p.reference));

-- rule: labels beside the current ones are of plans that hold
SELECT l.file, l.row, 'plan_id' AS "column", 'expected a row in plans, found none' AS message
FROM beside_labels AS l ANTI JOIN all_plans AS p USING (plan_id)
UNION ALL
SELECT l.file, l.row, 'plan_id', 'expected a plan that holds, found one that does not'
FROM beside_labels AS l JOIN all_plans AS p USING (plan_id) WHERE NOT p.holds
UNION ALL
SELECT l.file, l.row, 'relevant', l.query || ': expected relevant as every plan moves it, found false'
FROM beside_labels AS l JOIN all_plans AS p USING (plan_id)
WHERE l.policy IN ('found', 'any-minimal') AND NOT l.relevant AND list_contains(p.moved, l.query)
UNION ALL
SELECT l.file, l.row, 'relevant', l.query || ': expected irrelevant as the plan does without it, found true'
FROM beside_labels AS l JOIN all_plans AS p USING (plan_id)
WHERE l.policy IN ('found', 'necessary') AND l.relevant AND NOT list_contains(p.moved, l.query);

-- rule: a labelled plan has one label for each object
SELECT l.file, l.row, 'query' AS "column",
    'expected ' || s.n_objects || ' labels of as many objects for plan ' || l.plan_id
    || ', found ' || l.labels || ' of ' || l.found AS message
FROM (
    SELECT min(file) AS file, min(row) AS row, plan_id, scene_id,
        count(*) AS labels, count(DISTINCT query) AS found
    FROM labels GROUP BY plan_id, scene_id
) AS l
JOIN scenes AS s USING (scene_id)
WHERE l.found <> s.n_objects OR l.labels <> s.n_objects
UNION ALL
SELECT p.file, p.row, 'holds', 'expected labels for a plan that holds, found none'
FROM plans AS p ANTI JOIN labels AS l USING (plan_id)
WHERE p.holds AND ('labels' || substr(p.file, 6)) IN (SELECT DISTINCT file FROM labels);

-- rule: predictions and evaluations are of stored scenes and known checkpoints
SELECT p.file, p.row, 'scene_id' AS "column",
    'expected a stored scene of this split, found ' || p.scene_id AS message
FROM (
    SELECT file, row, scene_id, split FROM predictions
    UNION ALL SELECT file, row, scene_id, split FROM evaluations
) AS p ANTI JOIN scenes AS s USING (scene_id, split)
UNION ALL
SELECT p.file, p.row, 'checkpoint_id',
    'expected a row in checkpoints, found none for ' || p.checkpoint_id
FROM (
    SELECT file, min(row) AS row, checkpoint_id FROM predictions GROUP BY ALL
    UNION ALL SELECT file, min(row) AS row, checkpoint_id FROM evaluations GROUP BY ALL
) AS p ANTI JOIN checkpoints AS c USING (checkpoint_id);

-- rule: evaluations are possible
SELECT file, row, 'seconds_guided' AS "column",
    'expected at least seconds_inference = ' || seconds_inference
    || ', found ' || seconds_guided AS message
FROM evaluations
WHERE seconds_inference > seconds_guided OR least(seconds_unguided, seconds_inference) < 0;
