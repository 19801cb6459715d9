"""Figures with intervals, and the form in which every part hands over what it measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

from relevance.report.tables import Table

CONFIDENCE = 0.95
RESAMPLES = 2000

Draw = Callable[..., None]
Progress = Callable[[int, int], None]
"""progress(done, total)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """A figure that is still to be drawn: draw(*axes)."""

    name: str
    draw: Draw
    panels: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What one part of a benchmark found."""

    name: str
    """Stem of its files."""
    rows: tuple[Any, ...]
    """Dataclasses of one kind, one a task."""
    tables: tuple[Table, ...]
    plots: tuple[Plot, ...] = field(default=())

    def records(self) -> list[dict[str, Any]]:
        """The rows as flat dicts, sequences as one text."""
        return [
            {
                key: " ".join(map(str, value)) if isinstance(value, tuple) else value
                for key, value in asdict(row).items()
            }
            for row in self.rows
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A figure and the ends of its 95% interval."""

    value: float
    low: float
    high: float

    def __format__(self, spec: str) -> str:
        """`12.3 (11.0 to 13.9)`, each number by `spec`."""
        return f"{self.value:{spec}} ({self.low:{spec}} to {self.high:{spec}})"


STATISTICS: Mapping[str, Callable[..., Any]] = {
    "median": np.median,
    "mean": np.mean,
    "p90": lambda x, axis=None: np.quantile(x, 0.9, axis=axis),
    "p99": lambda x, axis=None: np.quantile(x, 0.99, axis=axis),
}


def interval(values: Sequence[float] | np.ndarray, statistic: str) -> Interval:
    """A statistic of a sample (N,) with its bootstrap interval; NaN throughout when empty."""
    sample, compute = np.asarray(values, dtype=float), STATISTICS[statistic]
    if len(sample) == 0:
        return Interval(value=np.nan, low=np.nan, high=np.nan)
    value = float(compute(sample))
    if len(sample) == 1 or (sample == sample[0]).all():
        return Interval(value=value, low=value, high=value)
    return _resampled((sample,), compute, value)


def _resampled(samples: tuple[np.ndarray, ...], compute: Any, value: float) -> Interval:
    """The bootstrap interval of a statistic; several samples are resampled as pairs."""
    found = bootstrap(
        samples,
        compute,
        paired=len(samples) > 1,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=200,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value=value, low=float(found.low), high=float(found.high))


def ratio_of_medians(a: Sequence[float], b: Sequence[float]) -> Interval:
    """median(a) / median(b) over the same tasks, with its paired bootstrap interval."""

    def ratio(x: np.ndarray, y: np.ndarray, axis: int = -1) -> Any:
        return np.median(x, axis=axis) / np.median(y, axis=axis)

    x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    value = float(ratio(x, y))
    if len(x) < 2:
        return Interval(value=value, low=np.nan, high=np.nan)
    return _resampled((x, y), ratio, value)


def share(part: int, whole: int) -> str:
    """`995 of 1000 = 99.5% (98.8 to 99.8)`, Wilson's interval; `0 of 0` when there is nothing."""
    if whole == 0:
        return "0 of 0"
    ends = binomtest(part, whole).proportion_ci(CONFIDENCE, method="wilson")
    return f"{part} of {whole} = {part / whole:.1%} ({100 * ends.low:.1f} to {100 * ends.high:.1f})"


def milliseconds(seconds: Sequence[float] | np.ndarray) -> tuple[str, ...]:
    """Median, mean, p90, p99 with intervals and the largest, ms; the columns of TIMES."""
    ms = 1e3 * np.asarray(seconds, dtype=float)
    if len(ms) == 0:
        return ("-",) * len(TIMES)
    return (*(f"{interval(ms, name):.1f}" for name in STATISTICS), f"{ms.max():.1f}")


TIMES = (*STATISTICS, "max")
