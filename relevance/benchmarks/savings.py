"""What guides save: figures, tables and plots of the reruns of `guides`, however many there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from relevance.benchmarks.guides import Rerun
from relevance.benchmarks.runs import Measured, Plot
from relevance.evaluation import (
    PRIORS,
    TRUE,
    amortised_costs,
    guided_cost,
    oracle_cost,
    with_oracle,
)
from relevance.metrics import (
    CONFIDENCE,
    WIDE,
    Interval,
    over_groups,
    ratio_of_sums,
    saving_reached,
)
from relevance.planner import GUIDES
from relevance.report.plots import MUTED
from relevance.report.tables import Table

LARGE = 10
"""From how many boxes on the share solved is drawn against time."""
LINES = ("-", "--", ":", "-.")
"""Of priors, in turn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What one prior and guide do to tasks of one size, in one search; ms a task."""

    search: str
    size: int
    prior: str
    guide: str
    tasks: int
    scenes: int
    u: Interval
    g: Interval
    o: Interval
    u_median: Interval
    g_median: Interval
    o_median: Interval
    look: float
    amortised: Interval
    """g, each scene encoded once for all its goals."""
    gain: Interval
    """u / g."""
    gain_wide: Interval
    """With its 95% interval."""
    free: Interval
    """Share of u - o that is saved before the look is paid, 95%."""
    reached: Interval
    """The same, look included."""
    solved: tuple[int, int, int]
    """By u, g and o."""
    limit: tuple[int, int, int]
    """At the node limit, likewise."""
    looked: float
    work: tuple[float, float, float]
    """By u, g and o, thousands; looks are no part of it."""
    worked: Interval
    """Share of u - o in work that g saves, 95%: no clock has a part in it."""
    nodes: tuple[float, float, float]
    nlps: tuple[float, float, float]
    sequences: tuple[float, float, float]
    """Until solved: means over tasks that all three solve."""
    sequences_median: tuple[float, float, float]
    actions: tuple[float, float, float]
    """Means over tasks that all three solve."""


def figures(rows: Sequence[Rerun]) -> list[Figures]:
    """Of every search, size, prior and guide, in order; other priors than the oracle first."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in _flat(rows):
        key = (row["search"], row["size"], row["prior"] == TRUE, row["prior"], row["guide"])
        groups.setdefault(key, []).append(row)
    return [
        _figures(search, size, prior, guide, groups[search, size, oracle, prior, guide])
        for search, size, oracle, prior, guide in sorted(groups)
    ]


def _flat(rows: Sequence[Rerun]) -> list[dict[str, Any]]:
    """Rows as `with_oracle` takes and gives them, and the oracle's counts besides."""
    flat = []
    for row in rows:
        predicate, _, names = row.goal.partition("(")
        subject, _, reference = names.removesuffix(")").partition(", ")
        goal = {"predicate": predicate, "subject": subject, "reference": reference}
        flat.append(asdict(row) | goal)
    true = {_place(row): row for row in flat if row["prior"] == TRUE}
    return [row | {"oracle": true[_place(row)]} for row in with_oracle(flat) if _place(row) in true]


def _place(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("search", "size", "task", "guide"))


