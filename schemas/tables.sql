-- One view per table, for plain DuckDB. `relevance sql` makes the same views by itself. Made of
-- schemas/*.toml by `python -m relevance.store.plain`; a test compares.
--
--   duckdb -cmd "SET VARIABLE dataset = 'DATASET'" -init schemas/tables.sql
--   D .read schemas/views.sql
--   D FROM label_balance;
--
-- The short form, for one table in one query:
--   FROM read_parquet('DATASET/labels/**/*.parquet', hive_partitioning = false)
-- All that folder names say is in columns too; reading it from the folders would go wrong below a
-- folder like `seed=3`. A table of which the dataset has no file yet answers "No files found"; go
-- on with the rest. Columns that are younger than a file are null.

CREATE OR REPLACE VIEW checkpoints AS
FROM read_parquet(
    getvariable('dataset') || '/checkpoints/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR AS "offsets" WHERE false;

CREATE OR REPLACE VIEW durations AS
FROM read_parquet(
    getvariable('dataset') || '/durations/stage=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
);

CREATE OR REPLACE VIEW evaluations AS
FROM read_parquet(
    getvariable('dataset') || '/evaluations/checkpoint_id=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR AS "prior", NULL::VARCHAR AS "suite", NULL::VARCHAR AS "stop", NULL::BOOLEAN AS "looked", NULL::BIGINT AS "sequences", NULL::BIGINT AS "sequences_unguided", NULL::DOUBLE AS "seconds_encoding" WHERE false;

CREATE OR REPLACE VIEW labels AS
FROM read_parquet(
    getvariable('dataset') || '/labels/predicate=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR AS "because" WHERE false;

CREATE OR REPLACE VIEW beside_labels AS
FROM read_parquet(
    getvariable('dataset') || '/beside/planner=*/config=*/labels/policy=*/predicate=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR AS "because" WHERE false;

CREATE OR REPLACE VIEW plans AS
FROM read_parquet(
    getvariable('dataset') || '/plans/predicate=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR[][] AS "alternatives", NULL::VARCHAR[] AS "blocking" WHERE false;

CREATE OR REPLACE VIEW beside_plans AS
FROM read_parquet(
    getvariable('dataset') || '/beside/planner=*/config=*/plans/predicate=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR[][] AS "alternatives", NULL::VARCHAR[] AS "blocking" WHERE false;

CREATE OR REPLACE VIEW predictions AS
FROM read_parquet(
    getvariable('dataset') || '/predictions/checkpoint_id=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::DOUBLE AS "offset" WHERE false;

CREATE OR REPLACE VIEW scenes AS
FROM read_parquet(
    getvariable('dataset') || '/scenes/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
)
UNION ALL BY NAME SELECT NULL::VARCHAR AS "sampler_version", NULL::VARCHAR AS "renderer_version" WHERE false;

CREATE OR REPLACE VIEW timings AS
FROM read_parquet(
    getvariable('dataset') || '/timings/predicate=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
);

CREATE OR REPLACE VIEW beside_timings AS
FROM read_parquet(
    getvariable('dataset') || '/beside/planner=*/config=*/timings/predicate=*/split=*/*.parquet',
    hive_partitioning = false, union_by_name = true
);
