-- Views that the dataset card is made of, besides those of views.sql. Plain DuckDB SQL; shares
-- are 0..1.

-- How many objects besides subject and reference the plans move.
CREATE OR REPLACE VIEW plan_blockers AS
SELECT
    family, predicate, split, blockers,
    count(*) AS plans,
    count(*) / sum(count(*)) OVER (PARTITION BY family, predicate, split) AS share
FROM (
    SELECT
        family, predicate, split,
        len(list_filter(moved, lambda name: name NOT IN (subject, reference))) AS blockers
    FROM plans LEFT JOIN shard_families USING (split, shard)
    WHERE holds
)
GROUP BY family, predicate, split, blockers
ORDER BY ALL;

-- Plans with another solution as good, or a bound left undecided: their labels could be others.
CREATE OR REPLACE VIEW plan_ambiguity AS
SELECT
    family, predicate, split,
    count(*) AS plans,
    count(*) FILTER (ambiguous) AS ambiguous,
    count(*) FILTER (ambiguous) / count(*) AS share
FROM plans LEFT JOIN shard_families USING (split, shard)
WHERE holds
GROUP BY family, predicate, split
ORDER BY ALL;

-- What the number of boxes does: goals with a plan that holds, relevant queries, planning time.
CREATE OR REPLACE VIEW by_size AS
WITH queries AS (
    SELECT plan_id, count(*) AS queries, count(*) FILTER (relevant) AS relevant
    FROM labels
    WHERE NOT is_goal_object
    GROUP BY plan_id
)
SELECT
    s.family,
    s.n_objects,
    count(*) AS goals,
    count(*) FILTER (p.holds) / count(*) AS plan_share,
    sum(q.relevant) / nullif(sum(q.queries), 0) AS relevant_share,
    median(t.seconds) AS median_seconds
FROM plans AS p
JOIN scenes AS s USING (scene_id)
LEFT JOIN queries AS q USING (plan_id)
LEFT JOIN timings AS t USING (plan_id)
GROUP BY ALL
ORDER BY ALL;

-- Objects by how much of them shows, in tenths.
CREATE OR REPLACE VIEW visibility_tenths AS
SELECT
    family,
    least(floor(visible_fraction * 10), 9)::INTEGER AS tenth,
    count(*) AS objects,
    count(*) / sum(count(*)) OVER (PARTITION BY family) AS share
FROM objects
GROUP BY family, tenth
ORDER BY ALL;

-- Where planning spends its time, s: the bounds, guides, and the replays in the simulator.
CREATE OR REPLACE VIEW bound_seconds AS
SELECT
    family, predicate,
    count(*) AS goals,
    sum(seconds_pose) AS pose,
    sum(seconds_keyframe) AS keyframe,
    sum(seconds_path) AS path,
    sum(seconds - seconds_pose - seconds_keyframe - seconds_path - seconds_guide) AS rest,
    sum(seconds_replay) AS replay
FROM timings LEFT JOIN shard_families USING (split, shard)
GROUP BY family, predicate
ORDER BY family, predicate;

-- Draws that were rejected before a scene was kept (no room, or an object hidden).
CREATE OR REPLACE VIEW scene_draws AS
SELECT
    split, family,
    count(*) AS scenes,
    sum(attempt)::BIGINT AS rejected,
    sum(attempt) / (count(*) + sum(attempt)) AS rejected_share
FROM scenes
GROUP BY split, family
ORDER BY ALL;

-- What made the rows: settings, planner and label policy, by their hashes and names.
CREATE OR REPLACE VIEW origins AS
SELECT 'scenes' AS made, config_hash, NULL AS planner_version, NULL AS policy, count(*) AS rows
FROM scenes GROUP BY ALL
UNION ALL
SELECT 'plans', config_hash, planner_version, NULL, count(*) FROM plans GROUP BY ALL
UNION ALL
SELECT 'labels', config_hash, planner_version, policy, count(*) FROM labels GROUP BY ALL
ORDER BY ALL;
