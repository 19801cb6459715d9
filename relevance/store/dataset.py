"""A dataset folder: its shards, tables and image tars, and DuckDB over them.

Every file is written to a temporary name and renamed; it exists whole or not at all. The
scenes file of a shard carries the hash of the shard's tar, a WebDataset that any reader of those
takes. webdataset itself shuffles here; its import loads torch, which making shards does not need.

Plans and labels of another planner version, goal set or label policy live beside the current
ones, in `beside/planner=V/config=HASH/`, see `Labelling`. A merged dataset holds the shards of
its sources by reference, see `Source`.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import tarfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from relevance.hashing import content_hash
from relevance.store import queries
from relevance.store.images import Pictures, Sample, decode, encode, undecoded
from relevance.store.places import file_hash, is_remote, locate, replacing, sweep
from relevance.store.tables import (
    DatasetError,
    read_footer,
    read_parquet,
    table_schema,
    to_parquet,
)

SPLITS = ("train", "validation", "test")

SHARDED = ("scenes", "plans", "timings", "labels", "durations")
"""The tables that generating and labelling make, which a merged dataset refers to."""


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Labelling:
    """One way in which a dataset's goals were planned and labelled."""

    planner: str
    """Version of the planner."""
    config: str
    """Hash of the plan settings, goal set included."""
    policy: str
    """How relevance was read from the plans."""

    @property
    def made_by(self) -> dict[str, str]:
        """What the footer of a labels file says."""
        return {**self.planned_by, "policy": self.policy}

    @property
    def planned_by(self) -> dict[str, str]:
        """What the footer of a plans file says."""
        return {"config": self.config, "planner": self.planner}


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A dataset whose shards a merged dataset refers to."""

    dataset: Dataset
    first: Mapping[str, int]
    """The number that its shard 0 of each split has in the merged dataset."""
    count: Mapping[str, int]
    """Its number of shards of each split when it was merged."""

    def number(self, split: str, shard: int) -> int | None:
        """The merged dataset's number of a shard; None when it was made after the merge."""
        return self.first[split] + shard if shard < self.count[split] else None


