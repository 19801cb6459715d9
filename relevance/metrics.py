"""Figures about scores and samples, each defined once: accuracy, calibration, intervals.

An object is kept iff its score > -beta (CONTRIBUTING, The words), everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

CONFIDENCE = 0.67
"""Level of every interval unless another is asked for, as in the paper's runtime tables."""
WIDE = 0.95
"""Level of the wider interval, where two are given."""
RESAMPLES = 2000
"""Bootstrap draws of every interval."""


# --- accuracy -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """How objects are judged at one beta, shares in 0..1; nan where there is nothing to judge."""

    n_rows: int
    share_relevant: float
    true_relevant: float
    """Of the relevant objects, the share kept."""
    true_irrelevant: float
    """Of the irrelevant objects, the share left out."""
    total: float
    """Of all objects, the share judged rightly."""
    base_rate: float
    """What `always irrelevant` scores in total."""
    n_tasks: int
    """Tasks (goals) that the objects belong to; 0 when they were not told."""
    set_recall: float
    """Share of a task's relevant objects that were kept, averaged over tasks that have any."""
    tasks_whole: float
    """Share of tasks in which every relevant object was kept, so that `prune` can succeed."""
    tasks_right: float
    """Share of tasks in which every object was judged rightly."""

    @property
    def balanced(self) -> float:
        """Mean of the two shares; a constant answer reaches 0.5."""
        return (self.true_relevant + self.true_irrelevant) / 2

    @classmethod
    def of(
        cls,
        score: np.ndarray,
        relevant: np.ndarray,
        *,
        beta: float = 0.0,
        task: np.ndarray | None = None,
    ) -> Accuracy:
        """Of scores, labels and, if known, task numbers of objects, (R,) each."""
        kept = score > -beta
        tasks, number = np.unique([] if task is None else task, return_inverse=True)

        def count(rows: np.ndarray) -> np.ndarray:
            """How many such rows each task has."""
            return np.bincount(number, rows if task is not None else [], minlength=len(tasks))

        wanted, found = count(relevant), count(relevant & kept)
        asked = wanted > 0
        return cls(
            n_rows=len(score),
            share_relevant=mean(relevant),
            true_relevant=mean(kept[relevant]),
            true_irrelevant=mean(~kept[~relevant]),
            total=mean(kept == relevant),
            base_rate=mean(~relevant),
            n_tasks=len(tasks),
            set_recall=mean(found[asked] / wanted[asked]),
            tasks_whole=mean(found == wanted),
            tasks_right=mean(count(kept != relevant) == 0),
        )


def accuracy(
    score: np.ndarray, relevant: np.ndarray, *, task: np.ndarray | None = None
) -> dict[str, Any]:
    """What a checkpoint keeps of its own accuracy, as JSON; None for nan.

    The shares are those of `Accuracy` at beta = 0 and, under `tuned`, at `best_beta`; the other
    figures are of the scores alone.
    """
    beta = best_beta(score, relevant)
    return {
        "relevant": int(relevant.sum()),
        "irrelevant": int((~relevant).sum()),
        **_shares(Accuracy.of(score, relevant, task=task)),
        "average_precision": _known(average_precision(score, relevant)),
        "auc": auc(score, relevant),
        "best_beta": beta,
        "tuned": _shares(Accuracy.of(score, relevant, beta=beta or 0.0, task=task)),
    }


def _shares(found: Accuracy) -> dict[str, float | None]:
    names = ("true_relevant", "true_irrelevant", "total", "base_rate", "balanced")
    names += ("set_recall", "tasks_whole", "tasks_right")
    return {name: _known(getattr(found, name)) for name in names}


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def average_precision(score: np.ndarray, relevant: np.ndarray) -> float:
    """Mean over the relevant objects of the share that is relevant among those that score as high.

    nan without a relevant object; a constant score reaches the share of relevant objects.
    """
    order = np.argsort(-score, kind="stable")
    ranked, hits = score[order], np.cumsum(relevant[order])
    if not len(hits) or not hits[-1]:
        return float("nan")
    last = np.flatnonzero(np.r_[ranked[1:] < ranked[:-1], True])  # equal scores come together
    return float(np.diff(hits[last], prepend=0) @ (hits[last] / (last + 1)) / hits[-1])


def recall_at(score: np.ndarray, relevant: np.ndarray, true_irrelevant: float = 0.95) -> float:
    """The share of the relevant objects that is kept by the lowest threshold that leaves out at
    least so many of the irrelevant ones; nan without either kind."""
    others = np.sort(score[~relevant])
    if not len(others) or not relevant.any():
        return float("nan")
    left_out = math.ceil(true_irrelevant * len(others) - 1e-9)  # 0.95 * 20 may be more than 19
    return mean(score[relevant] > others[max(1, left_out) - 1])


def calibration_error(score: np.ndarray, relevant: np.ndarray) -> float:
    """How far the probability is from the share that is relevant, in tenths of the probability,
    each weighing as many objects as it has; nan without any.
    """
    probability = 1 / (1 + np.exp(-np.clip(score, -700, 700)))
    tenth = np.minimum((10 * probability).astype(int), 9)
    gaps = np.bincount(tenth, probability - relevant)
    return float(np.abs(gaps).sum() / len(score)) if len(score) else float("nan")


