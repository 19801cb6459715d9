"""What is missing of a dataset, and the jobs that make it.

The command line, the flows and repair ask here, run the jobs in any order on as many processes
as they like, and call `Work.finish`. What cannot be is refused here, in one line for all of them,
before anything is written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from relevance.configs import override
from relevance.labels import POLICIES
from relevance.pipeline.settings import (
    DatasetConfig,
    ShardReport,
    ShardSpec,
    load_config,
    prepare,
)
from relevance.pipeline.shards import Progress, generate_shard, generated, label_shard, labelled
from relevance.pipeline.upkeep import finish
from relevance.scene import PREDICATES
from relevance.store import Dataset, DatasetError, absolute


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One unit of work that is left: a shard's scenes, or its labels of one predicate."""

    root: Path
    """Absolute, since a worker may run in another folder."""
    config: DatasetConfig
    stage: Literal["generate", "label"]
    spec: ShardSpec
    predicate: str | None = None
    """None for scenes and images."""
    policy: str | None = None
    """Another label policy than the dataset's own."""

    @property
    def name(self) -> str:
        """`train-000003` or `on-train-000003`."""
        shard = f"{self.spec.split}-{self.spec.shard:06d}"
        return f"{self.predicate}-{shard}" if self.predicate else shard

    @property
    def size(self) -> int:
        """Scenes in it."""
        return self.spec.count

    def run(self, progress: Progress | None = None) -> ShardReport:
        """Make it; `progress` hears (scenes done, scenes in all)."""
        if self.predicate is None:
            return generate_shard(self.root, self.config, self.spec, progress)
        return label_shard(
            self.root, self.config, self.spec, self.predicate, progress, policy=self.policy
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What is missing of one stage of a dataset."""

    root: Path
    config: DatasetConfig
    jobs: tuple[Job, ...]
    """What is missing; any order, any process."""
    done: int = 0
    """Units of work that were finished before."""
    waiting: int = 0
    """Shards that cannot be labelled yet, having no scenes."""

    def finish(self) -> None:
        """Note which stages are complete; raises RelevanceError for what must not pass unseen.

        Called once the jobs have run; a second call changes nothing.
        """
        finish(self.root)


def scenes_work(root: str | Path, config: DatasetConfig) -> Work:
    """Make or extend a dataset's dataset.json; the shards whose scenes are missing.

    Raises RelevanceError, with nothing written, for settings that are not those of the dataset
    that is there.
    """
    root = absolute(root)
    specs = prepare(root, config, scenes_only=True)
    dataset = Dataset.open(root)
    jobs = [
        Job(root=root, config=config, stage="generate", spec=spec)
        for spec in specs
        if not generated(dataset, spec)
    ]
    return Work(root=root, config=config, jobs=tuple(jobs), done=len(specs) - len(jobs))


def labels_work(
    root: str | Path,
    *,
    predicates: Sequence[str] | None = None,
    policy: str | None = None,
    replan: bool = False,
    goals_per_scene: int | None = None,
    goals_seed: int | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Work:
    """The labels that are missing of those shards whose scenes are there.

    `predicates` are all of them when None or empty; `policy` is the dataset's own when None.
    Other settings (`goals_per_scene`, `goals_seed`, or `overrides` by dotted name) ask to plan
    anew, as `replan` does. Raises RelevanceError for an unknown predicate, policy or setting, and
    for a dataset without any scene.
    """
    chosen = [PREDICATES[name] for name in predicates or PREDICATES]
    if policy is not None and policy not in POLICIES:
        raise DatasetError(f"policy {policy!r}: expected one of {', '.join(POLICIES)}")
    root = absolute(root)
    goals = {"goals_per_scene": goals_per_scene, "goals_seed": goals_seed}
    changes = {**(overrides or {}), **{k: v for k, v in goals.items() if v is not None}}
    config = override(load_config(Dataset.open(root)), changes)
    specs = prepare(root, config, replan=replan or bool(changes))
    return _labels(root, config, specs, [predicate.name for predicate in chosen], policy)


def missing(root: str | Path) -> Iterator[Work]:
    """What `repair` makes: scenes first, then labels of each policy that the dataset has some of.

    Do each before asking for the next: labels are only missing once their scenes are there.
    """
    root = absolute(root)
    dataset = Dataset.open(root)
    config = load_config(dataset)
    finished = dataset.description.get("finished", ())
    predicates = [
        name for name in PREDICATES if name in finished or dataset.files("labels", predicate=name)
    ]
    policies = sorted({of.policy for of in dataset.labellings()} - {config.policy})
    yield scenes_work(root, config)
    specs = prepare(root, config)
    for policy in (None, *policies):
        yield _labels(root, config, specs, predicates, policy)


def _labels(
    root: Path,
    config: DatasetConfig,
    specs: Sequence[ShardSpec],
    predicates: Sequence[str],
    policy: str | None,
) -> Work:
    dataset = Dataset.open(root)
    asked = [spec for spec in specs if any(p.name in predicates for p in spec.predicates)]
    there = [spec for spec in asked if dataset.has("scenes", split=spec.split, shard=spec.shard)]
    if asked and not there:
        raise DatasetError(f"{root}: no scenes of these predicates, expected `generate` first")
    pairs = [(s, p.name) for s in there for p in s.predicates if p.name in predicates]
    jobs = [
        Job(root=root, config=config, stage="label", spec=spec, predicate=name, policy=policy)
        for spec, name in pairs
        if not labelled(dataset, config, spec, name, policy)
    ]
    return Work(
        root=root,
        config=config,
        jobs=tuple(jobs),
        done=len(pairs) - len(jobs),
        waiting=len(asked) - len(there),
    )
