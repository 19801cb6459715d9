"""Flow `retrain`: train on what the dataset holds now, evaluate, report.

Runs by schedule and whenever new labels were written (prefect.yaml). When neither the data nor
the settings have changed since, it ends at once.
"""

from __future__ import annotations

from typing import Any

from flows.evaluate import evaluate
from flows.head import say, stage
from flows.parameters import DatasetPath, Overrides, Preset, Workers, absolute, configured
from flows.train import train


@stage()
def retrain(
    dataset: DatasetPath = "data/demo",
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    evaluation: Overrides | None = None,
    max_workers: Workers | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Train anew when there is new data, then evaluate; returns checkpoint and report.

    Args:
        dataset: Folder of a labelled dataset.
        preset: Size and settings of training and evaluation: smoke, demo, laptop or paper.
        overrides: Training settings that differ from the preset.
        evaluation: Evaluation settings that differ from the preset.
        max_workers: Processes that evaluate at a time; the number of cores when empty.
        force: Evaluate and report even when this model was there before.
    """
    from relevance.evaluation import EvaluationConfig
    from relevance.store import Dataset, sql
    from relevance.training import TrainConfig, checkpoint_id

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(TrainConfig, preset, overrides)
    configured(EvaluationConfig, preset, evaluation)  # refused now, not after an hour of training
    name = checkpoint_id(there, config)
    same = [name] if there.has("checkpoints", name=name) else []
    evaluated = {name for (name,) in sql(root, "select distinct checkpoint_id from evaluations")[1]}
    if evaluated.intersection(same) and not force:
        say("retrain: nothing new since %s", same[0])
        return {"checkpoint": same[0], "report": None, "new": False}
    checkpoint = train(dataset=str(root), preset=preset, overrides=overrides)
    report = evaluate(
        dataset=str(root),
        checkpoint=checkpoint,
        preset=preset,
        overrides=evaluation,
        max_workers=max_workers,
    )
    return {"checkpoint": checkpoint, "report": report, "new": not same}