class Dataset:
    """A dataset folder (DESIGN section 5); see `open` and `create`."""

    def __init__(self, path: Path, description: dict[str, Any]) -> None:
        self.path = path
        self._description = description
        self.sources = tuple(self._sources())

    def _sources(self) -> Iterator[Source]:
        for item in self._description.get("sources", ()):
            path = locate(item["path"])
            if not is_remote(path):
                path = Path(os.path.normpath(self.path / path))
            yield Source(dataset=Dataset.open(path), first=item["first"], count=item["count"])

    def __repr__(self) -> str:
        return f"Dataset({str(self.path)!r})"

    @classmethod
    def open(cls, path: str | Path) -> Dataset:
        """Open an existing dataset; raises DatasetError when there is none."""
        path = locate(path)
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
        path = locate(path)
        wanted = json.loads(json.dumps(description))
        if (path / "dataset.json").exists():
            there = cls.open(path)
            for key, found, expected in differences(there.description, wanted):
                raise DatasetError(
                    f"{path / 'dataset.json'}: {key}: the dataset was made with {found!r}, "
                    f"found {expected!r}; take another folder or the same settings"
                )
            sweep(path)
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
        stage: str | None = None,
        of: Labelling | None = None,
    ) -> Path:
        """The Parquet file of a shard; which keys it takes is `path` in the table's schema.

        `of` asks for plans, timings or labels beside the current ones.
        """
        schema = table_schema(table)
        given = {"split": split, "shard": shard, "predicate": predicate, "name": name}
        given = {k: v for k, v in {**given, "stage": stage}.items() if v is not None}
        if set(given) != set(schema.keys):
            raise DatasetError(
                f"table {table}: expected {', '.join(schema.keys)} to name a file, "
                f"found {', '.join(given) or 'nothing'}"
            )
        if split is not None and split not in SPLITS:
            raise DatasetError(f"split {split!r}: expected one of {', '.join(SPLITS)}")
        if name is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
            raise DatasetError(f"name {name!r}: expected letters, digits, dot, dash, underscore")
        home = self
        if split is not None and shard is not None and table in SHARDED:
            home, given["shard"] = self._home(split, shard)
        file = schema.path.format(**given).removeprefix(f"{table}/")
        return home.path / _folder(table, of) / file

    def images_path(self, split: str, shard: int) -> Path:
        """The image tar of a shard."""
        home, number = self._home(split, shard)
        return home.path / f"images/split={split}/shard-{number:06d}.tar"

    def _home(self, split: str, shard: int) -> tuple[Dataset, int]:
        """The dataset that holds a shard, and its number there."""
        for source in self.sources:
            number = shard - source.first[split]
            if 0 <= number < source.count[split]:
                return source.dataset._home(split, number)
        return self, shard

    def has(self, table: str, **keys: Any) -> bool:
        """Whether the file of that shard exists (then it is whole)."""
        return self.shard_path(table, **keys).is_file()

    def files(self, table: str, *, of: Labelling | None = None, **where: Any) -> list[Path]:
        """Files of a table in order, only those whose path agrees with `where`.

        `of` asks for plans, timings or labels beside the current ones.
        """
        found = (self.path / _folder(table, of)).rglob("*.parquet")
        keep = [file for file in sorted(found) if not file.name.startswith(".")]
        if table in SHARDED:
            for source in self.sources:
                mine = source.dataset.files(table, of=of)
                keep += [file for file in mine if "shard" in self.file_keys(file)]
        return [file for file in keep if _agrees(self.file_keys(file), where)]

    def labellings(self) -> list[Labelling]:
        """The labellings that are beside the current one (some of their shards, at least)."""
        found = {labelling for s in self.sources for labelling in s.dataset.labellings()}
        for file in (self.path / "beside").rglob("labels/**/*.parquet"):
            keys = self.file_keys(file)
            if not file.name.startswith("."):
                mine = (keys["planner"], keys["config"], keys["policy"])
                found.add(Labelling(planner=mine[0], config=mine[1], policy=mine[2]))
        return sorted(found)

    def files_beside(self) -> list[Path]:
        """Every file of the labellings that are beside the current one."""
        files = [
            file
            for of in self.labellings()
            for table in ("plans", "timings", "labels")
            for file in self.files(table, of=of)
        ]
        return list(dict.fromkeys(files))

    @property
    def labelling(self) -> Labelling | None:
        """How the dataset is labelled now; None when dataset.json does not say it.

        A merged dataset's is that of its first source.
        """
        if self.sources:
            return self.sources[0].dataset.labelling
        said = self.description
        try:
            return Labelling(
                planner=said["planner_version"],
                config=said["hashes"]["plans"],
                policy=said["config"]["policy"],
            )
        except (KeyError, TypeError):
            return None

    def file_keys(self, file: Path) -> dict[str, Any]:
        """What a file's path says of its rows: `key=value` folders and the shard number.

        A source's shard that was made after the merge has no number.
        """
        for source in self.sources:
            if file.is_relative_to(source.dataset.path) and not file.is_relative_to(self.path):
                parts = source.dataset.file_keys(file)
                if "shard" in parts:
                    number = source.number(parts["split"], parts.pop("shard"))
                    return parts if number is None else {**parts, "shard": number}
                return parts
        parts = {}
        for part in file.relative_to(self.path).parts[:-1]:
            key, sign, value = part.partition("=")
            if sign:
                parts[key] = value
        if found := re.fullmatch(r"shard-(\d+)", file.stem):
            parts["shard"] = int(found[1])
        return parts

    def name_of(self, file: Path) -> str:
        """A file's name within the dataset; a source's file by its way there."""
        if file.is_relative_to(self.path):
            return str(file.relative_to(self.path))
        return str(file) if is_remote(file) else os.path.relpath(file, self.path)

    def shards(self, split: str, family: str | None = None) -> list[int]:
        """Numbers of the finished shards of a split (and family), in order."""
        families = {
            item["shard"]: item["family"]
            for item in self.description.get("shards", ())
            if item["split"] == split
        }
        numbers = [self.file_keys(file)["shard"] for file in self.files("scenes", split=split)]
        return sorted(n for n in numbers if family is None or families.get(n) == family)

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
        stage: str | None = None,
        of: Labelling | None = None,
        made_by: Mapping[str, str] | None = None,
    ) -> Path:
        """Write the rows of one file, checked against the schema; equal rows, equal bytes.

        A nullable column may be left out of a row. `made_by` goes to the file's metadata, see
        `metadata`. Raises DatasetError naming file, row, column, expected and found.
        """
        path = self.shard_path(
            table, split=split, shard=shard, predicate=predicate, name=name, stage=stage, of=of
        )
        content = to_parquet(table_schema(table), rows, made_by or {}, path)
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        return path

    def metadata(self, file: Path) -> dict[str, str]:
        """What a file's footer says: table, version, sha256 and what `made_by` gave."""
        return read_footer(table_schema(self._table_of(file)), file)

    def read_file(self, file: Path) -> pa.Table:
        """Read one Parquet file whole; hash, version and columns are checked."""
        body = read_parquet(table_schema(self._table_of(file)), file)
        keys = self.file_keys(file)
        if self.sources and "shard" in keys and "shard" in body.column_names and len(body):
            field = body.schema.field("shard")
            numbers = pa.array([keys["shard"]] * len(body), type=field.type)
            body = body.set_column(body.column_names.index("shard"), field, numbers)
        return body

    def read_rows(
        self, table: str, *, of: Labelling | None = None, **where: Any
    ) -> list[dict[str, Any]]:
        """Rows of a table as dicts, in the order of files and rows; `where` gives column=value."""
        schema = table_schema(table)
        unknown = set(where) - {column.name for column in schema.columns}
        if unknown:
            raise DatasetError(f"table {table}: has no column {sorted(unknown)[0]!r}")
        rows: list[dict[str, Any]] = []
        for file in self.files(table, of=of, **where):
            body = self.read_file(file)
            for key, value in where.items():
                body = body.filter(pc.field(key) == value)
            rows += body.to_pylist()
        return rows

    def _table_of(self, file: Path) -> str:
        for source in self.sources:
            if file.is_relative_to(source.dataset.path) and not file.is_relative_to(self.path):
                return source.dataset._table_of(file)
        parts = file.relative_to(self.path).parts
        return parts[3] if parts[0] == "beside" else parts[0]

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
        order = list(self.shards(split) if shards is None else shards)
        if shuffle_seed is not None:
            np.random.Generator(np.random.Philox(key=shuffle_seed)).shuffle(order)

        raw: Iterable[dict[str, Any]] = (
            item
            for shard in order
            for item in undecoded(
                self.read_images(split, shard), str(self.images_path(split, shard))
            )
        )
        if shuffle_seed is not None:
            # Here and not above: importing webdataset loads torch.
            from webdataset.filters import detshuffle

            raw = detshuffle(bufsize=buffer, initial=buffer, seed=shuffle_seed).run(raw)
        for item in raw:
            yield decode(item)

    # queries ----------------------------------------------------------------------------------

    def connect(
        self,
        *,
        policy: str | None = None,
        origin: bool = False,
        without: Collection[Path] = (),
        memory: bool = False,
    ) -> duckdb.DuckDBPyConnection:
        """DuckDB with a view per table and all of `schemas/*.sql`; paths are absolute.

        A table without files is an empty view. `policy` chooses the labels; the dataset's own
        policy when None. With `origin` the table views also have `file` (within the dataset) and
        `row` (from 0); files in `without` are left out. With `memory` the tables are copied, for
        many queries on a small dataset. Raises DatasetError for a file that does not have the
        schema's columns.
        """
        return queries.connect(self, policy=policy, origin=origin, without=without, memory=memory)

    def content_hash(self, *, policy: str | None = None, split: str | None = None) -> str:
        """16 hex digits that change with any label or image (hashes kept in the files).

        Labels are those of `policy`, the dataset's own when None; of one split when it is given.
        """
        where = {} if split is None else {"split": split}
        labels = queries._files_of(self, "labels", policy)
        hashes = {}
        for files, key in ((labels, "sha256"), (self.files("scenes"), "images_sha256")):
            for file in files:
                if _agrees(self.file_keys(file), where):
                    hashes[self.name_of(file)] = self.metadata(file).get(key, "")
        return content_hash(hashes)


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


def _folder(table: str, of: Labelling | None) -> str:
    if of is None:
        return table
    if table not in ("plans", "timings", "labels"):
        raise DatasetError(f"table {table}: expected plans, timings or labels beside others")
    folder = f"beside/planner={of.planner}/config={of.config}/{table}"
    return f"{folder}/policy={of.policy}" if table == "labels" else folder


def _agrees(keys: Mapping[str, Any], where: Mapping[str, Any]) -> bool:
    return all(str(keys[key]) == str(value) for key, value in where.items() if key in keys)
