"""One self-contained HTML page: the paper's tables and figures beside ours, from the rows.

Plots are inline SVG, scenes inline PNG under vector outlines; the page asks nothing of any
network. What a dataset does not hold yet (no checkpoint, no reruns) is said in its place.
Every figure names the number of tasks that it rests on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from relevance.evaluation.comparisons import (
    Accuracy,
    Comparison,
    Interval,
    Predictions,
    in_group,
    read_evaluations,
    read_predictions,
    settings,
    summarise,
)
from relevance.report import plots
from relevance.report.gallery import anchor, choose_examples, draw_examples, outlined
from relevance.report.plots import (
    DASH,
    GROUPS,
    PAPER_ACCURACY,
    PAPER_RELEVANT,
    PAPER_SECONDS,
    PREDICATES,
    TIMES,
)
from relevance.store import SPLITS, Dataset, DatasetError, replacing

__all__ = [
    "Accuracy",
    "Comparison",
    "Interval",
    "Predictions",
    "build",
    "outlined",
    "read_evaluations",
    "read_predictions",
    "settings",
    "summarise",
]


def build(
    root: str | Path,
    out: str | Path | None = None,
    *,
    checkpoint_id: str | None = None,
    examples: int = 2,
) -> Path:
    """Write the report of a dataset to `out` (default ROOT/report.html) and return its path.

    `checkpoint_id` defaults to the newest checkpoint that was evaluated, else the newest;
    `examples` is the number of example scenes a predicate. Raises DatasetError for a folder
    that is no dataset and for an unknown checkpoint.
    """
    dataset = Dataset.open(root)
    out = Path(out) if out is not None else dataset.path / "report.html"
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "percent": percent,
        "seconds": plots.seconds,
        "times": times,
        "spread": spread,
        "number": number,
    }
    page = environment.get_template("page.html.j2").render(_page(dataset, checkpoint_id, examples))
    with replacing(out) as temporary:
        temporary.write_text(page)
    return out


def percent(value: float | None, decimals: int = 1) -> str:
    """A share in 0..1 as per cent; a dash where there is none."""
    return DASH if value is None or not math.isfinite(value) else f"{100 * value:.{decimals}f}%"


def times(interval: Interval) -> Markup:
    """A ratio with its interval."""
    if not math.isfinite(interval.value):
        return Markup(DASH)
    low, high = f"{interval.low:.2f}", f"{interval.high:.2f}"
    return Markup("{}{} <small>{} to {}</small>").format(f"{interval.value:.2f}", TIMES, low, high)


def spread(interval: Interval) -> Markup:
    """A time with its interval."""
    if not math.isfinite(interval.value):
        return Markup(DASH)
    value, low, high = map(plots.seconds, (interval.value, interval.low, interval.high))
    if low.split()[-1:] == high.split()[-1:]:
        low = low.split()[0]
    return Markup("{} <small>{} to {}</small>").format(value, low, high)


def number(value: float | int | None, decimals: int = 0) -> str:
    """A number with thin spaces between thousands."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:,.{decimals}f}".replace(",", "\u202f")


def _page(dataset: Dataset, checkpoint_id: str | None, examples: int) -> dict[str, Any]:
    with dataset.connect() as connection:

        def rows(query: str, *values: Any) -> list[dict[str, Any]]:
            found = connection.execute(query, list(values))
            names = [column[0] for column in found.description or ()]
            return [dict(zip(names, row, strict=True)) for row in found.fetchall()]

        data = _data(rows)
        planner = _planner(rows)
        checkpoints = rows(_CHECKPOINTS)
        chosen = _choose(dataset, checkpoints, checkpoint_id)
        guided = _guided(dataset, chosen)
        tasks = choose_examples(rows, chosen, missed=guided["misses"], per_predicate=examples)
    pictures = draw_examples(dataset, tasks)
    model = _model(dataset, checkpoints, chosen)
    return {
        "name": dataset.path.resolve().name,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "dataset_hash": dataset.content_hash(),
        "data": data,
        "planner": planner,
        "model": model,
        "guided": guided,
        "examples": pictures,
        "headlines": _headlines(data, planner, model, guided),
        "paper": {
            "accuracy": PAPER_ACCURACY,
            "relevant": PAPER_RELEVANT,
            "seconds": PAPER_SECONDS,
        },
        "groups": GROUPS,
    }


# --- data and planner ---------------------------------------------------------------------

_CHECKPOINTS = """
select c.*, (select count(*) from predictions p where p.checkpoint_id = c.checkpoint_id)
        as n_predictions,
    (select count(*) from evaluations e where e.checkpoint_id = c.checkpoint_id) as n_evaluations
from checkpoints c order by created desc, checkpoint_id
"""


