"""What a study found: its runs judged on unseen scenes beside two rules, in tables and pictures.

Shares are of queries (subject and reference left out) at beta = 0, which is what validation chose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from relevance.benchmarks.runs import Measured, Plot
from relevance.evaluation import JUDGES, NETWORK, NEVER, RULE, Predictions, read_predictions
from relevance.metrics import (
    WIDE,
    Accuracy,
    Interval,
    average_precision,
    bootstrap,
    ratio_of_sums,
    recall_at,
)
from relevance.report import curves
from relevance.report.paper import Queries, paper
from relevance.report.style import GROUPS, groups
from relevance.report.tables import Table
from relevance.scene import PREDICATES
from relevance.store import Dataset

EVERY, CLEAR = "all goals", "goals with one answer"
"""Which goals are judged; the second leaves the ambiguous ones out."""
STANDS = ("on the subject", "on the reference", "elsewhere")
"""Where a query stands."""
BOXES = {"3 to 10": (3, 10), "11 to 17": (11, 17), "18 to 22": (18, 22), "23 to 27": (23, 27),
         "28 to 31": (28, 31)}  # fmt: skip
"""Scenes by their number of boxes."""

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scored:
    """How a run, or a rule, judges one group of test queries."""

    label: str
    run: str
    judge: str
    group: str
    """A family of scenes, or a predicate."""
    stands: str
    """Where the queries stand; anywhere when empty."""
    goals: str
    """Which goals are judged."""
    boxes: str
    """How many boxes the scenes have; any number when empty."""
    body: str
    reading: str
    recipe: str
    polling: str
    seed: int | None
    parameters: int | None
    scenes: int | None
    """What it learned from: scenes, and goals of each and a predicate (0: all)."""
    scene_goals: int | None
    steps: int | None
    minutes: float | None
    """Of a core, that it was given; `core_minutes` are those that it took."""
    core_minutes: float | None
    scenes_shown: int | None
    asked: int | None
    """Queries of this group that it was asked in training, repetitions counted."""
    of_paper: float | None
    """The same as a share of the paper's queries."""
    checkpoint_id: str
    queries: int
    base_rate: float
    true_relevant: float
    true_irrelevant: float
    total: float
    total_low: float
    total_high: float
    """95% interval of the total over scenes."""
    total_at_paper: float | None
    """The total at the paper's share of relevant queries."""
    balanced: float
    average_precision: float
    recall: float
    """Of the relevant ones, the share kept where 95% of the irrelevant ones are left out."""
    tasks_right: float
    """Share of goals of which every query is judged rightly."""


def tabulate(
    root: Any, study: str, rows: Sequence[Row], progress: Callable[[int, int], None] | None = None
) -> Measured:
    """The tables and pictures of a study's rows, as `run_study` gives them."""
    dataset, scored, pooled = Dataset.open(root), [], {}
    for number, row in enumerate(rows, 1):
        queries = read_predictions(dataset, row["checkpoint_id"]).queries()
        scored += list(_scored(row, queries, {one.group for one in scored}))
        for family in GROUPS:
            if len(part := queries.of(family)):  # networks of other families share the label
                pooled.setdefault((row["label"], family), []).append(_by_scene(part))
        if progress:
            progress(number, len(rows))
    return Measured(
        name=study,
        rows=tuple(scored),
        tables=(
            _runs_table(study, scored),
            _means_table(study, scored, pooled),
            _predicates_table(study, scored),
            _stands_table(study, scored),
            _boxes_table(study, scored),
        ),
        plots=tuple(_plots(study, rows, scored)),
    )


def _scored(row: Row, queries: Predictions, ruled: set[str]) -> Iterator[Scored]:
    """Rows of a run, and those of the rules about groups that have none yet."""
    for group in groups():
        part = queries.of(group)
        if not len(part):
            continue
        yield from _judged(row, part, group, NETWORK)
        if group not in ruled:
            for judge in (RULE, NEVER):
                yield from _judged(row, part, group, judge)


