-- Views about how right networks are. Plain DuckDB SQL; shares are 0..1.

-- One row an object and what carries it, over others too: a box on a box on `base` stands on it.
CREATE OR REPLACE VIEW carried AS
WITH RECURSIVE carried AS (
    SELECT split, scene_id, name, stands_on AS base
    FROM objects
    WHERE stands_on IS NOT NULL
    UNION
    SELECT c.split, c.scene_id, c.name, o.stands_on AS base
    FROM carried AS c
    JOIN objects AS o ON o.split = c.split AND o.scene_id = c.scene_id AND o.name = c.base
    WHERE o.stands_on IS NOT NULL
)
SELECT split, scene_id, name, base FROM carried;

-- One row an object of a goal that a checkpoint was asked about, judged by the present label:
-- `score` is what it decides by (kept iff score > -beta), `raw_score` what the network said.
-- `stands` is where the query stands: on the subject, on the reference, or elsewhere.
CREATE OR REPLACE VIEW judged AS
WITH
on_subject AS (SELECT split, scene_id, name AS query, base AS subject, true AS yes FROM carried),
on_reference AS (
    SELECT split, scene_id, name AS query, base AS reference, true AS yes FROM carried
)
SELECT
    p.checkpoint_id, p.split, s.family, p.scene_id, p.predicate, p.subject, p.reference, p.query,
    l.policy, l.is_goal_object, l.relevant, l.ambiguous, l.visible_fraction, s.n_objects,
    CASE
        WHEN a.yes THEN 'on the subject'
        WHEN b.yes THEN 'on the reference'
        ELSE 'elsewhere'
    END AS stands,
    p.score, p.score - coalesce(p."offset", 0) AS raw_score
FROM predictions AS p
JOIN labels AS l USING (split, scene_id, predicate, subject, reference, query)
JOIN scenes AS s USING (split, scene_id)
LEFT JOIN on_subject AS a USING (split, scene_id, query, subject)
LEFT JOIN on_reference AS b USING (split, scene_id, query, reference);
