"""DuckDB over a dataset: a view for each table, and those of `schemas/*.sql`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb

from relevance.store import compacting
from relevance.store.places import filesystem, is_remote, quoted
from relevance.store.tables import (
    SCHEMAS,
    TABLES,
    DatasetError,
    TableSchema,
    nulls,
    one_line,
    table_schema,
)

if TYPE_CHECKING:
    from relevance.store.dataset import Dataset

BESIDE = ("plans", "labels")
"""The tables that have a view `beside_TABLE` of what is beside the current rows."""

_READ = (
    "hive_partitioning = true, hive_types_autocast = false, filename = true, file_row_number = true"
)


def connect(
    dataset: Dataset,
    *,
    policy: str | None = None,
    origin: bool = False,
    without: Collection[Path] = (),
    memory: bool = False,
) -> duckdb.DuckDBPyConnection:
    """See `Dataset.connect`."""
    connection = duckdb.connect()
    connection.execute("SET enable_progress_bar = false")
    if is_remote(dataset.path):
        connection.register_filesystem(filesystem(dataset.path))
    kind = "TABLE" if memory else "VIEW"
    compacted = {} if origin or without else compacting.fresh(dataset)
    for table in TABLES:
        schema = table_schema(table)
        files = _files_of(dataset, table, policy)
        files = [file for file in files if file not in without]
        if table in compacted and policy is None:
            parts = [f"SELECT {_columns(schema)} FROM read_parquet({compacted[table]}, {_READ})"]
        else:
            for file in files:
                dataset.metadata(file)
            parts = list(_scans(dataset, schema, files, origin))
        body = " UNION ALL ".join(parts) or _nothing(schema, origin)
        connection.execute(f"CREATE {kind} {table} AS {body}")
    for table in BESIDE:
        schema = table_schema(table)
        files: list[Path] = []
        if (dataset.path / "beside").is_dir() or dataset.sources:
            chosen = _files_of(dataset, table, policy)
            files = list(_beside(dataset, table, chosen, without))
        body = " UNION ALL ".join(_scans(dataset, schema, files, origin))
        connection.execute(f"CREATE {kind} beside_{table} AS {body or _nothing(schema, origin)}")
    for file in ("views.sql", "changes.sql", "card.sql"):
        connection.execute((SCHEMAS / file).read_text())
    return connection


def sql(
    path: str | Path, query: str, *, policy: str | None = None
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Column names and rows of a query over a dataset's views; DatasetError for a bad query."""
    from relevance.store.dataset import Dataset

    with Dataset.open(path).connect(policy=policy) as connection:
        try:
            result = connection.execute(query)
            return [column[0] for column in result.description or ()], result.fetchall()
        except duckdb.Error as error:
            raise DatasetError(f"query: {one_line(error)}") from None


def _files_of(dataset: Dataset, table: str, policy: str | None) -> list[Path]:
    """The files of a table; labels by the policy that is asked for."""
    current = dataset.labelling
    if table != "labels" or policy is None or current is None or policy == current.policy:
        return dataset.files(table)
    if not dataset.sources:
        return dataset.files(table, of=replace(current, policy=policy))
    return [
        file
        for source in dataset.sources
        for file in _files_of(source.dataset, table, policy)
        if "shard" in dataset.file_keys(file)
    ]


def _beside(
    dataset: Dataset, table: str, chosen: list[Path], without: Collection[Path]
) -> Iterator[Path]:
    """Every file of a table but the chosen ones.

    A shard that is being made anew is for a moment in two places: then the current one counts.
    """
    seen = {_identity(dataset, table, file) for file in chosen if file not in without}
    places = [dataset.files(table), *(dataset.files(table, of=of) for of in dataset.labellings())]
    for file in dict.fromkeys(file for files in places for file in files if file not in without):
        identity = _identity(dataset, table, file)
        if identity not in seen:
            seen.add(identity)
            yield file


def _identity(dataset: Dataset, table: str, file: Path) -> tuple[Any, ...]:
    keys, made_by = dataset.file_keys(file), dataset.metadata(file)
    by = [made_by.get(name) for name in ("planner", "config", *(["policy"] * (table == "labels")))]
    return (*by, keys.get("predicate"), keys.get("split"), keys.get("shard"))


def _columns(schema: TableSchema, changed: Mapping[str, str] | None = None) -> str:
    return ", ".join(
        f'({(changed or {}).get(c.name) or _name(c.name)})::{c.type} AS "{c.name}"'
        for c in schema.columns
    )


def _name(column: str) -> str:
    return f'"{column}"'


def _nothing(schema: TableSchema, origin: bool) -> str:
    more = ", NULL::VARCHAR AS file, NULL::BIGINT AS row" if origin else ""
    return f"SELECT {nulls(schema.columns)}{more} WHERE false"


def _scans(
    dataset: Dataset, schema: TableSchema, files: Iterable[Path], origin: bool
) -> Iterator[str]:
    """A SELECT for the files of the dataset itself and of each of its sources."""
    left = list(files)
    for source in (None, *dataset.sources):
        root = dataset.path if source is None else source.dataset.path
        mine = [file for file in left if file.is_relative_to(root)]
        left = [file for file in left if not file.is_relative_to(root)]
        if not mine:
            continue
        changed = {}
        if source is not None:
            cases = " ".join(f"WHEN '{k}' THEN {v}" for k, v in source.first.items())
            changed["shard"] = f'"shard" + CASE "split" {cases} END'
        body = _columns(schema, changed)
        if origin:
            # what `name_of` says of a file, without asking it for each of them
            prefix = dataset.name_of(mine[0])[: -len(str(mine[0].relative_to(root)))]
            start = len(str(root.resolve())) + 2
            body += (
                f", {_literal(prefix)} || substr(filename, {start}) AS file, file_row_number AS row"
            )
        listed = ", ".join(quoted(file.resolve()) for file in mine)
        yield f"SELECT {body} FROM read_parquet([{listed}], {_READ})"


def _literal(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
