"""Flow `evaluate`: score test scenes, rerun the planner with the model's guidance, report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow, get_run_logger, task
from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_table_artifact,
)
from prefect.cache_policies import NO_CACHE

from flows.parameters import (
    DatasetPath,
    Overrides,
    ParameterError,
    Preset,
    Workers,
    absolute,
    configured,
)
from flows.shards import process_pool, run_shards, worth_retrying

if TYPE_CHECKING:
    from relevance.evaluation import EvaluationConfig

_TASK: dict[str, Any] = {
    "retries": 2,
    "retry_delay_seconds": [1, 10],
    "retry_condition_fn": worth_retrying,
    "persist_result": False,
    "cache_policy": NO_CACHE,
}

SPEED = """
    select guide, search, beta, count(*) as tasks,
        round(avg(solved_unguided::int), 4) as solved_unguided,
        round(avg(solved_guided::int), 4) as solved_guided,
        round(avg(seconds_unguided), 5) as seconds_unguided,
        round(avg(seconds_guided), 5) as seconds_guided,
        round(sum(seconds_unguided) / nullif(sum(seconds_guided), 0), 3) as speed_up,
        round(avg(nlps_unguided), 2) as nlps_unguided,
        round(avg(nlps_guided), 2) as nlps_guided
    from evaluations where checkpoint_id = '{checkpoint_id}'
    group by all order by all
"""


@task(name="evaluate-shard", **_TASK)
def evaluate_one(root: str, checkpoint: str, config: EvaluationConfig, shard: int) -> int:
    """Score the labelled objects of one shard, then rerun the planner on its tasks."""
    from relevance import evaluation

    evaluation.predict(root, checkpoint, split=config.split, shards=[shard])
    return evaluation.evaluate(root, checkpoint, config, shards=[shard])


@task(name="report", **_TASK)
def report_one(root: str, checkpoint_id: str) -> str:
    """Write the report; its path."""
    from relevance.report import page

    return str(page.build(root, checkpoint_id=checkpoint_id))


@flow(
    name="evaluate",
    flow_run_name="evaluate-{preset}",
    task_runner=process_pool(),
    persist_result=False,
)
def evaluate(
    dataset: DatasetPath = "data/demo",
    checkpoint: str | None = None,
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    max_workers: Workers | None = None,
) -> str:
    """Evaluate a checkpoint on a dataset's test scenes; returns the path of the report.

    Args:
        dataset: Folder of a labelled dataset.
        checkpoint: Path of the checkpoint; the dataset's newest when empty.
        preset: How much is rerun: smoke, demo, laptop or paper.
        overrides: Settings that differ from the preset, e.g. {"tasks": 100}; keys may be dotted.
        max_workers: Processes that work at a time; the number of cores when empty. Times are of
            one core each; for the steadiest ones take 1.
    """
    from relevance.evaluation import EvaluationConfig
    from relevance.store import Dataset, sql
    from relevance.training import find_checkpoint

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(EvaluationConfig, preset, overrides)
    path = find_checkpoint(root, absolute(checkpoint) if checkpoint else None)
    shards = there.shards(config.split)
    if not shards:
        raise ParameterError(f"{root}: no {config.split} scenes, expected `generate` first")
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
        max_workers=max_workers,
    )
    report = Path(report_one(str(root), path.stem))
    columns, rows = sql(root, SPEED.format(checkpoint_id=path.stem))
    speed = [dict(zip(columns, row, strict=True)) for row in rows]
    create_table_artifact(speed, key="evaluation", description=f"Guided planning, `{path.stem}`")
    create_link_artifact(report.as_uri(), key="report", link_text="Report", description="Report")
    create_markdown_artifact(
        f"# Evaluation of {path.stem}\n\n{markdown(columns, rows)}\n\n"
        f"Report: [{report}]({report.as_uri()})\n",
        key="evaluation-summary",
        description="What guidance saves, and the link to the report",
    )
    get_run_logger().info("evaluate: report %s", report)
    return str(report)


def markdown(columns: list[str], rows: list[tuple[Any, ...]]) -> str:
    """A Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
