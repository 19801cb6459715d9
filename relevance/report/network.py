"""The page's section about how right a network is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from relevance.evaluation import Predictions, read_predictions, unjudged
from relevance.metrics import Accuracy
from relevance.report import plots
from relevance.report.style import groups as shown_groups
from relevance.store import Dataset


def network_section(
    dataset: Dataset, checkpoints: Sequence[dict[str, Any]], chosen: str | None
) -> dict[str, Any]:
    """Checkpoints, and the accuracies of the chosen one by the labels of its policy."""
    predictions = read_predictions(dataset, chosen).queries() if chosen else None
    model: dict[str, Any] = {
        "checkpoints": [row | {"metrics": json.loads(row["metrics"])} for row in checkpoints],
        "chosen": next((row for row in checkpoints if row["checkpoint_id"] == chosen), None),
        "accuracies": [],
        "with_goal_objects": [],
        "tuned": {},
        "n_tasks": 0,
        "plots": {},
        "notes": unjudged(dataset, chosen) if chosen else [],
    }
    history = _history(dataset, model["chosen"])
    if history:
        model["plots"]["training"] = plots.svg("training", plots.training_curve, history=history)
    if predictions is None or not len(predictions):
        return model
    everything = read_predictions(dataset, str(chosen))
    groups = [g for g in shown_groups() if len(predictions.of(g))]
    model["accuracies"] = [(group, predictions.of(group).accuracy()) for group in groups]
    model["with_goal_objects"] = [(group, everything.of(group).accuracy()) for group in groups]
    model["tuned"] = _tuned(predictions, groups, model["chosen"])
    model["n_tasks"] = len(np.unique(predictions.task))
    panels = len(plots.families_in(predictions))
    model["plots"] |= {
        "accuracy": plots.svg("accuracy", plots.accuracy, size=(4.8, 3.8), predictions=predictions),
        "beta": plots.svg(
            "beta",
            plots.beta_accuracy,
            size=(9.2, 3.1),
            panels=panels,
            predictions=predictions,
        ),
        "scores": plots.svg(
            "scores", plots.scores, size=(9.2, 2.7), panels=panels, predictions=predictions
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
