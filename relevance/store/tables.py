"""Tables: their schemas, and Parquet files that are checked against them.

A table is described once, in `schemas/TABLE.toml`, with DuckDB's type names; DuckDB turns them
into the Arrow schema that every write and read is checked against. A file carries the SHA-256
of all its other bytes in its own footer: no sidecar, so writing it is one rename, and one
flipped byte anywhere is noticed on reading. Equal rows give equal bytes: no clock, no host, no
worker in any file.
"""

from __future__ import annotations

import hashlib
import io
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from relevance.errors import RelevanceError
from relevance.store.places import is_remote

TABLES = (
    "scenes",
    "plans",
    "timings",
    "labels",
    "durations",
    "checkpoints",
    "predictions",
    "evaluations",
)
SCHEMAS = Path(__file__).parents[2] / "schemas"

_BLANK = "0" * 64  # stands in the footer while the rest is hashed


class DatasetError(RelevanceError):
    """A dataset that is not what it should be: file, column, expected and found in one line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column of a table as `schemas/` describes it."""

    name: str
    type: str
    """DuckDB's name of the type."""
    unit: str
    meaning: str
    nullable: bool = False
    since: int = 1
    """The version of the table that it came with."""
    fields: tuple[Mapping[str, Any], ...] = ()
    """Name, unit and meaning of the fields of a STRUCT."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableSchema:
    """One table: where its files are, its columns, and the Arrow schema they come to."""

    name: str
    version: int
    description: str
    path: str
    """File within the dataset, with `{split}`, `{shard}`, `{predicate}`, `{name}` open."""
    columns: tuple[Column, ...]
    arrow: pa.Schema

    @property
    def keys(self) -> tuple[str, ...]:
        """What must be named to point at one file."""
        return tuple(re.findall(r"{(\w+)", self.path))


@cache
def table_schema(table: str) -> TableSchema:
    """The schema of a table, read from `schemas/TABLE.toml`."""
    if table not in TABLES:
        raise DatasetError(f"unknown table {table!r}, expected one of {', '.join(TABLES)}")
    raw = tomllib.loads((SCHEMAS / f"{table}.toml").read_text())
    columns = tuple(
        Column(
            **{
                **column,
                "type": column["type"].strip(),
                "fields": tuple(column.get("fields", ())),
            }
        )
        for column in raw["columns"]
    )
    with duckdb.connect() as connection:
        empty = connection.sql(f"SELECT {nulls(columns)} LIMIT 0").to_arrow_table()
    return TableSchema(
        name=raw["table"],
        version=raw["version"],
        description=raw["description"],
        path=raw["path"],
        columns=columns,
        arrow=empty.schema,
    )


def to_parquet(
    schema: TableSchema,
    rows: Sequence[Mapping[str, Any]] | pa.Table,
    made_by: Mapping[str, str],
    where: Path,
) -> bytes:
    """The bytes of a Parquet file; raises DatasetError naming file, row, column, expected, found.

    A nullable column may be left out of a row. `made_by` goes into the file's metadata. An Arrow
    table of the schema is written as it is.
    """
    body = rows if isinstance(rows, pa.Table) else _to_arrow(schema, rows, where)
    buffer = io.BytesIO()
    with pq.ParquetWriter(
        buffer, schema.arrow, compression="zstd", write_page_checksum=True
    ) as writer:
        writer.write_table(body, row_group_size=1_000_000)
        writer.add_key_value_metadata(
            {
                "relevance.table": schema.name,
                "relevance.version": str(schema.version),
                **{f"relevance.{key}": value for key, value in made_by.items()},
                "relevance.sha256": _BLANK,
            }
        )
    blank = buffer.getvalue()
    assert blank.count(_BLANK.encode()) == 1, "the place of the hash must be unique"
    digest = hashlib.sha256(blank).hexdigest()
    return blank.replace(_BLANK.encode(), digest.encode())


@cache
def empty_size(table: str) -> int:
    """Bytes of a file of that table without any row."""
    return len(to_parquet(table_schema(table), [], {}, Path(table)))


def read_footer(schema: TableSchema, file: Path) -> dict[str, str]:
    """What a file's footer says: table, version, sha256 and what `made_by` gave.

    Raises DatasetError when it cannot be read or has not the schema's version and columns.
    """
    return _checked_footer(file, _opened(file, file).metadata, schema)


def read_parquet(schema: TableSchema, file: Path) -> pa.Table:
    """Read one file whole; raises DatasetError for a wrong hash, version, column or no file."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from None
    parquet = _opened(file, io.BytesIO(content))
    stored = _checked_footer(file, parquet.metadata, schema)["sha256"]
    found = hashlib.sha256(content.replace(stored.encode(), _BLANK.encode())).hexdigest()
    if found != stored:
        raise DatasetError(
            f"{file}: content hash: expected {stored[:16]}, found {found[:16]}; "
            "the file was changed after it was written"
        )
    try:
        return parquet.read(use_threads=len(content) > 1_000_000)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{file}: expected readable rows, found {one_line(error)}") from None


