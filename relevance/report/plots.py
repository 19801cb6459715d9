"""The report's plots, inline or as files, all in one quiet style.

Text stays text and takes the page's font; ids start with the plot's name, so that many plots
can share a page. Colours are those of `style`.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from relevance.metrics import over_groups
from relevance.report.paper import paper
from relevance.report.style import (
    BAND,
    FAINT,
    GROUPS,
    INK,
    LOSS_COLOR,
    MUTED,
    PALE,
    SHARES,
    STYLE,
    TIMES,
    UNGUIDED,
    VIOLET,
    family_color,
    guide_style,
    legend_below,
    pooled,
    seconds,
)
from relevance.report.style import groups as shown_groups
from relevance.store import replacing

if TYPE_CHECKING:  # the planner comes with it, of which most plots know nothing
    from relevance.evaluation import Comparison, Covered, Predictions

DPI = 200
"""Of pictures as files."""
QUANTILES = np.linspace(0, 1, 201)
"""Shares at which distributions of times are drawn; the middle one is the median."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """A plot before it is drawn: into the page, or into files."""

    name: str
    """What its ids start with, and its files are called."""
    draw: Callable[..., None]
    """Draws into the axes; `given` follows them."""
    given: Mapping[str, Any]
    size: tuple[float, float] = (4.8, 2.9)
    """Inches."""
    widths: tuple[float, ...] = (1.0,)
    """Of the panels side by side, relative to each other."""

    def inline(self) -> str:
        """Inline SVG: text takes the page's font, ids are told from those of other plots."""
        text = self._saved("svg", transparent=True).decode()
        text = text[text.index("<svg") :]
        text = re.sub(r'\bid="', f'id="{self.name}-', text)
        text = re.sub(r'((?:xlink:)?href="#|url\(#)', rf"\g<1>{self.name}-", text)
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        text = text.replace("'DejaVu Sans'", "var(--font)")
        return re.sub(r'<svg[^>]*?(viewBox="[^"]*")[^>]*>', r'<svg \1 role="img">', text, count=1)

    def write(self, folder: Path) -> None:
        """NAME.svg and NAME.png, on white."""
        for kind in ("svg", "png"):
            with replacing(folder / f"{self.name}.{kind}") as temporary:
                temporary.write_bytes(self._saved(kind))

    def _saved(self, kind: str, **options: Any) -> bytes:
        made = {"svg": {"Date": None}, "png": {"Software": None}}[kind]  # equal rows, equal bytes
        with mpl.rc_context({**STYLE, "svg.hashsalt": self.name}):
            figure = Figure(figsize=self.size, layout="constrained")
            panels = len(self.widths)
            axes = figure.subplots(1, panels, squeeze=False, width_ratios=self.widths)[0]
            self.draw(*axes, **self.given)
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=DPI, metadata=made, **options)
        return buffer.getvalue()


def svg(
    name: str,
    draw: Callable[..., None],
    *,
    size: tuple[float, float] = (4.8, 2.9),
    panels: int = 1,
    **given: Any,
) -> str:
    """Draw into `panels` axes side by side; inline SVG whose ids start with `name`."""
    return Drawing(name=name, draw=draw, given=given, size=size, widths=(1.0,) * panels).inline()


def _percent_axis(axis: Any) -> None:
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(100 * value, 2):g}%"))


def _log_seconds(ax: Axes, which: str) -> None:
    """Logarithmic scale in seconds, labelled at 1, 2 and 5."""
    (ax.set_xscale if which == "x" else ax.set_yscale)("log")
    axis = ax.xaxis if which == "x" else ax.yaxis
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 300 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: seconds(value)))
    axis.set_minor_formatter(NullFormatter())