def _judged(row: Row, part: Predictions, group: str, judge: str) -> Iterator[Scored]:
    yield _figures(row, part, group, judge, EVERY, "")
    if (~part.ambiguous).any():
        yield _figures(row, part.where(~part.ambiguous), group, judge, CLEAR, "")
    for stands in STANDS if group in GROUPS else ():
        rows = part.where(part.stands == stands)
        if len(rows):
            yield _figures(row, rows, group, judge, EVERY, stands)
    for boxes, (least, most) in BOXES.items() if group in GROUPS else ():
        rows = part.where((part.n_objects >= least) & (part.n_objects <= most))
        if len(rows):
            yield _figures(row, rows, group, judge, EVERY, "", boxes)


def _figures(
    row: Row, part: Predictions, group: str, judge: str, goals: str, stands: str, boxes: str = ""
) -> Scored:
    score = JUDGES[judge](part)
    found = Accuracy.of(score, part.relevant, task=part.task)
    total = _over_scenes([_by_scene(part, score)])
    network = judge == NETWORK
    asked = _asked(row, group)
    about: dict[str, Any] = {
        name: str(row[name]) if network else ""
        for name in ("body", "reading", "recipe", "polling", "checkpoint_id")
    }
    took: dict[str, Any] = {
        "seed": row["seed"],
        "parameters": row["parameters"],
        "scenes": row["scenes"],
        "scene_goals": row["scene_goals"],
        "steps": row["steps"],
        "minutes": row["minutes"],
        "core_minutes": row["core_seconds"] / 60,
        "scenes_shown": row["scenes_shown"],
        "asked": asked,
        "of_paper": _of_paper(asked, group),
    }
    learned: dict[str, Any] = {name: value if network else None for name, value in took.items()}
    theirs = None if stands or boxes else paper().test.get(group)
    return Scored(
        label=row["label"] if network else judge,
        run=row["run"] if network else judge,
        judge=judge,
        group=group,
        stands=stands,
        goals=goals,
        boxes=boxes,
        **about,
        **learned,
        queries=found.n_rows,
        base_rate=found.base_rate,
        true_relevant=found.true_relevant,
        true_irrelevant=found.true_irrelevant,
        total=found.total,
        total_low=total.low,
        total_high=total.high,
        total_at_paper=None if theirs is None else at_share(found, theirs),
        balanced=found.balanced,
        average_precision=average_precision(score, part.relevant),
        recall=recall_at(score, part.relevant),
        tasks_right=found.tasks_right,
    )


def at_share(found: Accuracy, theirs: Queries) -> float:
    """The total if as many of the queries were relevant as theirs are."""
    return theirs.share * found.true_relevant + (1 - theirs.share) * found.true_irrelevant


def _asked(row: Row, group: str) -> int:
    """What a run was asked in training about a group."""
    return sum(
        count
        for name, count in row["asked"].items()
        if group == name or (name in PREDICATES and group == PREDICATES[name].family)
    )


def _of_paper(asked: int, group: str) -> float | None:
    theirs = paper().train.get(group)
    return None if theirs is None else asked / (theirs.relevant + theirs.irrelevant)


Sums = tuple[np.ndarray, np.ndarray]
"""By scene: queries judged rightly, and all."""


def _by_scene(part: Predictions, score: np.ndarray | None = None) -> Sums:
    right = ((part.score if score is None else score) > 0) == part.relevant
    _, number = np.unique(part.scene, return_inverse=True)
    return np.bincount(number, right), np.bincount(number)


def _over_scenes(runs: Sequence[Sums]) -> Interval:
    """The share of queries judged rightly, with the interval that drawing scenes anew gives; of
    several runs on the same scenes their mean."""
    right, asked = (np.sum(columns, axis=0) for columns in zip(*runs, strict=True))
    return bootstrap((right, asked), ratio_of_sums, confidence=WIDE)


# --- tables -----------------------------------------------------------------------------------


