"""Whether a checkpoint becomes the champion: it and the present one, rerun on today's tasks.

Two figures, both paired, with a bootstrap interval (metrics.py) at `confidence`:

- *true relevant* of the test split's queries, by today's labels of the contender's policy, drawn
  scene by scene: it must not fall beyond noise (the interval must not lie under 0).
- *work* (`Counts.work`: bound calls at stated prices, no clock) on fresh tasks of many boxes,
  summed over those that either solves: it must shrink beyond noise (the ratio's interval must
  lie under 1). A guide that loses no task is asked for, so a miss costs what the fallback does.

Without a champion the contender is held against no guide, which keeps every object and stops as the
guide does (a guide whose first plan counts against a search of which the first plan counts): only
the work counts then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from relevance.configs import config, identity_hash
from relevance.evaluation.predictions import (
    Progress,
    policy_of_checkpoint,
    predict,
    unjudged,
)
from relevance.evaluation.reruns import settings_of
from relevance.evaluation.scorer import EvaluationError, NetworkScorer, load_scorer
from relevance.metrics import Interval, bootstrap, ratio_of_sums
from relevance.networks import Learned, find_checkpoint, read_record, settle
from relevance.planner import GUIDES, Guide, PlannerConfig, plan
from relevance.sampling import SAMPLER_VERSION, SceneConfig, sample_task
from relevance.scene import PREDICATES, Goal, Scene
from relevance.store import Dataset

_STREAM = "champion"  # a split of its own: never a scene of a dataset


@config
class TrialConfig:
    """How contenders are tried."""

    tasks: Annotated[int, Field(ge=2)] = 400
    """Fresh tasks, predicates in turn; with 20 boxes about a minute of CPU for both models."""
    boxes: Annotated[int, Field(ge=3, le=30)] = 20
    """Boxes of each."""
    guide: str = "order"
    """How scores enter the search; a complete one."""
    confidence: Annotated[float, Field(gt=0.5, lt=1)] = 0.95
    """What is within this interval is noise."""

    @field_validator("guide")
    @classmethod
    def _complete(cls, guide: str) -> str:
        allowed = [name for name, mode in GUIDES.items() if mode.guided and mode.complete]
        if guide not in allowed:
            raise ValueError(f"one of {', '.join(allowed)}")
        return guide

    @classmethod
    def smoke(cls) -> TrialConfig:
        """Seconds: too few tasks to promote anything but by a wide margin."""
        return cls(tasks=4, boxes=8)

    @classmethod
    def demo(cls) -> TrialConfig:
        """A minute."""
        return cls()

    @classmethod
    def laptop(cls) -> TrialConfig:
        """Three minutes."""
        return cls(tasks=1000)

    @classmethod
    def paper(cls) -> TrialConfig:
        """Six minutes."""
        return cls(tasks=2000)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A contender held against the champion, or against no guide where there is none."""

    contender: str
    champion: str | None
    change: Interval | None
    """How much true relevant rose, a share, over scenes; None without a champion."""
    work: Interval
    """Work of the contender over the other's, over the tasks that either solves."""
    boxes: int
    lacking: tuple[str, ...] = ()
    """Predicates that the champion answers and the contender cannot; then nothing was rerun."""

    @property
    def faults(self) -> tuple[str, ...]:
        """Why it is refused; none where it is promoted."""
        if self.lacking:
            return (f"it has no head for {', '.join(self.lacking)}",)
        found = []
        if self.change is not None and not self.change.high >= 0:  # nan is no proof either
            found.append("true relevant falls")
        if not self.work.high < 1:
            found.append("no less work beyond noise")
        return tuple(found)

    @property
    def promoted(self) -> bool:
        """Whether it is better, beyond noise."""
        return not self.faults

    @property
    def why(self) -> str:
        """The figures, and what they decide, in a sentence."""
        said = ", ".join(self.faults) or "better, beyond noise"
        if self.lacking:
            return said
        figures = (
            f"work {self.work:.2f} times that of {self.champion or 'no guide'} "
            f"on {self.work.n} solved tasks of {self.boxes} boxes"
        )
        if self.change is not None:
            low, value, high = (
                f"{100 * share:+.1f}"
                for share in (self.change.low, self.change.value, self.change.high)
            )
            figures += (
                f"; true relevant {value} points ({low} to {high}) on {self.change.n} test scenes"
            )
        return f"{said}: {figures}"


def contend(
    root: str | Path,
    checkpoint: str | Path,
    config: TrialConfig | None = None,
    *,
    learned: Learned | None = None,
    progress: Progress | None = None,
) -> Trial | None:
    """Try a checkpoint against the champion and promote or refuse it, which the record keeps with
    what it `learned` from.

    Where another was promoted meanwhile, it is tried against that one. None where it is the
    champion itself.
    """
    config = config or TrialConfig()
    dataset = Dataset.open(root)
    path = find_checkpoint(root, checkpoint)
    contender = load_scorer(path, into=dataset)
    name = contender.checkpoint_id
    while (standing := read_record(dataset).champion) != name:
        other = None if standing is None else load_scorer(find_checkpoint(root, standing))
        trial = _trial(dataset, path, contender, other, config, progress)
        found = {"promoted": trial.promoted, "why": trial.why, "learned": learned}
        if settle(dataset, name, before=standing, **found):
            return trial
    return None


