"""Rows of `predictions` and `evaluations` to the figures that pages and tables show.

Accuracies are shares of objects; times are CPU seconds a task with bootstrap intervals. A
task that a guide misses stays in the figures: its cost is the guided attempt and then the
unguided run that a user would need. The paper's way, misses left out, stands beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from relevance.scene import PREDICATES
from relevance.store import Dataset

CONFIDENCE = 0.67
"""Level of every interval, as in the paper's runtime tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Shares of objects judged rightly at one beta, in 0..1; nan where there are none."""

    n_tasks: int
    n_rows: int
    share_relevant: float
    true_relevant: float
    """Of the relevant objects, the share kept."""
    true_irrelevant: float
    """Of the irrelevant objects, the share left out."""
    total: float
    base_rate: float
    """What `always irrelevant` scores in total."""
    tasks_whole: float
    """Share of tasks in which every relevant object was kept, so that `prune` can succeed."""

    @property
    def balanced(self) -> float:
        """Mean of the two shares; a constant answer reaches 0.5."""
        return (self.true_relevant + self.true_irrelevant) / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Predictions:
    """Predictions of one checkpoint as columns, (R,) each."""

    predicate: np.ndarray
    task: np.ndarray
    """Number of the task that the row belongs to."""
    relevant: np.ndarray
    score: np.ndarray
    is_goal_object: np.ndarray

    def __len__(self) -> int:
        return len(self.score)

    def where(self, mask: np.ndarray) -> Predictions:
        """The rows that a boolean mask (R,) selects."""
        return Predictions(
            predicate=self.predicate[mask],
            task=self.task[mask],
            relevant=self.relevant[mask],
            score=self.score[mask],
            is_goal_object=self.is_goal_object[mask],
        )

    def of(self, group: str) -> Predictions:
        """Rows of one predicate, or of the family `same-plane`; `all` gives everything."""
        if group == "all":
            return self
        return self.where(np.array([in_group(name, group) for name in self.predicate], bool))

    def queries(self) -> Predictions:
        """Rows other than those of subject and reference."""
        return self.where(~self.is_goal_object)

    def accuracy(self, beta: float = 0.0) -> Accuracy:
        """Shares judged rightly when an object is kept iff score > -beta."""
        kept, relevant = self.score > -beta, self.relevant
        tasks, numbers = np.unique(self.task, return_inverse=True)
        lost = np.zeros(len(tasks), dtype=bool)
        np.logical_or.at(lost, numbers, relevant & ~kept)
        return Accuracy(
            n_tasks=len(tasks),
            n_rows=len(self),
            share_relevant=_mean(relevant),
            true_relevant=_mean(kept[relevant]),
            true_irrelevant=_mean(~kept[~relevant]),
            total=_mean(kept == relevant),
            base_rate=_mean(~relevant),
            tasks_whole=_mean(~lost),
        )


