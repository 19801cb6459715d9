"""Flow `evaluate`: score test scenes, rerun the planner with the model's guidance, report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from flows.head import leave_link, leave_page, leave_table, retried, say, stage
from flows.parameters import (
    Cluster,
    DatasetPath,
    Overrides,
    ParameterError,
    Preset,
    Workers,
    absolute,
    configured,
)
from flows.shards import process_pool, run_shards

if TYPE_CHECKING:
    from relevance.evaluation import EvaluationConfig


@retried(name="evaluate-shard")
def evaluate_one(root: str, checkpoint: str, config: EvaluationConfig, shard: int) -> int:
    """Score the labelled objects of one shard, then rerun the planner on its tasks."""
    from relevance import evaluation

    evaluation.predict(root, checkpoint, split=config.split, shards=[shard])
    return evaluation.evaluate(root, checkpoint, config, shards=[shard])


@retried(name="report")
def report_one(root: str, checkpoint_id: str) -> str:
    """Write the report; its path."""
    from relevance.report import page

    return str(page.build(root, checkpoint_id=checkpoint_id))


@stage(process_pool())
def evaluate(
    dataset: DatasetPath = "data/demo",
    checkpoint: str | None = None,
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    max_workers: Workers | None = None,
    cluster: Cluster | None = None,
) -> str:
    """Evaluate a checkpoint on a dataset's test scenes; returns the path of the report.

    Args:
        dataset: Folder of a labelled dataset, or s3://bucket/prefix.
        checkpoint: Path or id of the checkpoint; the dataset's champion when empty, or its newest.
        preset: How much is rerun: smoke, demo, laptop or paper.
        overrides: Settings that differ from the preset, e.g. {"tasks": 100}; keys may be dotted.
        max_workers: Processes that work at a time; the number of cores when empty. Times are of
            one core each; for the steadiest ones take 1.
        cluster: Address of a Dask scheduler whose workers rerun the shards instead, each of which
            reaches the dataset (and Prefect's server).
    """
    from relevance.evaluation import EvaluationConfig, load_scorer, speed_table
    from relevance.store import Dataset
    from relevance.training import find_checkpoint

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(EvaluationConfig, preset, overrides)
    path = absolute(find_checkpoint(root, checkpoint or None))
    shards = there.shards(config.split)
    if not shards:
        raise ParameterError(f"{root}: no {config.split} scenes, expected `generate` first")
    checkpoint_id = load_scorer(path, into=there).checkpoint_id  # whatever its file is called
    run_shards(
        evaluate_one,
        {
            f"{config.split}-{shard:06d}": {
                "root": str(root),
                "checkpoint": str(path),
                "config": config,
                "shard": shard,
            }
            for shard in shards
        },
        stage="evaluate",
        dataset=root,
        max_workers=max_workers,
        cluster=cluster,
    )
    report = absolute(report_one(str(root), checkpoint_id))
    speed = [{k: _short(v) for k, v in row.items()} for row in speed_table(there, checkpoint_id)]
    leave_table("evaluation", speed, f"Guided planning, `{checkpoint_id}`")
    leave_link("report", report, "Report")
    leave_page(
        "evaluation-summary",
        f"# Evaluation of {checkpoint_id}\n\n{markdown(speed)}\n\n"
        f"Report: [{report}]({report.as_uri()})\n",
        "What guidance saves, and the link to the report",
    )
    say("evaluate: report %s", report)
    return str(report)


def _short(value: Any) -> Any:
    """Four digits, and nothing for what is not a number: JSON has no nan."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.4g}") if math.isfinite(value) else None


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table; nothing for no rows."""
    if not rows:
        return ""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
