"""The paper's tables and figures from a dataset and its checkpoints, the paper's own beside them.

Nothing is trained here. What lacks predictions or reruns gets them from `relevance.evaluation`,
which keeps them in the dataset: a killed run goes on where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path

from relevance.evaluation import EvaluationConfig, evaluate, predict
from relevance.report import style
from relevance.report.pages import write_page
from relevance.report.paper import paper
from relevance.report.plots import Drawing
from relevance.report.reproduction.betas import curves, drawings, sheet
from relevance.report.reproduction.models import (
    Evidence,
    Model,
    compared,
    is_scored,
    models_of,
    rerun_config,
)
from relevance.report.reproduction.scenes import seen_scene, stacked_pair
from relevance.report.reproduction.tables import (
    FAMILIES,
    accuracies,
    bodies,
    label_distribution,
    planning_times,
)
from relevance.store import Dataset

__all__ = ["Model", "build", "models_of", "prepare", "rerun_config", "to_rerun", "to_score"]

Bar = Callable[[str], AbstractContextManager[Callable[[int, int], None]]]
"""What gives the progress of a part, named in words."""


def prepare(
    root: str | Path,
    checkpoints: Sequence[str | Path],
    config: EvaluationConfig,
    bar: Bar,
) -> None:
    """Make the predictions and reruns that `build` would miss.

    Reruns of a checkpoint that were made with other settings are made anew with these.
    """
    dataset = Dataset.open(root)
    models = models_of(dataset, checkpoints)
    for model in to_score(dataset, models):
        with bar(f"{model.name}: shards scored") as progress:
            predict(root, _file(model), progress=progress)
    for model in to_rerun(dataset, models):
        with bar(f"{model.name}: tasks") as progress:
            settings = rerun_config(dataset, model, config)
            evaluate(root, _file(model), settings, progress=progress)


def to_score(dataset: Dataset, models: Sequence[Model]) -> list[Model]:
    """The models whose predictions on the test split are missing or of older labels."""
    if not dataset.files("labels", split="test"):
        return []
    return [model for model in models if model.file and not is_scored(dataset, model)]


def to_rerun(dataset: Dataset, models: Sequence[Model]) -> list[Model]:
    """The models that the planner is rerun with: those of Table II and of the beta figures."""
    if not dataset.files("labels", split="test"):
        return []
    found = [model for family in FAMILIES for model in compared(models, family)]
    return [model for model in {m.name: m for m in found}.values() if model.file]


def _file(model: Model) -> Path:
    assert model.file, "models without weights are neither scored nor rerun"
    return model.file


def build(
    root: str | Path, out: str | Path | None = None, *, checkpoints: Sequence[str | Path] = ()
) -> Path:
    """Write page, tables and figures into a folder (default ROOT/paper); the path of the page.

    From what the dataset holds: a table says what is missing, and what makes it.
    """
    dataset = Dataset.open(root)
    out = Path(out) if out is not None else dataset.path / "paper"
    evidence = Evidence(dataset, checkpoints)
    beta_models = compared(evidence.models, "on")
    found = [curve for model in beta_models if (curve := curves(evidence, model))]
    sheets = {
        "data": label_distribution(dataset),
        "accuracies": accuracies(evidence),
        "times": planning_times(evidence),
        "bodies": bodies(evidence),
    }
    pictures = [shown for shown in (seen_scene(dataset), stacked_pair(dataset)) if shown]
    betas = [(sheet(curve), drawings(curve)) for curve in found]
    for one in (*sheets.values(), *(one for one, _ in betas)):
        one.write(out / "tables")
    for drawing, _ in (*pictures, *(shown for _, many in betas for shown in many)):
        drawing.write(out / "figures")
    return write_page(
        "reproduction/page.html.j2",
        out / "index.html",
        name=dataset.path.resolve().name,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        dataset_hash=dataset.content_hash(),
        planner=dataset.labelling.planner if dataset.labelling else "",
        models=evidence.models,
        sheets=sheets,
        betas=[(one, _inline(many)) for one, many in betas],
        missing_betas=_why_no_betas(beta_models),
        pictures=_inline(pictures),
        paper=paper(),
        style=style,
    )


def _inline(shown: Sequence[tuple[Drawing, str]]) -> list[tuple[str, str]]:
    return [(drawing.inline(), caption) for drawing, caption in shown]


def _why_no_betas(models: Sequence[Model]) -> str:
    if not models:
        return (
            "No checkpoint that looks at a picture and answers `on`: `relevance train` makes one."
        )
    troubles = "; ".join(model.trouble for model in models if model.trouble)
    return troubles or "No predictions on the test split yet: `relevance reproduce` makes them."