def auc(score: np.ndarray, relevant: np.ndarray) -> float | None:
    """The chance that a relevant object outscores another; None without either kind."""
    from scipy.stats import rankdata  # half a second to import

    n, k = len(score), int(relevant.sum())
    if not 0 < k < n:
        return None
    return float((rankdata(score)[relevant].sum() - k * (k + 1) / 2) / (k * (n - k)))


def best_beta(score: np.ndarray, relevant: np.ndarray) -> float | None:
    """The beta half-way between the scores where most objects are judged rightly.

    Of several that judge as many rightly it is the one nearest to 0; None without objects.
    """
    if not len(score):
        return None
    order = np.argsort(-score, kind="stable")
    ranked = np.r_[np.inf, score[order], -np.inf]
    gained = np.r_[0, np.cumsum(np.where(relevant[order], 1, -1))]
    above, below = ranked[:-1], ranked[1:]
    apart = above > below  # objects of equal score are kept together
    best = apart & (gained == gained[apart].max())
    above, below = above[best], below[best]
    # Beyond the highest and the lowest score: by one.
    above, below = (
        np.where(np.isinf(above), below + 2, above),
        np.where(np.isinf(below), above - 2, below),
    )
    betas = -(above + below) / 2
    return float(betas[np.argmin(np.abs(betas))])


def mean(values: Any) -> float:
    """Mean of numbers or truths; nan of nothing."""
    values = np.asarray(values)
    return float(values.mean()) if len(values) else float("nan")


# --- intervals ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """An estimate with its confidence interval, over `n` values; nan when there are none."""

    value: float
    low: float
    high: float
    n: int

    def __format__(self, spec: str) -> str:
        """`12.3 (11.0 to 13.9)`, each number by `spec`."""
        return f"{self.value:{spec}} ({self.low:{spec}} to {self.high:{spec}})"


def binomial_interval(hits: int, n: int, *, confidence: float) -> Interval:
    """A share with its exact (Clopper-Pearson) interval; nan of nothing."""
    from scipy.stats import binomtest  # half a second to import

    if not n:
        return Interval(value=np.nan, low=np.nan, high=np.nan, n=0)
    found = binomtest(hits, n).proportion_ci(confidence, method="exact")
    return Interval(value=hits / n, low=float(found.low), high=float(found.high), n=n)


def bootstrap(
    samples: tuple[np.ndarray, ...],
    statistic: Callable[..., Any],
    *,
    confidence: float = CONFIDENCE,
) -> Interval:
    """A statistic of samples (n,) with its percentile interval; several are drawn as pairs.

    `statistic` takes the samples and an axis. Draws are seeded: equal samples, equal interval.
    """
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
        n_resamples=RESAMPLES,
        batch=200,
        confidence_level=confidence,
        method="percentile",  # the bias-corrected one is undefined for tiny or tied samples
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value=value, low=float(interval.low), high=float(interval.high), n=n)


def over_groups(
    groups: Sequence[Hashable],
    statistic: Callable[..., Any],
    *columns: Sequence[float] | np.ndarray,
    confidence: float = CONFIDENCE,
) -> Interval:
    """A statistic of columns (n,) with the interval that drawing whole groups gives: what belongs
    to one group, such as the goals of a scene, is not as good as independent.

    `statistic` takes the columns, NaN where a group has fewer members than others, and an axis.
    """
    numbers = {group: place for place, group in enumerate(dict.fromkeys(groups))}
    which = np.array([numbers[group] for group in groups], dtype=int)
    order = np.argsort(which, kind="stable")
    counts = np.bincount(which, minlength=len(numbers))
    starts = np.cumsum(counts) - counts
    place = np.arange(len(which)) - np.repeat(starts, counts)
    tables = []
    for column in columns:
        table = np.full((len(numbers), max(counts, default=0)), np.nan)
        table[which[order], place] = np.asarray(column, dtype=float)[order]
        tables.append(table)

    def of(drawn: np.ndarray, axis: int = -1) -> Any:
        drawn = drawn.astype(int)
        return statistic(*(t[drawn].reshape(*drawn.shape[:-1], -1) for t in tables), axis=axis)

    found = bootstrap((np.arange(len(numbers)),), of, confidence=confidence)
    return replace(found, n=len(which))


def ratio_of_sums(above: np.ndarray, below: np.ndarray, axis: int = -1) -> Any:
    """For `over_groups`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nansum(above, axis=axis) / np.nansum(below, axis=axis)


def saving_reached(
    groups: Sequence[Hashable],
    without: Sequence[float],
    used: Sequence[float],
    best: Sequence[float],
    *,
    confidence: float = CONFIDENCE,
) -> Interval:
    """Of what the best saves of the sum without it, the share that what is used saves, as
    `over_groups`: 1 is all of it, negative a loss; nan where the best saves nothing."""

    def share(without: np.ndarray, used: np.ndarray, best: np.ndarray, axis: int = -1) -> Any:
        a, b, c = (np.nansum(column, axis=axis) for column in (without, used, best))
        with np.errstate(divide="ignore", invalid="ignore"):
            return (a - b) / (a - c)

    if sum(without) <= sum(best):
        return Interval(value=np.nan, low=np.nan, high=np.nan, n=len(groups))
    return over_groups(groups, share, without, used, best, confidence=confidence)
