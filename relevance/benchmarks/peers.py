"""Another planner guided: tables and a plot of its reruns by `guides`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from relevance.benchmarks.guides import OWN_PLAN, Rerun
from relevance.benchmarks.runs import Measured, Plot, share
from relevance.evaluation import PRIORS, TRUE, guided_cost
from relevance.metrics import CONFIDENCE, WIDE, Interval, over_groups, ratio_of_sums
from relevance.planner import GUIDES
from relevance.report.plots import MUTED
from relevance.report.tables import Table

MARKS = ("o", "s", "^", "D", "v")
"""Of priors, in turn."""
_OF = ("boxes", "prior", "guide")


def measured_peer(rows: Sequence[Rerun]) -> Measured:
    """Tables and a plot of what there is."""
    guided = _guided(rows)
    tables = (peer_times(guided), peer_counts(guided), peer_plans(guided), peer_drawn(rows))
    plots = [Plot(name="peer-times", draw=partial(peer_plot, rows=guided), panels=1)]
    return Measured(
        name="guides", rows=tuple(rows), tables=tables, plots=tuple(plots) if guided else ()
    )


def _guided(rows: Sequence[Rerun]) -> list[Rerun]:
    return [row for row in rows if GUIDES[row.guide].guided]


def _groups(rows: Sequence[Rerun]) -> list[tuple[tuple[str, str, str], list[Rerun]]]:
    """Rows of every prior and guide: of all sizes, then by size; what knows the answer last."""
    knowing = (TRUE, OWN_PLAN)
    order = sorted({(r.prior in knowing, r.prior, r.guide) for r in rows})
    sizes: list[tuple[str, Callable[[Rerun], bool]]] = [("all", lambda row: True)]
    for size in sorted({row.size for row in rows}):
        sizes.append((str(size), lambda row, size=size: row.size == size))
    return [
        ((name, prior, guide), some)
        for name, belongs in sizes
        for _, prior, guide in order
        if (some := [r for r in rows if belongs(r) and (r.prior, r.guide) == (prior, guide)])
    ]


def peer_times(rows: Sequence[Rerun]) -> Table:
    """CPU time with and without the guide."""
    lines = []
    for of, some in _groups(rows):
        u, g = _costs(some)
        over = partial(over_groups, [row.scene_id for row in some])

        def gain(statistic: Any, over: Any = over, u: Any = u, g: Any = g) -> tuple[str, str]:
            close, wide = (over(statistic, u, g, confidence=c) for c in (CONFIDENCE, WIDE))
            return f"{close:.2f}", f"{wide.low:.2f} to {wide.high:.2f}"

        means: list[Interval] = [over(np.nanmean, times, confidence=WIDE) for times in (u, g)]
        medians: list[Interval] = [over(np.nanmedian, times, confidence=WIDE) for times in (u, g)]
        lines.append(
            (
                *of,
                f"{len(some)} ({len({row.scene_id for row in some})})",
                *(f"{mean:.2f}" for mean in means),
                *gain(ratio_of_sums),
                *(f"{median:.2f}" for median in medians),
                *gain(_ratio_of_medians),
                f"{1e3 * np.mean([row.seconds_inference for row in some]):.1f}",
            )
        )
    columns = (
        *_OF, "tasks (scenes)", "u, mean", "g, mean", "u / g (67%)", "95%", "u, median",
        "g, median", "u / g of medians (67%)", "95%", "look, ms",
    )  # fmt: skip
    title = (
        f"CPU s a task of {_name(rows)}, solved unguided; 95% intervals over scenes; look and "
        "misses in g"
    )
    return Table(name="peer-times", title=title, columns=columns, rows=tuple(lines))


def _costs(rows: Sequence[Rerun]) -> tuple[list[float], list[float]]:
    """Seconds unguided and guided; after a miss the unguided run is paid, too."""
    return [row.seconds_unguided for row in rows], [guided_cost(asdict(row)) for row in rows]


def _ratio_of_medians(above: np.ndarray, below: np.ndarray, axis: int = -1) -> Any:
    return np.nanmedian(above, axis=axis) / np.nanmedian(below, axis=axis)


def peer_counts(rows: Sequence[Rerun]) -> Table:
    """What no clock has a part in: sequences whose switches were sought, and problems solved."""
    lines = []
    for of, some in _groups(rows):
        sequences = [(r.sequences_unguided, r.sequences) for r in some]
        nlps = [(r.nlps_unguided, r.nlps_guided) for r in some]
        lines.append((*of, *(_pair(np.mean, of) for of in (sequences, nlps))))
    return Table(
        name="peer-counts",
        title="Action sequences tried, and problems of switches and motions: means of u / g",
        columns=(*_OF, "sequences", "NLPs"),
        rows=tuple(lines),
    )


def _pair(statistic: Any, values: Sequence[tuple[float, float]]) -> str:
    return " / ".join(f"{statistic(column):.2f}" for column in zip(*values, strict=True))


def peer_plans(rows: Sequence[Rerun]) -> Table:
    """What becomes of the tasks: misses, and what the replay says of the plans."""
    lines = []
    for of, some in _groups(rows):
        found = [row for row in some if row.solved_guided]
        lengths = [(row.n_actions_unguided or 0, row.n_actions_guided or 0) for row in found]
        lines.append(
            (
                *of,
                share(len(some) - len(found), len(some)),
                share(sum(bool(row.replays_unguided) for row in some), len(some)),
                share(sum(bool(row.replays_guided) for row in found), len(found)),
                _pair(np.mean, lengths) if lengths else "-",
            )
        )
    return Table(
        name="peer-plans",
        title="Missed with the guide, plans that replay, actions where both solve (u / g)",
        columns=(*_OF, "missed", "replay, unguided", "replay, guided", "actions"),
        rows=tuple(lines),
    )


def peer_drawn(rows: Sequence[Rerun]) -> Table:
    """How the tasks that were drawn end unguided."""
    tasks = {(row.size, row.task): row for row in rows}.values()
    lines = []
    for size in sorted({row.size for row in rows}):
        some = [row for row in tasks if row.size == size]
        ends = [row.status_unguided for row in some]
        lines.append((size, *(share(ends.count(s), len(some)) for s in _ENDS)))
    title = f"Tasks drawn, as {_name(rows)} ends unguided"
    return Table(name="peer-drawn", title=title, columns=("boxes", *_ENDS), rows=tuple(lines))


_ENDS = ("solved", "limit", "infeasible")


def _name(rows: Sequence[Rerun]) -> str:
    return rows[0].search if rows else "the planner"


def peer_plot(ax: Axes, rows: Sequence[Rerun]) -> None:
    """Every task: guided over unguided time, the look and misses in, a mark a prior."""
    groups = [(of, some) for of, some in _groups(rows) if of[0] == "all"]
    for number, ((_, prior, guide), some) in enumerate(groups):
        u, g = _costs(some)
        color = {TRUE: PRIORS[TRUE].color, OWN_PLAN: MUTED}.get(prior)
        mark, name = MARKS[number % len(MARKS)], f"{guide}, {prior}"
        ax.plot(u, g, mark, color=color, markersize=4, alpha=0.7, label=name)
    ends = np.array([min(ax.get_xlim()[0], ax.get_ylim()[0]), max(ax.get_xlim()[1], 1.0)])
    ends = np.maximum(ends, 0.1)
    ax.plot(ends, ends, color=MUTED, linewidth=0.8)
    ax.set(xscale="log", yscale="log", xlabel="unguided, CPU s", ylabel="guided, CPU s")
    ax.legend(loc="upper left")
