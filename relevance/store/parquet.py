"""Parquet files of the tables, checked against their schemas.

A file carries the SHA-256 of all its other bytes in its own footer: no sidecar, so writing it is
one rename, and one flipped byte anywhere is noticed on reading. Equal rows give equal bytes: no
host, no worker in any file. A file of an older version of its schema has null in the columns
that are younger than it.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from relevance.store.paths import DatasetError, is_remote
from relevance.store.tables import TableSchema, one_line, table_schema, type_name

_BLANK = "0" * 64  # stands in the footer while the rest is hashed
_TAIL = 4096  # bytes at a file's end in which our part of the footer lies


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

    Raises DatasetError when it cannot be read, is of a younger version than the schema, or has
    not the columns of its own version.
    """
    return _checked_footer(file, _opened(file, file).metadata, schema)


def read_parquet(schema: TableSchema, file: Path) -> pa.Table:
    """Read one file whole; columns that are younger than it are null.

    Raises DatasetError for a wrong hash, column, younger version or no file.
    """
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
        body = parquet.read(use_threads=len(content) > 1_000_000)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{file}: expected readable rows, found {one_line(error)}") from None
    return body if body.schema.equals(schema.arrow) else _as_today(schema, body)


def content_mark(file: Path) -> str | None:
    """The SHA-256 that stands at a file's end, read without its footer; None when none does.

    A fraction of what `read_footer` takes, and tells two files apart as well.
    """
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - _TAIL))
        end = stream.read()
    found = re.search(rb"relevance\.sha256.{0,8}?([0-9a-f]{64})", end, re.DOTALL)
    return found[1].decode() if found and end.endswith(b"PAR1") else None


def _as_today(schema: TableSchema, body: pa.Table) -> pa.Table:
    """A file's rows with today's columns: younger ones, and younger fields, are null."""
    arrays = [
        body[field.name].cast(field.type)
        if field.name in body.column_names
        else pa.nulls(len(body), field.type)
        for field in schema.arrow
    ]
    return pa.Table.from_arrays(arrays, schema=schema.arrow)


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
    if stored.get("table") != schema.name:
        raise DatasetError(
            f"{file}: table of the schema: expected {schema.name}, "
            f"found {stored.get('table', 'none')}"
        )
    version = int(stored["version"]) if stored.get("version", "").isdecimal() else 0
    if not 1 <= version <= schema.version:
        younger = "; it was made by a younger relevance" if version else ""
        raise DatasetError(
            f"{file}: version of the schema: expected 1 to {schema.version}, "
            f"found {stored.get('version', 'none')}{younger}"
        )
    if not re.fullmatch(r"[0-9a-f]{64}", stored.get("sha256", "")):
        raise DatasetError(
            f"{file}: metadata relevance.sha256: expected 64 hex digits, "
            f"found {stored.get('sha256', 'none')}"
        )
    arrow = footer.schema.to_arrow_schema()
    if version == schema.version and arrow.equals(schema.arrow):
        return stored
    found = {field.name: type_name(field.type) for field in arrow}
    expected = schema.fields_of(version)
    for name, kind in expected.items():
        if found.get(name) != kind:
            raise DatasetError(
                f"{file}: column {name}: expected {kind}, found {found.get(name, 'no such column')}"
            )
    for name in found:
        if name not in expected:
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