def _figures(search: str, size: int, prior: str, guide: str, rows: list[dict[str, Any]]) -> Figures:
    scenes = [row["scene_id"] for row in rows]
    u = [1e3 * row["seconds_unguided"] for row in rows]
    g = [1e3 * guided_cost(row) for row in rows]
    o = [1e3 * oracle_cost(row) for row in rows]
    free = [1e3 * (guided_cost(row) - row["seconds_inference"]) for row in rows]

    def wide(statistic: Any, *columns: Sequence[float]) -> Interval:
        return over_groups(scenes, statistic, *columns, confidence=WIDE)

    def three(name: str, of: Sequence[dict[str, Any]], statistic: Any = np.mean) -> Any:
        guided = name if name == "sequences" else f"{name}_guided"
        columns = (
            [row[f"{name}_unguided"] for row in of],
            [row[guided] for row in of],
            [row["oracle"][guided] for row in of],
        )
        return tuple(float(statistic(c)) if c else float("nan") for c in columns)

    def count(what: str, status: str) -> tuple[int, int, int]:
        return (
            sum(row[f"{what}_unguided"] == status for row in rows),
            sum(row[f"{what}_guided"] == status for row in rows),
            sum(row["oracle"][f"{what}_guided"] == status for row in rows),
        )

    all_solve = [
        r for r in rows if r["solved_unguided"] and r["solved_guided"] and r["solved_oracle"]
    ]
    return Figures(
        search=search,
        size=size,
        prior=prior,
        guide=guide,
        tasks=len(rows),
        scenes=len(set(scenes)),
        u=wide(np.nanmean, u),
        g=wide(np.nanmean, g),
        o=wide(np.nanmean, o),
        u_median=wide(np.nanmedian, u),
        g_median=wide(np.nanmedian, g),
        o_median=wide(np.nanmedian, o),
        look=1e3 * float(np.mean([row["seconds_inference"] for row in rows])),
        amortised=wide(np.nanmean, [1e3 * cost for cost in amortised_costs(rows)]),
        gain=over_groups(scenes, ratio_of_sums, u, g, confidence=CONFIDENCE),
        gain_wide=wide(ratio_of_sums, u, g),
        free=saving_reached(scenes, u, free, o, confidence=WIDE),
        reached=saving_reached(scenes, u, g, o, confidence=WIDE),
        solved=count("status", "solved"),
        limit=count("status", "limit"),
        looked=float(np.mean([row["looked"] for row in rows])),
        work=three("work", rows, lambda values: 1e-3 * np.mean(values)),
        worked=saving_reached(
            scenes,
            [row["work_unguided"] for row in rows],
            [row["work_guided"] for row in rows],
            [row["oracle"]["work_guided"] for row in rows],
            confidence=WIDE,
        ),
        nodes=three("nodes", rows),
        nlps=three("nlps", rows),
        sequences=three("sequences", all_solve),
        sequences_median=three("sequences", all_solve, np.median),
        actions=three("n_actions", all_solve),
    )


# --- tables ---------------------------------------------------------------------------------------

_OF = ("search", "boxes", "prior", "guide")


def measured_guides(rows: Sequence[Rerun]) -> Measured:
    """Tables and plots of what there is: true labels are of tasks with a plan, so shares of what
    they save are of these; beside them what guides do to all tasks, and to those without."""
    found = figures([row for row in rows if row.truth])
    every, without = figures(rows), figures([row for row in rows if not row.truth])
    searches = list(dict.fromkeys(each.search for each in found))
    plots = [
        Plot(name=f"guides-{name}", draw=draw, panels=len(searches))
        for name, draw in (
            ("time", partial(time_plot, found=found)),
            ("gain", partial(gain_plot, found=found)),
            ("solved", partial(solved_plot, rows=rows)),
        )
    ]
    return Measured(
        name="guides",
        rows=tuple(rows),
        tables=(
            times_table(found),
            saving_table(found),
            work_table(found),
            every_table(every, without),
            limit_table(rows),
        ),
        plots=tuple(plots) if found else (),
    )


def times_table(found: Sequence[Figures]) -> Table:
    """Time with and without, and with true labels."""
    lines = [
        (
            *_of(each),
            f"{each.tasks} ({each.scenes})",
            f"{each.u:.1f}",
            f"{each.g:.1f}",
            f"{each.look:.1f}",
            f"{each.amortised.value:.1f}",
            f"{each.o:.1f}",
            " / ".join(f"{m.value:.1f}" for m in (each.u_median, each.g_median, each.o_median)),
        )
        for each in found
    ]
    columns = (
        *_OF, "tasks (scenes)", "u", "g, look in", "look", "g, scene encoded once", "o",
        "medians u / g / o",
    )  # fmt: skip
    title = (
        "CPU ms a task with a plan, means and 95% intervals over scenes; o: true labels, no look"
    )
    return Table(name="guides-times", title=title, columns=columns, rows=tuple(lines))


def saving_table(found: Sequence[Figures]) -> Table:
    """What is saved, of what there is to save."""
    lines = [
        (
            *_of(each),
            f"{each.gain:.2f}",
            f"{each.gain_wide.low:.2f} to {each.gain_wide.high:.2f}",
            _share(each.free),
            _share(each.reached),
            _three(each.solved),
            _three(each.limit),
            f"{each.looked:.0%}",
        )
        for each in found
    ]
    columns = (
        *_OF, "u / g (67%)", "95%", "of u - o, look not paid (95%)", "of u - o (95%)",
        "solved u / g / o", "at the limit", "looked",
    )  # fmt: skip
    title = "What is saved, of tasks with a plan"
    return Table(name="guides-saving", title=title, columns=columns, rows=tuple(lines))