def label_shares(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    groups = [row["group"] for row in rows]
    y = np.arange(len(rows))[::-1]
    shares = [row["relevant_share"] or 0.0 for row in rows]
    colors = [family_color(group) for group in groups]
    ax.barh(y, shares, height=0.56, color=colors)
    end = max([*shares, 0.3]) * 1.08
    for at, row, share in zip(y, rows, shares, strict=True):
        text = f"{100 * share:.1f}% of {row['queries']:,}"
        ax.text(end * 1.03, at, text, va="center", fontsize=8.5)
        theirs = paper().train.get(row["group"])
        if theirs:
            ax.plot([theirs.share] * 2, [at - 0.38, at + 0.38], color=INK, linewidth=1.6)
    ax.set_yticks(y, groups)
    ax.set_xlim(0, end)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("relevant among queries; black: the paper's")
    _percent_axis(ax.xaxis)


def lengths(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    lengths = sorted({row["n_actions"] for row in rows})
    width = 0.8 / len(GROUPS)
    for number, group in enumerate(GROUPS):
        counts = Counter()
        for row in rows:
            if row["family"] == group:
                counts[row["n_actions"]] += row["plans"]
        total = sum(counts.values())
        if total:
            at = np.arange(len(lengths)) + (number - (len(GROUPS) - 1) / 2) * width
            shares = [counts[length] / total for length in lengths]
            label = f"{group} (n = {total:,})"
            ax.bar(at, shares, width * 0.92, color=family_color(group), label=label)
    ax.set_xticks(range(len(lengths)), [str(length) for length in lengths])
    ax.set_xlabel("actions in the plan")
    ax.set_ylabel("share of solved tasks")
    ax.grid(axis="x", visible=False)
    ax.margins(y=0.4)  # the legend's place
    ax.legend(loc="upper right")
    _percent_axis(ax.yaxis)


def reasons(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    y = np.arange(len(rows))[::-1]
    counts = [row["goals"] for row in rows]
    ax.barh(y, counts, height=0.56, color=PALE)
    for at, count in zip(y, counts, strict=True):
        ax.text(count + max(counts) * 0.01, at, f"{count:,}", va="center", fontsize=8.5)
    ax.set_yticks(y, [textwrap.fill(row["label"], 26) for row in rows])
    ax.set_xlim(0, max(counts) * 1.12)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("tasks")


def times(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Distribution of planning times; rows hold a family's QUANTILES, s."""
    low, high = paper().seconds
    ax.axvspan(low, high, color=BAND, zorder=0)
    ax.text(low * 0.88, 0.03, "paper, means", ha="right", color=MUTED, fontsize=8.5)
    for row in rows:
        found, group = row["quantiles"], row["family"]
        label = f"{group}: median {seconds(found[len(found) // 2])} (n = {row['n']:,})"
        ax.plot(found, QUANTILES, color=family_color(group), label=label)
    ax.set_xlabel("planning time of a task")
    ax.set_ylabel("share of tasks done")
    ax.legend(loc="upper center", bbox_to_anchor=(0.45, -0.2))
    _percent_axis(ax.yaxis)
    _log_seconds(ax, "x")
    ax.set_xlim(right=max(20.0, *(row["quantiles"][-1] for row in rows)))


def families_in(predictions: Predictions) -> list[str]:
    """The families that there are predictions of: a panel each."""
    return [group for group in GROUPS if len(predictions.of(group))]


def accuracy(ax: Axes, predictions: Predictions) -> None:
    groups = [g for g in shown_groups() if not pooled(g) and len(predictions.of(g))]
    for number, (label, attribute, color) in enumerate(SHARES):
        for row, group in enumerate(groups):
            y = len(groups) - 1 - row + (1 - number) * 0.22
            value = getattr(predictions.of(group).accuracy(), attribute)
            ax.plot(value, y, "o", color=color, markersize=6, label=label if not row else None)
            if group in paper().accuracy:
                theirs = paper().accuracy[group][number]
                ax.plot([theirs, value], [y, y], color=FAINT, linewidth=1.2, zorder=1)
                ax.plot(theirs, y, "|", color=color, markersize=9, markeredgewidth=1.6)
    for row, group in enumerate(groups):
        base = predictions.of(group).accuracy().base_rate
        y = len(groups) - 1 - row
        label = None if row else "base rate of the total"
        ax.plot([base, base], [y - 0.4, y + 0.4], ":", color=INK, linewidth=1.2, label=label)
    ax.plot([], [], "|", color=MUTED, markersize=9, markeredgewidth=1.6, label="paper")
    ax.set_yticks(range(len(groups) - 1, -1, -1), groups)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("queries judged rightly")
    ax.legend(loc="upper center", bbox_to_anchor=(0.4, -0.17), ncols=3, columnspacing=1.2)
    _percent_axis(ax.xaxis)


def beta_accuracy(*axes: Axes, predictions: Predictions) -> None:
    for ax, group in zip(axes, families_in(predictions), strict=True):
        part = predictions.of(group)
        ax.set_title(f"{group} (n = {len(np.unique(part.task))} tasks)")
        ax.set_xlabel("beta (larger keeps more)")
        if len(part):
            limit = float(np.clip(np.ceil(np.abs(part.score).max()), 2, 12))
            betas = np.linspace(-limit, limit, 97)
            found = [part.accuracy(float(beta)) for beta in betas]
            for label, attribute, color in SHARES:
                ax.plot(betas, [getattr(a, attribute) for a in found], color=color, label=label)
            whole = [a.tasks_whole for a in found]
            ax.plot(betas, whole, "--", color=VIOLET, linewidth=1.4, label="whole tasks kept")
        ax.axvline(0, color=FAINT, linewidth=1)
        ax.set_ylim(0, 1.02)
        _percent_axis(ax.yaxis)
    max(reversed(axes), key=lambda ax: len(ax.lines)).legend(loc="lower center")


def coverage(*axes: Axes, rows: Sequence[Covered]) -> None:
    """What was promised against what was reached, and against how much is kept for it."""
    from relevance.evaluation import LEVELS

    reached_ax, kept_ax = axes
    for number, group in enumerate(dict.fromkeys(row.group for row in rows)):
        found, color = [row for row in rows if row.group == group], family_color(group)
        promised = [row.coverage for row in found]
        label = f"{group} (n = {found[0].reached.n} scenes)"
        reached_ax.plot(promised, [row.reached_all for row in found], color=color, label=label)
        for row in found:
            if row.coverage in LEVELS:
                low, value, high = row.reached.low, row.reached.value, row.reached.high
                at, spread = row.coverage + 0.003 * number, [[value - low], [high - value]]
                style = {"fmt": "o", "markersize": 4, "linewidth": 1, "capsize": 2.5}
                reached_ax.errorbar(at, value, spread, color=color, **style)
        kept_ax.plot(promised, [row.kept / row.objects for row in found], color=color)
    ends = [min(row.coverage for row in rows), 1.0]
    reached_ax.plot(ends, ends, ":", color=MUTED, linewidth=1.2, label="as promised")
    reached_ax.set_title("goals with everything relevant kept")
    reached_ax.legend(loc="lower right")
    kept_ax.set_title("boxes that are kept, the goal's own included")
    kept_ax.set_ylim(0, 1.02)
    for ax in axes:
        ax.set_xlabel("promised coverage")
        _percent_axis(ax.xaxis)
        _percent_axis(ax.yaxis)


def scores(*axes: Axes, predictions: Predictions) -> None:
    for ax, group in zip(axes, families_in(predictions), strict=True):
        part = predictions.of(group)
        ax.set_title(group)
        ax.set_xlabel("score (logit)")
        if len(part):
            low, high = np.clip([part.score.min(), part.score.max()], -15, 15)
            bins = np.linspace(low - 1e-6, high + 1e-6, 41).tolist()
            for value, name, color in ((False, "irrelevant", PALE), (True, "relevant", INK)):
                scores = np.clip(part.score[part.relevant == value], low, high)
                if len(scores):
                    label = f"{name} (n = {len(scores)})"
                    weights = np.full(len(scores), 1 / len(scores))
                    ax.hist(scores, bins, weights=weights, color=color, alpha=0.65, label=label)
            ax.margins(y=0.3)  # the legend's place
            ax.legend(loc="upper right")
        ax.axvline(0, color=MUTED, linewidth=1, linestyle=":")
        ax.grid(axis="x", visible=False)
        _percent_axis(ax.yaxis)
    axes[0].set_ylabel("share of its class")


def runtimes(*axes: Axes, comparisons: dict[str, list[Comparison]]) -> None:
    """Mean CPU time, and NLPs, a task: unguided beside each guide, one group of bars a family."""
    time_ax, nlp_ax = axes
    ticks = []
    for at, (group, found) in enumerate(comparisons.items()):
        first = found[0]
        bars = [(UNGUIDED, first.unguided, first.nlps_unguided)]
        bars += [(c.guide, c.guided, c.nlps_guided) for c in found]
        width = 0.8 / len(bars)
        for number, (name, interval, nlps) in enumerate(bars):
            x = at + (number - (len(bars) - 1) / 2) * width
            style = {"width": width * 0.9, "color": guide_style(name).color}
            time_ax.bar(x, interval.value, label=None if at else name, **style)
            spread = [[interval.value - interval.low], [interval.high - interval.value]]
            time_ax.errorbar(x, interval.value, spread, color=INK, linewidth=1, capsize=2.5)
            nlp_ax.bar(x, nlps, **style)
        ticks.append(f"{group}\nn = {first.n_solvable}")
    for ax, label in ((time_ax, "CPU time a task"), (nlp_ax, "NLPs solved a task")):
        ax.set_xticks(range(len(ticks)), ticks)
        ax.set_title(label)
        ax.grid(axis="x", visible=False)
    legend_below(time_ax, most=5)
    time_ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: seconds(value)))


def by_objects(ax: Axes, rows: dict[str, list[dict[str, Any]]]) -> None:
    """Mean CPU time by the number of objects, with intervals over scenes; `rows` per guide,
    solvable tasks."""
    from relevance.evaluation import guided_cost

    first = next(iter(rows.values()))
    series = {UNGUIDED: (first, lambda row: row["seconds_unguided"])}
    series |= {guide: (chosen, guided_cost) for guide, chosen in rows.items()}
    for name, (chosen, cost) in series.items():
        counts = sorted({row["n_objects"] for row in chosen})
        means = [
            over_groups([row["scene_id"] for row in of], np.nanmean, [cost(row) for row in of])
            for of in ([row for row in chosen if row["n_objects"] == n] for n in counts)
        ]
        color = guide_style(name).color
        ax.plot(counts, [m.value for m in means], "o-", markersize=4, color=color, label=name)
        lows, highs = [m.low for m in means], [m.high for m in means]
        ax.fill_between(counts, lows, highs, color=color, alpha=0.15, linewidth=0)
    _log_seconds(ax, "y")
    ax.set_xlabel("objects in the scene")
    ax.set_ylabel("mean CPU time a task")
    ax.legend()
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))


