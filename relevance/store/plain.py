"""`schemas/tables.sql`: the table views for plain DuckDB, made of the tables' schemas.

python -m relevance.store.plain > schemas/tables.sql
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from relevance.store.tables import TABLES, TableSchema, nulls, table_schema

_HEAD = """\
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
"""


def tables_sql() -> str:
    """The text of `schemas/tables.sql`."""
    return _HEAD + "".join(statement for table in TABLES for statement in _views(table))


def _views(table: str) -> Iterator[str]:
    schema = table_schema(table)
    yield _view(table, schema, schema.path)
    if schema.beside:
        yield _view(f"beside_{table}", schema, schema.beside)


def _view(name: str, schema: TableSchema, path: str) -> str:
    folders, _, _ = re.sub(r"{[^}]*}", "*", path).rpartition("/")
    younger = [column for column in schema.columns if column.since > 1]
    more = f"\nUNION ALL BY NAME SELECT {nulls(younger)} WHERE false" if younger else ""
    return f"""
CREATE OR REPLACE VIEW {name} AS
FROM read_parquet(
    getvariable('dataset') || '/{folders}/*.parquet',
    hive_partitioning = false, union_by_name = true
){more};
"""


if __name__ == "__main__":
    print(tables_sql(), end="")