def work_table(found: Sequence[Figures]) -> Table:
    """Work with and without, and with true labels."""
    lines = [
        (
            *_of(each),
            _three(each.work, ".1f"),
            _share(each.worked),
            _three(each.nodes, ".0f"),
            _three(each.nlps, ".2f"),
            _three(each.sequences, ".2f"),
            _three(each.sequences_median, "g"),
            _three(each.actions, ".2f"),
        )
        for each in found
    ]
    columns = (
        *_OF,
        "work, 1000",
        "of u - o (95%)",
        "nodes",
        "NLPs",
        "sequences",
        "sequences, median",
        "actions",
    )
    title = (
        "Work a task with a plan, means of u / g / o; sequences tried until solved and actions: "
        "where all three solve"
    )
    return Table(name="guides-work", title=title, columns=columns, rows=tuple(lines))


def every_table(every: Sequence[Figures], without: Sequence[Figures]) -> Table:
    """What guides do to all tasks, and to those of which no plan is known."""
    none = {_of(each): each for each in without}
    lines = []
    for each in every:
        line = [*_of(each), each.tasks, f"{each.u.value:.1f}", f"{each.g.value:.1f}"]
        line += [f"{each.gain_wide:.2f}", _three(each.solved[:2])]
        if beside := none.get(_of(each)):
            line += [beside.tasks, f"{beside.u.value:.1f}", f"{beside.g.value:.1f}"]
            line += [_three(beside.limit[:2]), f"{beside.looked:.0%}"]
        else:
            line += [0, "-", "-", "-", "-"]
        lines.append(tuple(line))
    columns = (
        *_OF, "tasks", "u", "g, look in", "u / g (95%)", "solved u / g",
        "without a plan", "their u", "their g", "at the limit", "looked",
    )  # fmt: skip
    title = "CPU ms a task, all tasks, and those of which no plan is known"
    return Table(name="guides-all", title=title, columns=columns, rows=tuple(lines))


def limit_table(rows: Sequence[Rerun]) -> Table:
    """The tasks at the node limit, by whichever way."""
    lines = []
    for r in sorted(rows, key=lambda r: (r.search, r.size, r.task, r.prior, r.guide)):
        ends = ((r.status_unguided, r.seconds_unguided), (r.status_guided, r.seconds_guided))
        if any(status == "limit" for status, _ in ends):
            said = [f"{status}, {1e3 * seconds:.0f} ms" for status, seconds in ends]
            where = (r.search, r.size, r.prior, r.guide)
            lines.append((*where, r.task, r.goal, r.scene_id, *said))
    columns = (*_OF, "task", "goal", "scene", "unguided", "guided")
    title = "Tasks at the node limit"
    return Table(name="guides-limit", title=title, columns=columns, rows=tuple(lines))


def _of(each: Figures) -> tuple[Any, ...]:
    return each.search, each.size, each.prior, each.guide


def _three(values: Sequence[float], spec: str = "d") -> str:
    return " / ".join(f"{value:{spec}}" for value in values)


def _share(share: Interval) -> str:
    """A dash where there is nothing to save."""
    return f"{share:.0%}" if np.isfinite(share.value) else "-"


# --- plots ----------------------------------------------------------------------------------------


def time_plot(*axes: Axes, found: Sequence[Figures]) -> None:
    """Mean CPU time over boxes, a panel a search: unguided, guided and with true labels."""
    for ax, some in _panels(axes, found):
        plain = [each for each in some if each.guide == some[0].guide and each.prior == TRUE]
        _line(ax, [(e.size, e.u) for e in plain], "unguided", GUIDES["none"].color, "-")
        for prior, guide, its in _lines(some):
            if prior == TRUE:
                continue
            style = LINES[_priors(found).index(prior) % len(LINES)]
            _line(ax, [(e.size, e.g) for e in its], f"{guide}, {prior}", GUIDES[guide].color, style)
        _line(ax, [(e.size, e.o) for e in plain], "true labels", PRIORS[TRUE].color, ":")
        ax.set(ylabel="CPU time a task, mean, ms")
        _over_boxes(ax, some)
    axes[0].legend(loc="upper left", handlelength=3)