def _data(rows: Any) -> dict[str, Any]:
    shares = rows(
        """
        select predicate, split, goals, solved, plans, queries, relevant, relevant_share
        from paper_label_distribution where n_actions = 'all'
        """
    )
    pooled = rows(
        """
        select predicate, sum(queries)::bigint as queries,
            sum(relevant) / nullif(sum(queries), 0) as relevant_share
        from paper_label_distribution where n_actions = 'all' and predicate <> 'same-plane'
        group by predicate
        """
    )
    order = [p for p in PREDICATES if p in {row["predicate"] for row in pooled}]
    pooled.sort(key=lambda row: order.index(row["predicate"]))
    lengths = rows(
        """
        select predicate, n_actions, count(*) as plans from plans where holds group by all
        order by n_actions
        """
    )
    sizes = rows(
        """
        select family, split, count(*) as scenes, avg(n_objects) as mean, min(n_objects) as least,
            max(n_objects) as most
        from scenes group by all
        """
    )
    sizes.sort(key=lambda row: (GROUPS.index(row["family"]), SPLITS.index(row["split"])))
    visible = rows(
        "select avg(visible_fraction) as mean, min(visible_fraction) as least from objects"
    )
    return {
        "sizes": sizes,
        "shares": _in_order(shares),
        "visible": visible[0],
        "n_scenes": sum(row["scenes"] for row in sizes),
        "n_labels": sum(row["queries"] or 0 for row in pooled),
        "shares_plot": plots.svg("labels", plots.label_shares, rows=pooled) if pooled else "",
        "lengths_plot": plots.svg("lengths", plots.lengths, rows=lengths) if lengths else "",
    }


