"""What is missing of a dataset, and the jobs that make it.

The command line, the flows and repair ask here, run the jobs in any order on as many processes
as they like, and call `Work.finish`. What cannot be is refused here, in one line for all of them,
before anything is written.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from relevance.configs import override
from relevance.errors import RelevanceError
from relevance.labels import POLICIES
from relevance.pipeline.labelling import label_shard, labelled
from relevance.pipeline.measuring import Progress
from relevance.pipeline.preparing import pending, prepare, refuse_other_scenes, resumed
from relevance.pipeline.scenes import generate_shard, generated, try_out
from relevance.pipeline.settings import DatasetConfig, ShardReport, ShardSpec, load_config
from relevance.pipeline.upkeep import broken, finish, refused
from relevance.scene import PREDICATES
from relevance.store import Dataset, DatasetError, absolute, compact


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
    anew: frozenset[str] = frozenset()
    """What is made again although it is there: `scenes`, or `plans` or `labels`."""

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
            return generate_shard(self.root, self.config, self.spec, progress, anew=bool(self.anew))
        return label_shard(
            self.root,
            self.config,
            self.spec,
            self.predicate,
            progress,
            policy=self.policy,
            anew=self.anew,
        )


class PlansRefused(RelevanceError):
    """The replay refuses more plans than chance allows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What is missing of one stage of a dataset."""

    root: Path
    config: DatasetConfig
    stage: Literal["generate", "label"]
    jobs: tuple[Job, ...]
    """What is missing; any order, any process."""
    done: int = 0
    """Units of work that were finished before."""
    waiting: int = 0
    """Shards that cannot be labelled yet, having no scenes."""

    def finish(self) -> None:
        """Note which stages are complete; raises PlansRefused for what must not pass unseen.

        Called once the jobs have run; a second call changes nothing.
        """
        finish(self.root)
        if self.stage == "label" and (problem := refused(Dataset.open(self.root))):
            raise PlansRefused(f"{self.root}: {problem}")


def scenes_work(root: str | Path, config: DatasetConfig) -> Work:
    """Make or extend a dataset's dataset.json; the shards whose scenes are missing.

    Raises RelevanceError, with nothing written, for settings that are not those of the dataset
    that is there.
    """
    root = absolute(root)
    if not (root / "dataset.json").is_file():
        try_out(config)
    specs = prepare(root, config, scenes_only=True)
    return _scenes(root, config, specs)


def _scenes(
    root: Path,
    config: DatasetConfig,
    specs: Sequence[ShardSpec],
    anew: Collection[tuple[str, int]] = (),
) -> Work:
    dataset = Dataset.open(root)
    jobs = [
        Job(
            root=root,
            config=config,
            stage="generate",
            spec=spec,
            anew=frozenset({"scenes"} if (spec.split, spec.shard) in anew else ()),
        )
        for spec in specs
        if (spec.split, spec.shard) in anew or not generated(dataset, spec)
    ]
    if jobs:
        refuse_other_scenes(dataset, config)
    done = len(specs) - len(jobs)
    return Work(root=root, config=config, stage="generate", jobs=tuple(jobs), done=done)


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
    anew, as `replan` does; what was cut short goes on without asking again. Raises RelevanceError
    for an unknown predicate, policy or setting, and for a dataset without any scene.
    """
    chosen = [PREDICATES[name] for name in predicates or PREDICATES]
    if policy is not None:
        POLICIES[policy]  # refuses an unknown one
    root = absolute(root)
    goals = {"goals_per_scene": goals_per_scene, "goals_seed": goals_seed}
    changes = {**(overrides or {}), **{k: v for k, v in goals.items() if v is not None}}
    dataset = resumed(root)
    if load_config(dataset).mined is not None and {"goals_per_scene", "goals_seed"} & {*changes}:
        raise RelevanceError(f"{root}: is asked the goals that were mined, expected no others")
    under_way = None if replan or changes or policy else pending(dataset)
    config = override(under_way or load_config(dataset), changes)
    specs = prepare(root, config, replan=replan or bool(changes))
    return _labels(root, config, specs, [predicate.name for predicate in chosen], policy)


def missing(root: str | Path, named: Iterable[str] = ()) -> Iterator[Work]:
    """What `repair` makes: scenes first, then labels of each policy that the dataset has some of.

    Besides what is not there, those of the `named` files that can be made anew exactly, each
    under a temporary name before it takes the place of the broken one (see `beyond_repair`). Do
    each before asking for the next: labels are only missing once their scenes are there.
    """
    root = absolute(root)
    dataset = resumed(root)
    config = load_config(dataset)
    named = list(named)
    anew, _ = broken(dataset, named)
    specs = prepare(root, config, scenes_only=True)
    shards = {(split, shard) for split, shard, predicate, _ in anew if predicate is None}
    yield _scenes(root, config, specs, shards)
    if dataset.labelling != config.labelling:
        return  # planned by another version: what is missing has to be planned anew as a whole
    finished = dataset.description.get("finished", ())
    predicates = [
        name
        for name in PREDICATES
        if name in finished
        or dataset.files("labels", predicate=name)
        or any(name == predicate for _, _, predicate, _ in anew)
    ]
    policies = {
        of.policy for of in dataset.labellings() if of.planned_by == config.labelling.planned_by
    }
    for policy in (None, *sorted(policies - {config.policy})):
        mine = {
            (split, shard, predicate): tables
            for (split, shard, predicate, of), tables in anew.items()
            if predicate is not None and of == policy
        }
        if predicates:
            yield _labels(root, config, specs, predicates, policy, mine)
    if any(Path(name).parts[0] == "compacted" for name in named):
        compact(Dataset.open(root))


def beyond_repair(root: str | Path, named: Iterable[str]) -> dict[str, str]:
    """Those of the named files that `missing` does not make anew, and why."""
    return broken(Dataset.open(root), named)[1]


def _labels(
    root: Path,
    config: DatasetConfig,
    specs: Sequence[ShardSpec],
    predicates: Sequence[str],
    policy: str | None,
    anew: Mapping[tuple[str, int, str], set[str]] | None = None,
) -> Work:
    dataset = Dataset.open(root)
    asked = [spec for spec in specs if any(p.name in predicates for p in spec.predicates)]
    there = [spec for spec in asked if dataset.has("scenes", split=spec.split, shard=spec.shard)]
    if asked and not there:
        raise DatasetError(f"{root}: no scenes of these predicates, expected `generate` first")
    pairs = [(s, p.name) for s in there for p in s.predicates if p.name in predicates]
    wanted = [(s, name, (anew or {}).get((s.split, s.shard, name), set())) for s, name in pairs]
    jobs = [
        Job(
            root=root,
            config=config,
            stage="label",
            spec=spec,
            predicate=name,
            policy=policy,
            anew=frozenset(tables),
        )
        for spec, name, tables in wanted
        if tables or not labelled(dataset, config, spec, name, policy)
    ]
    return Work(
        root=root,
        config=config,
        stage="label",
        jobs=tuple(jobs),
        done=len(pairs) - len(jobs),
        waiting=len(asked) - len(there),
    )
