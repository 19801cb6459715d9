"""The files of a dataset: where each lies, what its name says, and which there are.

Every file is written to a temporary name and renamed; it exists whole or not at all. Plans and
labels of another planner version, goal set or label policy lie beside the current ones, see
`labellings`. A merged dataset holds the shards of its sources by reference, see `Source`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from relevance.configs import identity
from relevance.store import labellings
from relevance.store.labellings import Labelling
from relevance.store.parquet import read_footer
from relevance.store.paths import (
    DatasetError,
    checked_name,
    is_remote,
    keys_of,
    locate,
    replacing,
    sweep,
)
from relevance.store.tables import TABLES, table_schema

SPLITS = ("train", "validation", "test")
LAYOUT = 1
"""Version of dataset.json."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A dataset whose shards a merged dataset refers to."""

    dataset: Files
    first: Mapping[str, int]
    """The number that its shard 0 of each split has in the merged dataset."""
    count: Mapping[str, int]
    """Its number of shards of each split when it was merged."""
    without: Mapping[str, Sequence[int]]
    """Its shards of each split that were left out; nothing takes their numbers."""

    def number(self, split: str, shard: int) -> int | None:
        """The merged dataset's number of a shard; None when it was left out or made later."""
        there = shard < self.count[split] and shard not in self.without.get(split, ())
        return self.first[split] + shard if there else None


