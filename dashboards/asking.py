"""What the pages ask of a dataset: the queries of `sql/`, and pictures, answers being kept.

A query takes its settings from DuckDB variables and has a default for each, so that every file
also runs by itself, in plain DuckDB after `schemas/tables.sql` and `schemas/views.sql`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import streamlit as st

from relevance.store import (
    Dataset,
    DatasetError,
    Files,
    Labelling,
    Sample,
    decode,
    is_remote,
    needs,
)

SQL = Path(__file__).parent / "sql"


Part = tuple[str, tuple[int, ...]] | None
"""A split and shards of it; everything when None."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What the side bar says."""

    path: str
    version: tuple[int, int]
    """Changes whenever a file of the dataset does, so that kept answers are asked for again."""
    own_policy: str | None = None
    policy: str | None = None
    """Of the labels: the checkpoint's, or the dataset's own without a checkpoint."""
    split: str = "test"
    checkpoint: str | None = None
    beta: float = 0.0
    shards: tuple[int, ...] | None = None
    """Those of the split that are looked at, and nothing else; everything when None."""

    @property
    def dataset(self) -> Dataset:
        """The dataset, whose files' footers are read once."""
        return _opened(self.path, self.part)

    @property
    def part(self) -> Part:
        """What is looked at, and nothing else."""
        return None if self.shards is None else (self.split, self.shards)


SCENES = 2_500
"""About as many judge a checkpoint: more would cost memory and time alone."""
MEMORY = "200MB"
"""Of one query; what takes more is put on disk meanwhile."""


class _Kept(Dataset):
    """A dataset that reads a file's footer again only when the file has changed."""

    part: Part = None
    """What there is besides is not seen."""

    def files(self, table: str, *, of: Labelling | None = None, **where: Any) -> list[Path]:
        found = super().files(table, of=of, **where)
        if self.part is None:
            return found
        split, shards = self.part[0], frozenset(self.part[1])
        keys = [self.file_keys(file) for file in found]
        seen = [
            key.get("split", split) == split and ("shard" not in key or key["shard"] in shards)
            for key in keys
        ]
        return list(compress(found, seen))

    def connect(self, **how: Any) -> Any:
        connection = super().connect(**how)
        connection.execute(f"SET memory_limit = '{MEMORY}'")
        connection.execute("SET temp_directory = ?", [gettempdir()])
        return connection

    def metadata(self, file: Path) -> dict[str, str]:
        if is_remote(file) or not file.is_file():
            return super().metadata(file)
        state = file.stat()
        known = _FOOTERS.get(file)
        if known is None or known[:2] != (state.st_size, state.st_mtime_ns):
            known = (state.st_size, state.st_mtime_ns, super().metadata(file))
            _FOOTERS[file] = known
        return known[2]


def _opened(path: str, part: Part) -> _Kept:
    dataset = _Kept.open(path)
    dataset.part = part
    return dataset


_FOOTERS: dict[Path, tuple[int, int, dict[str, str]]] = {}
"""Size, time of change and footer of a file, as they were when it was read."""


def version_of(dataset: Files) -> tuple[int, int]:
    """Changes whenever a table of the dataset does, or of one that it refers to: number of files
    and newest change (of those of this machine)."""
    changes = [0 if is_remote(file) else file.stat().st_mtime_ns for file in _tables(dataset)]
    return len(changes), max(changes, default=0)


def _tables(dataset: Files) -> Iterator[Path]:
    yield from dataset.path.rglob("*.parquet")
    for source in dataset.sources:
        yield from _tables(source.dataset)


def chosen() -> Choice:
    """What the side bar says now."""
    return st.session_state["choice"]


def ask(choice: Choice, query: str, **variables: Any) -> list[dict[str, Any]]:
    """Rows of `sql/QUERY.sql`; raises DatasetError when the dataset cannot answer."""
    policy = choice.policy if choice.policy != choice.own_policy else None
    return _ask(choice.path, choice.version, choice.part, policy, query, variables)


@st.cache_data(show_spinner=False, max_entries=300)
def _ask(
    path: str,
    version: tuple[int, int],
    part: Part,
    policy: str | None,
    query: str,
    variables: Mapping[str, Any],
) -> list[dict[str, Any]]:
    text = (SQL / f"{query}.sql").read_text(encoding="utf-8")
    with _opened(path, part).connect(policy=policy, names=needs(text)) as connection:
        try:
            for name, value in variables.items():
                connection.execute(f"SET VARIABLE {name} = ?", [value])
            found = connection.execute(text)
            names = [column[0] for column in found.description or ()]
            return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
        except Exception as error:  # the queries are ours and tested: what fails is the data
            raise DatasetError(f"{path}: {str(error).splitlines()[0]}") from error


def tasks_with_answers(
    choice: Choice, tasks: Sequence[dict[str, Any]]
) -> list[tuple[dict[str, Any], Sample]]:
    """Goals with what is `relevant`, the checkpoint's `scores` (empty without), and pictures."""
    if not tasks:
        return []
    shards = sorted({task["shard"] for task in tasks})
    plan_ids = [task["plan_id"] for task in tasks]
    answers = ask(choice, "answers", shards=shards, plan_ids=plan_ids)
    relevant = {row["plan_id"]: row["relevant"] for row in answers}
    scores = {}
    if choice.checkpoint:
        scene_ids = sorted({task["scene_id"] for task in tasks})
        scored = ask(choice, "scores", checkpoint_id=choice.checkpoint, scene_ids=scene_ids)
        scores = {_goal(row): row["scores"] for row in scored}
    answered = []
    wanted = {task["scene_id"]: (task["split"], task["shard"]) for task in tasks}
    found = {key: _sample(choice.path, choice.version, key, *at) for key, at in wanted.items()}
    for task in tasks:
        known = {"relevant": relevant.get(task["plan_id"], [])}
        known |= {"scores": scores.get(_goal(task), {})}
        answered.append((task | known, found[task["scene_id"]]))
    return answered


def _goal(row: Mapping[str, Any]) -> tuple[str, ...]:
    return row["scene_id"], row["predicate"], row["subject"], row["reference"]


@st.cache_resource(show_spinner=False, max_entries=60)
def _sample(path: str, version: tuple[int, int], scene_id: str, split: str, shard: int) -> Sample:
    for members in _Kept.open(path).undecoded(split, shard):
        if members["__key__"] == scene_id:
            return decode(members)
    raise DatasetError(f"{path}: the images of shard {split} {shard} lack scene {scene_id}")
