"""Which checkpoints the paper's tables are made of, and what is asked of each."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from relevance.evaluation import (
    EvaluationConfig,
    EvaluationError,
    Predictions,
    in_group,
    left_out,
    load_scorer,
    read_evaluations,
    read_predictions,
    settings,
    shown_as,
    unjudged,
)
from relevance.models import BODIES
from relevance.networks import CheckpointError, find_checkpoint, read_checkpoint
from relevance.report.paper import paper
from relevance.scene import PREDICATES
from relevance.store import Dataset

WAY = SEARCH, GUIDE = "tree", "prune"
"""The paper's: leave out what the network calls irrelevant, in an uninformed search."""
SPLIT = "test"
TRANSFORMER = "vit"
POINTS = 0.1
"""By how much the true relevant share moves over the paper's range of beta, and over ours."""
_STEP, _MOST = 0.05, 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A checkpoint of a dataset."""

    name: str
    """Its id."""
    body: str
    reading: str
    """How the attention of a ViT is read; empty for others."""
    told: bool
    """Whether it is told the poses and sees no picture."""
    heads: tuple[str, ...]
    """The predicates that it learned."""
    file: Path | None
    """Its weights, where they can be read."""
    trouble: str
    """Why they cannot."""
    eta: Mapping[str, float]
    """By family of the paper: the weight of relevant objects in its loss."""
    steps: int
    train_seconds: float
    validation: Mapping[str, float]
    """By family: share of the validation queries judged rightly at its own beta."""


def models_of(dataset: Dataset, given: Sequence[str | Path] = ()) -> list[Model]:
    """The checkpoints that are given (files, ids, or names of the package's), else all that the
    dataset has, the newest first.

    What is given from elsewhere gets a row in the dataset. Raises DatasetError for an unknown one.
    """
    names = [_entered(dataset, checkpoint) for checkpoint in given]
    rows = {row["checkpoint_id"]: row for row in dataset.read_rows("checkpoints")}
    newest = sorted(rows, key=lambda name: (rows[name]["created"], name), reverse=True)
    return [_model(dataset, rows[name]) for name in dict.fromkeys(names or newest)]


def _entered(dataset: Dataset, checkpoint: str | Path) -> str:
    return load_scorer(find_checkpoint(dataset.path, checkpoint), into=dataset).checkpoint_id


def _model(dataset: Dataset, row: Mapping[str, Any]) -> Model:
    config, metrics = json.loads(row["config"] or "{}"), json.loads(row["metrics"] or "{}")
    file = dataset.path / row["path"]
    heads, trouble = (), ""
    try:
        heads = read_checkpoint(file).meta["predicates"]
    except CheckpointError as error:  # a dataset may travel without its weights
        trouble = str(error)
    queries = {name: of["queries"] for name, of in metrics.items() if "queries" in of}
    return Model(
        name=row["checkpoint_id"],
        body=row["body"],
        reading=config.get("model", {}).get("attention", ""),
        told=_told(row["body"]),
        heads=tuple(name for name in PREDICATES if name in (heads or metrics)),
        file=None if trouble else file,
        trouble=trouble,
        eta={
            family: config[key]
            for family, key in (("same-plane", "eta_same_plane"), ("on", "eta_on"))
            if key in config
        },
        steps=config.get("steps", 0),
        train_seconds=row["train_seconds"],
        validation={name: of.get("tuned", of).get("total") or 0.0 for name, of in queries.items()},
    )


@cache
def _told(body: str) -> bool:
    """Whether a body is told the poses; of one that is not known here nobody can say."""
    return body in BODIES and BODIES[body].make(BODIES[body].config.smoke(), ()).told


def of_family(family: str) -> tuple[str, ...]:
    """The predicates that the paper has in a family."""
    return tuple(name for name in paper().scenes if PREDICATES[name].family == family)


def transformer(models: Sequence[Model], family: str) -> Model | None:
    """The ViT with a head for every predicate of a family, the first of several."""
    return next((m for m in _able(models, family) if m.body == TRANSFORMER), None)


def best(models: Sequence[Model], family: str) -> Model | None:
    """Of those that look at the picture, the one that validation has as the most often right."""
    seeing = [m for m in _able(models, family) if not m.told]
    return max(seeing, key=lambda m: m.validation.get(family, 0.0), default=None)


def _able(models: Sequence[Model], family: str) -> list[Model]:
    return [m for m in models if set(of_family(family)) <= set(m.heads)]


def compared(models: Sequence[Model], family: str) -> list[Model]:
    """The models of Table II and of the beta figures: the ViT and our best, if they are two."""
    found = [transformer(models, family), best(models, family)]
    return list({model.name: model for model in found if model}.values())


# --- what is known of them ---------------------------------------------------------------------


class Evidence:
    """What a dataset holds of some of its checkpoints, each thing read once."""

    def __init__(self, dataset: Dataset, given: Sequence[str | Path] = ()) -> None:
        self.dataset = dataset
        self.models = models_of(dataset, given)
        self._predictions: dict[str, Predictions] = {}
        self._warnings: dict[str, list[str]] = {}
        self._reruns: dict[str, dict[tuple[str, str, float], list[dict[str, Any]]]] = {}

    def queries(self, model: Model, group: str = "all") -> Predictions:
        """Its predictions for the test queries of a predicate or family."""
        if model.name not in self._predictions:
            self._predictions[model.name] = read_predictions(self.dataset, model.name).queries()
        return self._predictions[model.name].of(group)

    def betas(self, model: Model) -> set[float]:
        """Those at which the planner was rerun in the paper's way."""
        return {b for search, guide, b in self._settings(model) if (search, guide) == WAY}

    def reruns(self, model: Model, beta: float, group: str) -> list[dict[str, Any]]:
        """The rows of `evaluations` that the paper's way of guiding gave at a beta."""
        rows = self._settings(model).get((*WAY, beta), [])
        return [row for row in rows if in_group(shown_as(row), group)]

    def _settings(self, model: Model) -> dict[tuple[str, str, float], list[dict[str, Any]]]:
        if model.name not in self._reruns:
            self._reruns[model.name] = settings(read_evaluations(self.dataset, model.name))
        return self._reruns[model.name]

    def warnings(self, models: Iterable[Model]) -> list[str]:
        """What a reader should know of the predictions and reruns of some."""
        return [line for model in models for line in self._known(model)]

    def _known(self, model: Model) -> list[str]:
        if model.name not in self._warnings:
            lines = [*unjudged(self.dataset, model.name), *left_out(self.dataset, model.name)]
            lines += [model.trouble] if model.trouble else []
            self._warnings[model.name] = [f"{model.name}: {line}." for line in lines]
        return self._warnings[model.name]


# --- what is asked of them ---------------------------------------------------------------------


def is_scored(dataset: Dataset, model: Model) -> bool:
    """Whether its predictions on the test split are there, and those of the present labels."""
    files = dataset.files("predictions", checkpoint_id=model.name, split="test")
    return bool(files) and not unjudged(dataset, model.name)


def papers_betas() -> tuple[float, ...]:
    """The eleven of the paper's figures."""
    return paper().curves["beta"]


def our_betas(predictions: Predictions) -> tuple[float, ...]:
    """Eleven betas around 0, over the least range in which the true relevant share moves ten
    points; none without a relevant query."""
    relevant = predictions.score[predictions.relevant]
    if not len(relevant):
        return ()
    for half in np.arange(_STEP, _MOST, _STEP):
        moved = np.mean(relevant > -half) - np.mean(relevant > half)
        if moved >= POINTS:
            return tuple(np.round(np.linspace(-half, half, 11), 6).tolist())
    return ()


def rerun_config(dataset: Dataset, model: Model, start: EvaluationConfig) -> EvaluationConfig:
    """The settings of the reruns that the tables and figures need of a scored model, and of all
    that `start` asks for besides.

    EvaluationError for another split than the test split.
    """
    if start.split != SPLIT:
        raise EvaluationError(f"split {start.split}: expected {SPLIT}, which the tables are of")
    betas = {*start.betas}
    if "on" in model.heads:
        scored = read_predictions(dataset, model.name).queries().of("on")
        betas |= {*papers_betas(), *our_betas(scored)}
    searches = tuple(dict.fromkeys((SEARCH, *start.searches)))
    guides = tuple(dict.fromkeys((GUIDE, *start.guides)))
    betas -= {start.beta}
    return replace(start, betas=tuple(sorted(betas)), guides=guides, searches=searches)
