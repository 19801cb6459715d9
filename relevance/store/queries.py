"""DuckDB over a dataset: a view for each table, and those of `schemas/*.sql`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from relevance.store import compacting, labellings
from relevance.store.files import Files
from relevance.store.needs import everything, needs, views
from relevance.store.paths import DatasetError, is_remote, listed
from relevance.store.scans import nothing, scans
from relevance.store.tables import TABLES, one_line, table_schema

_READING = ("SELECT", "MULTI")
"""Statements that read, in DuckDB's words: SELECT, FROM, WITH, SHOW, DESCRIBE, SUMMARIZE; PIVOT."""


def connect(
    dataset: Files,
    *,
    policy: str | None = None,
    origin: bool = False,
    without: Collection[Path] = (),
    memory: bool = False,
    names: Collection[str] | None = None,
) -> duckdb.DuckDBPyConnection:
    """See `Dataset.connect`; `names`: the tables and views that there will be, all when None."""
    names = everything() if names is None else names
    dataset.files_under("labels", policy)  # an unknown policy is an error whatever is asked
    bodies: dict[str, str] = {}
    for table in TABLES:
        if not {table, f"beside_{table}"} & {*names}:
            continue
        schema = table_schema(table)
        files = [file for file in dataset.files_under(table, policy) if file not in without]
        gathered = None
        if not origin and not without and policy in (None, _own(dataset)):
            gathered = compacting.fresh(dataset, table)
        made_by = {} if gathered else {file: _readable(dataset, file) for file in files}
        versions = {file: int(footer["version"]) for file, footer in made_by.items()}
        body = gathered or " UNION ALL ".join(scans(dataset, schema, versions, origin=origin))
        bodies[table] = body or nothing(schema, origin=origin)
        if f"beside_{table}" in names:
            beside = dict(_beside(dataset, table, files, made_by, without))
            body = " UNION ALL ".join(scans(dataset, schema, beside, origin=origin))
            bodies[f"beside_{table}"] = body or nothing(schema, origin=origin)
    connection = duckdb.connect()
    connection.execute("SET enable_progress_bar = false")
    if is_remote(dataset.path):
        # each file is opened for each query: without a listing it would be asked about each time
        connection.register_filesystem(listed(dataset.path))
    for name, body in bodies.items():
        try:
            connection.execute(f"CREATE {'TABLE' if memory else 'VIEW'} {name} AS {body}")
        except duckdb.Error as error:  # such as a gathered file whose footer was changed
            mend = f"`relevance repair {dataset.path}` mends it"
            raise DatasetError(f"{dataset.path}: {name}: {one_line(error)}; {mend}") from None
    for name, statement in views().items():
        if name in names:
            connection.execute(statement)
    return connection


def sql(
    path: str | Path, query: str, *, policy: str | None = None
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Column names and rows of a query over a dataset's views.

    A query is one statement that reads, other files too if it names them; nothing that writes,
    attaches or sets. Equal column names are told apart (name, name_1), decimals are floats.
    Raises DatasetError for anything else and for a bad query.
    """
    try:
        found = duckdb.extract_statements(query)
    except duckdb.Error as error:
        raise DatasetError(f"query: {one_line(error)}") from None
    if len(found) != 1:
        raise DatasetError(f"query: expected one statement, found {len(found) or 'none'}")
    if found[0].type.name not in _READING:
        raise DatasetError(
            f"query: {found[0].type.name}: expected a statement that reads (SELECT, FROM, ...)"
        )
    with connect(Files.open(path), policy=policy, names=needs(query)) as connection:
        try:
            result = connection.execute(found[0])
            names = [column[0] for column in result.description or ()]
            return _distinct(names), [tuple(map(_plain, row)) for row in result.fetchall()]
        except duckdb.Error as error:
            raise DatasetError(f"query: {one_line(error)}") from None


def arrays(
    connection: duckdb.DuckDBPyConnection, query: str, values: Sequence[Any] = ()
) -> dict[str, np.ndarray]:
    """A query's columns, (R,) each; its `$1`, `$2`, ... are `values`.

    Texts are NumPy's: as objects they would take most of the memory.
    """
    body = connection.sql(query, params=list(values)).to_arrow_table()
    return {name: _array(body[name]) for name in body.column_names}


def _array(column: pa.ChunkedArray) -> np.ndarray:
    if not pa.types.is_string(column.type):
        return column.to_numpy()
    texts = column.combine_chunks().dictionary_encode()
    return np.array(texts.dictionary.to_pylist(), str)[texts.indices.to_numpy()]


def replanned(
    new: str | Path, old: str | Path | None = None
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Columns and rows of the view `replanned`: what planning anew changed in a dataset.

    Compared with what it keeps beside its current labels, or with those of another folder, `old`,
    a copy of the same scenes that was labelled otherwise. Raises DatasetError when they have no
    planned goal in common.
    """
    with connect(Files.open(new)) as connection:
        if old is not None:
            with connect(Files.open(old)) as before:
                for table in ("plans", "labels"):
                    connection.register(
                        f"old_{table}", before.sql(f"FROM {table}").to_arrow_table()
                    )
                    connection.execute(f"CREATE OR REPLACE VIEW beside_{table} AS FROM old_{table}")
        found = connection.execute("FROM replanned")
        names = [column[0] for column in found.description or ()]
        rows = found.fetchall()
    if not rows:
        against = "other labels beside it" if old is None else f"goals of {old}"
        raise DatasetError(f"{new}: has no planned goal in common with {against}")
    return names, rows


def _own(dataset: Files) -> str | None:
    return dataset.labelling.policy if dataset.labelling else None


def _readable(dataset: Files, file: Path) -> dict[str, str]:
    try:
        return dataset.metadata(file)
    except DatasetError as error:
        raise DatasetError(f"{error}; `relevance repair {dataset.path}` mends it") from None


def _beside(
    dataset: Files,
    table: str,
    chosen: list[Path],
    footers: Mapping[Path, Mapping[str, str]],
    without: Collection[Path],
) -> Iterator[tuple[Path, int]]:
    """Every file of a table but the chosen ones, with its version.

    A shard that is being made anew is for a moment in two places: then the current one counts.
    """
    others = [dataset.files(table, of=of) for of in dataset.labellings()]
    if not any(others) and chosen == dataset.files(table):
        return
    seen = {
        _identity(dataset, table, file, footers.get(file) or _readable(dataset, file))
        for file in chosen
    }
    for file in dict.fromkeys(file for files in (dataset.files(table), *others) for file in files):
        if file in without or file in chosen:
            continue
        made_by = _readable(dataset, file)
        identity = _identity(dataset, table, file, made_by)
        if identity not in seen:
            seen.add(identity)
            yield file, int(made_by["version"])


def _identity(
    dataset: Files, table: str, file: Path, made_by: Mapping[str, str]
) -> tuple[Any, ...]:
    keys = dataset.file_keys(file)
    place = [keys.get(name) for name in ("predicate", "split", "shard")]
    return (*labellings.identity(table, made_by), *place)


def _distinct(names: Iterable[str]) -> list[str]:
    """Names with a number behind those that were there before."""
    names = list(names)
    found: list[str] = []
    for name in names:
        new, number = name, 0
        while new in found or (number and new in names):
            number += 1
            new = f"{name}_{number}"
        found.append(new)
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(_plain, value))
    return value
