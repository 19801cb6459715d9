-- One view per table, for plain DuckDB. `relevance sql` makes the same views by itself.
--
--   duckdb -cmd "SET VARIABLE dataset = 'DATASET'" -init schemas/tables.sql
--   D .read schemas/views.sql
--   D FROM label_balance;
--
-- The short form, for one table in one query:
--   FROM read_parquet('DATASET/labels/**/*.parquet', hive_partitioning = true)
-- A table of which the dataset has no file yet answers "No files found"; go on with the rest.

CREATE OR REPLACE VIEW scenes AS
FROM read_parquet(getvariable('dataset') || '/scenes/**/*.parquet', hive_partitioning = true);

CREATE OR REPLACE VIEW plans AS
FROM read_parquet(getvariable('dataset') || '/plans/**/*.parquet', hive_partitioning = true);

CREATE OR REPLACE VIEW timings AS
FROM read_parquet(getvariable('dataset') || '/timings/**/*.parquet', hive_partitioning = true);

CREATE OR REPLACE VIEW labels AS
FROM read_parquet(getvariable('dataset') || '/labels/**/*.parquet', hive_partitioning = true);

CREATE OR REPLACE VIEW durations AS
FROM read_parquet(getvariable('dataset') || '/durations/**/*.parquet', hive_partitioning = true);

-- What was made by another planner, goal set or label policy; see all_labels, label_changes.
CREATE OR REPLACE VIEW beside_plans AS
SELECT * EXCLUDE (planner, config) FROM read_parquet(
    getvariable('dataset') || '/beside/*/*/plans/**/*.parquet',
    hive_partitioning = true, hive_types_autocast = false
);

CREATE OR REPLACE VIEW beside_labels AS
SELECT * EXCLUDE (planner, config) FROM read_parquet(
    getvariable('dataset') || '/beside/*/*/labels/**/*.parquet',
    hive_partitioning = true, hive_types_autocast = false
);

CREATE OR REPLACE VIEW checkpoints AS
FROM read_parquet(getvariable('dataset') || '/checkpoints/*.parquet');

CREATE OR REPLACE VIEW predictions AS
FROM read_parquet(
    getvariable('dataset') || '/predictions/**/*.parquet',
    hive_partitioning = true, hive_types_autocast = false
);

CREATE OR REPLACE VIEW evaluations AS
FROM read_parquet(
    getvariable('dataset') || '/evaluations/**/*.parquet',
    hive_partitioning = true, hive_types_autocast = false
);
