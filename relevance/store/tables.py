"""Tables: each is described once, in `schemas/TABLE.toml`, columns and properties.

Types are DuckDB's names; DuckDB turns them into the Arrow schema that every write and read is
checked against. A new table is a TOML file and what writes it; a new column is an entry of
that file, with `since` saying in which version of the table it came, and what writes it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa

from relevance.store.paths import DatasetError

SCHEMAS = Path(__file__).parents[2] / "schemas"
TABLES = tuple(sorted(file.stem for file in SCHEMAS.glob("*.toml")))
"""Every table that has a schema."""


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
    """Version of the table from which on files have it; older ones read as null."""
    fields: tuple[Mapping[str, Any], ...] = ()
    """Name, unit, meaning, nullable and since of the fields of a STRUCT."""


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
    beside: str = ""
    """Where files of another `Labelling` than the current one lie; empty when they do not."""
    sharded: bool = False
    """Made by generating and labelling, shard by shard; a merged dataset refers to it."""
    gathered: tuple[str, ...] = ()
    """The flags by which `compact` gathers it; empty when it does not."""
    exported: str = ""
    """What the card of an export says of it; empty when it is not exported."""

    @property
    def keys(self) -> tuple[str, ...]:
        """What must be named to point at one file."""
        return tuple(re.findall(r"{(\w+)", self.path))

    def columns_of(self, version: int) -> tuple[Column, ...]:
        """The columns that a file of that version has."""
        return tuple(column for column in self.columns if column.since <= version)

    def fields_of(self, version: int) -> dict[str, str]:
        """Names and types, in DuckDB's words, of what a file of that version has."""
        return {
            column.name: type_name(
                _without(
                    self.arrow.field(column.name).type,
                    {field["name"] for field in column.fields if field.get("since", 1) > version},
                )
            )
            for column in self.columns_of(version)
        }


@cache
def table_schema(table: str) -> TableSchema:
    """The schema of a table, read from `schemas/TABLE.toml`."""
    if table not in TABLES:
        raise DatasetError(f"unknown table {table!r}, expected one of {', '.join(TABLES)}")
    raw = tomllib.loads((SCHEMAS / f"{table}.toml").read_text(encoding="utf-8"))
    columns = tuple(
        Column(
            **{
                **column,
                "type": column["type"].strip(),
                "fields": tuple(column.get("fields", ())),
            }
        )
        for column in raw.pop("columns")
    )
    with duckdb.connect() as connection:
        empty = connection.sql(f"SELECT {nulls(columns)} LIMIT 0").to_arrow_table()
    return TableSchema(
        **{
            **{key: value for key, value in raw.items() if key != "table"},
            "name": raw["table"],
            "columns": columns,
            "arrow": empty.schema,
            "gathered": tuple(raw.get("gathered", ())),
        }
    )


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
    """The first paragraph of an error's message, in one line."""
    text = str(error).strip() or type(error).__name__
    return " ".join(re.split(r"\n\s*\n|\nLINE \d", text)[0].split())


def _without(kind: pa.DataType, younger: set[str]) -> pa.DataType:
    """A STRUCT, or lists of it, without some of its fields."""
    if pa.types.is_list(kind):
        return pa.list_(_without(kind.value_type, younger))
    if pa.types.is_struct(kind) and younger:
        return pa.struct([field for field in kind if field.name not in younger])
    return kind