class Files:
    """The files of a dataset folder; `Dataset` reads and writes what is in them."""

    def __init__(self, path: Path, description: dict[str, Any]) -> None:
        self.path = path
        self._description = description
        self.sources = tuple(self._sources())

    def _sources(self) -> Iterator[Source]:
        for item in self._description.get("sources", ()):
            path = locate(item["path"])
            if not is_remote(path):
                # seen from the real place: `..` of a symbolic link leads elsewhere
                path = (self.path.resolve() / path).resolve()
            yield Source(
                dataset=type(self).open(path),
                first=item["first"],
                count=item["count"],
                without=item.get("without", {}),
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r})"

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open an existing dataset; raises DatasetError when there is none."""
        path = locate(path)
        file = path / "dataset.json"
        try:
            if not file.is_file():
                raise DatasetError(f"{path}: no dataset.json there, expected a dataset folder")
            description = json.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise DatasetError(f"{file}: cannot be read ({error.strerror})") from None
        except ValueError as error:
            if isinstance(error, DatasetError):
                raise
            raise DatasetError(f"{file}: expected a JSON object, found {error}") from None
        if not isinstance(description, dict):
            raise DatasetError(f"{file}: expected a JSON object, found {type(description)}")
        if (layout := description.get("layout", LAYOUT)) != LAYOUT:
            raise DatasetError(f"{file}: layout: expected {LAYOUT}, found {layout!r}")
        if description.get("changing"):
            raise DatasetError(
                f"{file}: new plans were being put in the place of old ones when that was cut "
                "short; `relevance label` does it to its end"
            )
        return cls(path, description)

    @classmethod
    def create(cls, path: str | Path, description: Mapping[str, Any]) -> Self:
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

    # names ------------------------------------------------------------------------------------

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
        for key, value in given.items():
            if isinstance(value, str):
                checked_name(key, value)
        home = self
        if split is not None and shard is not None and schema.sharded:
            home, given["shard"] = self._home(split, shard)
        return home.path / labellings.template(table, of).format(**given)

    def images_path(self, split: str, shard: int) -> Path:
        """The image tar of a shard."""
        home, number = self._home(split, shard)
        return home.path / f"images/split={split}/shard-{number:06d}.tar"

    def _home(self, split: str, shard: int) -> tuple[Files, int]:
        """The dataset that holds a shard, and its number there."""
        for source in self.sources:
            number = shard - source.first[split]
            if 0 <= number < source.count[split]:
                return source.dataset._home(split, number)
        return self, shard

    def _source_of(self, file: Path) -> Source | None:
        """The source that a file lies in; None for one of the dataset itself."""
        mine = len(self.path.parts) if file.is_relative_to(self.path) else 0
        holding = [s for s in self.sources if file.is_relative_to(s.dataset.path)]
        deepest = max(holding, key=lambda s: len(s.dataset.path.parts), default=None)
        return deepest if deepest and len(deepest.dataset.path.parts) > mine else None

    def file_keys(self, file: Path) -> dict[str, Any]:
        """What a file's path says of its rows: `key=value` folders and the shard number.

        A source's shard that was left out of the merge, or made after it, has no number.
        """
        source = self._source_of(file)
        if source is None:
            return keys_of(file.relative_to(self.path))
        keys = source.dataset.file_keys(file)
        if "shard" in keys:
            number = source.number(keys["split"], keys.pop("shard"))
            return keys if number is None else {**keys, "shard": number}
        return keys

    def table_of(self, file: Path) -> str:
        """The table that a file belongs to."""
        source = self._source_of(file)
        if source is not None:
            return source.dataset.table_of(file)
        parts = file.relative_to(self.path).parts
        return parts[3] if parts[0] == labellings.FOLDER else parts[0]

    def name_of(self, file: Path) -> str:
        """A file's name within the dataset; a source's file by its way there."""
        if self._source_of(file) is None:
            return str(file.relative_to(self.path))
        return str(file) if is_remote(file) else os.path.relpath(file, self.path.resolve())

    # what is there ----------------------------------------------------------------------------

    def has(self, table: str, **keys: Any) -> bool:
        """Whether the file of that shard exists (then it is whole)."""
        return self.shard_path(table, **keys).is_file()

    def files(self, table: str, *, of: Labelling | None = None, **where: Any) -> list[Path]:
        """Files of a table in order, only those whose path agrees with `where`.

        `of` asks for plans, timings or labels beside the current ones. What is named otherwise,
        see `strays`, belongs to no table.
        """
        keep = [file for file in self._parquet(table, of) if self._is_named(table, of, file)]
        if table_schema(table).sharded:
            for source in self.sources:
                mine = source.dataset.files(table, of=of)
                keep += [file for file in mine if "shard" in self.file_keys(file)]
        return [file for file in keep if _agrees(self.file_keys(file), where)] if where else keep

    def strays(self) -> list[Path]:
        """Parquet files in the folders of the tables that have no shard's name, such as copies;
        nothing reads them."""
        places: list[tuple[str, Labelling | None]] = [(table, None) for table in TABLES]
        places += [(t, of) for of in self.labellings() for t in labellings.beside_tables()]
        return [
            file
            for table, of in places
            for file in self._parquet(table, of)
            if not (file.name.startswith(".") or self._is_named(table, of, file))
        ]

    def _parquet(self, table: str, of: Labelling | None) -> list[Path]:
        return sorted((self.path / labellings.folder(table, of)).rglob("*.parquet"))

    def _is_named(self, table: str, of: Labelling | None, file: Path) -> bool:
        return labellings.is_named(table, of, file.relative_to(self.path))

    def shards(self, split: str) -> list[int]:
        """Numbers of the finished shards of a split, in order."""
        return sorted(self.file_keys(file)["shard"] for file in self.files("scenes", split=split))

    def metadata(self, file: Path) -> dict[str, str]:
        """What a file's footer says: table, version, sha256 and what `made_by` gave."""
        return read_footer(table_schema(self.table_of(file)), file)

    # labellings -------------------------------------------------------------------------------

    @property
    def labelling(self) -> Labelling | None:
        """How the dataset is labelled now; None when dataset.json does not say it.

        A merged dataset's is that of its first source.
        """
        if self.sources:
            return self.sources[0].dataset.labelling
        return labellings.from_description(self.description)

    def labellings(self) -> list[Labelling]:
        """The labellings that are beside the current one (some of their shards, at least)."""
        found = {of for source in self.sources for of in source.dataset.labellings()}
        for file in (self.path / labellings.FOLDER).rglob("labels/**/*.parquet"):
            of = labellings.from_keys(self.file_keys(file))
            if of is not None and not file.name.startswith("."):
                found.add(of)
        return sorted(found)

    def policies(self) -> list[str]:
        """The policies under which the current plans are labelled, the dataset's own first.

        Of a merged dataset those of all its sources; none when dataset.json names no labelling.
        """
        if self.sources:
            first, *rest = [source.dataset.policies() for source in self.sources]
            return [policy for policy in first if all(policy in other for other in rest)]
        own = self.labelling
        if own is None:
            return []
        beside = {of.policy for of in self.labellings() if of == replace(own, policy=of.policy)}
        return [own.policy, *sorted(beside - {own.policy})]

    def files_under(self, table: str, policy: str | None, **where: Any) -> list[Path]:
        """The files of a table; labels by the policy that is asked for, the own one when None.

        Raises DatasetError for a policy that the dataset does not have.
        """
        own = self.labelling
        if policy is not None and own is not None and policy not in (known := self.policies()):
            raise DatasetError(
                f"{self.path}: policy {policy!r}: expected one of {', '.join(known)}"
            )
        by_policy = "{policy}" in table_schema(table).beside
        if not by_policy or policy is None or own is None or policy == own.policy:
            return self.files(table, **where)
        if not self.sources:
            return self.files(table, of=replace(own, policy=policy), **where)
        found = [f for s in self.sources for f in s.dataset.files_under(table, policy)]
        keys = {file: self.file_keys(file) for file in found}
        return [file for file in found if "shard" in keys[file] and _agrees(keys[file], where)]

    def files_beside(self) -> list[Path]:
        """Every file of the labellings that are beside the current one."""
        files = [
            file
            for of in self.labellings()
            for table in labellings.beside_tables()
            for file in self.files(table, of=of)
        ]
        return list(dict.fromkeys(files))


def differences(
    found: Any, expected: Any, prefix: str = "", ignore: Sequence[str] = ()
) -> Iterator[tuple[str, Any, Any]]:
    """Where two JSON values differ: (dotted key, value in the first, value in the second).

    Configs among them count by their identities: what has its default differs from nothing.
    """
    found, expected = identity(found), identity(expected)
    if prefix in ignore:
        return
    if isinstance(found, dict) and isinstance(expected, dict):
        for key in sorted({*found, *expected}):
            dotted = f"{prefix}.{key}" if prefix else key
            yield from differences(found.get(key), expected.get(key), dotted, ignore)
    elif found != expected:
        yield prefix, found, expected


def _agrees(keys: Mapping[str, Any], where: Mapping[str, Any]) -> bool:
    return all(str(keys[key]) == str(value) for key, value in where.items() if key in keys)