def _trial(
    dataset: Dataset,
    path: Path,
    contender: NetworkScorer,
    champion: NetworkScorer | None,
    config: TrialConfig,
    progress: Progress | None,
) -> Trial:
    name, standing = contender.checkpoint_id, champion.checkpoint_id if champion else None
    asked = champion.model.predicates if champion else contender.model.predicates
    lacking = tuple(p for p in asked if p not in contender.model.predicates)
    if lacking:
        nothing = Interval(value=np.nan, low=np.nan, high=np.nan, n=0)
        return Trial(
            contender=name, champion=standing, change=None, work=nothing, boxes=config.boxes,
            lacking=lacking,
        )  # fmt: skip
    planner = settings_of(dataset).planner
    if GUIDES[config.guide].first:  # then no guide, too, is done with its first plan
        planner = replace(planner, stop="first")
    guides = [
        scorer and Guide(scorer=scorer, mode=config.guide) for scorer in (contender, champion)
    ]
    pairs = []
    for done, (scene, goal) in enumerate(fresh_tasks(dataset, config, asked), 1):
        pairs.append([_spent(scene, goal, planner, guide) for guide in guides])
        if progress:
            progress(done, config.tasks)
    return Trial(
        contender=name,
        champion=standing,
        change=_change(dataset, path, name, standing, config.confidence),
        work=_ratio(pairs, config.confidence),
        boxes=config.boxes,
    )


def fresh_tasks(
    dataset: Dataset, config: TrialConfig, predicates: Sequence[str]
) -> list[tuple[Scene, Goal]]:
    """The tasks of a trial: as the dataset draws its scenes, but for their number of boxes.

    They depend on the scenes' settings, the predicates and `config` alone; more tasks keep the
    earlier ones. Raises EvaluationError for more boxes than its scenes can hold.
    """
    scenes: SceneConfig = settings_of(dataset).scene
    seed = int(identity_hash([scenes, config.boxes], sampler=SAMPLER_VERSION)[:15], 16)
    chosen = [predicate for name, predicate in PREDICATES.items() if name in predicates]
    tasks = []
    for index in range(config.tasks):
        predicate = chosen[index % len(chosen)]
        found = sample_task(scenes, predicate, config.boxes, seed=seed, index=index, split=_STREAM)
        if found is None:
            raise EvaluationError(
                f"{dataset.path}: no scene of {config.boxes} boxes for {predicate.name}, expected "
                "fewer boxes for trials"
            )
        tasks.append(found)
    return tasks


def _spent(
    scene: Scene, goal: Goal, planner: PlannerConfig, guide: Guide | None
) -> tuple[int, bool]:
    """The work of one task, and whether it was solved."""
    result = plan(scene, goal, config=planner, guide=guide, replay=False)
    return result.counts.work, result.status == "solved" and result.check_ok


def _ratio(pairs: Sequence[Sequence[tuple[int, bool]]], confidence: float) -> Interval:
    """Work over work of the tasks that either solved."""
    solved = [(mine[0], its[0]) for mine, its in pairs if mine[1] or its[1]]
    mine, its = np.array(solved, dtype=float).reshape(-1, 2).T
    return bootstrap((mine, its), ratio_of_sums, confidence=confidence)


def _change(
    dataset: Dataset, path: Path, contender: str, champion: str | None, confidence: float
) -> Interval | None:
    """How much true relevant rose from the champion to the contender, on today's labels."""
    if champion is None:
        return None
    for name, file in ((contender, path), (champion, find_checkpoint(dataset.path, champion))):
        scored = dataset.files("predictions", checkpoint_id=name, split="test")
        if not scored or unjudged(dataset, name):
            predict(dataset.path, file)
    policy = policy_of_checkpoint(dataset, contender)
    with dataset.connect(policy=policy) as connection:
        columns = connection.execute(
            """
            select count(*) as relevant, sum((n.score > 0)::int - (o.score > 0)::int) as gained
            from judged as n
            join judged as o using (split, scene_id, predicate, subject, reference, query)
            where n.checkpoint_id = $1 and o.checkpoint_id = $2 and split = 'test'
                and n.policy = $3 and o.policy = $3 and n.relevant and not n.is_goal_object
            group by scene_id order by scene_id
            """,
            [contender, champion, policy],
        ).fetchnumpy()
    gained, relevant = (np.asarray(columns[name], float) for name in ("gained", "relevant"))
    return bootstrap(
        (gained, relevant),
        lambda g, r, axis: g.sum(axis=axis) / r.sum(axis=axis),
        confidence=confidence,
    )
