"""When a guide that waits should look: the patience that saves most work on validation tasks.

Work is counted (`Counts.work`), never timed, and a look has a stated price in it: equal tasks and
weights give equal answers on any machine. It is kept in the checkpoint's file, as offsets are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from relevance.configs import config
from relevance.evaluation.predictions import Progress
from relevance.evaluation.reruns import choose_tasks, limits
from relevance.evaluation.scorer import EvaluationError, NetworkScorer, load_scorer
from relevance.networks import named, read_checkpoint, write_checkpoint
from relevance.planner import Guide, PlannerConfig, plan
from relevance.scene import Goal, Scene
from relevance.store import Dataset

PRICE = {False: (2_000, 120), True: (350, 15)}
"""Work of one look: once, and for each box; of a network that is shown pictures, and of one that is
told poses. Measured: CPU time of a look over that of a unit of work, on the same core."""
NEARLY = 1.01
"""Of patiences whose work is at most this times the least, the smallest is chosen: what validation
hardly tells apart is decided for hard tasks, of which it has few and which have much to lose."""
WAITS = "lazy"
"""The guide that is tried."""


@config
class TuningConfig:
    """On what patience is chosen."""

    tasks: Annotated[int, Field(ge=0)] = 20
    """Tasks per predicate, drawn by the hash of their id; 0 takes all."""
    split: Literal["train", "validation", "test"] = "validation"
    searches: Annotated[tuple[Literal["tree", "informed"], ...], Field(min_length=1)] = (
        "tree", "informed",
    )  # fmt: skip
    """What is saved is summed up over these."""
    patiences: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (
        1_000, 2_000, 3_000, 5_000, 7_000, 10_000, 15_000, 20_000, 30_000, 50_000,
    )  # fmt: skip
    """Among which is chosen. One that does not wait at all is `order`: it loses on easy tasks."""
    price: Annotated[int, Field(ge=0)] | None = None
    """Work that one look costs; by what the network takes, and the number of boxes, when empty."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Limits of the search, the dataset's own where these are the defaults; its `search` is
    overridden by each of the ones above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Patience:
    """What one amount of patience costs, summed up over the tasks of all searches."""

    patience: int
    work: int
    """Looks included."""
    looks: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuned:
    """What was chosen, and among what."""

    patience: int
    runs: int
    """Tasks, each once a search."""
    unguided: int
    """Work without a guide, to the first plan."""
    tried: tuple[Patience, ...]


def tune(
    root: str | Path,
    checkpoint: str | Path,
    config: TuningConfig | None = None,
    *,
    progress: Progress | None = None,
) -> Tuned:
    """Choose a checkpoint's patience on a dataset's validation tasks, and keep it in its file.

    Raises EvaluationError where there are no tasks.
    """
    config = config or TuningConfig()
    dataset, path = Dataset.open(root), named(checkpoint)
    scorer = load_scorer(path)
    tasks = choose_tasks(
        dataset,
        split=config.split,
        per_predicate=config.tasks,
        predicates=scorer.model.predicates,
    )
    if not tasks:
        raise EvaluationError(f"{dataset.path}: no {config.split} tasks, expected planned goals")
    total = {
        patience: Patience(patience=patience, work=0, looks=0) for patience in config.patiences
    }
    own = limits(dataset, config.planner)
    unguided = done = 0
    for sample in dataset.samples(config.split, sorted({task.shard for task in tasks})):
        for task in tasks:
            if task.scene_id != sample.scene.id:
                continue
            scorer.observe(sample.scene, sample.image, sample.views)
            for search in config.searches:
                planner = replace(own, search=search, stop="first")
                plain, found = costs(sample.scene, task.goal, scorer, planner, config)
                unguided += plain
                for one in found:
                    before = total[one.patience]
                    total[one.patience] = replace(
                        before, work=before.work + one.work, looks=before.looks + one.looks
                    )
            done += 1
            if progress:
                progress(done, len(tasks))
    tried = tuple(total.values())
    tuned = Tuned(
        patience=chosen(tried),
        runs=len(tasks) * len(config.searches),
        unguided=unguided,
        tried=tried,
    )
    _keep(path, tuned.patience)
    return tuned


def chosen(tried: Sequence[Patience]) -> int:
    """The smallest patience that costs hardly more work than the one that costs least."""
    least = min(one.work for one in tried)
    return min(one.patience for one in tried if one.work <= NEARLY * least)


def tune_once(
    root: str | Path, checkpoint: str | Path, *, progress: Progress | None = None
) -> None:
    """`tune`, where nobody did and there are tasks to choose on."""
    meta = read_checkpoint(named(checkpoint)).meta
    if "patience" not in meta and choose_tasks(
        Dataset.open(root), split="validation", per_predicate=1, predicates=meta["predicates"]
    ):
        tune(root, checkpoint, progress=progress)


def costs(
    scene: Scene,
    goal: Goal,
    scorer: NetworkScorer,
    planner: PlannerConfig,
    config: TuningConfig,
) -> tuple[int, list[Patience]]:
    """Work of one task without a guide, and with each patience."""
    once, each = PRICE[scorer.model.told]
    price = once + each * len(scene.objects) if config.price is None else config.price
    plain = plan(scene, goal, config=planner, replay=False).counts.work
    found: list[Patience] = []
    for patience in sorted(set(config.patiences)):
        if found and not found[-1].looks:  # it was done without a look: waiting longer is the same
            found.append(replace(found[-1], patience=patience))
            continue
        guide = Guide(scorer=scorer, mode=WAITS, patience=patience)
        result = plan(scene, goal, config=planner, guide=guide, replay=False)
        work = result.counts.work + price * result.looked
        found.append(Patience(patience=patience, work=work, looks=int(result.looked)))
    return plain, found


def _keep(path: Path, patience: int) -> None:
    """Write it into a checkpoint's file; its id, weights and graphs stay."""
    found = read_checkpoint(path)
    if found.meta.get("patience") != patience:
        write_checkpoint(path, replace(found, meta={**found.meta, "patience": patience}))
