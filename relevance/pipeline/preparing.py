"""dataset.json: made once and by one writer, grown, and changed over to new plans.

Settings are compared by their identities: a setting that is younger than a dataset has its
default there. A dataset that is planned anew keeps its old plans and labels until all the new
ones, which are made beside them, are there; then they change places (`change_over`).
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from relevance.pipeline.settings import (
    Counts,
    DatasetConfig,
    ShardSpec,
    dump_config,
    dump_specs,
    load_config,
    read_config,
    refuse_merged,
    scenes_of,
    shard_specs,
    shards_of,
    versions,
)
from relevance.planner import PLANNER_VERSION
from relevance.scene import FAMILIES
from relevance.store import (
    LAYOUT,
    SPLITS,
    TABLES,
    Dataset,
    DatasetError,
    Labelling,
    copy_file,
    create_object,
    differences,
    is_remote,
    locate,
    sweep,
    table_schema,
)

PLANNED = ("timings", "plans", "labels")
"""The tables that planning makes, in the order in which they are written."""


def describe(config: DatasetConfig, specs: Sequence[ShardSpec]) -> dict[str, Any]:
    """What dataset.json holds: settings, their hashes, versions, counts and the shards."""
    return {
        "layout": LAYOUT,
        "config": dump_config(config),
        "hashes": {"scenes": config.scenes_hash, "plans": config.plans_hash},
        "versions": versions(),
        "planner_version": PLANNER_VERSION,
        "tables": {table: table_schema(table).version for table in TABLES},
        **_listed(specs),
    }


def _listed(specs: Sequence[ShardSpec]) -> dict[str, Any]:
    counts = {split: scenes_of(specs, split) for split in SPLITS}
    return {
        "counts": {s: {f: counts[s].of(f) for f in FAMILIES} for s in SPLITS},
        "shards": dump_specs(specs),
    }


def prepare(
    root: str | Path, config: DatasetConfig, *, replan: bool = False, scenes_only: bool = False
) -> list[ShardSpec]:
    """Make or extend a dataset's dataset.json; returns every shard of it.

    More scenes than before append shards and renumber none. Raises DatasetError when the
    dataset there was drawn with other settings, or planned with others unless `replan`: then
    `label_shard` makes plans and labels anew beside those that are there, which they replace
    when all of them are made (`finish`); scenes and images stay. With `scenes_only` the planner
    of today may be another one than labelled the dataset.
    """
    root = locate(root)
    if not (root / "dataset.json").exists():
        specs = shard_specs(config)
        if _create(root, describe(config, specs)):
            return specs
    there = resumed(root)
    refuse_merged(there)
    sweep(root)
    before = load_config(there)
    if before.scenes_hash != config.scenes_hash:
        raise _other(
            there, before.drawn_as, config.drawn_as, "take another folder or the same settings"
        )
    old = shards_of(there)
    specs = shard_specs(config, old)
    if specs != old:
        if before.mined is not None:
            raise DatasetError(f"{there.path}: holds what was mined and no more; mine another one")
        refuse_other_scenes(there, config)
    # asking for fewer than there are keeps what there is
    grown = {split: scenes_of(specs, split, each=config.own_scenes) for split in SPLITS}
    grown = {**grown, "scenes_per_shard": config.scenes_per_shard}
    said = {**there.description, "config": dump_config(replace(before, **grown)), **_listed(specs)}
    wanted = replace(config, **grown)
    same = there.labelling == config.labelling
    kept = scenes_only and _way(before) == _way(config)
    pending = there.description.get("next")
    if replan:
        said.pop("next", None)
        if not same:
            said |= {"next": _planning(wanted)}
    elif not (same or kept or (pending and labelling_of(pending) == config.labelling)):
        hint = "plan it anew (replan)"
        if _way(before) != _way(config):
            raise _other(there, _way(before), _way(config), hint)
        raise _differs(there, *_first_version(there, config), hint)
    if specs != old:
        said.pop("finished", None)
    if "next" in said and not any(there.files(table) for table in PLANNED):
        said = _changed(said)  # there is nothing to keep in place
    if said != there.description:
        there.describe(said)
    return specs


def refuse_other_scenes(there: Dataset, config: DatasetConfig) -> None:
    """Raises DatasetError unless today's sampler and renderer draw as the dataset was drawn."""
    found, now = there.description.get("hashes", {}).get("scenes"), config.scenes_hash
    if found == now:
        return
    before = there.description.get("versions", {})
    for key, version in versions().items():
        if key != "labels" and before.get(key) != version:
            raise _differs(there, f"versions.{key}", before.get(key), version, "draw another")
    raise _differs(there, "hashes.scenes", found, now, "take another folder")


def _first_version(there: Dataset, config: DatasetConfig) -> tuple[str, Any, Any]:
    if there.description.get("planner_version") != PLANNER_VERSION:
        return "planner_version", there.description.get("planner_version"), PLANNER_VERSION
    return "hashes.plans", there.description.get("hashes", {}).get("plans"), config.plans_hash


def _way(config: DatasetConfig) -> DatasetConfig:
    """How a config plans and labels."""
    return replace(config.planned_as, policy=config.policy)


def _other(there: Dataset, before: DatasetConfig, config: DatasetConfig, hint: str) -> DatasetError:
    for key, found, expected in differences(dump_config(before), dump_config(config)):
        return _differs(there, f"config.{key}", found, expected, hint)
    raise AssertionError("they differ")


def _differs(there: Dataset, key: str, found: Any, now: Any, hint: str) -> DatasetError:
    return DatasetError(
        f"{there.path / 'dataset.json'}: {key}: the dataset was made with {found!r}, "
        f"found {now!r}; {hint}"
    )


