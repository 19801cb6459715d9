"""A dataset folder: the rows of its tables, its images, and DuckDB over both.

The scenes file of a shard carries the hash of the shard's tar, a WebDataset that any reader of
those takes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.compute as pc

from relevance.hashing import content_hash
from relevance.store import queries
from relevance.store.files import Files
from relevance.store.images import Pictures, Sample, decode, undecoded, write_tar
from relevance.store.labellings import Labelling
from relevance.store.parquet import read_parquet, to_parquet
from relevance.store.paths import DatasetError, file_hash, replacing
from relevance.store.streaming import shuffled
from relevance.store.tables import table_schema


class Dataset(Files):
    """A dataset folder (data/README.md); see `open` and `create`."""

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

    def read_file(self, file: Path) -> pa.Table:
        """Read one Parquet file whole; hash, version and columns are checked."""
        body = read_parquet(table_schema(self.table_of(file)), file)
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

    # images -----------------------------------------------------------------------------------

    def write_images(
        self, split: str, shard: int, samples: Iterable[tuple[str, Pictures, str]]
    ) -> dict[str, str]:
        """Write the image tar of a shard from (scene_id, pictures, scene JSON).

        Returns what the shard's scenes file must carry as `made_by`: the tar's hash and size.
        """
        path = self.images_path(split, shard)
        with replacing(path) as temporary:
            write_tar(temporary, samples)
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
    ) -> Iterator[Sample]:
        """Scenes with their images, decoded; in stored order, or shuffled by `shuffle_seed`.

        Shuffling permutes the shards, then draws from a buffer of undecoded samples; it depends
        on the seed alone. Raises DatasetError naming a truncated, changed or missing tar.
        """
        order = self.shards(split) if shards is None else shards
        if shuffle_seed is None:
            raw = (item for shard in order for item in self.undecoded(split, shard))
        else:
            raw = shuffled(order, partial(self.undecoded, split), shuffle_seed)
        for item in raw:
            yield decode(item)

    def undecoded(self, split: str, shard: int) -> Iterator[dict[str, Any]]:
        """The samples of a shard, members by name, as `decode` takes them."""
        return undecoded(self.read_images(split, shard), str(self.images_path(split, shard)))

    def connect(
        self,
        *,
        policy: str | None = None,
        origin: bool = False,
        without: Collection[Path] = (),
        memory: bool = False,
        names: Collection[str] | None = None,
    ) -> duckdb.DuckDBPyConnection:
        """DuckDB with a view per table and all of `schemas/*.sql`; paths are absolute.

        A table without files is an empty view. `policy` chooses the labels; the dataset's own
        policy when None. With `origin` the table views also have `file` (within the dataset) and
        `row` (from 0); files in `without` are left out. With `memory` the tables are copied, for
        many queries on a small dataset. `names`: the tables and views that will be asked, which
        alone are there and read; all when None. Raises DatasetError for a file of theirs that
        cannot be read or has other columns than its schema, and for a policy that the dataset
        does not have.
        """
        return queries.connect(
            self, policy=policy, origin=origin, without=without, memory=memory, names=names
        )

    def content_hash(self, *, policy: str | None = None, split: str | None = None) -> str:
        """16 hex digits of what a model learns from: labels of one policy, images, of one split.

        The dataset's own policy when None, every split when None. The hashes are those that the
        files keep; nothing else of the dataset changes it, nor where its files lie.
        """
        where: dict[str, Any] = {} if split is None else {"split": split}
        labels, scenes = self.files_under("labels", policy, **where), self.files("scenes", **where)
        hashes = {}
        for what, files in (("sha256", labels), ("images_sha256", scenes)):
            for file in files:
                keys = self.file_keys(file)
                place = [what, keys.get("predicate"), keys.get("split"), keys.get("shard")]
                hashes["/".join(map(str, place))] = self.metadata(file).get(what, "")
        return content_hash(hashes)
