"""One self-contained HTML page: the paper's tables and figures beside ours, from the rows.

Plots are inline SVG, scenes inline PNG under vector outlines; the page asks nothing of any
network. What a dataset does not hold yet (no checkpoint, no reruns) is said in its place.
Every figure names the number of tasks that it rests on.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from relevance.evaluation import NETWORK, RULE, policy_of_checkpoint
from relevance.networks import read_record
from relevance.report import style
from relevance.report.data import data_section, planner_section
from relevance.report.gallery import Rows, choose_examples, draw_examples
from relevance.report.guided import guided_section
from relevance.report.misses import misses_section
from relevance.report.network import network_section
from relevance.report.pages import write_page
from relevance.report.paper import paper
from relevance.report.style import DASH, GROUPS, TIMES, number, percent, seconds
from relevance.store import Dataset, DatasetError


def build(
    root: str | Path,
    out: str | Path | None = None,
    *,
    checkpoint_id: str | None = None,
    examples: int = 2,
) -> Path:
    """Write the report of a dataset to `out` (default ROOT/report.html) and return its path.

    `checkpoint_id` defaults to the champion, without one to the newest that was evaluated;
    `examples` is the number of example scenes a predicate. Raises DatasetError for a folder
    that is no dataset and for an unknown checkpoint.
    """
    dataset = Dataset.open(root)
    out = Path(out) if out is not None else dataset.path / "report.html"
    return write_page("page.html.j2", out, **_page(dataset, checkpoint_id, examples))


_CHECKPOINTS = """
select c.*, (select count(*) from predictions p where p.checkpoint_id = c.checkpoint_id)
        as n_predictions,
    (select count(*) from evaluations e where e.checkpoint_id = c.checkpoint_id) as n_evaluations
from checkpoints c order by created desc, checkpoint_id
"""


def _page(dataset: Dataset, checkpoint_id: str | None, examples: int) -> dict[str, Any]:
    known = _ask(dataset, None, ("checkpoints", "predictions", "evaluations"))(_CHECKPOINTS)
    chosen = _choose(dataset, known, checkpoint_id)
    own = dataset.labelling.policy if dataset.labelling else None
    policy = policy_of_checkpoint(dataset, chosen) if chosen else own
    rows = _ask(dataset, policy if policy != own else None)
    data, planner = data_section(rows), planner_section(rows)
    guided = guided_section(dataset, chosen)
    tasks = choose_examples(rows, chosen, missed=guided["misses"], per_predicate=examples)
    pictures = draw_examples(dataset, tasks)
    model = network_section(dataset, known, chosen)
    return {
        "name": dataset.path.resolve().name,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "dataset_hash": dataset.content_hash(),
        "training_hash": dataset.content_hash(policy=policy, split="train") if chosen else None,
        "data": data,
        "planner": planner,
        "model": model,
        "guided": guided,
        "misses": misses_section(dataset, rows, chosen, policy),
        "examples": pictures,
        "headlines": _headlines(data, planner, model, guided),
        "policy": policy,
        "own_policy": own,
        "paper": paper(),
        "style": style,
        "groups": GROUPS,
    }


def _ask(dataset: Dataset, policy: str | None, names: Collection[str] | None = None) -> Rows:
    """A function that asks the dataset's views, all or some, its labels being those of `policy`."""
    connection = dataset.connect(policy=policy, names=names)

    def rows(query: str, *values: Any) -> list[dict[str, Any]]:
        found = connection.execute(query, list(values))
        names = [column[0] for column in found.description or ()]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]

    return rows


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
    if (champion := read_record(dataset).champion) in known:
        return champion
    for column in ("n_evaluations", "n_predictions"):
        for row in checkpoints:
            if row[column]:
                return row["checkpoint_id"]
    return known[0] if known else None


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
        low, high = paper().seconds
        cards.append(
            {
                "value": seconds(planner["median"]),
                "label": "median planning time a task",
                "note": f"{number(planner['n_timed'])} tasks; "
                f"paper: {low:.1f} to {high:.1f} s, means",
                "link": "#planner",
            }
        )
    by_judge = {(row["family"], row["judge"]): row for row in model["accuracies"]}
    for group in GROUPS:
        network = by_judge.get((group, NETWORK))
        if network is None:
            continue
        rule, theirs = by_judge[group, RULE], paper().accuracy.get(group)
        cards.append(
            {
                "value": percent(network["total"]),
                "label": f"accuracy, {group}",
                "note": f"always irrelevant: {percent(network['base_rate'])}; "
                f"rule: {percent(rule['total'])}; {network['tasks']} tasks; "
                f"paper: {percent(theirs.total, 0) if theirs else DASH}",
                "link": "#model",
            }
        )
    for search in guided["searches"][:1]:
        for comparison in search["comparisons"][-1][1]:
            if not comparison.n_solvable:
                continue
            interval = comparison.speedup
            note = f"{comparison.misses} missed" + (", counted" if comparison.misses else "")
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