def pairs(ax: Axes, rows: dict[str, list[dict[str, Any]]]) -> None:
    ends = [
        row[c] for r in rows.values() for row in r for c in ("seconds_unguided", "seconds_guided")
    ]
    low, high = min(ends) / 1.4, max(ends) * 1.4
    ax.plot([low, high], [low, high], color=FAINT, linewidth=1.2)
    ax.text(low * 1.15, low * 1.25, "same time", color=MUTED, fontsize=8, rotation=45)
    for name, chosen in rows.items():
        solved = [row for row in chosen if row["solved_guided"]]
        missed = [row for row in chosen if not row["solved_guided"]]
        for part, marker, label in ((solved, "o", name), (missed, "x", f"{name}: missed")):
            if part:
                x = [row["seconds_unguided"] for row in part]
                y = [row["seconds_guided"] for row in part]
                style = {"s": 16, "marker": marker, "color": guide_style(name).color, "alpha": 0.7}
                ax.scatter(x, y, label=label, rasterized=len(part) > 2000, **style)
    ax.set_xlim(low, high)
    ax.set_ylim(low, high)
    _log_seconds(ax, "x")
    _log_seconds(ax, "y")
    ax.set_xlabel("CPU time unguided")
    ax.set_ylabel("CPU time guided")
    ax.legend(loc="upper left")


