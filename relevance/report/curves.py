"""Pictures of what networks learned, and from what: the rows of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullLocator

from relevance.report.style import (
    BLUE,
    FAINT,
    GREEN,
    GREY,
    GROUPS,
    INK,
    ORANGE,
    ROSE,
    TEAL,
    VIOLET,
    legend_below,
)

COLORS = (BLUE, ORANGE, GREEN, VIOLET, TEAL, ROSE, INK, GREY)
Row = Mapping[str, Any]


def families_of(rows: Sequence[Row]) -> list[str]:
    """The families that were judged on the way: a panel each."""
    seen = {name for row in rows for point in row["validations"] for name in point["queries"]}
    return [family for family in GROUPS if family in seen]


def learning(*axes: Axes, rows: Sequence[Row]) -> None:
    """Training loss, then the validation accuracy of each family, over the time of a core; a line
    a label, the mean over seeds, in the band of their range."""
    loss, *accuracies = axes
    labels = list(dict.fromkeys(row["label"] for row in rows))
    for number, label in enumerate(labels):
        mine, color = [row for row in rows if row["label"] == label], COLORS[number % len(COLORS)]
        if told := [row for row in mine if row["history"]]:
            steps = [entry["step"] for entry in told[0]["history"]]
            losses = [[entry["relevance"] for entry in row["history"]] for row in told]
            _line(loss, _minutes(told, steps), losses, color, label)
        steps = [point["step"] for point in mine[0]["validations"]]
        for ax, family in zip(accuracies, families_of(rows), strict=True):
            points = [[_right(point, family) for point in row["validations"]] for row in mine]
            _line(ax, _minutes(mine, steps), points, color, label)
    loss.set_title("training loss (relevance)")
    loss.set_yscale("log")
    for format in (loss.yaxis.set_major_formatter, loss.yaxis.set_minor_formatter):
        format(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "125" else ""))
    for ax, family in zip(accuracies, families_of(rows), strict=True):
        ax.set_title(f"{family}: validation queries judged rightly")
        base = next((b for row in rows if (b := _base(row, family)) is not None), None)
        if base is not None:
            ax.axhline(base, color=FAINT, linewidth=1.2)
            ax.text(0, base, " always irrelevant", color=GREY, fontsize=8, va="bottom")
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(100 * value, 2):g}%"))
    for ax in axes:
        ax.set_xlabel("minutes of a core")
        ax.set_xlim(left=0)
    legend_below(loss)


def _line(
    ax: Axes, x: np.ndarray, values: Sequence[Sequence[float]], color: str, label: str
) -> None:
    """The mean of some runs at common places, and the range of them."""
    found = np.array(values)
    ax.plot(x, found.mean(axis=0), color=color, label=label, linewidth=1.5)
    if len(found) > 1:
        low, high = found.min(axis=0), found.max(axis=0)
        ax.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)


def _minutes(rows: Sequence[Row], steps: Sequence[float]) -> np.ndarray:
    """When steps were done: each takes as long as another."""
    mean = np.mean([row["core_seconds"] / row["steps"] for row in rows])
    return np.array(steps) * mean / 60


def _right(point: Row, family: str) -> float:
    """The total at the best beta of the very scenes: offsets are not chosen on the way."""
    found = point["queries"].get(family)
    return float("nan") if found is None else found["tuned"]["total"]


def _base(row: Row, family: str) -> float | None:
    points = row["validations"]
    found = points[-1]["queries"].get(family) if points else None
    return None if found is None else found["base_rate"]


def data(*axes: Axes, rows: Sequence[Row], by: str, title: str) -> None:
    """Accuracy on unseen scenes over something that networks had more or less of; a panel a
    family, a line a body and whatever else differs. Rows are `Scored` of families."""
    families = [family for family in GROUPS if any(row["group"] == family for row in rows)]
    ticks = sorted({row[by] for row in rows})
    lines = list(dict.fromkeys(row["line"] for row in rows))
    for ax, family in zip(axes, families, strict=True):
        for number, line in enumerate(lines):
            mine = [row for row in rows if (row["line"], row["group"]) == (line, family)]
            at = sorted({row[by] for row in mine})
            found = [[row["total"] for row in mine if row[by] == value] for value in at]
            color = COLORS[number % len(COLORS)]
            ax.plot(at, [np.mean(v) for v in found], "o-", markersize=4, color=color, label=line)
            for value, totals in zip(at, found, strict=True):
                ax.plot([value] * 2, [min(totals), max(totals)], color=color, linewidth=1)
        base = next(row["base_rate"] for row in rows if row["group"] == family)
        ax.axhline(base, color=FAINT, linewidth=1.2)
        ax.set_title(f"{family} (always irrelevant: {100 * base:.1f}%)")
        ax.set_xscale("log")
        ax.set_xticks(ticks, [f"{tick:,.3g}" if tick < 1000 else f"{tick:,}" for tick in ticks])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.set_xlabel(title)
        low = min(row["total"] for row in rows if row["group"] == family)
        ax.set_ylim(bottom=max(base, low) - 0.01)
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(100 * value, 2):g}%"))
    axes[0].set_ylabel("test queries judged rightly")
    legend_below(axes[0])
