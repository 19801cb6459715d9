"""Whether a dataset's files are complete and current, and making anew what is not.

`finish` notes in dataset.json which stages are complete; from then on a file that is not there
was deleted. `integrity` names every such file, and everything beside the current tables that is
not what it should be; `broken` says which of the named files can be made anew exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from relevance.pipeline.labelling import labelled_as
from relevance.pipeline.preparing import change_over, clear, labelling_of, resumed
from relevance.pipeline.scenes import generated
from relevance.pipeline.settings import ShardSpec, load_config, shards_of
from relevance.scene import PREDICATES
from relevance.store import Dataset, DatasetError, Labelling

REFUSED_SHARE = 0.01
"""Share of the replayed plans that the replay may refuse."""
REFUSED_LEAST = 2
"""Refused replays that count as chance whatever their share."""

Key = tuple[str, int, str | None, str | None]
"""Split, shard, predicate, policy."""


def finish(root: str | Path) -> None:
    """Note in dataset.json which stages have all their files: scenes, and predicates labelled.

    Plans that were made anew take the place of the old ones once none of them is missing.
    """
    dataset = resumed(root)
    specs = shards_of(dataset)
    found = dataset.description.get("next")
    if found and _complete(dataset, labelling_of(found), specs):
        change_over(dataset)
    clear(dataset)
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


def _complete(dataset: Dataset, way: Labelling, specs: list[ShardSpec]) -> bool:
    """Whether every shard that is labelled now is labelled in the new way too."""
    return all(
        labelled_as(dataset, way, spec, predicate)
        for spec in specs
        for predicate in spec.predicates
        if dataset.has("labels", split=spec.split, shard=spec.shard, predicate=predicate.name)
        or dataset.has("plans", split=spec.split, shard=spec.shard, predicate=predicate.name)
    )


def refused(dataset: Dataset) -> str | None:
    """What is wrong when the replay refuses more plans than chance allows; None when it does not.

    Then those plans that were not replayed cannot be believed either.
    """
    unreadable = {file for file in dataset.files("plans") if _cut(dataset, file)}
    with dataset.connect(without=unreadable, names=["plans"]) as connection:
        query = "select count(replay_ok), count(*) filter (not replay_ok) from plans"
        [(replayed, bad)] = connection.execute(query).fetchall()
    if bad <= max(REFUSED_LEAST, REFUSED_SHARE * replayed):
        return None
    return (
        f"the replay refuses {bad} of {replayed} plans, expected at most {REFUSED_SHARE:.0%}; "
        "planner and replay disagree about these scenes, so do not trust the other plans"
    )


def _cut(dataset: Dataset, file: Path) -> bool:
    try:
        dataset.metadata(file)
    except DatasetError:
        return True  # named by whoever reads it
    return False


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


def broken(dataset: Dataset, named: Iterable[str]) -> tuple[dict[Key, set[str]], dict[str, str]]:
    """Which of the named files can be made anew exactly, and why the others cannot.

    The first by what makes them (split, shard, predicate, policy), None where it is neither
    labels nor of another policy than the dataset's own; the second by name.
    """
    anew: dict[Key, set[str]] = {}
    left: dict[str, str] = {}
    config, specs = load_config(dataset), shards_of(dataset)
    listed = {(spec.split, spec.shard): spec for spec in specs}
    drawn = dataset.description.get("hashes", {}).get("scenes") == config.scenes_hash
    planned = dataset.labelling == config.labelling
    strays = {dataset.name_of(file) for file in dataset.strays()}
    for name in dict.fromkeys(named):
        parts = Path(name).parts
        top, keys = parts[0], dataset.file_keys(dataset.path / name)
        spec = listed.get((keys.get("split", ""), keys.get("shard", -1)))
        table = parts[3] if top == "beside" and len(parts) > 3 else top
        if table == "compacted":
            continue  # gathered again from the labels
        made = table in ("scenes", "images", "plans", "timings", "labels") and name not in strays
        if not made or spec is None:
            left[name] = "nothing makes it anew"
            continue
        if table in ("scenes", "images"):
            if drawn:
                anew.setdefault((spec.split, spec.shard, None, None), set()).add("scenes")
            else:
                left[name] = "it was drawn or rendered by another version"
            continue
        way = dataset.labelling
        if top == "beside" and way is not None:
            way = Labelling(planner=keys["planner"], config=keys["config"], policy=way.policy)
        if not planned or way != dataset.labelling:
            left[name] = "it was planned by another version or with other settings"
            continue
        policy = keys.get("policy")
        policy = None if policy == config.policy else policy
        key = (spec.split, spec.shard, keys["predicate"], policy)
        anew.setdefault(key, set()).add("labels" if table == "labels" else "plans")
    return anew, left
