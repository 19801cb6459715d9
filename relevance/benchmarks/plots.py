"""The benchmark's plots, each a function that draws rows into axes, and how they are saved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from relevance.benchmarks.runs import Planned, Plot
from relevance.report.plots import MUTED, STYLE

BLUE, ORANGE, GREEN, GREY = "#2f6db3", "#c26a1c", "#3a8a5f", "#8a939d"
BOUND_COLOR = {"pose": GREEN, "keyframe": ORANGE, "path": BLUE, "rest": GREY}
SEARCH_COLOR = {"informed": BLUE, "tree": ORANGE}


def save(plot: Plot, folder: Path) -> list[Path]:
    """Draw a plot into `folder` as NAME.png and NAME.svg."""
    with mpl.rc_context({**STYLE, "svg.hashsalt": plot.name}):
        figure = Figure(figsize=(4.8 * plot.panels, 3.2), layout="constrained")
        FigureCanvasAgg(figure)
        plot.draw(*figure.subplots(1, plot.panels, squeeze=False)[0])
        files = [folder / f"{plot.name}.{kind}" for kind in ("png", "svg")]
        figure.savefig(files[0], dpi=160)
        figure.savefig(files[1], metadata={"Date": None})
    return files


def speed_plot(left: Axes, right: Axes, *, rows: Sequence[Planned]) -> None:
    """Distribution of CPU time by outcome; mean CPU time by bound over the number of boxes."""
    for name, color, some in (
        ("solved", BLUE, [row.cpu for row in rows if row.solved]),
        ("not solved", ORANGE, [row.cpu for row in rows if not row.solved]),
        ("all", GREY, [row.cpu for row in rows]),
    ):
        if some:
            left.ecdf(1e3 * np.array(some), label=f"{name} ({len(some)})", color=color)
    left.set(xscale="log", xlabel="CPU time a task, ms", ylabel="share of tasks at most")
    left.legend(loc="lower right")
    boxes = sorted({row.n_objects for row in rows})
    base = np.zeros(len(boxes))
    for bound, color in BOUND_COLOR.items():
        mean = np.array(
            [
                1e3 * np.mean([getattr(row, f"cpu_{bound}") for row in rows if row.n_objects == n])
                for n in boxes
            ]
        )
        right.bar(boxes, mean, bottom=base, color=color, label=bound)
        base += mean
    right.set(xlabel="boxes", ylabel="CPU time a task, mean, ms", xticks=boxes)
    right.legend(loc="upper left")


def truth_plot(ax: Axes, *, rows: Sequence[Planned]) -> None:
    """Deepest penetration of each plan, the planner's check against the replay."""
    judged = [row for row in rows if row.replay_max_penetration is not None]
    own = [1e3 * (row.max_penetration or 0.0) for row in judged]
    found = [1e3 * (row.replay_max_penetration or 0.0) for row in judged]
    ax.scatter(own, found, s=9, color=BLUE, alpha=0.5, linewidths=0)
    top = 1.05 * max([1.0, *own, *found])
    ax.plot([0, top], [0, top], color=MUTED, linewidth=0.8, linestyle="--")
    ax.axhline(1.0, color=ORANGE, linewidth=0.8)
    ax.set(
        xlabel="planner's check: deepest penetration, mm",
        ylabel="replay: deepest penetration, mm",
        xlim=(-0.02, top),
        ylim=(-0.02, top),
    )


def scaling_plot(time: Axes, nodes: Axes, solved: Axes, *, rows: Sequence[Planned]) -> None:
    """CPU time and nodes (median, 10th to 90th percentile) and share solved over boxes."""
    for search, color in SEARCH_COLOR.items():
        boxes = sorted({row.n_objects for row in rows if row.search == search})
        groups = [[r for r in rows if r.search == search and r.n_objects == n] for n in boxes]
        for ax, values in (
            (time, [[1e3 * row.cpu for row in some] for some in groups]),
            (nodes, [[float(row.nodes) for row in some] for some in groups]),
        ):
            low, middle, high = np.array([np.quantile(v, (0.1, 0.5, 0.9)) for v in values]).T
            ax.plot(boxes, middle, color=color, marker="o", markersize=3, label=search)
            ax.fill_between(boxes, low, high, color=color, alpha=0.15, linewidth=0)
        share = [float(np.mean([row.solved for row in some])) for some in groups]
        dashed = "--" if search == "tree" else "-"  # where both solve as many, both show
        solved.plot(boxes, share, color=color, linestyle=dashed, marker="o", markersize=3)
    ticks = sorted({row.n_objects for row in rows})
    time.set(yscale="log", ylabel="CPU time a task, ms")
    nodes.set(yscale="log", ylabel="nodes a task")
    solved.set(ylabel="share of tasks solved", ylim=(0, 1.02))
    for ax in (time, nodes, solved):
        ax.set(xlabel="boxes", xticks=ticks)
    time.legend(loc="upper left")


def against_plot(
    left: Axes, right: Axes, *, ours: Sequence[float], theirs: Sequence[float], name: str
) -> None:
    """CPU time of both planners: distributions, and task by task."""
    for label, times, color in (("ours", ours, BLUE), (name, theirs, ORANGE)):
        left.ecdf(np.array(times), label=label, color=color)
    left.set(xscale="log", xlabel="CPU time a task, s", ylabel="share of tasks at most")
    left.legend(loc="lower right")
    right.scatter(ours, theirs, s=12, color=BLUE, linewidths=0)
    right.set(xscale="log", yscale="log", xlabel="ours, s", ylabel=f"{name}, s")
