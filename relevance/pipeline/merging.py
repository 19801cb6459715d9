"""Merging datasets by reference: no file of theirs is copied, renamed or rewritten."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from relevance.pipeline.mining import SPLIT, copied_shards, looked_at
from relevance.pipeline.preparing import describe
from relevance.pipeline.settings import ShardSpec, load_config, scenes_of, shards_of
from relevance.store import SPLITS, Dataset, DatasetError, absolute, differences, is_remote


def merge(sources: Sequence[str | Path], into: str | Path) -> Dataset:
    """Make a dataset that holds the shards of others by reference; returns it.

    Its shards are numbered anew, one source after the other; every view, reader and trainer
    works on it. Labels that a source gets later, under another policy say, are seen here too;
    shards that it gets later are not. Validation shards whose scenes one of the sources was mined
    from are left out: copies of them are trained on. Raises DatasetError for fewer than two
    sources, labels made in different ways, or a scene that is there twice.
    """
    target = absolute(into)
    datasets = [_flat(path) for path in sources]
    datasets = [dataset for several in datasets for dataset in several]
    if len(datasets) < 2:
        raise DatasetError(f"{target}: expected at least two datasets to merge")
    if (target / "dataset.json").is_file():
        raise DatasetError(f"{target}: is a dataset already, expected another folder")
    head, *rest = datasets
    for other in rest:
        _same(head, other)
    _distinct(datasets)
    seen = looked_at(datasets)
    first: dict[str, int] = dict.fromkeys(SPLITS, 0)
    entries: list[dict[str, Any]] = []
    specs: list[ShardSpec] = []
    scenes: dict[str, int] = dict.fromkeys(SPLITS, 0)
    for dataset in datasets:
        mine = shards_of(dataset)
        count = {split: sum(spec.split == split for spec in mine) for split in SPLITS}
        entry = {"path": _way(target, dataset.path), "first": dict(first), "count": count}
        copied = copied_shards(dataset, seen)
        entries.append({**entry, "without": {SPLIT: copied}} if copied else entry)
        for spec in mine:
            if spec.split == SPLIT and spec.shard in copied:
                continue
            specs.append(
                replace(
                    spec,
                    shard=first[spec.split] + spec.shard,
                    first=scenes[spec.split] + spec.first,
                )
            )
        for split in SPLITS:
            first[split] += count[split]
            scenes[split] += sum(spec.count for spec in mine if spec.split == split)
    config = load_config(head)
    kept = {split: scenes_of(specs, split, each=config.own_scenes) for split in SPLITS}
    config = replace(config, mined=None, **kept)
    description = describe(config, specs)
    for key in ("planner_version", "tables", "versions"):
        description[key] = head.description.get(key)
    # Seeds differ, and so do the hashes of the settings: each source is held to its own.
    description["hashes"] = {}
    description["sources"] = entries
    finished = [d.description.get("finished", []) for d in datasets]
    description["finished"] = [
        stage for stage in finished[0] if all(stage in other for other in finished)
    ]
    return Dataset.create(target, description)


def _flat(path: str | Path) -> list[Dataset]:
    """A dataset, or the sources of a merged one."""
    dataset = Dataset.open(absolute(path))
    if not dataset.sources:
        return [dataset]
    return [item for source in dataset.sources for item in _flat(source.dataset.path)]


def _way(target: Path, source: Path) -> str:
    """A way to a source that goes along when both are moved together."""
    if is_remote(source) or is_remote(target):
        return str(source)
    return os.path.relpath(source.resolve(), target.resolve())


def _same(head: Dataset, other: Dataset) -> None:
    """Raises DatasetError unless two datasets are labelled in the same way."""
    mine, its = (
        {"planner_version": d.description.get("planner_version"), "policy": load_config(d).policy}
        for d in (head, other)
    )
    for key, found, expected in differences(its, mine):
        raise DatasetError(
            f"{other.path}: {key}: expected {expected} as in {head.path}, found {found}"
        )


def _distinct(datasets: Sequence[Dataset]) -> None:
    """Raises DatasetError that names a scene which is there twice."""
    seen: dict[str, tuple[Dataset, str]] = {}
    for dataset in datasets:
        for split in SPLITS:
            for file in dataset.files("scenes", split=split):
                for scene_id in dataset.read_file(file)["scene_id"].to_pylist():
                    if scene_id in seen:
                        there, other = seen[scene_id]
                        raise DatasetError(
                            f"{dataset.path}: scene {scene_id} of {split}: expected in one "
                            f"dataset only, found in {other} of {there.path} too"
                        )
                    seen[scene_id] = dataset, split
