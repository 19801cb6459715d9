"""Flow `train`: a relevance model from a dataset's shards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_markdown_artifact, create_table_artifact
from prefect.cache_policies import NO_CACHE

from flows.parameters import DatasetPath, Overrides, Preset, absolute, configured
from flows.shards import one_by_one, progress, worth_retrying

if TYPE_CHECKING:
    from relevance.training import TrainConfig


@task(
    name="train-model",
    # Another try goes on from the last saved state.
    retries=2,
    retry_delay_seconds=[1, 10],
    retry_condition_fn=worth_retrying,
    persist_result=False,
    cache_policy=NO_CACHE,
)
def train_model(root: str, config: TrainConfig, out: str | None) -> str:
    """Train, or go on with what was begun; the path of the checkpoint."""
    from relevance import training

    with progress("train", config.steps) as advance:
        path = training.train(root, config, out=out, progress=lambda done, total: advance(done))
        advance(config.steps)
    return str(path)


@flow(
    name="train",
    flow_run_name="train-{preset}",
    task_runner=one_by_one(),
    persist_result=False,
)
def train(
    dataset: DatasetPath = "data/demo",
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    out: str | None = None,
) -> str:
    """Train a model on a labelled dataset; returns the path of its checkpoint.

    The same settings on the same data give the same checkpoint, so nothing is trained twice.

    Args:
        dataset: Folder of a labelled dataset.
        preset: Size and settings: smoke, demo, laptop or paper.
        overrides: Settings that differ from the preset, e.g. {"steps": 2000, "model.body": "vit"}.
        out: Another folder for the checkpoint than DATASET/checkpoints.
    """
    from relevance.store import Dataset
    from relevance.training import TrainConfig

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(TrainConfig, preset, overrides)
    path = Path(train_model(str(root), config, str(absolute(out)) if out else None))
    [row] = [r for r in there.read_rows("checkpoints") if r["checkpoint_id"] == path.stem]
    metrics = json.loads(row["metrics"])
    create_table_artifact(
        table(metrics), key="train-metrics", description=f"Validation metrics of `{path.stem}`"
    )
    create_markdown_artifact(
        f"Checkpoint [{path.name}]({path.as_uri()}), {row['body']}, preset {row['preset']}, "
        f"trained in {row['train_seconds'] / 60:.1f} minutes on data {row['dataset_hash']}.",
        key="checkpoint",
        description="The trained model",
    )
    get_run_logger().info("train: %s", path)
    return str(path)


def table(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    """One row a group of the metrics, inner names dotted, shares rounded."""

    def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
        row: dict[str, Any] = {}
        for name, value in values.items():
            if isinstance(value, dict):
                row |= flat(value, f"{prefix}{name}.")
            else:
                row[prefix + name] = round(value, 4) if isinstance(value, float) else value
        return row

    return [{"group": group} | flat(values) for group, values in metrics.items()]
