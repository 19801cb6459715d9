"""Figures about scores and samples, each defined once: accuracy, intervals, bootstrap.

An object is kept iff its score > -beta (CONTRIBUTING, The words), everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

CONFIDENCE = 0.67
"""Level of every interval unless another is asked for, as in the paper's runtime tables."""
RESAMPLES = 2000
"""Bootstrap draws of every interval."""


# --- accuracy -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Shares of objects judged rightly at one beta, in 0..1; nan where there are none."""

    n_rows: int
    share_relevant: float
    true_relevant: float
    """Of the relevant objects, the share kept."""
    true_irrelevant: float
    """Of the irrelevant objects, the share left out."""
    total: float
    base_rate: float
    """What `always irrelevant` scores in total."""
    n_tasks: int
    """Tasks that the objects belong to; 0 when they were not told."""
    tasks_whole: float
    """Share of tasks in which every relevant object was kept, so that `prune` can succeed."""

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
        tasks, numbers = np.unique([] if task is None else task, return_inverse=True)
        lost = np.zeros(len(tasks), dtype=bool)
        if task is not None:
            np.logical_or.at(lost, numbers, relevant & ~kept)
        return cls(
            n_rows=len(score),
            share_relevant=mean(relevant),
            true_relevant=mean(kept[relevant]),
            true_irrelevant=mean(~kept[~relevant]),
            total=mean(kept == relevant),
            base_rate=mean(~relevant),
            n_tasks=len(tasks),
            tasks_whole=mean(~lost),
        )


def accuracy(score: np.ndarray, relevant: np.ndarray) -> dict[str, float | int | None]:
    """What a checkpoint keeps of its own accuracy at beta = 0, as JSON; None for nan.

    The shares are those of `Accuracy`, beside them `auc` and `best_beta`; eta makes beta = 0
    lean towards keeping.
    """
    found = Accuracy.of(score, relevant)
    shares = {
        name: getattr(found, name)
        for name in ("true_relevant", "true_irrelevant", "total", "base_rate", "balanced")
    }
    return {
        "relevant": int(relevant.sum()),
        "irrelevant": int((~relevant).sum()),
        **{name: None if np.isnan(share) else share for name, share in shares.items()},
        "auc": auc(score, relevant),
        "best_beta": best_beta(score, relevant),
    }


def auc(score: np.ndarray, relevant: np.ndarray) -> float | None:
    """The chance that a relevant object outscores another; None without either kind."""
    from scipy.stats import rankdata  # half a second to import

    n, k = len(score), int(relevant.sum())
    if not 0 < k < n:
        return None
    return float((rankdata(score)[relevant].sum() - k * (k + 1) / 2) / (k * (n - k)))


def best_beta(score: np.ndarray, relevant: np.ndarray) -> float | None:
    """The beta half-way between the scores where most objects are judged rightly."""
    if not len(score):
        return None
    order = np.argsort(-score, kind="stable")
    ranked = np.r_[np.inf, score[order], -np.inf]
    gained = np.r_[0, np.cumsum(np.where(relevant[order], 1, -1))]
    # Objects of equal score are kept together.
    splits = ranked[:-1] > ranked[1:]
    best = int(np.argmax(np.where(splits, gained, -len(score))))
    above, below = ranked[best], ranked[best + 1]
    if np.isinf(above) or np.isinf(below):
        return float(-below - 1.0) if np.isinf(above) else float(-above + 1.0)
    return float(-(above + below) / 2)


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


def mean_interval(values: Iterable[float], *, confidence: float = CONFIDENCE) -> Interval:
    """Mean with its bootstrap interval; same values, same interval."""
    sample = np.asarray(list(values), dtype=float)
    return bootstrap((sample,), lambda a, axis: a.mean(axis=axis), confidence=confidence)


def ratio_interval(
    above: Iterable[float], below: Iterable[float], *, confidence: float = CONFIDENCE
) -> Interval:
    """Ratio of two paired sums with its bootstrap interval over the pairs."""
    return bootstrap(
        (np.asarray(list(above), dtype=float), np.asarray(list(below), dtype=float)),
        lambda a, b, axis: a.sum(axis=axis) / b.sum(axis=axis),
        confidence=confidence,
    )


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
