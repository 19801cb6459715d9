"""Compaction: many small label files gathered into few large ones, for fast queries.

Rows are put into one file for each value of the flags that label queries ask for (`relevant`,
`is_goal_object`, `ambiguous`), as folders that DuckDB takes for columns: counting by them reads
no row at all. The shards stay what counts; the gathered files are a copy that queries use as
long as its manifest names exactly the shards that are there (by name, size and time of change).
Anything else, and queries read the shards again.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb

from relevance.store.places import is_remote, quoted
from relevance.store.tables import DatasetError, table_schema

if TYPE_CHECKING:
    from relevance.store.dataset import Dataset

FOLDER = "compacted"
TABLES = ("labels",)
FLAGS = ("is_goal_object", "relevant", "ambiguous")
ROW_GROUP = 1_000_000


def compact(dataset: Dataset) -> dict[str, int]:
    """Gather the current labels by predicate, split and flags; rows by table."""
    if is_remote(dataset.path) or dataset.sources:
        raise DatasetError(f"{dataset.path}: expected a local dataset that is not a merged one")
    folder = dataset.path / FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    rows: dict[str, int] = {}
    for table in TABLES:
        listed = _listing(dataset, table)
        policies = {dataset.metadata(file).get("policy") for file in dataset.files(table)}
        if not listed:
            continue
        if len(policies) != 1 or None in policies:
            found = ", ".join(sorted(map(str, policies)))
            raise DatasetError(f"{dataset.path}: {table}: expected one policy, found {found}")
        [policy] = policies
        for (predicate, split), files in _groups(dataset, table).items():
            target = folder / table / f"policy={policy}/predicate={predicate}/split={split}"
            target.mkdir(parents=True)
            rows[table] = rows.get(table, 0) + _gather(table, files, target)
        # last: without its manifest a half-made copy is not used
        (folder / f"{table}.json").write_text(json.dumps(listed))
    return rows


def fresh(dataset: Dataset) -> dict[str, str]:
    """The tables whose gathered files are those of today's shards, with what to read (SQL)."""
    found: dict[str, str] = {}
    if is_remote(dataset.path) or dataset.sources:
        return found
    for table in TABLES:
        folder = dataset.path / FOLDER
        manifest = folder / f"{table}.json"
        if manifest.is_file() and json.loads(manifest.read_text()) == _listing(dataset, table):
            files = sorted((folder / table).rglob("*.parquet"))
            found[table] = "[" + ", ".join(quoted(file.resolve()) for file in files) + "]"
    return found


def _listing(dataset: Dataset, table: str) -> list[list[Any]]:
    listed = []
    for file in dataset.files(table):
        known = file.stat()
        listed.append([dataset.name_of(file), known.st_size, known.st_mtime_ns])
    return listed


def _groups(dataset: Dataset, table: str) -> dict[tuple[str, str], list[Path]]:
    groups: dict[tuple[str, str], list[Path]] = {}
    for file in dataset.files(table):
        dataset.metadata(file)
        keys = dataset.file_keys(file)
        groups.setdefault((keys["predicate"], keys["split"]), []).append(file)
    return groups


def _gather(table: str, files: list[Path], target: Path) -> int:
    listed = ", ".join(quoted(file.resolve()) for file in files)
    columns = ", ".join(f'"{column.name}"' for column in table_schema(table).columns)
    place = str(target).replace("'", "''")
    with duckdb.connect() as connection:
        connection.execute("SET enable_progress_bar = false")
        made = connection.execute(
            f"COPY (SELECT {columns} FROM read_parquet([{listed}], hive_partitioning = false)) "
            f"TO '{place}' (FORMAT parquet, COMPRESSION zstd,"
            f" ROW_GROUP_SIZE {ROW_GROUP}, PARTITION_BY ({', '.join(FLAGS)}))"
        ).fetchone()
    assert made is not None, "COPY says how many rows it wrote"
    return int(made[0])
