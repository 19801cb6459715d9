"""Whether a dataset's files are complete and current, and making anew what is not.

`finish` notes in dataset.json which stages are complete; from then on a file that is not there
was deleted. `integrity` names every such file, and everything beside the current tables that is
not what it should be; `repair` deletes what `check` has named and says what has to be made.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from relevance.pipeline.settings import ShardSpec, shards_of
from relevance.pipeline.shards import generated
from relevance.scene import PREDICATES
from relevance.store import Dataset, DatasetError

REMADE = ("scenes", "images", "plans", "timings", "labels", "durations", "beside", "compacted")
"""Folders whose files `generate` and `label` make again when they are gone."""


def finish(root: str | Path) -> None:
    """Note in dataset.json which stages have all their files: scenes, and predicates labelled."""
    dataset = Dataset.open(root)
    specs = shards_of(dataset)
    finished = [
        *(["scenes"] if all(generated(dataset, spec) for spec in specs) else []),
        *(
            predicate.name
            for predicate in PREDICATES.values()
            for mine in [[spec for spec in specs if predicate in spec.predicates]]
            if mine and not any(_missing(dataset, spec, predicate.name) for spec in mine)
        ),
    ]
    if dataset.description.get("finished") != finished:
        dataset.describe({**dataset.description, "finished": finished})


def _missing(dataset: Dataset, spec: ShardSpec, predicate: str) -> list[Path]:
    where = {"split": spec.split, "shard": spec.shard, "predicate": predicate}
    files = [dataset.shard_path(table, **where) for table in ("plans", "timings", "labels")]
    return [file for file in files if not file.is_file()]


def integrity(dataset: Dataset) -> Iterator[tuple[str, str]]:
    """(file, message) of what is missing, stale, or not what its place beside says."""
    try:
        specs = shards_of(dataset)
    except DatasetError:
        return  # named by whoever reads dataset.json
    finished = dataset.description.get("finished", ())
    expected = "expected there, since the stage was finished, found none; it was deleted"
    for spec in specs:
        where = {"split": spec.split, "shard": spec.shard}
        files = {"scenes": dataset.shard_path("scenes", **where)}
        files["images"] = dataset.images_path(**where)
        there = [name for name, file in files.items() if file.is_file()]
        if "scenes" in finished or (there == ["scenes"]):
            for file in files.values():
                if not file.is_file():
                    yield dataset.name_of(file), expected
        for predicate in spec.predicates:
            if predicate.name in finished:
                for file in _missing(dataset, spec, predicate.name):
                    yield dataset.name_of(file), expected
    yield from _stale(dataset)
    yield from _beside(dataset)


def _stale(dataset: Dataset) -> Iterator[tuple[str, str]]:
    current = dataset.labelling
    if current is None:
        return
    wanted = {"labels": current.made_by}
    wanted |= {"plans": current.planned_by, "timings": current.planned_by}
    for table, made_by in wanted.items():
        for file in dataset.files(table):
            with suppress(DatasetError):  # named by whoever reads it
                yield from _differences(dataset, file, made_by, "dataset.json")


def _beside(dataset: Dataset) -> Iterator[tuple[str, str]]:
    for of in dataset.labellings():
        wanted = {"plans": of.planned_by, "timings": of.planned_by, "labels": of.made_by}
        for table, made_by in wanted.items():
            for file in dataset.files(table, of=of):
                with suppress(DatasetError):  # named by whoever reads it
                    yield from _differences(dataset, file, made_by, "its folder")


def _differences(
    dataset: Dataset, file: Path, made_by: dict[str, str], source: str
) -> Iterator[tuple[str, str]]:
    found = dataset.metadata(file)
    for key, value in made_by.items():
        if found.get(key) != value:
            yield (
                dataset.name_of(file),
                f"stale: expected {key} {value} as {source} says, found {found.get(key, 'none')}",
            )
            return


def repair(root: str | Path, named: Iterable[str]) -> list[str]:
    """Delete those of the named files that `generate` and `label` make again; the others' names.

    After it `generate` and `label` complete the dataset. A scenes file goes with its tar, plans
    with their timings, so that what belongs together is made together.
    """
    dataset = Dataset.open(root)
    left = []
    for name in dict.fromkeys(named):
        file = dataset.path / name
        top = Path(name).parts[0]
        if top not in REMADE:
            if name != "dataset.json" or not file.is_file():
                left.append(name)
            continue
        together = [file]
        keys = dataset.file_keys(file)
        if top in ("scenes", "images"):
            where = {"split": keys["split"], "shard": keys["shard"]}
            together += [dataset.shard_path("scenes", **where), dataset.images_path(**where)]
        elif top in ("plans", "timings"):
            where = {key: keys[key] for key in ("split", "shard", "predicate")}
            together += [dataset.shard_path(table, **where) for table in ("plans", "timings")]
        for item in together:
            if item.is_file():
                item.unlink()
    return left
