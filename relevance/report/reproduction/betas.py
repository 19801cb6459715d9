"""The paper's two figures over beta, for `on`: on its axes, and where ours moves as far."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from relevance.report.gallery import anchor
from relevance.report.paper import paper
from relevance.report.plots import Drawing
from relevance.report.reproduction.models import (
    POINTS,
    Evidence,
    Model,
    our_betas,
    papers_betas,
)
from relevance.report.reproduction.sheets import (
    OURS,
    TRIPLE,
    Sheet,
    counts,
    saved,
    share_cells,
    shares,
    words,
)
from relevance.report.reproduction.tables import time_saved
from relevance.report.style import (
    FAINT,
    GREEN,
    INK,
    LOST,
    MUTED,
    percent,
    seconds,
)
from relevance.report.style import SHARES as COLORS

PANELS = ("the paper's range", "where ours moves ten points")


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """What beta does to a checkpoint on `on`."""

    model: Model
    rows: tuple[dict[str, Any], ...]
    """One a beta and panel: shares of the queries, and what was saved where it was rerun."""
    n_queries: int
    n_tasks: int
    """Tasks that were rerun at every beta."""

    def panel(self, name: str) -> list[dict[str, Any]]:
        """Its rows, by beta."""
        return [row for row in self.rows if row["panel"] == name]


def curves(evidence: Evidence, model: Model) -> Curves | None:
    """Shares from stored scores, time saved from reruns; None without predictions."""
    predictions = evidence.queries(model, "on")
    if not len(predictions):
        return None
    ranges = dict(zip(PANELS, (papers_betas(), our_betas(predictions)), strict=True))
    rerun = _rerun(evidence, model, {beta for betas in ranges.values() for beta in betas})
    rows = [
        {
            "panel": panel,
            "whose": OURS,
            "checkpoint": model.name,
            "beta": beta,
            **share_cells(TRIPLE, predictions.accuracy(beta)),
            "false_irrelevant": 1 - predictions.accuracy(beta).true_relevant,
            **(time_saved(rerun[beta]) if rerun else {}),
            **(_theirs(number) if panel == PANELS[0] else {}),
        }
        for panel, betas in ranges.items()
        for number, beta in enumerate(betas)
    ]
    n_tasks = len(next(iter(rerun.values()))) if rerun else 0
    return Curves(model=model, rows=tuple(rows), n_queries=len(predictions), n_tasks=n_tasks)


def _rerun(
    evidence: Evidence, model: Model, betas: set[float]
) -> dict[float, list[dict[str, Any]]]:
    """The reruns of the tasks that were rerun at every beta; nothing where there are none."""
    if not betas <= evidence.betas(model):
        return {}
    found = {beta: evidence.reruns(model, beta, "on") for beta in betas}
    common = set.intersection(*({anchor(row) for row in rows} for rows in found.values()))
    every = {beta: [r for r in rows if anchor(r) in common] for beta, rows in found.items()}
    return every if common else {}


def _theirs(number: int) -> dict[str, float]:
    names = (*TRIPLE, "false_irrelevant", "saved")
    return {f"paper_{name}": paper().curves[name][number] for name in names}


def sheet(found: Curves) -> Sheet:
    """The figures as rows."""
    columns = (
        words("range", "panel"),
        words("beta", "shown"),
        shares("true relevant", "true_relevant"),
        shares("true irrelevant", "true_irrelevant"),
        shares("total", "total"),
        shares("false irrelevant", "false_irrelevant"),
        shares("the paper's", "paper_false_irrelevant", decimals=0),
        saved("saved, the look not paid", "saved_free"),
        shares("the paper's", "paper_saved"),
        saved("saved, the look paid", "saved", ends=False),
        saved("saved, misses counted", "saved_counted", ends=False),
        counts("missed", "missed"),
    )
    return Sheet(
        name=f"beta-{found.model.body}",
        title=f"Figures 7 and 8, on: {found.model.name}",
        columns=columns,
        rows=tuple(
            row | {"shown": f"{row['beta']:+.3g}" if row["beta"] else "0"} for row in found.rows
        ),
        notes=(*paper().notes["beta"], *_notes(found)),
    )


def _notes(found: Curves) -> list[str]:
    said = [
        f"Ours: {found.model.name}; an object is kept iff its score is over minus beta, and its "
        "score includes the offset that validation chose, so that beta = 0 is that decision. "
        f"Shares are of {found.n_queries} test queries, from stored scores.",
    ]
    if not found.n_tasks:
        said.append("Not rerun at these betas yet: `relevance reproduce` does that.")
        return said
    first = found.rows[0]
    said.append(
        f"Time saved is from reruns of {found.n_tasks} tasks, the same at every beta, of which the "
        f"unguided planner solves {first['solvable']}: mean CPU time of those that both solve, "
        f"bars are 67% intervals. A task takes {seconds(first['unguided'])} unguided, a look "
        f"{seconds(first['look'])}: with the look paid, what is saved is "
        f"{_ends(row['saved'] for row in found.rows)}, misses counted "
        f"{_ends(row['saved_counted'] for row in found.rows)}."
    )
    return said


def _ends(values: Any) -> str:
    known = sorted(values)
    low, high = (
        percent(value, 0).replace("-", "\N{MINUS SIGN}") for value in (known[0], known[-1])
    )
    return low if low == high else f"{low} to {high}"


def drawings(found: Curves) -> list[tuple[Drawing, str]]:
    """Figures 7 and 8, each with its caption."""
    body = found.model.body
    wide: dict[str, Any] = {"size": (9.2, 3.5), "widths": (1.0, 1.0), "given": {"found": found}}
    low, high = papers_betas()[0], papers_betas()[-1]
    moved = f"left: beta from {low:g} to {high:g} on the paper's axes; right: the range around 0"
    moved += f" over which our true relevant share moves {100 * POINTS:g} points"
    shown = [
        (
            Drawing(name=f"figure-7-{body}", draw=_shares, **wide),
            f"Figure 7, on: queries judged rightly over beta; {moved}. Dots: the paper's.",
        )
    ]
    if found.n_tasks:
        shown.append(
            (
                Drawing(name=f"figure-8-{body}", draw=_saved, **wide),
                f"Figure 8, on: time saved over beta, tasks that both solve; {moved}. Dots and "
                f"crosses: the paper's. {found.n_tasks} tasks; bars: 67% intervals.",
            )
        )
    return shown


def _shares(*axes: Axes, found: Curves) -> None:
    for ax, panel in zip(axes, PANELS, strict=True):
        rows = found.panel(panel)
        betas = [row["beta"] for row in rows]
        for label, name, color in COLORS:
            ax.plot(betas, [row[name] for row in rows], color=color, label=label)
            if panel == PANELS[0]:
                theirs = [row[f"paper_{name}"] for row in rows]
                ax.plot(betas, theirs, "o", color=color, markersize=4, alpha=0.75)
        ax.set_ylim(*paper().axes["share"])
        _dress(ax, panel)
    axes[0].plot([], [], "o", color=MUTED, markersize=4, label="the paper's")
    axes[0].legend(loc="lower left", ncols=2)


def _saved(*axes: Axes, found: Curves) -> None:
    for ax, panel in zip(axes, PANELS, strict=True):
        rows = found.panel(panel)
        betas = [row["beta"] for row in rows]
        values = [row["saved_free"] for row in rows]
        spread = [
            [value - row["saved_free_low"] for value, row in zip(values, rows, strict=True)],
            [row["saved_free_high"] - value for value, row in zip(values, rows, strict=True)],
        ]
        label = "time saved, the look not paid"
        ax.errorbar(betas, values, spread, color=GREEN, capsize=2.5, linewidth=1.5, label=label)
        paid = [row["saved"] for row in rows]
        ax.plot(betas, paid, "--", color=GREEN, linewidth=1.3, label="time saved, the look paid")
        lost = [row["false_irrelevant"] for row in rows]
        ax.plot(betas, lost, color=LOST, label="false irrelevant")
        ax.axhline(0, color=FAINT, linewidth=1.2)
        _dress(ax, panel)
        if panel == PANELS[0]:
            ax.plot(
                betas,
                [r["paper_saved"] for r in rows],
                "o",
                color=INK,
                markersize=4.5,
                label="time saved, the paper's",
            )
            ax.plot(
                betas,
                [r["paper_false_irrelevant"] for r in rows],
                "x",
                color=LOST,
                markersize=4.5,
                label="false irrelevant, the paper's",
            )
        shown = [*values, *lost, *paper().axes["saved"]]
        shown += [row[end] for row in rows for end in ("saved_free_low", "saved_free_high")]
        shown = [value for value in shown if math.isfinite(value)]  # some beta may solve nothing
        ax.set_ylim(min(shown) - 0.02, max(shown) + 0.02)
        if paid and max(paid) < ax.get_ylim()[0]:
            text = f"the look paid: below, at {_ends(paid)}"
            ax.text(0.98, 0.93, text, transform=ax.transAxes, ha="right", color=MUTED, fontsize=8)
    axes[0].figure.legend(
        loc="outside lower center",
        ncols=3,
        columnspacing=1.2,
        handles=axes[0].get_legend_handles_labels()[0],
    )


def _dress(ax: Axes, panel: str) -> None:
    ax.set_title(panel)
    ax.set_xlabel("beta (larger keeps more)")
    if panel == PANELS[0]:
        low, high = paper().axes["beta"]
        ax.set_xlim(low - 0.015, high + 0.015)
    if not math.isclose(*ax.get_xlim()):
        ax.axvline(0, color=FAINT, linewidth=1, zorder=0)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(100 * value, 1):g}%"))