def type_name(kind: pa.DataType) -> str:
    """An Arrow type in DuckDB's words; what error messages and comparisons use."""
    if pa.types.is_struct(kind):
        fields = ", ".join(f"{field.name} {type_name(field.type)}" for field in kind)
        return f"STRUCT({fields})"
    if pa.types.is_fixed_size_list(kind):
        return f"{type_name(kind.value_type)}[{kind.list_size}]"
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return f"{type_name(kind.value_type)}[]"
    if pa.types.is_timestamp(kind):
        return "TIMESTAMP"
    names = {"string": "VARCHAR", "large_string": "VARCHAR", "bool": "BOOLEAN"}
    names |= {"int32": "INTEGER", "int64": "BIGINT", "double": "DOUBLE", "float": "FLOAT"}
    return names.get(str(kind), str(kind).upper())


def nulls(columns: Iterable[Column]) -> str:
    """A SELECT list of typed nulls, one for each column."""
    return ", ".join(f'NULL::{column.type} AS "{column.name}"' for column in columns)


def one_line(error: BaseException) -> str:
    """The first line of an error's message."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0]


def _opened(file: Path, source: Any) -> pq.ParquetFile:
    try:
        if is_remote(file) and source is file:
            # its end holds all that is asked for; one request
            with source.open("rb", cache_type="readahead", block_size=2**16) as stream:
                return pq.ParquetFile(stream, page_checksum_verification=True)
        return pq.ParquetFile(source, page_checksum_verification=True)
    except FileNotFoundError:
        raise DatasetError(f"{file}: does not exist, expected a Parquet file") from None
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(
            f"{file}: expected a whole Parquet file, found: {one_line(error)}"
        ) from None


def _checked_footer(file: Path, footer: pq.FileMetaData, schema: TableSchema) -> dict[str, str]:
    raw = footer.metadata or {}
    stored = {
        key.decode().removeprefix("relevance."): value.decode()
        for key, value in raw.items()
        if key.startswith(b"relevance.")
    }
    for key, expected in (("table", schema.name), ("version", str(schema.version))):
        if stored.get(key) != expected:
            raise DatasetError(
                f"{file}: {key} of the schema: expected {expected}, found {stored.get(key, 'none')}"
            )
    if not re.fullmatch(r"[0-9a-f]{64}", stored.get("sha256", "")):
        raise DatasetError(
            f"{file}: metadata relevance.sha256: expected 64 hex digits, "
            f"found {stored.get('sha256', 'none')}"
        )
    found = {field.name: type_name(field.type) for field in footer.schema.to_arrow_schema()}
    for field in schema.arrow:
        if field.name not in found:
            raise DatasetError(
                f"{file}: column {field.name}: expected {type_name(field.type)}, "
                "found no such column"
            )
        if found[field.name] != type_name(field.type):
            raise DatasetError(
                f"{file}: column {field.name}: expected {type_name(field.type)}, "
                f"found {found[field.name]}"
            )
    for name in found:
        if name not in schema.arrow.names:
            raise DatasetError(
                f"{file}: column {name}: expected no such column, found {found[name]}"
            )
    return stored


def _to_arrow(schema: TableSchema, rows: Sequence[Mapping[str, Any]], path: Path) -> pa.Table:
    known = {column.name for column in schema.columns}
    for index, row in enumerate(rows):
        if extra := set(row) - known:
            raise DatasetError(
                f"{path}: row {index}: column {min(extra)}: not in schema {schema.name}"
            )
    arrays = []
    for column in schema.columns:
        where = f"{path}: column {column.name}: expected {column.type}"
        values = [row.get(column.name) for row in rows]
        if not column.nullable and None in (value if value is None else 0 for value in values):
            index = next(i for i, value in enumerate(values) if value is None)
            raise DatasetError(f"{where}, found null in row {index}")
        if pa.types.is_integer(schema.arrow.field(column.name).type):
            for index, value in enumerate(values):  # Arrow would cut 2.5 to 2
                if value is not None and not isinstance(value, (int, np.integer)):
                    raise DatasetError(f"{where}, found {value!r} in row {index}")
        try:
            array = pa.array(values, type=schema.arrow.field(column.name).type)
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise DatasetError(f"{where}, found {one_line(error)}") from None
        optional = {str(field["name"]) for field in column.fields if field.get("nullable")}
        if problem := _hole(array, optional, top=True):
            raise DatasetError(f"{where}, found {problem}")
        arrays.append(array)
    return pa.Table.from_arrays(arrays, schema=schema.arrow)


def _hole(array: pa.Array, optional: set[str], *, top: bool = False) -> str | None:
    """A NaN anywhere, or a null inside a list or struct that has no room for it."""
    if not top and array.null_count:
        return "null inside"
    if pa.types.is_struct(array.type):
        for field, child in zip(array.type, array.drop_null().flatten(), strict=True):
            if problem := _hole(child, optional, top=field.name in optional):
                return f"{problem} ({field.name})"
    elif pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
        return _hole(array.drop_null().flatten(), optional)
    elif pa.types.is_floating(array.type):
        values = array.drop_null().to_numpy(zero_copy_only=False)
        return None if np.isfinite(values).all() else "NaN or infinity"
    return None
