"""More plots in the report's style: of one dataset and one checkpoint, for who looks around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from relevance.report.style import (
    FAINT,
    GREEN,
    GREY,
    GROUPS,
    INK,
    MUTED,
    SHARES,
    TIMES,
    VIOLET,
    family_color,
    legend_below,
)


def _percent(axis: Any) -> None:
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(100 * value, 2):g}%"))


def visibility(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Objects by how much of them shows, in tenths: a bar a family."""
    families = [group for group in GROUPS if any(row["family"] == group for row in rows)]
    first = min(row["tenth"] for row in rows)
    width = 0.8 / len(families)
    for number, family in enumerate(families):
        counts = {row["tenth"]: row["objects"] for row in rows if row["family"] == family}
        total = sum(counts.values())
        at = [tenth + (number - (len(families) - 1) / 2) * width for tenth in counts]
        shares = [count / total for count in counts.values()]
        label = f"{family} (n = {total:,})"
        ax.bar(at, shares, width * 0.92, color=family_color(family), label=label)
    ticks = range(first, 10)
    ax.set_xticks(ticks, [f"{10 * tenth}+" for tenth in ticks])
    ax.set_xlabel("how much of an object the picture shows, %")
    ax.set_ylabel("share of objects")
    ax.grid(axis="x", visible=False)
    ax.legend(loc="upper left")
    _percent(ax.yaxis)


def throughput(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Scenes, or goals of a predicate, in a second: a dot a shard, a line at the middle one."""
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    for place, stage in enumerate(stages):
        mine = [row for row in rows if row["stage"] == stage and row["rows_per_second"]]
        speeds = [row["rows_per_second"] for row in mine]
        color = INK if stage == "scenes" else family_color(stage)
        y = len(stages) - 1 - place
        spread = y + 0.18 * np.sin(np.arange(len(mine)))  # dots that do not hide each other
        ax.scatter(speeds, spread, s=14, color=color, alpha=0.45, linewidths=0)
        if speeds:
            ax.plot([np.median(speeds)] * 2, [y - 0.36, y + 0.36], color=color)
    names = [name if name == "scenes" else f"goals: {name}" for name in stages]
    ax.set_yticks(range(len(stages) - 1, -1, -1), names)
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ticks = [n * 10.0**e for e in range(-3, 6) for n in (1, 2, 5)]
    ticks = [tick for tick in ticks if low <= tick <= high]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_xlabel("made in a second")
    ax.grid(axis="y", visible=False)


def by_part(ax: Axes, rows: Sequence[Mapping[str, Any]], by: str, title: str) -> None:
    """A network's shares by part of the queries, beside `always irrelevant`; one family."""
    y = np.arange(len(rows))[::-1]
    for place, (label, name, color) in enumerate(SHARES):
        values = [row[name] for row in rows]
        ax.plot(values, y + (1 - place) * 0.2, "o", markersize=5.5, color=color, label=label)
    for at, row in zip(y, rows, strict=True):
        base = [row["base_rate"]] * 2
        label = None if at else "always irrelevant"
        ax.plot(base, [at - 0.4, at + 0.4], ":", color=INK, linewidth=1.2, label=label)
    ax.set_yticks(y, [f"{row[by]} (n = {row['objects']:,})" for row in rows])
    ax.set_ylim(-0.6, len(rows) - 0.4)
    ax.set_xlim(-0.02, 1.02)
    ax.grid(axis="y", visible=False)
    ax.set_title(title)
    legend_below(ax, columnspacing=1.0, handletextpad=0.3)
    _percent(ax.xaxis)


def bodies(*axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Every checkpoint's shares, a panel a family, named by its body and the start of its id."""
    families = [group for group in GROUPS if any(row["family"] == group for row in rows)]
    names = list(dict.fromkeys(row["checkpoint_id"] for row in rows))
    for ax, family in zip(axes, families, strict=False):
        ax.set_title(family)
        for row in rows:
            if row["family"] != family:
                continue
            at = len(names) - 1 - names.index(row["checkpoint_id"])
            for place, (label, name, color) in enumerate(SHARES):
                first = label if row["checkpoint_id"] == names[0] else None
                at_share = at + (1 - place) * 0.2
                ax.plot(row[name], at_share, "o", markersize=5.5, color=color, label=first)
            base = [row["base_rate"]] * 2
            first = "always irrelevant" if row["checkpoint_id"] == names[0] else None
            ax.plot(base, [at - 0.4, at + 0.4], ":", color=INK, linewidth=1.2, label=first)
        labels = [name if len(name) <= 20 else f"{name[:19]}…" for name in names]
        shown = labels if ax is axes[0] else [""] * len(names)
        ax.set_yticks(range(len(names) - 1, -1, -1), shown)
        ax.set_ylim(-0.6, len(names) - 0.4)
        ax.set_xlim(-0.02, 1.02)
        ax.grid(axis="y", visible=False)
        _percent(ax.xaxis)
    for ax in axes[len(families) :]:
        ax.set_axis_off()
    legend_below(axes[0], columnspacing=1.0, handletextpad=0.3)


def keeping(ax: Axes, curve: Sequence[Mapping[str, float]], now: Mapping[str, float]) -> None:
    """What is kept over beta, and what of that which is relevant; `now` is the chosen beta."""
    betas = [row["beta"] for row in curve]
    for name, label, color, line in (
        ("recall", "relevant queries kept", GREEN, "-"),
        ("whole", "goals kept whole", VIOLET, "--"),
        ("kept", "objects kept", GREY, "-"),
    ):
        ax.plot(betas, [row[name] for row in curve], line, color=color, label=label)
        ax.plot(now["beta"], now[name], "o", color=color, markersize=6)
    ax.axvline(now["beta"], color=MUTED, linewidth=1)
    ax.set_ylim(0, 1.03)
    ax.set_xlabel("beta (larger keeps more)")
    ax.legend(loc="lower right")
    _percent(ax.yaxis)


def saving(
    ax: Axes,
    betas: Sequence[float],
    speedups: Sequence[float],
    beta: float,
    reruns: Sequence[float],
) -> None:
    """The speed-up over beta, misses counted; `reruns` are the betas that were measured."""
    ax.axhline(1, color=FAINT, linewidth=1.2)
    ax.plot(betas, speedups, color=INK, label="speed-up, misses counted")
    at = np.interp(reruns, betas, speedups)
    ax.plot(reruns, at, "D", color=INK, markersize=4.5, label="the planner was rerun here")
    ax.axvline(beta, color=MUTED, linewidth=1)
    ax.plot(beta, np.interp(beta, betas, speedups), "o", color=INK, markersize=7)
    ax.set_ylim(0, max(1.1, 1.15 * max(speedups)))
    ax.set_xlabel("beta (larger keeps more)")
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}{TIMES}"))
    ax.legend(loc="lower right")
