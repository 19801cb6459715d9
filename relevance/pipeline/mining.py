"""Learning from failure: near copies of validation scenes in which a checkpoint left out a blocker.

A mined dataset is one of its own, all of it training scenes: `mined.json` holds the scenes that
were copied and the goals that failed, so that its shards can be made, killed and made again like
any others. Every second validation shard is looked at and no other. The scenes that were looked
at are named there too, and `merge` leaves their shards out of the merged dataset's validation
split: who trains on copies selects, calibrates and tunes on scenes that nobody copied.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from pydantic import TypeAdapter, ValidationError

from relevance.configs import config, dotted, first_error
from relevance.errors import RelevanceError
from relevance.hashing import content_hash
from relevance.labels import stored_scene
from relevance.pipeline.preparing import prepare
from relevance.pipeline.settings import (
    Counts,
    DatasetConfig,
    Positive,
    ShardSpec,
    load_config,
    settings_of_family,
    shards_of,
)
from relevance.planner import PLANNER_VERSION
from relevance.sampling import Jitter, near_copy, sample_goals, sample_scene
from relevance.scene import (
    FAMILIES,
    Goal,
    Predicate,
    Scene,
    goal_holds,
    scene_from_json,
    scene_to_json,
)
from relevance.store import Dataset, DatasetError, absolute, differences, replacing

FILE = "mined.json"
"""Within a mined dataset: a `Mined` as JSON."""
SPLIT = "validation"
"""Whose scenes are looked at."""


@config
class MiningConfig:
    """What is mined of a checkpoint's failures."""

    copies: Positive = 4
    """Near copies of each scene in which something relevant was left out."""
    beta: float = 0.0
    """At which decision: an object counts as left out when its score is at most -beta."""
    ambiguous: bool = False
    """Whether goals whose label could be another count too."""
    random: bool = False
    """Fresh random scenes instead of copies, as many of each family, with as many goals drawn of
    each predicate: what copies are to be compared with."""
    jitter: Jitter = Jitter()
    """How far a copy may be from its scene."""


@config
class Failed:
    """A scene with goals of which something relevant was left out."""

    family: str
    scene: dict[str, Any]
    """As scenes are written, with those goals."""


