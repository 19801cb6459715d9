"""Flow `reproduce`: the paper's tables and figures from a dataset and its checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flows.head import leave_link, leave_page, retried, say, stage
from flows.parameters import (
    DatasetPath,
    Overrides,
    Preset,
    Workers,
    absolute,
    configured,
)
from flows.shards import process_pool, run_shards

if TYPE_CHECKING:
    from relevance.evaluation import EvaluationConfig


@retried(name="score-shard")
def score_one(root: str, checkpoint: str, shard: int) -> int:
    """Score the labelled objects of a test shard."""
    from relevance import evaluation

    return evaluation.predict(root, checkpoint, shards=[shard])


@retried(name="rerun-shard")
def rerun_one(root: str, checkpoint: str, config: EvaluationConfig, shard: int) -> int:
    """Rerun the planner on the tasks of a shard, at every beta of the figures."""
    from relevance import evaluation

    return evaluation.evaluate(root, checkpoint, config, shards=[shard])


@retried(name="reproduction")
def build_one(root: str, out: str | None, checkpoints: list[str]) -> str:
    """Write page, tables and figures; the path of the page."""
    from relevance.report import reproduction

    return str(reproduction.build(root, out, checkpoints=checkpoints))


@stage(process_pool())
def reproduce(
    dataset: DatasetPath = "data/demo",
    checkpoints: list[str] | None = None,
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    out: str | None = None,
    max_workers: Workers | None = None,
) -> str:
    """The paper's tables and figures, ours beside its own; returns the path of the page.

    Nothing is trained; predictions and reruns that are missing are made and kept in the dataset.

    Args:
        dataset: Folder of a labelled dataset.
        checkpoints: Files, ids or names of models; all of the dataset when empty.
        preset: How much is rerun: smoke, demo, laptop or paper.
        overrides: Settings that differ from the preset, e.g. {"sweep_tasks": 60}; keys may be
            dotted.
        out: Another folder for page, tables and figures than DATASET/paper.
        max_workers: Processes that work at a time; the number of cores when empty. Times are of
            one core each; for the steadiest ones take 1.
    """
    from relevance.evaluation import EvaluationConfig
    from relevance.report import reproduction
    from relevance.store import Dataset

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(EvaluationConfig, preset, overrides)
    given = [_absolute(name) for name in checkpoints or ()]
    models, shards = reproduction.models_of(there, given), there.shards("test")
    run_shards(
        score_one,
        {
            f"{model.name}-{shard:06d}": {
                "root": str(root),
                "checkpoint": str(model.file),
                "shard": shard,
            }
            for model in reproduction.to_score(there, models)
            for shard in shards
        },
        stage="score",
        dataset=root,
        max_workers=max_workers,
    )
    run_shards(
        rerun_one,
        {
            f"{model.name}-{shard:06d}": {
                "root": str(root),
                "checkpoint": str(model.file),
                "config": settings,
                "shard": shard,
            }
            for model in reproduction.to_rerun(there, models)
            for settings in [reproduction.rerun_config(there, model, config)]
            for shard in shards
        },
        stage="rerun",
        dataset=root,
        max_workers=max_workers,
    )
    page = Path(build_one(str(root), str(absolute(out)) if out else None, given))
    leave_link("reproduction", page, "The paper's tables and figures")
    leave_page(
        "reproduction-summary",
        f"# The paper's tables and figures\n\nPage: [{page}]({page.as_uri()}); tables in "
        f"`{page.parent / 'tables'}`, figures in `{page.parent / 'figures'}`.\n",
        "Where page, tables and figures are",
    )
    say("reproduce: %s", page)
    return str(page)


def _absolute(checkpoint: str) -> str:
    """A file's absolute path; ids and names of models stay what they are."""
    return str(absolute(checkpoint)) if Path(checkpoint).exists() else checkpoint
