"""What a checkpoint is worth away from home: on suites, and on any other datasets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from relevance.evaluation.accuracies import read_predictions
from relevance.evaluation.calibration import LEVELS, Calibration
from relevance.evaluation.comparisons import read_evaluations, settings, summarise
from relevance.evaluation.coverage import covered
from relevance.evaluation.scorer import open_checkpoint
from relevance.evaluation.suites import suite_of
from relevance.metrics import mean
from relevance.planner import GUIDES
from relevance.scene import FAMILIES
from relevance.store import Dataset


def away(roots: Sequence[str | Path], checkpoint: str | Path) -> list[dict[str, Any]]:
    """What a checkpoint is worth on each of some datasets: a row each, of what they hold.

    Recall and coverage need its predictions there, speed-ups its reruns (`relevance evaluate`);
    what is not there is None. `solved` and `solved_guided` are shares of the tasks, the latter of
    the complete guide that solves fewest: it must not be smaller.
    """
    scorer, meta = open_checkpoint(checkpoint)
    calibration = Calibration.of(meta)
    return [_away(Dataset.open(root), scorer.checkpoint_id, calibration) for root in roots]


def _away(dataset: Dataset, name: str, calibration: Calibration | None) -> dict[str, Any]:
    everything = read_predictions(dataset, name)
    found = everything.queries().accuracy() if len(everything) else None
    row: dict[str, Any] = {
        "dataset": suite_of(dataset) or dataset.path.name,
        "boxes": mean(everything.n_objects) if found else None,
        "goals": found.n_tasks if found else 0,
        "total": found and found.total,
        "base_rate": found and found.base_rate,
        "set_recall": found and found.set_recall,
        "kept_whole": found and found.tasks_whole,
    }
    for level in LEVELS:
        rows = covered(everything, calibration, levels=(level,)) if calibration else []
        rows = [one for one in rows if one.group in FAMILIES]
        row[f"covered_{100 * level:g}"] = min((one.reached_all for one in rows), default=None)
        row[f"breached_{100 * level:g}"] = any(one.breached for one in rows) if rows else None
    return row | _reruns(dataset, name)


def _reruns(dataset: Dataset, name: str) -> dict[str, Any]:
    """Solved shares, and the speed-up of each search and guide at its working point."""
    found: dict[str, Any] = {"tasks": 0, "solved": None, "solved_guided": None}
    for (search, guide, beta), rows in settings(read_evaluations(dataset, name)).items():
        figures = summarise(rows)
        key = f"{guide}, {search}" + (f", beta {beta:g}" if beta else "")
        found[key] = figures.speedup.value
        found["tasks"] = max(found["tasks"], figures.n_tasks)
        found["solved"] = mean([row["solved_unguided"] for row in rows])
        if guide in GUIDES and GUIDES[guide].complete:
            share = mean([row["solved_guided"] for row in rows])
            least = found["solved_guided"]
            found["solved_guided"] = share if least is None else min(least, share)
    return found