@config
class Mined:
    """What the scenes of a mined dataset are copies of, and what they are asked."""

    checkpoint: str
    """Whose failures they were."""
    how: MiningConfig
    looked_at: tuple[str, ...]
    """Ids of the validation scenes that were looked at, whether something failed or not."""
    failed: tuple[Failed, ...]
    """By family, in stored order; scene `index` of the dataset is a copy of `index // copies`."""

    @property
    def content_hash(self) -> str:
        """16 hex digits that name all of it."""
        return content_hash(self)

    @property
    def counts(self) -> Counts:
        """How many scenes are made of it."""
        families = [failed.family for failed in self.failed]
        return Counts.by_family({f: self.how.copies * families.count(f) for f in FAMILIES})

    def source(self, index: int) -> Scene:
        """The scene that scene `index` is a copy of, with the goals that failed."""
        failed = self.failed[index // self.how.copies]
        return scene_from_json(json.dumps(failed.scene), where=f"{FILE}, failed")

    def draw(
        self, config: DatasetConfig, family: str, index: int, attempt: int = 0
    ) -> Scene | None:
        """Scene `index`; None when this attempt failed (try the next)."""
        settings = settings_of_family(config.scene, family)
        if self.how.random:
            return sample_scene(settings, seed=config.seed, index=index, attempt=attempt)
        source, jitter = self.source(index), self.how.jitter
        return near_copy(source, settings, jitter, seed=config.seed, number=index, attempt=attempt)

    def goals(
        self, config: DatasetConfig, scene: Scene, predicate: Predicate, index: int
    ) -> tuple[Goal, ...]:
        """What scene `index` is asked: what failed, but for what is true of the copy already."""
        source = self.source(index)
        failed = [goal for goal in map(source.goal, source.goals) if goal.predicate == predicate]
        if self.how.random:
            seed, odds = config.drawn_by, config.goals
            return sample_goals(scene, predicate, len(failed), seed=seed, config=odds)
        return tuple(g for g in failed if not goal_holds(scene.objects, g, scene.robot))

    def write(self, root: Path) -> None:
        """Put it into the folder of a dataset, equal bytes for equal content."""
        text = json.dumps(_MINED.dump_python(self, mode="json"), sort_keys=True)
        with replacing(root / FILE) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def read(cls, root: Path) -> Self:
        """What `write` wrote; DatasetError where it is none."""
        file = root / FILE
        try:
            return _MINED.validate_json(file.read_bytes())
        except OSError as error:
            raise DatasetError(f"{file}: cannot be read ({error.strerror})") from None
        except ValidationError as error:
            raise DatasetError(f"{file}: {first_error(error)}, expected what was mined") from None
        except RelevanceError as error:
            raise DatasetError(f"{file}: {error}") from None


_MINED: TypeAdapter[Any] = TypeAdapter(Mined)


def mined_of(dataset: Dataset, config: DatasetConfig | None = None) -> Mined | None:
    """What a dataset was mined from; None for any other.

    Raises DatasetError when its file is not the one that dataset.json names.
    """
    config = config or load_config(dataset)
    if config.mined is None:
        return None
    found = Mined.read(dataset.path)
    if found.content_hash != config.mined:
        raise DatasetError(
            f"{dataset.path / FILE}: content hash: expected {config.mined} as dataset.json says, "
            f"found {found.content_hash}"
        )
    return found


def minable(dataset: Dataset) -> list[ShardSpec]:
    """The validation shards whose failures may be mined: of each kind every second one.

    Shards that come later change nothing of those before. The first of each kind is left for
    selection, so a kind with one shard gives none.
    """
    kinds: dict[tuple[str, str | None], list[ShardSpec]] = {}
    for spec in shards_of(dataset):
        if spec.split == SPLIT:
            kinds.setdefault((spec.family, spec.predicate), []).append(spec)
    found = [spec for specs in kinds.values() for spec in specs[1::2]]
    return sorted(found, key=lambda spec: spec.shard)


def mine(
    root: str | Path,
    into: str | Path,
    checkpoint_id: str,
    how: MiningConfig,
    *,
    score: Callable[[Sequence[int]], Any],
    policy: str | None = None,
) -> DatasetConfig:
    """Make the dataset of a checkpoint's failures; its scenes and labels are made as ever.

    `score` writes the checkpoint's predictions of the validation shards that it is told; `policy`
    is that of the labels which it learned. What was begun in `into` goes on without asking again.
    Raises DatasetError for a folder that holds something else, a dataset that was labelled by
    another planner than today's or has no validation shard to spare, and RelevanceError where
    nothing failed.
    """
    dataset, target = Dataset.open(absolute(root)), absolute(into)
    shards = minable(dataset)
    if not shards:
        raise DatasetError(
            f"{dataset.path}: no kind of scene has two {SPLIT} shards, expected one to mine and "
            f"one to select by; `relevance append {root} --split {SPLIT}` adds some"
        )
    rows = [
        (spec.family, row)
        for spec in shards
        for row in dataset.read_rows("scenes", split=SPLIT, shard=spec.shard)
    ]
    looked_at = tuple(row["scene_id"] for _, row in rows)
    if (target / "dataset.json").is_file():
        return _begun(target, checkpoint_id, how, looked_at)
    made_by = dataset.labelling.planner if dataset.labelling else None
    if made_by != PLANNER_VERSION:
        raise DatasetError(
            f"{dataset.path}: planner_version: expected {PLANNER_VERSION}, by which copies would "
            f"be labelled, found {made_by}; `relevance label {root} --replan` plans it anew"
        )
    score([spec.shard for spec in shards])
    goals = _failures(dataset, checkpoint_id, how, policy)
    failed = tuple(
        Failed(family=family, scene=_asked(row, goals[row["scene_id"]]))
        for family, row in sorted(rows, key=lambda item: FAMILIES.index(item[0]))
        if row["scene_id"] in goals
    )
    if not failed:
        raise RelevanceError(
            f"{dataset.path}: {checkpoint_id} leaves out nothing relevant in the {len(rows)} "
            f"{SPLIT} scenes that may be mined, at beta {how.beta:g}; there is nothing to copy"
        )
    mined = Mined(checkpoint=checkpoint_id, how=how, looked_at=looked_at, failed=failed)
    base = load_config(dataset)
    config = DatasetConfig(
        seed=int(mined.content_hash[:8], 16),
        train=mined.counts,
        scenes_per_shard=base.scenes_per_shard,
        scene=base.scene,
        goals=base.goals,
        planner=base.planner,
        replay_share=base.replay_share,
        policy=base.policy,
        mined=mined.content_hash,
    )
    mined.write(target)  # first: from dataset.json on the dataset is one
    prepare(target, config)
    return config


def _begun(
    target: Path, checkpoint_id: str, how: MiningConfig, looked_at: tuple[str, ...]
) -> DatasetConfig:
    """The config of what is in a folder; DatasetError unless it was mined just so."""
    dataset = Dataset.open(target)
    config = load_config(dataset)
    there = mined_of(dataset, config)
    if there is None:
        raise DatasetError(f"{target}: is a dataset that was not mined, expected another folder")
    wanted = {"checkpoint": checkpoint_id, **dotted(_plain(how)), "looked_at": looked_at}
    found = {"checkpoint": there.checkpoint, **dotted(_plain(there.how))}
    for key, old, new in differences({**found, "looked_at": there.looked_at}, wanted):
        if key == "looked_at":
            old, new = "other scenes", "those of this dataset"
        raise DatasetError(
            f"{target / FILE}: {key}: was mined with {old}, found {new}; take another folder"
        )
    return config


def _plain(how: MiningConfig) -> dict[str, Any]:
    return TypeAdapter(MiningConfig).dump_python(how, mode="json")


def _failures(
    dataset: Dataset, checkpoint_id: str, how: MiningConfig, policy: str | None
) -> dict[str, tuple[str, ...]]:
    """By scene, the goals of which the checkpoint leaves out something relevant."""
    query = """
        select distinct scene_id, predicate, subject, reference from judged
        where checkpoint_id = $name and split = $split and policy = coalesce($policy, policy)
            and relevant and not is_goal_object and score <= -$beta
            and ($ambiguous or not ambiguous)
        order by all
    """
    asked = {
        "name": checkpoint_id, "split": SPLIT, "policy": policy,
        "beta": how.beta, "ambiguous": how.ambiguous,
    }  # fmt: skip
    with dataset.connect(policy=policy) as connection:
        rows = connection.execute(query, asked).fetchall()
    found: dict[str, tuple[str, ...]] = {}
    for scene_id, predicate, subject, reference in rows:
        found[scene_id] = (*found.get(scene_id, ()), f"{predicate}({subject}, {reference})")
    return found


def _asked(row: dict[str, Any], goals: tuple[str, ...]) -> dict[str, Any]:
    scene = json.loads(scene_to_json(stored_scene(row)))
    return {**scene, "goals": list(goals)}


def looked_at(datasets: Sequence[Dataset]) -> frozenset[str]:
    """Ids of the scenes that some of the datasets were mined from."""
    found = (mined_of(dataset) for dataset in datasets)
    return frozenset(name for mined in found if mined for name in mined.looked_at)


def copied_shards(dataset: Dataset, seen: frozenset[str]) -> list[int]:
    """The validation shards of a dataset that hold a scene which was looked at."""
    files = dataset.files("scenes", split=SPLIT) if seen else []
    return [
        dataset.file_keys(file)["shard"]
        for file in files
        if not seen.isdisjoint(dataset.read_file(file)["scene_id"].to_pylist())
    ]


def leaks(merged: Dataset) -> Iterator[tuple[str, str]]:
    """(file, message) of the validation shards of a merged dataset whose scenes were copied."""
    seen = looked_at([Dataset.open(source.dataset.path) for source in merged.sources])
    for shard in copied_shards(merged, seen):
        file = merged.shard_path("scenes", split=SPLIT, shard=shard)
        yield (
            merged.name_of(file),
            "expected no scene that the training split may have copies of, found some; "
            "`relevance merge` leaves its shard out",
        )
