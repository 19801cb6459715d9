"""A dataset folder: its shards, tables and image tars, and DuckDB over them.

Every file is written to a temporary name and renamed; it exists whole or not at all. The
scenes file of a shard carries the hash of the shard's tar. Tars are written with the standard
library and read with webdataset, whose import loads torch: workers that make shards stay light.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import tarfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from relevance.scene import content_hash
from relevance.store.images import Pictures, Sample, decode, encode
from relevance.store.tables import (
    SCHEMAS,
    TABLES,
    DatasetError,
    nulls,
    one_line,
    read_footer,
    read_parquet,
    table_schema,
    to_parquet,
)

SPLITS = ("train", "validation", "test")

_STALE = 86_400.0  # s; a temporary file that old belongs to nobody
_READ = (
    "hive_partitioning = true, hive_types_autocast = false, filename = true, file_row_number = true"
)


def file_hash(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.{os.getpid()}-{os.urandom(3).hex()}.tmp"
    try:
        yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())  # the name must not outlive the bytes in a power cut
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


class Dataset:
    """A dataset folder (DESIGN section 5); see `open` and `create`."""

    def __init__(self, path: Path, description: dict[str, Any]) -> None:
        self.path = path
        self._description = description

    def __repr__(self) -> str:
        return f"Dataset({str(self.path)!r})"

    @classmethod
    def open(cls, path: str | Path) -> Dataset:
        """Open an existing dataset; raises DatasetError when there is none."""
        path = Path(path)
        file = path / "dataset.json"
        if not file.is_file():
            raise DatasetError(f"{path}: no dataset.json there, expected a dataset folder")
        try:
            description = json.loads(file.read_text())
        except (OSError, ValueError) as error:
            raise DatasetError(f"{file}: expected a JSON object, found {error}") from None
        if not isinstance(description, dict):
            raise DatasetError(f"{file}: expected a JSON object, found {type(description)}")
        return cls(path, description)

    @classmethod
    def create(cls, path: str | Path, description: Mapping[str, Any]) -> Dataset:
        """Make a dataset, or open the one that is there if its description is equal.

        Raises DatasetError that names the first difference otherwise.
        """
        path = Path(path)
        wanted = json.loads(json.dumps(description))
        if (path / "dataset.json").exists():
            there = cls.open(path)
            for key, found, expected in differences(there.description, wanted):
                raise DatasetError(
                    f"{path / 'dataset.json'}: {key}: the dataset was made with {found!r}, "
                    f"found {expected!r}; take another folder or the same settings"
                )
            there._sweep()
            return there
        dataset = cls(path, wanted)
        dataset.describe(wanted)
        return dataset

    @property
    def description(self) -> dict[str, Any]:
        """What dataset.json says."""
        return self._description

    def describe(self, description: Mapping[str, Any]) -> None:
        """Rewrite dataset.json (to append shards or to plan anew)."""
        text = json.dumps(description, indent=2, sort_keys=True) + "\n"
        with replacing(self.path / "dataset.json") as temporary:
            temporary.write_text(text)
        self._description = json.loads(text)

    # files ------------------------------------------------------------------------------------

    def shard_path(
        self,
        table: str,
        *,
        split: str | None = None,
        shard: int | None = None,
        predicate: str | None = None,
        name: str | None = None,
    ) -> Path:
        """The Parquet file of a shard; which keys it takes is `path` in the table's schema."""
        schema = table_schema(table)
        given = {"split": split, "shard": shard, "predicate": predicate, "name": name}
        given = {key: value for key, value in given.items() if value is not None}
        if set(given) != set(schema.keys):
            raise DatasetError(
                f"table {table}: expected {', '.join(schema.keys)} to name a file, "
                f"found {', '.join(given) or 'nothing'}"
            )
        if split is not None and split not in SPLITS:
            raise DatasetError(f"split {split!r}: expected one of {', '.join(SPLITS)}")
        if name is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
            raise DatasetError(f"name {name!r}: expected letters, digits, dot, dash, underscore")
        return self.path / schema.path.format(**given)

    def images_path(self, split: str, shard: int) -> Path:
        """The image tar of a shard."""
        return self.path / f"images/split={split}/shard-{shard:06d}.tar"

    def has(self, table: str, **keys: Any) -> bool:
        """Whether the file of that shard exists (then it is whole)."""
        return self.shard_path(table, **keys).is_file()

    def files(self, table: str, **where: Any) -> list[Path]:
        """Files of a table in order, only those whose path agrees with `where`."""
        keep = []
        for file in sorted((self.path / table).rglob("*.parquet")):
            parts = self.file_keys(file)
            if not file.name.startswith(".") and all(
                str(parts[key]) == str(value) for key, value in where.items() if key in parts
            ):
                keep.append(file)
        return keep

    def file_keys(self, file: Path) -> dict[str, Any]:
        """What a file's path says of its rows: `key=value` folders and the shard number."""
        parts: dict[str, Any] = {}
        for part in file.relative_to(self.path).parts[:-1]:
            key, sign, value = part.partition("=")
            if sign:
                parts[key] = value
        if found := re.fullmatch(r"shard-(\d+)", file.stem):
            parts["shard"] = int(found[1])
        return parts

    def shards(self, split: str, family: str | None = None) -> list[int]:
        """Numbers of the finished shards of a split (and family), in order."""
        families = {
            item["shard"]: item["family"]
            for item in self.description.get("shards", ())
            if item["split"] == split
        }
        numbers = [self.file_keys(file)["shard"] for file in self.files("scenes", split=split)]
        return [n for n in numbers if family is None or families.get(n) == family]

    def _sweep(self) -> None:
        for file in self.path.rglob(".*.tmp"):
            if time.time() - file.stat().st_mtime > _STALE:
                file.unlink(missing_ok=True)

    # tables -----------------------------------------------------------------------------------

    def write_rows(
        self,
        table: str,
        rows: Sequence[Mapping[str, Any]],
        *,
        split: str | None = None,
        shard: int | None = None,
        predicate: str | None = None,
        name: str | None = None,
        made_by: Mapping[str, str] | None = None,
    ) -> Path:
        """Write the rows of one file, checked against the schema; equal rows, equal bytes.

        A nullable column may be left out of a row. `made_by` goes to the file's metadata, see
        `metadata`. Raises DatasetError naming file, row, column, expected and found.
        """
        path = self.shard_path(table, split=split, shard=shard, predicate=predicate, name=name)
        content = to_parquet(table_schema(table), rows, made_by or {}, path)
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        return path

    def metadata(self, file: Path) -> dict[str, str]:
        """What a file's footer says: table, version, sha256 and what `made_by` gave."""
        return read_footer(table_schema(self._table_of(file)), file)

    def read_file(self, file: Path) -> pa.Table:
        """Read one Parquet file whole; hash, version and columns are checked."""
        return read_parquet(table_schema(self._table_of(file)), file)

    def read_rows(self, table: str, **where: Any) -> list[dict[str, Any]]:
        """Rows of a table as dicts, in the order of files and rows; `where` gives column=value."""
        schema = table_schema(table)
        unknown = set(where) - {column.name for column in schema.columns}
        if unknown:
            raise DatasetError(f"table {table}: has no column {sorted(unknown)[0]!r}")
        rows: list[dict[str, Any]] = []
        for file in self.files(table, **where):
            body = self.read_file(file)
            for key, value in where.items():
                body = body.filter(pc.field(key) == value)
            rows += body.to_pylist()
        return rows

    def _table_of(self, file: Path) -> str:
        return file.relative_to(self.path).parts[0]

    # images -----------------------------------------------------------------------------------

    def write_images(
        self, split: str, shard: int, samples: Iterable[tuple[str, Pictures, str]]
    ) -> dict[str, str]:
        """Write the image tar of a shard from (scene_id, pictures, scene JSON).

        Returns what the shard's scenes file must carry as `made_by`: the tar's hash and size.
        """
        path = self.images_path(split, shard)
        with replacing(path) as temporary:
            with tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:
                for key, pictures, scene_json in samples:
                    for member, content in encode(pictures, scene_json).items():
                        # a TarInfo's defaults are time 0, owner 0: equal bytes everywhere
                        info = tarfile.TarInfo(f"{key}.{member}")
                        info.size = len(content)
                        tar.addfile(info, io.BytesIO(content))
            made = {
                "images_sha256": file_hash(temporary),
                "images_bytes": str(temporary.stat().st_size),
            }
        return made

    def read_images(self, split: str, shard: int) -> bytes:
        """The image tar of a shard; raises DatasetError when it is not the one that was written."""
        path = self.images_path(split, shard)
        stored = self.metadata(self.shard_path("scenes", split=split, shard=shard))
        if "images_sha256" not in stored:
            raise DatasetError(
                f"{self.shard_path('scenes', split=split, shard=shard)}: metadata: "
                f"expected relevance.images_sha256, found none"
            )
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
        if len(content) != int(stored["images_bytes"]):
            state = "truncated" if len(content) < int(stored["images_bytes"]) else "too long"
            raise DatasetError(
                f"{path}: {state}: expected {stored['images_bytes']} bytes, found {len(content)}"
            )
        found = hashlib.sha256(content).hexdigest()
        if found != stored["images_sha256"]:
            raise DatasetError(
                f"{path}: content hash: expected {stored['images_sha256'][:16]}, "
                f"found {found[:16]}; the file was changed after it was written"
            )
        return content

    def samples(
        self,
        split: str,
        shards: Sequence[int] | None = None,
        *,
        shuffle_seed: int | None = None,
        buffer: int = 1000,
    ) -> Iterator[Sample]:
        """Scenes with their images, decoded; in stored order, or shuffled by `shuffle_seed`.

        Shuffling permutes the shards, then draws from a buffer of undecoded samples; it depends
        on the seed alone. Raises DatasetError naming a truncated, changed or missing tar.
        """
        # Here and not above: importing webdataset loads torch.
        from webdataset.filters import detshuffle
        from webdataset.tariterators import group_by_keys, tar_file_expander

        order = list(self.shards(split) if shards is None else shards)
        if shuffle_seed is not None:
            np.random.Generator(np.random.Philox(key=shuffle_seed)).shuffle(order)

        def sources() -> Iterator[dict[str, Any]]:
            for shard in order:
                content = io.BytesIO(self.read_images(split, shard))
                yield {"url": str(self.images_path(split, shard)), "stream": content}

        raw: Iterable[dict[str, Any]] = group_by_keys(tar_file_expander(sources()))
        if shuffle_seed is not None:
            raw = detshuffle(bufsize=buffer, initial=buffer, seed=shuffle_seed).run(raw)
        for item in raw:
            yield decode(item)

    # queries ----------------------------------------------------------------------------------

    def connect(
        self, *, origin: bool = False, without: Collection[Path] = (), memory: bool = False
    ) -> duckdb.DuckDBPyConnection:
        """DuckDB with a view per table and all of `schemas/views.sql`; paths are absolute.

        A table without files is an empty view. With `origin` the table views also have `file`
        (within the dataset) and `row` (from 0); files in `without` are left out. With `memory`
        the tables are copied, for many queries on a small dataset. Raises DatasetError for a
        file that does not have the schema's columns.
        """
        connection = duckdb.connect()
        for table in TABLES:
            schema = table_schema(table)
            files = [file for file in self.files(table) if file not in without]
            for file in files:
                self.metadata(file)
            if files:
                body = ", ".join(f'"{c.name}"::{c.type} AS "{c.name}"' for c in schema.columns)
                if origin:
                    start = len(str(self.path.resolve())) + 2
                    body += f", substr(filename, {start}) AS file, file_row_number AS row"
                if without:
                    source = "[" + ", ".join(_quoted(file.resolve()) for file in files) + "]"
                else:
                    source = _quoted(self.path.resolve() / table, "/**/*.parquet")
                body += f" FROM read_parquet({source}, {_READ})"
            else:
                body = nulls(schema.columns)
                if origin:
                    body += ", NULL::VARCHAR AS file, NULL::BIGINT AS row"
                body += " WHERE false"
            connection.execute(f"CREATE {'TABLE' if memory else 'VIEW'} {table} AS SELECT {body}")
        connection.execute((SCHEMAS / "views.sql").read_text())
        return connection

    def content_hash(self) -> str:
        """16 hex digits that change with any label or image (hashes kept in the files)."""
        hashes = {}
        for table, key in (("labels", "sha256"), ("scenes", "images_sha256")):
            for file in self.files(table):
                hashes[str(file.relative_to(self.path))] = self.metadata(file).get(key, "")
        return content_hash(hashes)


def _quoted(path: Path, pattern: str = "") -> str:
    """A path as SQL text; its own brackets, stars and question marks are names, not patterns."""
    escaped = re.sub(r"[\[*?]", r"[\g<0>]", str(path)) + pattern
    return "'" + escaped.replace("'", "''") + "'"


def sql(path: str | Path, query: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Column names and rows of a query over a dataset's views; DatasetError for a bad query."""
    with Dataset.open(path).connect() as connection:
        try:
            result = connection.execute(query)
            return [column[0] for column in result.description or ()], result.fetchall()
        except duckdb.Error as error:
            raise DatasetError(f"query: {one_line(error)}") from None


def differences(
    found: Any, expected: Any, prefix: str = "", ignore: Sequence[str] = ()
) -> Iterator[tuple[str, Any, Any]]:
    """Where two JSON values differ: (dotted key, value in the first, value in the second)."""
    if prefix in ignore:
        return
    if isinstance(found, dict) and isinstance(expected, dict):
        for key in sorted({*found, *expected}):
            dotted = f"{prefix}.{key}" if prefix else key
            yield from differences(found.get(key), expected.get(key), dotted, ignore)
    elif found != expected:
        yield prefix, found, expected
