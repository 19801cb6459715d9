"""What DuckDB reads of a table's files: SELECTs that give today's columns, whatever their age.

Every key of a file's way is a column in the file too, so nothing is read from folder names: a
folder above a dataset that is named `key=value` would change rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path

from relevance.store.files import Files
from relevance.store.paths import quoted
from relevance.store.tables import TableSchema, nulls


def scans(
    dataset: Files, schema: TableSchema, versions: Mapping[Path, int], *, origin: bool = False
) -> Iterator[str]:
    """A SELECT for each root (the dataset, its sources) and version of the files that are given.

    With `origin` they also have `file` (within the dataset) and `row` (from 0).
    """
    firsts = {source.dataset.path: source.first for source in dataset.sources}
    roots = sorted([dataset.path, *firsts], key=lambda path: -len(path.parts))

    def kind(file: Path) -> tuple[int, int]:
        root = next(i for i, path in enumerate(roots) if file.is_relative_to(path))
        return root, versions[file]

    for (number, version), group in groupby(sorted(versions, key=lambda f: (kind(f), f)), key=kind):
        files, root = list(group), roots[number]
        changed = {}
        if root in firsts and "shard" in schema.arrow.names:
            cases = " ".join(f"WHEN '{k}' THEN {v}" for k, v in firsts[root].items())
            changed["shard"] = f'"shard" + CASE "split" {cases} END'
        body = columns(schema, version, changed)
        if origin:
            # what `name_of` says of a file, without asking it for each of them
            name = dataset.name_of(files[0])
            prefix = name[: len(name) - len(str(files[0].relative_to(root)))]
            start = len(str(root.resolve())) + 2
            body += f", {literal(prefix)} || substr(filename, {start}) AS file"
            body += ", file_row_number AS row"
        yield f"SELECT {body} FROM {reading(files)}"


def columns(
    schema: TableSchema, version: int | None = None, changed: Mapping[str, str] | None = None
) -> str:
    """A SELECT list of today's columns of files of a version; `changed` gives some otherwise."""
    there = {column.name for column in schema.columns_of(version or schema.version)}
    given = {name: f'"{name}"' if name in there else "NULL" for name in schema.arrow.names}
    given |= changed or {}
    return ", ".join(f'({given[c.name]})::{c.type} AS "{c.name}"' for c in schema.columns)


def nothing(schema: TableSchema, *, origin: bool = False) -> str:
    """A SELECT of today's columns without a row."""
    more = ", NULL::VARCHAR AS file, NULL::BIGINT AS row" if origin else ""
    return f"SELECT {nulls(schema.columns)}{more} WHERE false"


def reading(files: Iterable[Path]) -> str:
    """What reads Parquet files, columns from the files alone."""
    listed = ", ".join(quoted(file.resolve()) for file in files)
    return f"read_parquet([{listed}], hive_partitioning = false, filename = true, " + (
        "file_row_number = true)"
    )


def literal(text: str) -> str:
    """Text as SQL."""
    return "'" + text.replace("'", "''") + "'"
