"""Flow `retrain`: train on what the dataset holds now, evaluate, promote or refuse, report.

Runs by schedule and whenever new labels were written (prefect.yaml). When neither the data nor
the settings have changed since, it ends at once. What it trained becomes the dataset's champion
only if it is better beyond noise; else the old one stays. An artifact says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prefect.events import emit_event

from flows.evaluate import evaluate
from flows.head import leave_page, retried, say, stage
from flows.parameters import DatasetPath, Overrides, Preset, Workers, absolute, configured
from flows.train import train

if TYPE_CHECKING:
    from relevance.evaluation import TrialConfig


# Another try begins a trial anew; the record is written at its end alone.
@retried(name="trial")
def try_one(root: str, checkpoint: str, config: TrialConfig) -> dict[str, Any]:
    """Hold a checkpoint against the champion: which stands now, whether it was promoted, why."""
    from relevance.evaluation import contend
    from relevance.networks import read_record
    from relevance.store import Dataset

    trial = contend(root, checkpoint, config)
    return {
        "champion": read_record(Dataset.open(root)).champion,
        "promoted": trial is not None and trial.promoted,
        "why": trial.why if trial else "it is the champion already",
    }


@stage()
def retrain(
    dataset: DatasetPath = "data/demo",
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    evaluation: Overrides | None = None,
    trial: Overrides | None = None,
    max_workers: Workers | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Train anew when there is new data, evaluate, and promote what is better beyond noise.

    Returns checkpoint, report, whether it is new, and what became of it.

    Args:
        dataset: Folder of a labelled dataset.
        preset: Size and settings of training and evaluation: smoke, demo, laptop or paper.
        overrides: Training settings that differ from the preset.
        evaluation: Evaluation settings that differ from the preset.
        trial: Settings that differ from the preset of how it is held against the champion, e.g.
            {"tasks": 100}.
        max_workers: Processes that evaluate at a time; the number of cores when empty.
        force: Evaluate and report even when this model was there before.
    """
    from relevance.evaluation import EvaluationConfig, TrialConfig
    from relevance.networks import read_record
    from relevance.store import Dataset, sql
    from relevance.training import TrainConfig, checkpoint_id

    root = absolute(dataset)
    there = Dataset.open(root)
    config = configured(TrainConfig, preset, overrides)
    configured(EvaluationConfig, preset, evaluation)  # refused now, not after an hour of training
    trying = configured(TrialConfig, preset, trial)
    name = checkpoint_id(there, config)
    same = [name] if there.has("checkpoints", name=name) else []
    evaluated = {name for (name,) in sql(root, "select distinct checkpoint_id from evaluations")[1]}
    tried = read_record(there).tried(name)
    if evaluated.intersection(same) and tried and not force:
        say("retrain: nothing new since %s", same[0])
        return {"checkpoint": same[0], "report": None, "new": False, "promoted": False}
    checkpoint = train(dataset=str(root), preset=preset, overrides=overrides)
    report = evaluate(
        dataset=str(root),
        checkpoint=checkpoint,
        preset=preset,
        overrides=evaluation,
        max_workers=max_workers,
    )
    found = try_one(str(root), checkpoint, trying)
    verdict = "promoted" if found["promoted"] else "refused"
    leave_page(
        "champion",
        f"# {name}: {verdict}\n\n{found['why']}\n\nThe champion is `{found['champion']}`.\n",
        "Whether the new checkpoint became the champion, and why",
    )
    emit_event(
        f"checkpoint.{verdict}",
        resource={
            "prefect.resource.id": f"relevance.dataset.{root}",
            "prefect.resource.name": root.name,
        },
        payload={"dataset": str(root), "checkpoint": name, "why": found["why"]},
    )
    say("retrain: %s %s: %s", name, verdict, found["why"])
    return {
        "checkpoint": checkpoint,
        "report": report,
        "new": not same,
        "promoted": found["promoted"],
    }