def gain_plot(*axes: Axes, found: Sequence[Figures]) -> None:
    """How many times faster guided planning is over boxes, the look included, a panel a search."""
    for ax, some in _panels(axes, found):
        ax.axhline(1.0, color=MUTED, linewidth=0.8)
        for prior, guide, its in _lines(some):
            style = LINES[_priors(found).index(prior) % len(LINES)]
            color = PRIORS[TRUE].color if prior == TRUE else GUIDES[guide].color
            name = "true labels" if prior == TRUE else f"{guide}, {prior}"
            _line(ax, [(e.size, e.gain_wide) for e in its], name, color, style)
        ax.set(ylabel="unguided over guided time")
        _over_boxes(ax, some)
    axes[-1].legend(loc="lower right", handlelength=2.4, columnspacing=1, ncols=2)


def solved_plot(*axes: Axes, rows: Sequence[Rerun]) -> None:
    """Share of tasks solved against time, of LARGE boxes and more together, a panel a search."""
    searches = list(dict.fromkeys(sorted(row.search for row in rows)))
    priors = sorted({row.prior for row in rows}, key=lambda name: (name == TRUE, name))
    for ax, search in zip(axes, searches, strict=True):
        some = [row for row in rows if row.search == search]
        some = [row for row in some if row.size >= LARGE] or some
        pairs = _distinct(sorted({(row.prior, row.guide) for row in some}))
        plain = [row for row in some if (row.prior, row.guide) == pairs[0]]
        done = [row.seconds_unguided for row in plain if row.solved_unguided]
        _solved(ax, done, len(plain), "unguided", GUIDES["none"].color, "-")
        for prior, guide in pairs:
            its = [row for row in some if (row.prior, row.guide) == (prior, guide)]
            done = [row.seconds_guided for row in its if row.solved_guided]
            color = PRIORS[TRUE].color if prior == TRUE else GUIDES[guide].color
            style = LINES[priors.index(prior) % len(LINES)]
            name = "true labels" if prior == TRUE else f"{guide}, {prior}"
            _solved(ax, done, len(its), name, color, style)
        ax.set_title(f"{search}, {min(row.size for row in some)} boxes and more")
        ax.set(xscale="log", xlabel="CPU time, ms", ylabel="share of tasks solved", ylim=(0, 1.02))
    axes[0].legend(loc="lower right", handlelength=3)


def _panels(axes: Sequence[Axes], found: Sequence[Figures]) -> list[tuple[Axes, list[Figures]]]:
    searches = dict.fromkeys(each.search for each in found)
    panels = [
        (ax, [each for each in found if each.search == search])
        for ax, search in zip(axes, searches, strict=True)
    ]
    for (ax, _), search in zip(panels, searches, strict=True):
        ax.set_title(search)
    return panels


def _over_boxes(ax: Axes, some: Sequence[Figures]) -> None:
    ax.set(yscale="log", xlabel="boxes")
    ax.set_xticks(sorted({each.size for each in some}))
    for written in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
        written(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "125" else ""))


def _lines(some: Sequence[Figures]) -> list[tuple[str, str, list[Figures]]]:
    pairs = _distinct([(each.prior, each.guide) for each in some])
    return [
        (prior, guide, [e for e in some if (e.prior, e.guide) == (prior, guide)])
        for prior, guide in pairs
    ]


def _distinct(pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Each once; with true labels a guide that waits does as one that does not: one of them."""
    found: dict[tuple[str, str | bool], tuple[str, str]] = {}
    for prior, guide in pairs:
        alike = prior == TRUE and GUIDES[guide].first
        found.setdefault((prior, alike or guide), (prior, guide))
    return list(found.values())


def _priors(found: Sequence[Figures]) -> list[str]:
    return list(dict.fromkeys(each.prior for each in found))


def _line(
    ax: Axes, points: Sequence[tuple[int, Interval]], name: str, color: str, style: str
) -> None:
    """Values with their intervals as a band."""
    sizes = [size for size, _ in points]
    values = [interval.value for _, interval in points]
    ax.plot(sizes, values, color=color, linestyle=style, marker="o", markersize=3, label=name)
    low, high = [i.low for _, i in points], [i.high for _, i in points]
    ax.fill_between(sizes, low, high, color=color, alpha=0.12, linewidth=0)


def _solved(ax: Axes, seconds: Sequence[float], of: int, name: str, color: str, style: str) -> None:
    times = 1e3 * np.sort(np.array(seconds))
    shares = np.arange(1, len(times) + 1) / of
    ax.step(times, shares, where="post", color=color, linestyle=style, label=name)
