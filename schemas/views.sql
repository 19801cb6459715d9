-- Views over the tables of a dataset: scenes, plans, timings, labels, durations, checkpoints,
-- predictions, evaluations. Plain DuckDB SQL; `relevance sql` has all of them, and after tables.sql they work
-- in any DuckDB. Shares are 0..1.

-- One row an object of a scene; place counts from 0 and mask = place + 1.
CREATE OR REPLACE VIEW objects AS
SELECT
    scene_id, split, shard, family, n_objects, place,
    o.name, o.size, o.position, o.yaw, o.color, o."on" AS stands_on,
    o.visible_pixels, o.visible_fraction
FROM (
    SELECT
        scene_id, split, shard, family, n_objects,
        unnest(objects) AS o, unnest(range(len(objects)))::INTEGER AS place
    FROM scenes
);

-- The family of each shard's scenes: all of a shard are of one. Plans, timings and labels name
-- their shard; a predicate may be asked of several families, whose figures are kept apart.
CREATE OR REPLACE VIEW shard_families AS
SELECT split, shard, min(family) AS family FROM scenes GROUP BY split, shard;

-- How the labels of the queries (goal objects left out) are balanced. Two rows of each plan are
-- of its goal objects, so that plans are counted without looking at their ids. Counting by the
-- flags first reads no row of gathered labels (`relevance compact`).
CREATE OR REPLACE VIEW label_balance AS
WITH counted AS (
    SELECT predicate, split, shard, policy, is_goal_object, relevant, ambiguous, count(*) AS n
    FROM labels
    GROUP BY predicate, split, shard, policy, is_goal_object, relevant, ambiguous
),
summed AS (
    SELECT
        family, predicate, split, policy,
        coalesce(sum(n) FILTER (is_goal_object), 0)::BIGINT // 2 AS plans,
        coalesce(sum(n) FILTER (NOT is_goal_object), 0)::BIGINT AS queries,
        coalesce(sum(n) FILTER (relevant AND NOT is_goal_object), 0)::BIGINT AS relevant,
        coalesce(sum(n) FILTER (ambiguous AND NOT is_goal_object), 0)::BIGINT AS ambiguous
    FROM counted LEFT JOIN shard_families USING (split, shard)
    GROUP BY family, predicate, split, policy
)
SELECT
    family, predicate, split, policy, plans, queries, relevant,
    relevant / nullif(queries, 0) AS relevant_share,
    ambiguous / nullif(queries, 0) AS ambiguous_share
FROM summed
ORDER BY family, predicate, split, policy;

-- The paper's table of label distribution: per family, predicate and split, over all plans
-- (n_actions = 'all') and by length of the plan. predicate = 'all' sums those of a family that is
-- asked several; one that is named as a predicate has no sum. Goals without a plan have no length, so only 'all' counts them.
CREATE OR REPLACE VIEW paper_label_distribution AS
WITH queries AS (
    SELECT plan_id, count(*) AS queries, count(*) FILTER (relevant) AS relevant
    FROM labels
    WHERE NOT is_goal_object
    GROUP BY plan_id
),
goals AS (
    SELECT
        s.family, p.predicate, p.split,
        CASE WHEN p.status = 'solved' THEN p.n_actions END AS n_actions,
        p.status = 'solved' AS solved, p.holds,
        coalesce(q.queries, 0) AS queries, coalesce(q.relevant, 0) AS relevant
    FROM plans AS p
    JOIN scenes AS s USING (scene_id)
    LEFT JOIN queries AS q USING (plan_id)
),
grouped AS (
    SELECT
        family, CASE WHEN grouping(predicate) = 1 THEN 'all' ELSE predicate END AS predicate, split,
        CASE WHEN grouping(n_actions) = 1 THEN 'all' ELSE n_actions::VARCHAR END AS n_actions,
        count(*) AS goals, count(*) FILTER (solved) AS solved, count(*) FILTER (holds) AS plans,
        sum(queries)::BIGINT AS queries, sum(relevant)::BIGINT AS relevant
    FROM goals
    GROUP BY GROUPING SETS (
        (family, predicate, split, n_actions), (family, predicate, split),
        (family, split, n_actions), (family, split)
    )
)
SELECT
    family, predicate, split, n_actions, goals, solved, plans, queries, relevant,
    relevant / nullif(queries, 0) AS relevant_share
FROM grouped
WHERE n_actions IS NOT NULL AND (
    predicate <> 'all' OR family NOT IN (SELECT predicate FROM plans) AND family IN (
        SELECT family FROM goals GROUP BY family HAVING count(DISTINCT predicate) > 1
    )
)
ORDER BY family, predicate, split, n_actions <> 'all', length(n_actions), n_actions;