def _in_order(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    order = ["same-plane", *PREDICATES]
    return sorted(rows, key=lambda r: (order.index(r["predicate"]), SPLITS.index(r["split"])))


def _planner(rows: Any) -> dict[str, Any]:
    verdicts = rows(
        """
        select predicate, sum(goals)::bigint as goals, sum(solved)::bigint as solved,
            sum(plans)::bigint as plans, sum(ambiguous)::bigint as ambiguous,
            sum(replayed)::bigint as replayed, sum(replay_ok)::bigint as replay_ok,
            max(max_penetration) as deepest, max(replay_max_penetration) as replay_deepest
        from plan_verdicts group by predicate
        """
    )
    verdicts.sort(key=lambda row: PREDICATES.index(row["predicate"]))
    seconds = rows(
        """
        select predicate, count(*) as n, avg(seconds) as mean, median(seconds) as median,
            quantile_cont(seconds, 0.9) as p90, max(seconds) as longest,
            avg(seconds_pose) as pose, avg(seconds_keyframe) as keyframe, avg(seconds_path) as path
        from timings group by predicate
        """
    )
    seconds.sort(key=lambda row: PREDICATES.index(row["predicate"]))
    counts = rows(
        """
        select predicate, avg(nodes) as nodes, avg(pose_checks) as pose,
            avg(keyframe_nlps) as keyframe, avg(path_nlps) as path
        from plans group by predicate
        """
    )
    counts_of = {row["predicate"]: row for row in counts}
    reasons = rows(
        """
        select status, reason, sum(goals)::bigint as goals from plan_failures group by all
        order by goals desc, status, reason
        """
    )
    families = rows(
        """
        select case predicate when 'on' then 'on' else 'same-plane' end as family,
            count(*) as n, quantile_cont(seconds, $1::double[]) as quantiles
        from timings group by family order by family desc
        """,
        plots.QUANTILES.tolist(),
    )
    middle = rows("select count(*) as n, median(seconds) as median from timings")[0]
    versions = [
        row["planner_version"] for row in rows("select distinct planner_version from plans")
    ]
    for row in reasons:
        row["label"] = ": ".join(part for part in (row["status"], row["reason"]) if part)
    total = {
        key: sum(row[key] or 0 for row in verdicts)
        for key in ("goals", "solved", "plans", "ambiguous", "replayed", "replay_ok")
    }
    return {
        "verdicts": verdicts,
        "total": total,
        "seconds": [row | {"counts": counts_of.get(row["predicate"], {})} for row in seconds],
        "median": middle["median"],
        "n_timed": middle["n"],
        "versions": versions,
        "reasons": reasons,
        "reasons_plot": plots.svg(
            "reasons",
            plots.reasons,
            size=(4.8, 0.75 + 0.3 * min(len(reasons), 12)),
            rows=reasons[:12],
        )
        if reasons
        else "",
        "times_plot": plots.svg("times", plots.times, rows=families) if families else "",
    }


# --- model and guided planning --------------------------------------------------------------


def _choose(
    dataset: Dataset, checkpoints: Sequence[Mapping[str, Any]], wanted: str | None
) -> str | None:
    known = [row["checkpoint_id"] for row in checkpoints]
    if wanted is not None:
        if wanted not in known:
            raise DatasetError(
                f"{dataset.path}: unknown checkpoint {wanted!r}, "
                f"expected one of {', '.join(known) or 'none: nothing was trained yet'}"
            )
        return wanted
    for column in ("n_evaluations", "n_predictions"):
        for row in checkpoints:
            if row[column]:
                return row["checkpoint_id"]
    return known[0] if known else None


def _model(
    dataset: Dataset, checkpoints: Sequence[dict[str, Any]], chosen: str | None
) -> dict[str, Any]:
    predictions = read_predictions(dataset, chosen).queries() if chosen else None
    model: dict[str, Any] = {
        "checkpoints": [row | {"metrics": json.loads(row["metrics"])} for row in checkpoints],
        "chosen": next((row for row in checkpoints if row["checkpoint_id"] == chosen), None),
        "accuracies": [],
        "with_goal_objects": [],
        "tuned": {},
        "n_tasks": 0,
        "plots": {},
    }
    history = _history(dataset, model["chosen"])
    if history:
        model["plots"]["training"] = plots.svg("training", plots.training_curve, history=history)
    if predictions is None or not len(predictions):
        return model
    everything = read_predictions(dataset, str(chosen))
    groups = [g for g in ("same-plane", *PREDICATES) if len(predictions.of(g))]
    model["accuracies"] = [(group, predictions.of(group).accuracy()) for group in groups]
    model["with_goal_objects"] = [(group, everything.of(group).accuracy()) for group in groups]
    model["tuned"] = _tuned(predictions, groups, model["chosen"])
    model["n_tasks"] = len(np.unique(predictions.task))
    model["plots"] |= {
        "accuracy": plots.svg("accuracy", plots.accuracy, size=(4.8, 3.8), predictions=predictions),
        "beta": plots.svg(
            "beta", plots.beta_accuracy, size=(9.2, 3.1), panels=2, predictions=predictions
        ),
        "scores": plots.svg(
            "scores", plots.scores, size=(9.2, 2.7), panels=2, predictions=predictions
        ),
    }
    return model


def _tuned(
    predictions: Predictions, groups: Sequence[str], chosen: Mapping[str, Any] | None
) -> dict[str, tuple[float, Accuracy]]:
    """By group: the beta with the highest total on validation, and what it gives on test."""
    metrics = json.loads(chosen["metrics"]) if chosen else {}
    found = {}
    for group in groups:
        beta = metrics.get(group, {}).get("queries", {}).get("best_beta")
        if beta is not None:
            found[group] = (beta, predictions.of(group).accuracy(beta))
    return found


def _history(dataset: Dataset, chosen: Mapping[str, Any] | None) -> list[dict[str, float]]:
    """The training curve that the checkpoint's file holds; empty without the file."""
    from relevance.training import CheckpointError, load_checkpoint  # torch: only for this curve

    if chosen is None:
        return []
    try:
        return load_checkpoint(dataset.path / chosen["path"])[1].get("history", [])
    except CheckpointError:  # a dataset may travel without its weights
        return []


def _guided(dataset: Dataset, chosen: str | None) -> dict[str, Any]:
    by_setting = settings(read_evaluations(dataset, chosen)) if chosen else {}
    found: dict[str, Any] = {"searches": [], "misses": [], "n_tasks": 0}
    searches = sorted({search for search, _, _ in by_setting}, reverse=True)  # tree first
    for search in searches:
        of_search = {key[1:]: rows for key, rows in by_setting.items() if key[0] == search}
        working: dict[str, list[dict[str, Any]]] = {}
        for guide, beta in sorted(of_search, key=lambda key: (-len(of_search[key]), abs(key[1]))):
            working.setdefault(guide, of_search[guide, beta])
        found["searches"].append(_search(search, working, of_search))
        if search == searches[0]:
            found["misses"] = [
                row | {"anchor": anchor(row)}
                for row in working.get("prune", ())
                if row["solved_unguided"] and not row["solved_guided"]
            ]
        found["n_tasks"] += max(map(len, working.values()))
    return found


def _search(
    search: str,
    working: dict[str, list[dict[str, Any]]],
    of_search: dict[tuple[str, float], list[dict[str, Any]]],
) -> dict[str, Any]:
    present = {row["predicate"] for rows in working.values() for row in rows}
    families = [g for g in GROUPS if any(in_group(p, g) for p in present)]
    groups = [*families, *(p for p in PREDICATES if p in present and p not in families), "all"]
    comparisons = [(g, [summarise(rows, g) for rows in working.values()]) for g in groups]
    solvable = {g: [r for r in rows if r["solved_unguided"]] for g, rows in working.items()}
    drawn: dict[str, str] = {}
    bars = {g: found for g, found in comparisons if g in families and found[0].n_solvable}
    if bars:
        drawn["runtimes"] = plots.svg(
            f"{search}-runtimes", plots.runtimes, size=(9.2, 3.0), panels=2, comparisons=bars
        )
        drawn["objects"] = plots.svg(
            f"{search}-objects", plots.by_objects, size=(4.6, 3.4), rows=solvable
        )
        drawn["pairs"] = plots.svg(f"{search}-pairs", plots.pairs, size=(4.6, 3.4), rows=solvable)
    sweep = _sweep(of_search, families)
    if sweep:
        drawn["sweep"] = plots.svg(
            f"{search}-sweep", plots.beta_reruns, size=(9.2, 2.9), panels=2, sweep=sweep
        )
    return {
        "search": search,
        "comparisons": comparisons,
        "sweep": sweep,
        "plots": drawn,
        "n_solvable": max(map(len, solvable.values())),
        "beta": {guide: rows[0]["beta"] for guide, rows in working.items()},
    }


def _sweep(
    of_search: dict[tuple[str, float], list[dict[str, Any]]], families: Sequence[str]
) -> dict[str, list[Comparison]]:
    """Comparisons by beta for each family, over the tasks that were rerun at every beta."""
    by_guide: dict[str, list[float]] = {}
    for guide, beta in of_search:
        by_guide.setdefault(guide, []).append(beta)
    guide, betas = max(by_guide.items(), key=lambda item: len(item[1]))
    if len(betas) < 2:
        return {}
    every = [{anchor(row) for row in of_search[guide, beta]} for beta in betas]
    common = set.intersection(*every)
    sweep = {}
    for family in families:
        found = [
            summarise([r for r in of_search[guide, beta] if anchor(r) in common], family)
            for beta in sorted(betas)
        ]
        if found[0].n_solvable:
            sweep[family] = found
    return sweep


def _headlines(
    data: dict[str, Any], planner: dict[str, Any], model: dict[str, Any], guided: dict[str, Any]
) -> list[dict[str, str]]:
    """The figures at the top: value, what it is, what it rests on, where it is explained."""
    total, cards = planner["total"], []
    if total["goals"]:
        cards.append(
            {
                "value": percent(total["solved"] / total["goals"]),
                "label": "of goals solved",
                "note": f"{number(total['goals'])} goals in {number(data['n_scenes'])} scenes",
                "link": "#planner",
            }
        )
    if total["replayed"]:
        cards.append(
            {
                "value": percent(total["replay_ok"] / total["replayed"]),
                "label": "of replayed plans hold within 1 mm",
                "note": f"{number(total['replayed'])} plans replayed in pybullet",
                "link": "#planner",
            }
        )
    if planner["n_timed"]:
        low, high = PAPER_SECONDS
        cards.append(
            {
                "value": plots.seconds(planner["median"]),
                "label": "median planning time a task",
                "note": f"{number(planner['n_timed'])} tasks; paper: {low} to {high} s, mean",
                "link": "#planner",
            }
        )
    for group, plain in model["accuracies"]:
        if group in GROUPS:
            beta, accuracy = model["tuned"].get(group, (0.0, plain))
            cards.append(
                {
                    "value": percent(accuracy.total),
                    "label": f"accuracy, {group}",
                    "note": f"base rate {percent(accuracy.base_rate)}; {accuracy.n_tasks} tasks; "
                    f"beta {beta:.1f} from validation, {percent(plain.total)} at beta 0; "
                    f"paper: {percent(PAPER_ACCURACY[group][2], 0)}",
                    "link": "#model",
                }
            )
    for search in guided["searches"][:1]:
        for comparison in search["comparisons"][-1][1]:
            if not comparison.n_solvable:
                continue
            counted = comparison.guide != "prune"
            interval = comparison.speedup if counted else comparison.speedup_both
            note = f"{comparison.misses} missed" + ("" if counted else ", left out")
            if interval.n:
                low, high = f"{interval.low:.2f}", f"{interval.high:.2f}"
                note = f"{low} to {high} over {interval.n} tasks, network included; {note}"
            cards.append(
                {
                    "value": f"{interval.value:.2f}{TIMES}" if interval.n else DASH,
                    "label": f"speed-up by {comparison.guide}, {comparison.search} search",
                    "note": note,
                    "link": "#guided",
                }
            )
    return cards
