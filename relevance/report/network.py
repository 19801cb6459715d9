"""The page's section about how right a network is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from relevance.evaluation import (
    BREAKDOWNS,
    LEVELS,
    Calibration,
    accuracy_table,
    breakdown_table,
    covered,
    out_of_reach,
    read_predictions,
    unjudged,
)
from relevance.networks import CheckpointError, read_checkpoint
from relevance.report import plots
from relevance.report.style import GROUPS
from relevance.store import Dataset

PROMISED = tuple(sorted({*LEVELS, *np.round(np.arange(0.5, 0.9951, 0.005), 3).tolist()}))
"""Coverages at which curves are drawn."""


def network_section(
    dataset: Dataset, checkpoints: Sequence[dict[str, Any]], chosen: str | None
) -> dict[str, Any]:
    """Checkpoints, and the accuracies of the chosen one by the labels of its policy."""
    model: dict[str, Any] = {
        "checkpoints": [row | {"metrics": json.loads(row["metrics"])} for row in checkpoints],
        "chosen": next((row for row in checkpoints if row["checkpoint_id"] == chosen), None),
        "accuracies": [],
        "breakdowns": [],
        "with_goal_objects": [],
        "offsets": {},
        "n_tasks": 0,
        "coverage": [],
        "out_of_reach": [],
        "plots": {},
        "notes": unjudged(dataset, chosen) if chosen else [],
    }
    meta = _meta(dataset, model["chosen"])
    history = meta.get("history", [])
    if history:
        model["plots"]["training"] = plots.svg("training", plots.training_curve, history=history)
    everything = read_predictions(dataset, chosen or "")
    if not len(everything):
        return model
    predictions = everything.queries()
    model["accuracies"] = accuracy_table(predictions)
    model["with_goal_objects"] = accuracy_table(everything)
    model["breakdowns"] = [
        (by, question.title, breakdown_table(predictions, by))
        for by, question in BREAKDOWNS.items()
    ]
    model["offsets"] = json.loads(model["chosen"]["offsets"] or "{}")
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
    calibration = Calibration.of(meta)
    if calibration is not None:
        model["coverage"] = covered(everything, calibration)
        model["out_of_reach"] = out_of_reach(everything, calibration)
        curves = [r for r in covered(everything, calibration, levels=PROMISED) if r.group in GROUPS]
        if curves:
            model["plots"]["coverage"] = plots.svg(
                "coverage", plots.coverage, size=(9.2, 3.1), panels=2, rows=curves
            )
    return model


def training_history(dataset: Dataset, chosen: Mapping[str, Any] | None) -> list[dict[str, float]]:
    """The training curve that a checkpoint's file holds; empty without the file."""
    return _meta(dataset, chosen).get("history", [])


def _meta(dataset: Dataset, chosen: Mapping[str, Any] | None) -> dict[str, Any]:
    """What the checkpoint's file says of it (curve, calibration); nothing without the file."""
    if chosen is None:
        return {}
    try:
        return read_checkpoint(dataset.path / chosen["path"]).meta
    except CheckpointError:  # a dataset may travel without its weights
        return {}