def read_predictions(dataset: Dataset, checkpoint_id: str, *, split: str = "test") -> Predictions:
    """All predictions of a checkpoint on a split, in a fixed order."""
    with dataset.connect() as connection:
        columns = connection.execute(
            """
            select predicate, relevant, score, is_goal_object,
                dense_rank() over (order by scene_id, predicate, subject, reference) as task
            from predictions where checkpoint_id = ? and split = ?
            order by task, query
            """,
            [checkpoint_id, split],
        ).fetchnumpy()
    return Predictions(
        predicate=np.asarray(columns["predicate"], dtype=str),
        task=np.asarray(columns["task"], dtype=int),
        relevant=np.asarray(columns["relevant"], dtype=bool),
        score=np.asarray(columns["score"], dtype=float),
        is_goal_object=np.asarray(columns["is_goal_object"], dtype=bool),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """An estimate with its 67% confidence interval, over `n` tasks; nan when there are none."""

    value: float
    low: float
    high: float
    n: int


def mean_interval(values: Iterable[float]) -> Interval:
    """Mean with a bootstrap interval (bias-corrected); same values, same interval."""
    return _bootstrap((np.asarray(list(values), dtype=float),), lambda a, axis: a.mean(axis=axis))


def ratio_interval(above: Iterable[float], below: Iterable[float]) -> Interval:
    """Ratio of two paired sums with a bootstrap interval over the pairs."""
    return _bootstrap(
        (np.asarray(list(above), dtype=float), np.asarray(list(below), dtype=float)),
        lambda a, b, axis: a.sum(axis=axis) / b.sum(axis=axis),
    )


def _bootstrap(samples: tuple[np.ndarray, ...], statistic: Callable[..., Any]) -> Interval:
    from scipy.stats import bootstrap  # half a second to import

    n = len(samples[0])
    if n == 0:
        return Interval(value=np.nan, low=np.nan, high=np.nan, n=0)
    value = float(statistic(*samples, axis=-1))
    if n < 2 or all((s == s[0]).all() for s in samples):
        return Interval(value=value, low=value, high=value, n=n)
    interval = bootstrap(
        samples,
        statistic,
        paired=len(samples) > 1,
        vectorized=True,
        n_resamples=2000,
        confidence_level=CONFIDENCE,
        method="percentile",  # the bias-corrected one is undefined for tiny or tied samples
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value=value, low=float(interval.low), high=float(interval.high), n=n)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A guide against no guide on the same tasks; seconds are CPU seconds a task."""

    guide: str
    search: str
    beta: float
    group: str
    n_tasks: int
    n_solvable: int
    """Tasks that the unguided planner solves."""
    n_both: int
    """Tasks that both solve: what the paper's times rest on."""
    misses: int
    """Tasks that only the unguided planner solves."""
    gains: int
    """Tasks that only the guided planner solves (within the limits)."""
    unguided: Interval
    """Over the solvable tasks."""
    guided: Interval
    """The same, misses counted (see the top of this file)."""
    inference: Interval
    speedup: Interval
    """Sum of unguided over sum of guided seconds, solvable tasks, misses counted."""
    speedup_both: Interval
    """The same over the tasks that both solve (misses left out, as in the paper)."""
    speedup_all: Interval
    """The same over all tasks, those without a plan too."""
    nodes_unguided: float
    nodes_guided: float
    nlps_unguided: float
    nlps_guided: float
    actions_unguided: float
    """Mean plan length over the tasks that both solve."""
    actions_guided: float
    kept: float
    """Share of the objects that the guide kept."""

    @property
    def reduction(self) -> float:
        """Share of the time saved, misses left out: the paper's figure."""
        return 1 - 1 / self.speedup_both.value


def read_evaluations(dataset: Dataset, checkpoint_id: str) -> list[dict[str, Any]]:
    """All evaluation rows of a checkpoint, in a fixed order."""
    with dataset.connect() as connection:
        found = connection.execute(
            """
            select * from evaluations where checkpoint_id = ?
            order by guide, search, beta, predicate, scene_id, subject, reference
            """,
            [checkpoint_id],
        )
        names = [column[0] for column in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def summarise(rows: Sequence[dict[str, Any]], group: str = "all") -> Comparison:
    """Sum up rows of one guide, search and beta; `group` is a predicate, `same-plane` or `all`."""
    chosen = [row for row in rows if in_group(row["predicate"], group)]
    setting = {(row["guide"], row["search"], row["beta"]) for row in rows}
    assert len(setting) == 1, f"rows of one guide, search and beta, got {setting}"
    guide, search, beta = setting.pop()
    solvable = [row for row in chosen if row["solved_unguided"]]
    both = [row for row in solvable if row["solved_guided"]]

    def column(name: str, of: Sequence[dict[str, Any]]) -> list[float]:
        return [row[name] for row in of]

    def cost(of: Sequence[dict[str, Any]]) -> list[float]:
        return [guided_cost(row) for row in of]

    def speedup(of: Sequence[dict[str, Any]]) -> Interval:
        return ratio_interval(column("seconds_unguided", of), cost(of))

    return Comparison(
        guide=guide,
        search=search,
        beta=beta,
        group=group,
        n_tasks=len(chosen),
        n_solvable=len(solvable),
        n_both=len(both),
        misses=len(solvable) - len(both),
        gains=sum(row["solved_guided"] and not row["solved_unguided"] for row in chosen),
        unguided=mean_interval(column("seconds_unguided", solvable)),
        guided=mean_interval(cost(solvable)),
        inference=mean_interval(column("seconds_inference", solvable)),
        speedup=speedup(solvable),
        speedup_both=speedup(both),
        speedup_all=speedup(chosen),
        nodes_unguided=_mean(column("nodes_unguided", solvable)),
        nodes_guided=_mean(column("nodes_guided", solvable)),
        nlps_unguided=_mean(column("nlps_unguided", solvable)),
        nlps_guided=_mean(column("nlps_guided", solvable)),
        actions_unguided=_mean(column("n_actions_unguided", both)),
        actions_guided=_mean(column("n_actions_guided", both)),
        kept=_mean([row["n_kept"] / row["n_objects"] for row in chosen if row["n_kept"]]),
    )


def guided_cost(row: dict[str, Any]) -> float:
    """Seconds that a user of the guide pays: after a miss the task is planned again unguided."""
    missed = row["solved_unguided"] and not row["solved_guided"]
    return row["seconds_guided"] + (row["seconds_unguided"] if missed else 0.0)


def settings(
    rows: Iterable[dict[str, Any]],
) -> dict[tuple[str, str, float], list[dict[str, Any]]]:
    """Rows by (search, guide, beta), in order."""
    found: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["search"], row["guide"], row["beta"]), []).append(row)
    return dict(sorted(found.items()))


def in_group(predicate: str, group: str) -> bool:
    """Whether a predicate belongs to `all`, to a family or is the group itself."""
    return group == "all" or group == predicate or PREDICATES[predicate].family == group


def _mean(values: Any) -> float:
    values = np.asarray(values)
    return float(values.mean()) if len(values) else float("nan")