-- How long the plans are.
CREATE OR REPLACE VIEW plan_lengths AS
SELECT
    family, predicate, split, n_actions,
    count(*) AS plans,
    count(*) / sum(count(*)) OVER (PARTITION BY family, predicate, split) AS share
FROM plans LEFT JOIN shard_families USING (split, shard)
WHERE holds
GROUP BY family, predicate, split, n_actions
ORDER BY ALL;

-- Goals that made no labels, by what ended the search, objects' names left out; a plan that a check
-- refuted or that the replay refused stands here too.
CREATE OR REPLACE VIEW plan_failures AS
SELECT
    family, predicate, split,
    CASE
        WHEN status <> 'solved' THEN status
        WHEN NOT check_ok THEN 'refuted by the dense check'
        ELSE 'refused'
    END AS status,
    CASE
        WHEN status = 'refused' THEN coalesce(nullif(replay_reason, ''), reason)
        WHEN status <> 'solved' OR NOT check_ok THEN reason
        ELSE replay_reason
    END.split_part('; ', -1)
    .regexp_replace(' while .+ stands? there$', ' while others stand there')
    .regexp_replace('^.+ stands on .+ and would', 'the subject stands on something and would')
    .regexp_replace(
        '^.+ (would have to leave|may not be moved|cannot be (taken|grasped))', 'something \1'
    ) AS reason,
    count(*) AS goals
FROM plans LEFT JOIN shard_families USING (split, shard)
WHERE NOT holds
GROUP BY ALL
ORDER BY family, predicate, split, goals DESC, status, reason;

-- Does every plan hold, and how many were replayed in the simulator?
CREATE OR REPLACE VIEW plan_verdicts AS
SELECT
    family, predicate, split,
    count(*) AS goals,
    count(*) FILTER (status = 'solved') AS solved,
    count(*) FILTER (holds) AS plans,
    count(*) FILTER (ambiguous AND holds) AS ambiguous,
    count(*) FILTER (replay_ok IS NOT NULL) AS replayed,
    count(*) FILTER (replay_ok) AS replay_ok,
    max(max_penetration) FILTER (holds) AS max_penetration,
    max(replay_max_penetration) FILTER (holds) AS replay_max_penetration
FROM plans LEFT JOIN shard_families USING (split, shard)
GROUP BY ALL
ORDER BY ALL;

-- Planning time in seconds, failures included.
CREATE OR REPLACE VIEW plan_seconds AS
SELECT
    family, predicate, split,
    count(*) AS goals,
    sum(seconds) AS total,
    avg(seconds) AS mean,
    median(seconds) AS median,
    quantile_cont(seconds, 0.9) AS p90,
    max(seconds) AS longest
FROM timings LEFT JOIN shard_families USING (split, shard)
GROUP BY ALL
ORDER BY ALL;

-- How much of the objects the images show.
CREATE OR REPLACE VIEW visibility AS
SELECT
    split, family,
    count(DISTINCT scene_id) AS scenes,
    count(*) AS objects,
    avg(visible_fraction) AS mean,
    min(visible_fraction) AS lowest,
    count(*) FILTER (visible_fraction < 0.5) / count(*) AS share_under_half,
    min(visible_pixels) AS fewest_pixels
FROM objects
GROUP BY ALL
ORDER BY ALL;

-- Scenes by number of boxes.
CREATE OR REPLACE VIEW scene_sizes AS
SELECT split, family, n_objects, count(*) AS scenes
FROM scenes
GROUP BY ALL
ORDER BY ALL;

-- Scenes that are in more than one split, or twice in one: must be empty.
CREATE OR REPLACE VIEW split_overlap AS
SELECT scene_id, list(DISTINCT split ORDER BY split) AS splits, count(*) AS scenes
FROM scenes
GROUP BY scene_id
HAVING count(*) > 1
ORDER BY scene_id;

-- Where the hours went: busy time of one process, s. Stages are scenes and the predicates.
CREATE OR REPLACE VIEW stage_seconds AS
SELECT
    family, stage, split,
    count(*) AS shards, sum(rows)::BIGINT AS rows,
    sum(seconds) AS seconds, sum(seconds_cpu) AS seconds_cpu,
    sum(rows) / nullif(sum(seconds), 0) AS rows_per_second
FROM durations LEFT JOIN shard_families USING (split, shard)
GROUP BY family, stage, split
ORDER BY family, stage, split;
