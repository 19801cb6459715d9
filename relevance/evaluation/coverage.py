"""Calibrating a checkpoint on a dataset, and what its promises are worth on any dataset.

What is counted is goals of which every relevant object was kept. Goals of one scene are not
independent, so an exact interval counts one goal a scene, drawn without looking at its scores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from relevance.evaluation.accuracies import Predictions, read_predictions
from relevance.evaluation.calibration import (
    KEY,
    LEVELS,
    Calibration,
    CalibrationError,
    Needs,
    Promise,
    check_coverage,
)
from relevance.evaluation.comparisons import Comparison, summarise
from relevance.evaluation.predictions import Progress, predict
from relevance.evaluation.reruns import EvaluationConfig, choose_tasks, compare, limits
from relevance.evaluation.scorer import load_scorer, open_checkpoint
from relevance.metrics import WIDE, Interval, binomial_interval, mean
from relevance.networks import named, read_checkpoint, write_checkpoint
from relevance.scene import FAMILIES, PREDICATES
from relevance.store import Dataset


def calibrate(
    root: str | Path,
    checkpoint: str | Path,
    *,
    split: Literal["validation", "test"] = "validation",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a checkpoint on the labelled scenes of a split, and store that in its file.

    Not on scenes that it was trained on: its scores there are better than anywhere else.
    CalibrationError where no goal of the split is labelled.
    """
    path = named(checkpoint)
    predict(root, path, split=split, progress=progress)
    dataset, (scorer, _) = Dataset.open(root), open_checkpoint(path)
    found = calibration_of(
        read_predictions(dataset, scorer.checkpoint_id, split=split),
        dataset_hash=dataset.content_hash(policy=scorer.policy, split=split),
        split=split,
    )
    if not found.needs:
        raise CalibrationError(f"{dataset.path}: no labelled goals of split {split} to go by")
    stored = read_checkpoint(path)
    write_checkpoint(path, replace(stored, meta={**stored.meta, KEY: found.to_json()}))
    return found


def calibration_of(predictions: Predictions, *, dataset_hash: str, split: str) -> Calibration:
    """What scores of labelled goals say about every coverage."""
    needs: dict[str, dict[str, Needs]] = {}
    for name in PREDICATES:
        for family in FAMILIES:
            mine = (predictions.predicate == name) & (predictions.family == family)
            if mine.any():
                part = predictions.where(mine)
                _, first, goal = np.unique(part.task, return_index=True, return_inverse=True)
                need = np.full(len(first), -np.inf)
                asked = part.relevant & ~part.is_goal_object
                np.maximum.at(need, goal[asked], -part.score[asked])
                needs.setdefault(name, {})[family] = Needs.of(need, part.scene[first])
    return Calibration(dataset_hash=dataset_hash, split=split, needs=needs)


@dataclass(frozen=True, slots=True, kw_only=True)
class Covered:
    """What a coverage came to, on the goals of a predicate or a family of scenes."""

    group: str
    coverage: float
    """The probability that was promised."""
    beta: float
    """The betas of its predicates, averaged over goals."""
    reached: Interval
    """Share of the goals with every relevant object kept, one goal a scene, exact interval."""
    reached_all: float
    """The same over all goals, each scene weighing the same."""
    goals: int
    objects: float
    """Boxes in the scene, mean over goals."""
    kept: float
    """Boxes that are kept, the goal's own included, mean over goals."""

    @property
    def breached(self) -> bool:
        """Whether the promise is broken beyond chance: the interval lies below it."""
        return self.reached.high < self.coverage


def covered(
    predictions: Predictions, calibration: Calibration, *, levels: Sequence[float] = LEVELS
) -> list[Covered]:
    """What the coverages came to on labelled goals: rows a family, then its predicates.

    Predicates for which a coverage cannot be had are left out of it, see `out_of_reach`.
    """
    found = []
    for group in _groups():
        part = predictions.of(group)
        for level in levels if len(part) else ():
            betas = {
                str(name): _beta(calibration, name, level) for name in np.unique(part.predicate)
            }
            there = part.where(np.array([betas[name] is not None for name in part.predicate]))
            if len(there):
                beta = np.array([betas[name] for name in there.predicate], float)
                found.append(_covered(group, level, there, beta))
    return found


