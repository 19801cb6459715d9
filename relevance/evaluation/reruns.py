"""The planner rerun with and without a checkpoint's guidance, paired, into rows.

How the comparison stays honest:

- Paired: each task is planned unguided and with every guide, one right after the other, the
  order rotated from task to task, so that a warm cache or a busy machine favours nobody.
- All of it counts: guided time includes the network and every fallback. The scene is encoded
  anew in each guided run, as though its goal came alone; `seconds_inference` says how much of
  the time that was. The picture itself is the camera's work and is not timed.
- CPU time (`time.process_time`, all threads), so that a shared machine does not blur it.
- Misses stay in: a task that `prune` fails and the unguided planner solves is a row.
- The replay of a plan is on neither side: both would pay the same for it.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from relevance.configs import config, identity_hash
from relevance.evaluation.predictions import Progress
from relevance.evaluation.scorer import NetworkScorer, load_scorer
from relevance.hashing import content_hash
from relevance.planner import (
    GUIDES,
    PLANNER_VERSION,
    Guide,
    PlannerConfig,
    PlanResult,
    Scorer,
    plan,
)
from relevance.scene import PREDICATES, Goal, Scene
from relevance.store import Dataset

EVALUATION_VERSION = "2"
"""Raised when rows of equal settings would come out otherwise."""


@config
class EvaluationConfig:
    """What to rerun, and how often."""

    guides: Annotated[tuple[str, ...], Field(min_length=1)] = ("prune", "prune-then-full")
    """Names of guides; the first is also rerun at `betas`."""
    beta: float = 0.0
    """The working point: an object is kept iff score > -beta."""
    betas: tuple[float, ...] = (-2.0, 2.0, 4.0)
    """Further values at which the first guide is rerun, on the first `sweep_tasks` tasks."""
    tasks: Annotated[int, Field(ge=0)] = 40
    """Tasks per predicate, drawn by the hash of their id; 0 takes all."""
    sweep_tasks: Annotated[int, Field(ge=0)] = 20
    """Tasks per predicate that also rerun the further betas."""
    repeats: Annotated[int, Field(ge=1)] = 1
    """Timed runs of each task and guide; the median counts."""
    split: Literal["train", "validation", "test"] = "test"
    searches: Annotated[tuple[Literal["tree", "informed"], ...], Field(min_length=1)] = ("tree",)
    """`tree` is the paper's uninformed baseline; `informed` our own stronger one."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Limits of the search; its own `search` is overridden by each of the ones above."""

    @model_validator(mode="after")
    def _guides(self) -> EvaluationConfig:
        allowed = [name for name, mode in GUIDES.items() if mode.guided]
        for guide in self.guides:
            if guide not in allowed:
                raise ValueError(f"unknown guide {guide!r}, expected one of {', '.join(allowed)}")
        for name in ("guides", "searches", "betas"):
            given = getattr(self, name)
            if len(set(given)) != len(given):
                raise ValueError(f"{name} {given}: expected distinct ones")
        return self

    @classmethod
    def smoke(cls) -> EvaluationConfig:
        """Seconds: enough to see every column filled."""
        return cls(tasks=2, sweep_tasks=1, betas=(2.0,))

    @classmethod
    def demo(cls) -> EvaluationConfig:
        """A minute or two."""
        return cls(tasks=24, sweep_tasks=10)

    @classmethod
    def laptop(cls) -> EvaluationConfig:
        """An hour."""
        return cls(tasks=200, sweep_tasks=60, repeats=3, betas=(-4.0, -2.0, -1.0, 1.0, 2.0, 4.0))

    @classmethod
    def paper(cls) -> EvaluationConfig:
        """Every test task."""
        return cls(tasks=0, sweep_tasks=500, repeats=3, betas=(-4.0, -2.0, -1.0, 1.0, 2.0, 4.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One goal of one stored scene."""

    plan_id: str
    scene_id: str
    shard: int
    goal: Goal
    nth: int
    """Its place among the tasks of its predicate and family, from 1."""


def choose_tasks(
    dataset: Dataset, *, split: str, per_predicate: int, predicates: Sequence[str] = ()
) -> list[Task]:
    """Planned goals of a split, unselected: the first by the hash of their id; 0 takes all.

    predicates: of these alone; none for all. Tasks that have no plan stay in: a user meets them
    too.
    """
    with dataset.connect() as connection:
        rows = connection.execute(
            """
            select plan_id, scene_id, shard, predicate, subject, reference, nth from (
                select *, row_number() over (
                    partition by family, predicate order by md5(plan_id)) as nth
                from plans left join shard_families using (split, shard) where split = $1)
            where ($2 = 0 or nth <= $2) and ($3 = [] or list_contains($3, predicate))
            order by predicate, family, nth
            """,
            [split, per_predicate, list(predicates)],
        ).fetchall()
    return [
        Task(
            plan_id=plan_id,
            scene_id=scene_id,
            shard=shard,
            goal=Goal(predicate=PREDICATES[predicate], subject=subject, reference=reference),
            nth=nth,
        )
        for plan_id, scene_id, shard, predicate, subject, reference, nth in rows
    ]


def evaluate(
    root: str | Path,
    checkpoint: str | Path,
    config: EvaluationConfig | None = None,
    *,
    shards: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> int:
    """Rerun the planner on tasks of a split's shards into `evaluations`; returns the row count.

    A shard whose file was made with the same settings, planner and tasks is left as it is;
    another file of this checkpoint and shard is replaced.
    """
    config = config or EvaluationConfig.demo()
    dataset = Dataset.open(root)
    scorer = load_scorer(checkpoint, into=dataset)
    shards = dataset.shards(config.split) if shards is None else shards
    tasks: dict[int, list[Task]] = {shard: [] for shard in shards}
    heads = scorer.model.predicates
    for task in choose_tasks(
        dataset, split=config.split, per_predicate=config.tasks, predicates=heads
    ):
        if task.shard in tasks:
            tasks[task.shard].append(task)
    total, done, count = sum(map(len, tasks.values())), 0, 0
    for shard, chosen in tasks.items():
        where = {"name": scorer.checkpoint_id, "split": config.split, "shard": shard}
        made_by = content_hash([hash_of(config), [task.plan_id for task in chosen]])
        file = dataset.shard_path("evaluations", **where)
        if file.is_file() and dataset.metadata(file).get("made_by") == made_by:
            done, count = done + len(chosen), count + dataset.read_file(file).num_rows
            continue
        rows: list[dict[str, Any]] = []
        for found in _reruns(dataset, shard, chosen, scorer, config):
            rows += found
            done += 1
            if progress:
                progress(done, total)
        dataset.write_rows("evaluations", rows, made_by={"made_by": made_by}, **where)
        count += len(rows)
    return count


def hash_of(config: EvaluationConfig) -> str:
    """16 hex digits of the settings and of what carries them out."""
    return identity_hash(config, evaluation=EVALUATION_VERSION, planner=PLANNER_VERSION)


def _reruns(
    dataset: Dataset,
    shard: int,
    tasks: Sequence[Task],
    scorer: NetworkScorer,
    config: EvaluationConfig,
) -> Iterator[list[dict[str, Any]]]:
    """The rows of each task."""
    made = {
        "checkpoint_id": scorer.checkpoint_id,
        "split": config.split,
        "config_hash": hash_of(config),
    }
    warm = False
    for sample in dataset.samples(config.split, [shard]) if tasks else ():
        for task in tasks:
            if task.scene_id != sample.scene.id:
                continue
            scorer.observe(sample.scene, sample.image, sample.views)
            if not warm:  # first calls load compiled code; nobody's time should hold that
                compare(sample.scene, task.goal, scorer, config)
                warm = True
            swept = task.nth <= config.sweep_tasks
            rows = compare(sample.scene, task.goal, scorer, config, swept=swept, turn=task.nth)
            yield [row | made for row in rows]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """One timed call of the planner."""

    result: PlanResult
    seconds: float
    inference: float

    @property
    def solved(self) -> bool:
        return self.result.status == "solved" and self.result.check_ok

    @property
    def length(self) -> int | None:
        return len(self.result.actions) if self.solved else None

    @property
    def nlps(self) -> int:
        return self.result.counts.keyframe + self.result.counts.path


def compare(
    scene: Scene,
    goal: Goal,
    scorer: Scorer,
    config: EvaluationConfig,
    *,
    swept: bool = False,
    turn: int = 0,
) -> list[dict[str, Any]]:
    """Plan one task unguided and with each guide; one row a search, guide and beta.

    `turn` rotates who goes first; further betas are rerun, with the first search, if `swept`.
    Rows lack checkpoint_id, split and config_hash.
    """
    scores, rows = scorer.scores(scene, goal), []
    for search in config.searches:
        guides = [(guide, config.beta) for guide in config.guides]
        if swept and search == config.searches[0]:
            guides += [(config.guides[0], beta) for beta in config.betas]
        runs: list[tuple[str, float] | None] = [None, *dict.fromkeys(guides)]
        planner = replace(config.planner, search=search)
        timed: dict[tuple[str, float] | None, list[_Run]] = defaultdict(list)
        for repeat in range(config.repeats):
            for position in range(len(runs)):
                which = runs[(position + turn + repeat) % len(runs)]
                guide = which and Guide(scorer=scorer, mode=which[0], beta=which[1])
                timed[which].append(_timed(scene, goal, planner, guide))
        unguided = timed.pop(None)
        for which in runs[1:]:
            assert which is not None
            (guide, beta), guided = which, timed[which]
            kept = {name for name, score in scores.items() if score > -beta}
            rows.append(
                {
                    "guide": guide,
                    "search": search,
                    "beta": beta,
                    "scene_id": scene.id,
                    "predicate": goal.predicate.name,
                    "subject": goal.subject,
                    "reference": goal.reference,
                    "n_objects": len(scene.objects),
                    "solved_unguided": unguided[0].solved,
                    "solved_guided": guided[0].solved,
                    "seconds_unguided": float(np.median([run.seconds for run in unguided])),
                    "seconds_guided": float(np.median([run.seconds for run in guided])),
                    "seconds_inference": float(np.median([run.inference for run in guided])),
                    "nodes_unguided": unguided[0].result.counts.nodes,
                    "nodes_guided": guided[0].result.counts.nodes,
                    "nlps_unguided": unguided[0].nlps,
                    "nlps_guided": guided[0].nlps,
                    "n_actions_unguided": unguided[0].length,
                    "n_actions_guided": guided[0].length,
                    "n_kept": len(kept | {goal.subject, goal.reference}),
                    "planner_version": PLANNER_VERSION,
                }
            )
    return rows


def _timed(scene: Scene, goal: Goal, planner: PlannerConfig, guide: Guide | None) -> _Run:
    scorer = guide.scorer if guide else None
    if isinstance(scorer, NetworkScorer):
        scorer.forget()
    start = time.process_time()
    result = plan(scene, goal, config=planner, guide=guide, replay=False)
    seconds = time.process_time() - start
    inference = scorer.seconds if isinstance(scorer, NetworkScorer) else 0.0
    return _Run(result=result, seconds=seconds, inference=inference)