def _runs_table(study: str, scored: Sequence[Scored]) -> Table:
    clear = {(one.run, one.group): one for one in scored if one.goals == CLEAR}
    return Table(
        name="runs",
        title=f"{study}: every run, queries of unseen scenes, %",
        columns=(
            "run", "M", "scenes", "goals", "steps", "core min", "scenes shown", "of the paper's",
            "scenes of", "true relevant", "true irrelevant", "total", "95% over scenes",
            "at the paper's rate", "base rate", "balanced", "AP", "all right",
            "total, one answer", "all right, one answer",
        ),
        rows=tuple(
            (
                one.run,
                "-" if one.parameters is None else f"{one.parameters / 1e6:.2f}",
                _count(one.scenes),
                "-" if one.scene_goals is None else one.scene_goals or "all",
                _count(one.steps),
                "-" if one.core_minutes is None else f"{one.core_minutes:.1f}",
                _count(one.scenes_shown),
                "-" if one.of_paper is None else f"{100 * one.of_paper:.3g}",
                one.group,
                *map(_percent, (one.true_relevant, one.true_irrelevant, one.total)),
                f"{_percent(one.total_low)} to {_percent(one.total_high)}",
                *map(_percent, (one.total_at_paper, one.base_rate, one.balanced)),
                *map(_percent, (one.average_precision, one.tasks_right)),
                *map(_percent, _clear(clear.get((one.run, one.group)))),
            )
            for one in _of_families(scored)
        ),
    )  # fmt: skip


def _clear(one: Scored | None) -> tuple[float | None, float | None]:
    return (None, None) if one is None else (one.total, one.tasks_right)


def _means_table(
    study: str, scored: Sequence[Scored], pooled: Mapping[tuple[str, str], Sequence[Sums]]
) -> Table:
    names = (
        "true_relevant", "true_irrelevant", "total", "total_at_paper", "balanced",
        "average_precision", "tasks_right",
    )  # fmt: skip
    rows = []
    for (family, label), runs in _together(_of_families(scored)).items():
        sums = pooled.get((label, family), ())
        total = _over_scenes(sums) if sums else None
        rows.append(
            (
                family,
                label,
                len(runs),
                *(_mean([getattr(one, name) for one in runs]) for name in names),
                f"{_percent(total.low)} to {_percent(total.high)}" if total else "-",
            )
        )
    return Table(
        name="means",
        title=f"{study}: mean over seeds (range), queries of unseen scenes, %",
        columns=(
            "scenes of", "what", "runs", "true relevant", "true irrelevant", "total",
            "at the paper's rate", "balanced", "AP", "all right", "total, 95% over scenes",
        ),
        rows=tuple(rows),
    )  # fmt: skip


def _predicates_table(study: str, scored: Sequence[Scored]) -> Table:
    rows = [one for one in scored if one.goals == EVERY and not one.stands and not one.boxes]
    rows = [one for one in rows if one.group in PREDICATES]
    names = ("true_relevant", "true_irrelevant", "total", "total_at_paper", "base_rate")
    return Table(
        name="predicates",
        title=f"{study}: by predicate, mean over seeds (range), %",
        columns=(
            "predicate", "what", "runs", "true relevant", "true irrelevant", "total",
            "at the paper's rate", "base rate",
        ),
        rows=tuple(
            (*key, len(runs), *(_mean([getattr(one, name) for one in runs]) for name in names))
            for key, runs in _together(rows).items()
        ),
    )  # fmt: skip


def _stands_table(study: str, scored: Sequence[Scored]) -> Table:
    figures = {
        "true relevant": "true_relevant", "true irrelevant": "true_irrelevant", "total": "total",
        "base rate": "base_rate", "balanced": "balanced",
    }  # fmt: skip
    head = ("stands", f"{study}: by where the query stands", "the query stands")
    return _parts_table(scored, *head, STANDS, lambda one: one.stands, figures)


def _boxes_table(study: str, scored: Sequence[Scored]) -> Table:
    figures = {
        "true relevant": "true_relevant", "true irrelevant": "true_irrelevant", "total": "total",
        "true relevant at 95 true irrelevant": "recall", "base rate": "base_rate",
        "balanced": "balanced",
    }  # fmt: skip
    head = ("boxes", f"{study}: by the number of boxes", "boxes")
    return _parts_table(scored, *head, BOXES, lambda one: one.boxes, figures)


