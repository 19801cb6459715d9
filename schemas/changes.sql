-- Views over what was labelled more than once: beside_plans and beside_labels hold what was made
-- by another planner version, goal set or label policy than the current rows. Plain DuckDB SQL;
-- `relevance sql` has all of them, and after tables.sql they work in any DuckDB.

-- Current rows and those beside them. Which labelling a row belongs to say planner_version,
-- config_hash and policy.
CREATE OR REPLACE VIEW all_plans AS
SELECT *, true AS current FROM plans
UNION ALL BY NAME SELECT *, false AS current FROM beside_plans;

CREATE OR REPLACE VIEW all_labels AS
SELECT *, true AS current FROM labels
UNION ALL BY NAME SELECT *, false AS current FROM beside_labels;

-- Every way in which this dataset was labelled.
CREATE OR REPLACE VIEW labellings AS
SELECT
    planner_version, config_hash, policy, current,
    count(*) FILTER (is_goal_object) // 2 AS plans,
    count(*) FILTER (NOT is_goal_object) AS queries,
    count(*) FILTER (relevant AND NOT is_goal_object)
        / nullif(count(*) FILTER (NOT is_goal_object), 0) AS relevant_share
FROM all_labels
GROUP BY planner_version, config_hash, policy, current
ORDER BY current DESC, planner_version, config_hash, policy;

-- Which labels differ between a labelling beside and the current one, and why. Goals that only
-- one of the two has are no change; a null says that a goal had, or has, no plan that holds.
CREATE OR REPLACE VIEW label_changes AS
WITH both_labelled AS (
    SELECT
        n.scene_id, n.split, n.shard, n.predicate, n.subject, n.reference, n.query,
        n.is_goal_object, o.planner_version AS planner_before, n.planner_version AS planner_now,
        o.config_hash AS config_before, n.config_hash AS config_now,
        o.policy AS policy_before, n.policy AS policy_now,
        o.relevant AS relevant_before, n.relevant AS relevant_now,
        o.plan_id AS plan_before, n.plan_id AS plan_now,
        o.because AS because_before, n.because AS because_now
    FROM beside_labels AS o
    JOIN labels AS n USING (scene_id, split, predicate, subject, reference, query)
    WHERE o.relevant <> n.relevant
)
SELECT
    b.* EXCLUDE (plan_before, plan_now, because_before, because_now),
    CASE
        WHEN b.policy_before <> b.policy_now AND list_sort(o.moved) = list_sort(n.moved) THEN
            b.policy_before || ': ' || coalesce(
                b.because_before,
                CASE WHEN b.relevant_before THEN 'the plan moves it' ELSE 'the plan does without it' END
            ) || '; ' || b.policy_now || ': ' || coalesce(
                b.because_now,
                CASE WHEN b.relevant_now THEN 'the plan moves it' ELSE 'the plan does without it' END
            )
        ELSE
            'the plan moves ' || array_to_string(n.moved, ', ') || ' instead of '
            || array_to_string(o.moved, ', ')
            || CASE WHEN o.n_actions <> n.n_actions
                THEN ' (' || n.n_actions || ' actions instead of ' || o.n_actions || ')' ELSE '' END
            || CASE WHEN o.ambiguous OR n.ambiguous THEN ' (ambiguous)' ELSE '' END
            || CASE WHEN b.policy_before <> b.policy_now
                THEN '; ' || b.policy_now || ' instead of ' || b.policy_before ELSE '' END
    END AS why
FROM both_labelled AS b
JOIN all_plans AS o ON o.plan_id = b.plan_before
JOIN all_plans AS n ON n.plan_id = b.plan_now
UNION ALL
SELECT
    o.scene_id, o.split, o.shard, o.predicate, o.subject, o.reference, o.query, o.is_goal_object,
    o.planner_version, n.planner_version, o.config_hash, n.config_hash, o.policy, NULL,
    o.relevant, NULL,
    'no plan that holds now: ' || coalesce(
        nullif(n.reason, ''), nullif(n.replay_reason, ''), n.status
    )
