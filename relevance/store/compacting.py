"""Compaction: many small label files gathered into few large ones, for fast queries.

Rows are put into one file for each value of the flags that label queries ask for (`gathered` in
the table's schema), and a view says each file's values as constants: counting by them reads no
row at all. The shards stay what counts; the gathered files are a copy that queries use as long
as its manifest names exactly the shards that are there, by name and hash, and the gathered files
are those that were written. Anything else, and queries read the shards again. That a file is as
it was written they see by its size and time of change; `relevance check` reads its bytes (see
`altered`).
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import Any

import duckdb

from relevance.store.files import Files
from relevance.store.parquet import content_mark
from relevance.store.paths import (
    DatasetError,
    file_hash,
    is_remote,
    keys_of,
    replacing,
    writing,
)
from relevance.store.scans import columns, literal, reading, scans
from relevance.store.tables import TABLES, one_line, table_schema

FOLDER = "compacted"
ROW_GROUP = 1_000_000
KEYS = ("policy", "predicate", "split")
"""What a gathered file's folders say besides the flags."""


def compact(dataset: Files) -> dict[str, int]:
    """Gather the current labels by predicate, split and flags; rows by table.

    An earlier copy stays in use until the new one is whole. Raises DatasetError for a merged or
    remote dataset, labels of several policies, and where nothing can be written.
    """
    if is_remote(dataset.path) or dataset.sources:
        raise DatasetError(f"{dataset.path}: expected a local dataset that is not a merged one")
    return {
        table: _compact(dataset, table)
        for table in TABLES
        if table_schema(table).gathered and dataset.files(table)
    }


def _compact(dataset: Files, table: str) -> int:
    footers = {file: dataset.metadata(file) for file in dataset.files(table)}
    policies = {footer.get("policy") for footer in footers.values()}
    if len(policies) != 1 or None in policies:
        found = ", ".join(sorted(map(str, policies)))
        raise DatasetError(f"{dataset.path}: {table}: expected one policy, found {found}")
    [policy] = policies
    manifest = dataset.path / FOLDER / f"{table}.json"
    with _emptied(manifest.parent / f"{table}-{os.urandom(4).hex()}") as folder:
        rows = 0
        for (predicate, split), files in _groups(dataset, table).items():
            target = folder / f"policy={policy}/predicate={predicate}/split={split}"
            with writing(target, target, dataset.path):
                target.mkdir(parents=True)
            versions = {file: int(footers[file]["version"]) for file in files}
            rows += _gather(dataset, table, versions, target)
        listed = {
            "version": table_schema(table).version,
            "folder": folder.name,
            "shards": {dataset.name_of(f): footer["sha256"] for f, footer in footers.items()},
            "files": {
                str(file.relative_to(folder)): [*_state(file), file_hash(file)]
                for file in sorted(folder.rglob("*.parquet"))
            },
        }
        # last: without its manifest a half-made copy is not used
        with replacing(manifest) as temporary:
            temporary.write_text(json.dumps(listed))
    for old in manifest.parent.glob(f"{table}*"):
        if old.is_dir() and old != folder:
            shutil.rmtree(old, ignore_errors=True)
    return rows


@contextmanager
def _emptied(folder: Path) -> Iterator[Path]:
    """A folder that is gone again when the block fails."""
    try:
        yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def fresh(dataset: Files, table: str) -> str | None:
    """A SELECT over the gathered files of a table; None unless they are those of today's shards."""
    written = _written(dataset, table)
    for file, (*state, digest) in written.items():
        if not file.is_file() or (_state(file) != state and file_hash(file) != digest):
            return None
    schema = table_schema(table)
    parts = []
    for folder, files in groupby(sorted(written), key=lambda file: file.parent):
        said = keys_of(folder.relative_to(dataset.path) / "x")
        constants = {key: literal(said[key]) for key in (*KEYS, *schema.gathered)}
        parts.append(f"SELECT {columns(schema, None, constants)} FROM {reading(files)}")
    return " UNION ALL ".join(parts) or None


def altered(dataset: Files) -> Iterator[tuple[str, str]]:
    """(file, message) of gathered files of today's shards whose bytes are not those written."""
    for table in TABLES:
        for file, (*_, digest) in _written(dataset, table).items():
            found = file_hash(file) if file.is_file() else "none"
            if found != digest:
                yield (
                    dataset.name_of(file),
                    f"content hash: expected {digest[:16]}, found {found[:16]}; the file was "
                    "changed after it was written (`relevance compact` makes it anew)",
                )


def _written(dataset: Files, table: str) -> dict[Path, list[Any]]:
    """The gathered files of a table: size, time of change and hash as they were written.

    None at all when there is half a copy, or one of another age or of other shards.
    """
    schema = table_schema(table)
    manifest = dataset.path / FOLDER / f"{table}.json"
    if not schema.gathered or is_remote(dataset.path) or not manifest.is_file():
        return {}
    with suppress(OSError, ValueError, KeyError, TypeError):
        listed = json.loads(manifest.read_text(encoding="utf-8"))
        folder, files = manifest.parent / listed["folder"], listed["files"]
        if listed["version"] == schema.version and listed["shards"] == _shards(dataset, table):
            return {
                folder / name: [size, time, digest] for name, (size, time, digest) in files.items()
            }
    return {}


def _shards(dataset: Files, table: str) -> dict[str, str | None]:
    """The hash of each shard by its name."""
    return {dataset.name_of(file): content_mark(file) for file in dataset.files(table)}


def _state(file: Path) -> list[int]:
    known = file.stat()
    return [known.st_size, known.st_mtime_ns]


def _groups(dataset: Files, table: str) -> dict[tuple[str, str], list[Path]]:
    groups: dict[tuple[str, str], list[Path]] = {}
    for file in dataset.files(table):
        keys = dataset.file_keys(file)
        groups.setdefault((keys["predicate"], keys["split"]), []).append(file)
    return groups


def _gather(dataset: Files, table: str, versions: dict[Path, int], target: Path) -> int:
    schema = table_schema(table)
    body = " UNION ALL ".join(scans(dataset, schema, versions))
    with duckdb.connect() as connection:
        connection.execute("SET enable_progress_bar = false")
        try:
            made: Any = connection.execute(
                f"COPY ({body}) TO {literal(str(target))} (FORMAT parquet, COMPRESSION zstd,"
                f" ROW_GROUP_SIZE {ROW_GROUP}, PARTITION_BY ({', '.join(schema.gathered)}))"
            ).fetchone()
        except duckdb.Error as error:
            raise DatasetError(f"{target}: cannot be written ({one_line(error)})") from None
    return int(made[0])