def _parts_table(
    scored: Sequence[Scored],
    name: str,
    title: str,
    column: str,
    parts: Iterable[str],
    of: Callable[[Scored], str],
    figures: Mapping[str, str],
) -> Table:
    """Families divided into parts; `figures` names columns and what of a run they show."""
    rows = []
    for part in parts:
        some = [one for one in scored if of(one) == part and one.group in GROUPS]
        for (family, label), runs in _together(some).items():
            means = (_mean([getattr(one, figure) for one in runs]) for figure in figures.values())
            rows.append((family, part, label, len(runs), runs[0].queries, *means))
    return Table(
        name=name,
        title=f"{title}, mean over seeds (range), %",
        columns=("scenes of", column, "what", "runs", "queries", *figures),
        rows=tuple(rows),
    )


def _of_families(scored: Sequence[Scored]) -> list[Scored]:
    """The rows of whole families, family by family, the rules first."""
    some = [s for s in scored if s.group in GROUPS and s.goals == EVERY]
    some = [s for s in some if not s.stands and not s.boxes]
    return sorted(some, key=lambda one: (GROUPS.index(one.group), one.judge == NETWORK))


def _together(scored: Sequence[Scored]) -> dict[tuple[str, str], list[Scored]]:
    """Rows by group and label, the groups in order."""
    found: dict[tuple[str, str], list[Scored]] = {}
    order = groups()
    for one in sorted(scored, key=lambda one: (order.index(one.group), one.judge == NETWORK)):
        found.setdefault((one.group, one.label), []).append(one)
    return found


def _mean(values: Sequence[float | None]) -> str:
    """The mean of what there is, and its range where there is one."""
    known = [value for value in values if value is not None and not np.isnan(value)]
    if not known:
        return "-"
    spread = f" ({_percent(min(known))} to {_percent(max(known))})" if len(known) > 1 else ""
    return f"{_percent(float(np.mean(known)))}{spread}"


def _percent(share: float | None) -> str:
    return "-" if share is None or np.isnan(share) else f"{100 * share:.1f}"


def _count(number: int | None) -> str:
    return "-" if number is None else f"{number:,}"


def markdown(tables: Sequence[Table]) -> str:
    """Tables as Markdown."""
    parts = []
    for table in tables:
        lines = [table.columns, ["---"] * len(table.columns), *table.rows]
        body = "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
        parts.append(f"### {table.title}\n\n{body}\n")
    return "\n".join(parts)


# --- pictures ---------------------------------------------------------------------------------


def _plots(study: str, rows: Sequence[Row], scored: Sequence[Scored]) -> Iterator[Plot]:
    """Learning curves, a picture each group of runs; then what more data and more time brought."""
    drawn = [row for row in rows if row["curve"] and row["validations"]]
    for curve in dict.fromkeys(row["curve"] for row in drawn):
        mine = [row for row in drawn if row["curve"] == curve]
        name = "-".join(["learning", *curve.replace(",", "").split()])
        yield Plot(
            name=f"{study}-{name}",
            draw=partial(curves.learning, rows=mine),
            panels=1 + len(curves.families_of(mine)),
        )
    networks = [asdict(one) for one in _of_families(scored) if one.judge == NETWORK]
    yield from _more(study, networks, "scenes", "scenes to learn from", same="minutes")
    yield from _more(study, networks, "minutes", "minutes of a core", same="scenes")


def _more(study: str, networks: Sequence[Row], by: str, title: str, *, same: str) -> Iterator[Plot]:
    """What more of something brought, a line a kind of network, where some had three amounts."""
    rows = [{**row, "line": _line_of(row, same)} for row in networks if row["recipe"] == "long"]
    lines = dict.fromkeys(row["line"] for row in rows)
    amounts = {line: {row[by] for row in rows if row["line"] == line} for line in lines}
    rows = [row for row in rows if len(amounts[row["line"]]) > 1]
    if any(len(its) > 2 for its in amounts.values()):
        yield Plot(
            name=f"{study}-by-{by}",
            draw=partial(curves.data, rows=rows, by=by, title=title),
            panels=len({row["group"] for row in rows}),
        )


def _line_of(row: Row, same: str) -> str:
    """Body, goals, and what is the same along the line."""
    goals = {0: "all goals", 1: "1 goal"}.get(row["scene_goals"], f"{row['scene_goals']} goals")
    amount = f"{row['scenes']:,} scenes" if same == "scenes" else f"{row['minutes']:g} minutes"
    return f"{row['body']}, {goals} of each, {amount}"