def beta_reruns(*axes: Axes, sweep: dict[str, list[Comparison]]) -> None:
    time_ax, miss_ax = axes
    for group, found in sweep.items():
        betas, color = [c.beta for c in found], family_color(group)
        label = f"{group} (n = {found[0].n_solvable})"
        speedups = [c.speedup_both for c in found]
        time_ax.plot(
            betas, [s.value for s in speedups], "o-", markersize=4, color=color, label=label
        )
        lows, highs = [s.low for s in speedups], [s.high for s in speedups]
        time_ax.fill_between(betas, lows, highs, color=color, alpha=0.15, linewidth=0)
        shares = [c.misses / c.n_solvable if c.n_solvable else np.nan for c in found]
        miss_ax.plot(betas, shares, "o-", markersize=4, color=color)
    time_ax.axhline(1, color=FAINT, linewidth=1.2)
    time_ax.set_title("speed-up, misses left out")
    time_ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}{TIMES}"))
    time_ax.legend()
    miss_ax.set_title("tasks missed")
    miss_ax.set_ylim(bottom=0)
    _percent_axis(miss_ax.yaxis)
    for ax in axes:
        ax.set_xlabel("beta (larger keeps more)")


def training_curve(ax: Axes, history: Sequence[Mapping[str, float]]) -> None:
    """Training loss and its parts by step."""
    names = [name for name in history[0] if name != "step"]
    for name in names:
        steps, values = [h["step"] for h in history], [h[name] for h in history]
        ax.plot(steps, values, color=LOSS_COLOR.get(name, MUTED), linewidth=1.5, label=name)
    ax.set_yscale("log")
    for format in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
        format(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "125" else ""))
    ax.set_xlabel("step")
    ax.set_ylabel("training loss")
    ax.legend(ncols=len(names), loc="lower left", bbox_to_anchor=(0, 1), columnspacing=1.2)