def out_of_reach(
    predictions: Predictions, calibration: Calibration, *, levels: Sequence[float] = LEVELS
) -> list[str]:
    """Why some coverages cannot be had for predicates that there are goals of, in words."""
    said = []
    for name in dict.fromkeys(predictions.predicate.tolist()):
        for level in levels:
            try:
                calibration.beta(name, level)
            except CalibrationError as error:
                said.append(str(error))
    return list(dict.fromkeys(said))


def read_calibration(checkpoint: str | Path, levels: Sequence[float] = LEVELS) -> Calibration:
    """The calibration that a checkpoint has; CalibrationError without one, or for a level that
    is no share."""
    meta = read_checkpoint(named(checkpoint)).meta
    for level in levels:
        check_coverage(level)
    return Promise.of(meta, LEVELS[0]).calibration


def covered_speeds(
    root: str | Path,
    checkpoint: str | Path,
    config: EvaluationConfig | None = None,
    *,
    levels: Sequence[float] = LEVELS,
    progress: Progress | None = None,
) -> dict[float, list[Comparison]]:
    """The planner rerun at every coverage: a comparison a search and guide, all tasks together.

    Of the settings, `beta`, `betas` and `priors` have no part in it. Tasks of a predicate for which
    a coverage cannot be had are left out of it.
    """
    config = replace(config or EvaluationConfig.demo(), beta=0.0, betas=(), priors=())
    dataset = Dataset.open(root)
    config = replace(config, planner=limits(dataset, config.planner))
    scorers = {level: load_scorer(checkpoint, coverage=level) for level in levels}
    calibration = read_calibration(checkpoint, levels)
    heads = tuple(calibration.needs)
    tasks = choose_tasks(dataset, split=config.split, per_predicate=config.tasks, predicates=heads)
    rows: dict[float, list[dict[str, Any]]] = {level: [] for level in levels}
    done = 0
    for sample in dataset.samples(config.split, sorted({task.shard for task in tasks})):
        for task in [task for task in tasks if task.scene_id == sample.scene.id]:
            for level, scorer in scorers.items():
                if _beta(calibration, task.goal.predicate.name, level) is None:
                    continue
                scorer.observe(sample.scene, sample.image, sample.views)
                if not done:  # first calls load compiled code
                    compare(sample.scene, task.goal, scorer, config)
                rows[level] += compare(sample.scene, task.goal, scorer, config, turn=task.nth)
            done += 1
            if progress:
                progress(done, len(tasks))
    return {level: _comparisons(found) for level, found in rows.items() if found}


def _comparisons(rows: Sequence[Mapping[str, Any]]) -> list[Comparison]:
    settings = dict.fromkeys((row["search"], row["guide"]) for row in rows)
    return [
        summarise([dict(row) for row in rows if (row["search"], row["guide"]) == setting])
        for setting in settings
    ]


def _covered(group: str, level: float, rows: Predictions, beta: np.ndarray) -> Covered:
    """Of rows and the beta of each; goals are counted by their rows."""
    kept = (rows.score > -beta) | rows.is_goal_object
    _, first, goal = np.unique(rows.task, return_index=True, return_inverse=True)
    whole = np.bincount(goal, rows.relevant & ~kept) == 0
    _, scene, goals = np.unique(rows.scene[first], return_inverse=True, return_counts=True)
    # One goal a scene: the first in an order that nobody's scores had a part in.
    order = np.random.default_rng(0).permutation(len(first))
    _, chosen = np.unique(scene[order], return_index=True)
    hits = whole[order][chosen]
    return Covered(
        group=group,
        coverage=level,
        beta=mean(beta[first]),
        reached=binomial_interval(int(hits.sum()), len(hits), confidence=WIDE),
        reached_all=float(np.average(whole, weights=1 / goals[scene])),
        goals=len(first),
        objects=mean(rows.n_objects[first]),
        kept=mean(np.bincount(goal, kept)),
    )


def _beta(calibration: Calibration, predicate: str, coverage: float) -> float | None:
    try:
        return calibration.beta(predicate, coverage)
    except CalibrationError:
        return None


def _groups() -> list[str]:
    """Families, each before its predicates; a name of both comes once."""
    return list(
        dict.fromkeys(
            name
            for family in FAMILIES
            for name in (family, *(p.name for p in PREDICATES.values() if p.family == family))
        )
    )