FROM beside_labels AS o
JOIN plans AS n USING (scene_id, split, predicate, subject, reference)
WHERE NOT n.holds
UNION ALL
SELECT
    n.scene_id, n.split, n.shard, n.predicate, n.subject, n.reference, n.query, n.is_goal_object,
    o.planner_version, n.planner_version, o.config_hash, n.config_hash, NULL, n.policy,
    NULL, n.relevant,
    'no plan that held before: ' || coalesce(
        nullif(o.reason, ''), nullif(o.replay_reason, ''), o.status
    )
FROM labels AS n
JOIN beside_plans AS o USING (scene_id, split, predicate, subject, reference)
WHERE NOT o.holds;

-- What planning anew changed, a row a family and older settings: goals of both by what became
-- of their plans, and queries of both by what became of their labels (of the same policy). All
-- that is moved counts, subject included.
CREATE OR REPLACE VIEW replanned AS
WITH goals AS (
    SELECT
        family, o.planner_version AS planner_before, n.planner_version AS planner_now,
        o.config_hash AS config_before,
        CASE
            WHEN o.holds AND n.holds AND list_sort(o.moved) = list_sort(n.moved) THEN 'same'
            WHEN o.holds AND n.holds AND len(n.moved) < len(o.moved) THEN 'fewer'
            WHEN o.holds AND n.holds AND len(n.moved) > len(o.moved) THEN 'more'
            WHEN o.holds AND n.holds THEN 'others'
            WHEN n.holds THEN 'solved'
            WHEN o.holds THEN 'lost'
            ELSE 'neither'
        END AS became
    FROM beside_plans AS o
    JOIN plans AS n USING (scene_id, split, predicate, subject, reference)
    LEFT JOIN shard_families AS f ON f.split = n.split AND f.shard = n.shard
),
by_goal AS (
    SELECT
        family, planner_before, planner_now, config_before,
        count(*) AS goals,
        count(*) FILTER (became = 'solved') AS newly_solved,
        count(*) FILTER (became = 'lost') AS no_longer_solved,
        count(*) FILTER (became = 'neither') AS never_solved,
        count(*) FILTER (became = 'same') AS same_boxes_moved,
        count(*) FILTER (became = 'fewer') AS fewer_boxes_moved,
        count(*) FILTER (became = 'more') AS more_boxes_moved,
        count(*) FILTER (became = 'others') AS other_boxes_moved
    FROM goals
    GROUP BY ALL
),
by_query AS (
    SELECT
        f.family, o.planner_version AS planner_before, n.planner_version AS planner_now,
        o.config_hash AS config_before,
        count(*) AS queries,
        count(*) FILTER (o.relevant = n.relevant) AS equal,
        count(*) FILTER (n.relevant < o.relevant) AS to_irrelevant,
        count(*) FILTER (n.relevant > o.relevant) AS to_relevant
    FROM beside_labels AS o
    JOIN labels AS n USING (scene_id, split, predicate, subject, reference, query)
    LEFT JOIN shard_families AS f ON f.split = n.split AND f.shard = n.shard
    WHERE o.policy = n.policy AND NOT n.is_goal_object
    GROUP BY ALL
)
SELECT
    g.family, g.planner_before, g.planner_now, g.config_before,
    goals, newly_solved, no_longer_solved, never_solved,
    same_boxes_moved, fewer_boxes_moved, more_boxes_moved, other_boxes_moved,
    coalesce(queries, 0) AS queries, coalesce(equal, 0) AS equal,
    coalesce(to_irrelevant, 0) AS to_irrelevant, coalesce(to_relevant, 0) AS to_relevant
FROM by_goal AS g
LEFT JOIN by_query AS q
    ON (g.planner_before, g.planner_now, g.config_before)
        = (q.planner_before, q.planner_now, q.config_before)
    AND g.family IS NOT DISTINCT FROM q.family
ORDER BY g.family, g.planner_before, g.planner_now, g.config_before;