def _create(root: Path, description: Mapping[str, Any]) -> bool:
    """Write dataset.json unless another process was first, whose dataset it is then."""
    text = json.dumps(description, indent=2, sort_keys=True) + "\n"
    if is_remote(root):
        return create_object(root / "dataset.json", text.encode())
    owner = f"{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"
    draft = root / f".dataset.json.{owner}.tmp"  # `sweep` removes it when this process dies
    try:
        root.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8")
        os.link(draft, root / "dataset.json")
    except FileExistsError:
        if (root / "dataset.json").exists():
            return False
        raise DatasetError(f"{root}: is a file, expected a folder for the dataset") from None
    except OSError as error:
        raise DatasetError(f"{root}: cannot be written ({error.strerror})") from None
    finally:
        if draft.parent.is_dir():
            draft.unlink(missing_ok=True)
    return True


def append(root: str | Path, split: str, **scenes: int) -> list[ShardSpec]:
    """Add that many scenes of each family to a split, as further shards; all the shards.

    What is there is neither renumbered nor rewritten. Raises DatasetError for an unknown split.
    """
    if split not in SPLITS:
        raise DatasetError(f"split {split!r}: expected one of {', '.join(SPLITS)}")
    if min(scenes.values(), default=0) < 0 or sum(scenes.values()) == 0:
        raise DatasetError(f"append to {split}: expected at least 1 scene in all")
    config = load_config(Dataset.open(root))
    grown = Counts.total([config.counts(split), Counts(**scenes)])
    return prepare(root, replace(config, **{split: grown}), scenes_only=True)


# planned anew ----------------------------------------------------------------------------------


def _planning(config: DatasetConfig) -> dict[str, Any]:
    """What dataset.json says of new plans until they take the place of the old ones."""
    return {
        "config": dump_config(config),
        "plans": config.plans_hash,
        "planner_version": PLANNER_VERSION,
        "labels": versions()["labels"],
    }


def labelling_of(planning: Mapping[str, Any]) -> Labelling:
    """The labelling of new plans that are under way."""
    return Labelling(
        planner=planning["planner_version"],
        config=planning["plans"],
        policy=planning["config"]["policy"],
    )


def pending(dataset: Dataset) -> DatasetConfig | None:
    """The config of new plans that are under way; None when there are none."""
    found = dataset.description.get("next")
    return None if found is None else read_config(dataset, "config", found)


def _changed(said: Mapping[str, Any]) -> dict[str, Any]:
    """What dataset.json says once the new plans are in place."""
    now = said["next"]
    grown = {key: said["config"][key] for key in (*SPLITS, "scenes_per_shard")}
    changed = {key: value for key, value in said.items() if key not in ("next", "changing")}
    return {
        **changed,
        "config": {**now["config"], **grown},
        "hashes": {**said.get("hashes", {}), "plans": now["plans"]},
        "versions": {**said.get("versions", {}), "labels": now["labels"]},
        "planner_version": now["planner_version"],
    }


def change_over(dataset: Dataset) -> None:
    """Put the new plans and labels in place, the old ones beside.

    dataset.json says while it lasts that it goes on, and `Dataset.open` refuses; so nobody reads
    a mixture. What was cut short is done to its end by whoever calls `resumed` next.
    """
    said = dataset.description
    if not said.get("changing"):
        dataset.describe({**said, "changing": True})
    new, old = labelling_of(said["next"]), dataset.labelling
    for table in PLANNED:
        for source in dataset.files(table, of=new):
            place = dataset.shard_path(table, **_place(dataset, source))
            if place.is_file() and old is not None:
                set_aside(dataset, table, place, new)
            copy_file(source, place)
    dataset.describe(_changed(dataset.description))
    clear(dataset)


def _place(dataset: Dataset, file: Path) -> dict[str, Any]:
    keys = dataset.file_keys(file)
    return {key: keys[key] for key in ("split", "shard", "predicate")}


def set_aside(dataset: Dataset, table: str, file: Path, new: Labelling) -> None:
    """Copy a file in place to its labelling's folder beside, unless it is one of the new ones."""
    try:
        made = made_as(dataset, table, file)
    except DatasetError:
        made = dataset.labelling  # broken, and kept as it is: `check` has named it
    if made is None or made == new or (table != "labels" and made.planned_by == new.planned_by):
        return
    target = dataset.shard_path(table, of=made, **_place(dataset, file))
    if not target.is_file():
        copy_file(file, target)


def made_as(dataset: Dataset, table: str, file: Path) -> Labelling | None:
    """The labelling of a file by its footer; the policy of plans is that of the dataset."""
    made, current = dataset.metadata(file), dataset.labelling
    policy = made.get("policy") if table == "labels" else (current.policy if current else "")
    if policy is None or not {"planner", "config"} <= set(made):
        return None
    return Labelling(planner=made["planner"], config=made["config"], policy=policy)


def clear(dataset: Dataset) -> None:
    """Remove the copies beside of what is in place now."""
    current = dataset.labelling
    for table in PLANNED if current else ():
        for file in dataset.files(table, of=current):
            place = dataset.shard_path(table, **_place(dataset, file))
            if place.is_file() and dataset.metadata(place) == dataset.metadata(file):
                file.unlink()


def resumed(root: str | Path) -> Dataset:
    """Open a dataset; a change-over that was cut short is done to its end first."""
    root = locate(root)
    file = root / "dataset.json"
    if file.is_file():
        said = None
        with suppress(ValueError):  # named by `Dataset.open`
            said = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(said, dict) and said.get("changing"):
            change_over(Dataset(root, said))
    return Dataset.open(root)
