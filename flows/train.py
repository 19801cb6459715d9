"""Flow `train`: a relevance model from a dataset's shards, ready to guide."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from flows.head import leave_page, leave_table, retried, say, stage
from flows.parameters import DatasetPath, Overrides, Preset, absolute, configured
from flows.shards import progress
from relevance.configs import dotted

if TYPE_CHECKING:
    from relevance.training import TrainConfig


# Another try goes on from the last saved state.
@retried(name="train-model")
def train_model(root: str, config: TrainConfig, out: str | None) -> str:
    """Train, or go on with what was begun; the path of the checkpoint."""
    from relevance import training

    with progress("train", config.steps) as advance:
        path = training.train(root, config, out=out, progress=lambda done, total: advance(done))
        advance(config.steps)
    return str(path)


@retried(name="tune-guide")
def tune_guide(root: str, checkpoint: str) -> None:
    """Choose when a lazy guide looks, where nobody did and there are tasks to choose on."""
    from relevance import evaluation

    evaluation.tune_once(root, checkpoint)


@stage()
def train(
    dataset: DatasetPath = "data/demo",
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    out: str | None = None,
) -> str:
    """Train a model on a labelled dataset and choose when a lazy guide asks it; returns the path of
    its checkpoint.

    The same settings on the same data give the same checkpoint, so nothing is trained twice.

    Args:
        dataset: Folder of a labelled dataset, or s3://bucket/prefix.
        preset: Size and settings: smoke, demo, laptop or paper.
        overrides: Settings that differ from the preset, e.g. {"steps": 2000, "model.body": "vit"}.
        out: Another folder for the checkpoint than DATASET/checkpoints, or s3://bucket/prefix.
    """
    from relevance.store import Dataset
    from relevance.training import TrainConfig

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(TrainConfig, preset, overrides)
    path = absolute(train_model(str(root), config, str(absolute(out)) if out else None))
    tune_guide(str(root), str(path))
    [row] = [r for r in there.read_rows("checkpoints") if r["checkpoint_id"] == path.stem]
    metrics = json.loads(row["metrics"])
    leave_table("train-metrics", table(metrics), f"Validation metrics of `{row['checkpoint_id']}`")
    leave_page(
        "checkpoint",
        f"Checkpoint [{path.name}]({path.as_uri()}), {row['body']}, preset {row['preset']}, "
        f"trained in {row['train_seconds'] / 60:.1f} minutes on data {row['dataset_hash']}.",
        "The trained model",
    )
    say("train: %s", path)
    return str(path)


def table(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    """One row a group of the metrics, inner names dotted, shares rounded."""

    return [
        {"group": group}
        | {k: round(v, 4) if isinstance(v, float) else v for k, v in dotted(values).items()}
        for group, values in metrics.items()
    ]
