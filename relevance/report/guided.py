"""The page's section about what guidance saves the planner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from relevance.evaluation import (
    Comparison,
    in_group,
    left_out,
    read_evaluations,
    rerun_priors,
    settings,
    shown_as,
    summarise,
)
from relevance.report import plots
from relevance.report.gallery import anchor
from relevance.report.style import GROUPS
from relevance.report.style import groups as shown_groups
from relevance.store import Dataset


def guided_section(dataset: Dataset, chosen: str | None) -> dict[str, Any]:
    """Comparisons by search and guide, the sweep over beta, and the tasks that were missed."""
    by_setting = settings(read_evaluations(dataset, chosen)) if chosen else {}
    others = _other_priors(dataset, chosen) if chosen else []
    found: dict[str, Any] = {"searches": [], "misses": [], "n_tasks": 0}
    found["notes"] = left_out(dataset, chosen) if chosen else []
    searches = sorted({search for search, _, _ in by_setting}, reverse=True)  # tree first
    for search in searches:
        of_search = {key[1:]: rows for key, rows in by_setting.items() if key[0] == search}
        working: dict[str, list[dict[str, Any]]] = {}
        for guide, beta in sorted(of_search, key=lambda key: (-len(of_search[key]), abs(key[1]))):
            working.setdefault(guide, of_search[guide, beta])
        shown = _search(search, working, of_search)
        shown["others"] = [other for other in others if other.search == search]
        found["searches"].append(shown)
        if search == searches[0]:
            misses = [_missed(rows) for rows in working.values()]
            found["misses"] = max(misses, key=len)
        found["n_tasks"] += max(map(len, working.values()))
    return found


def _other_priors(dataset: Dataset, chosen: str) -> list[Comparison]:
    """What others than the checkpoint save with the same guides, over all tasks."""
    return [
        summarise(rows)
        for prior in rerun_priors(dataset, chosen)
        for rows in settings(read_evaluations(dataset, chosen, prior)).values()
    ]


def _missed(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Tasks that only the unguided planner solves."""
    return [
        row | {"anchor": anchor(row)}
        for row in rows
        if row["solved_unguided"] and not row["solved_guided"]
    ]


def _search(
    search: str,
    working: dict[str, list[dict[str, Any]]],
    of_search: dict[tuple[str, float], list[dict[str, Any]]],
) -> dict[str, Any]:
    present = {shown_as(row) for rows in working.values() for row in rows}
    families = [g for g in GROUPS if any(in_group(p, g) for p in present)]
    groups = [*(g for g in shown_groups() if g in {*families, *present}), "all"]
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
