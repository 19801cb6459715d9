"""Flow `retrain`: train on what the dataset holds now, evaluate, promote or refuse, report.

Runs by schedule and whenever new labels were written (prefect.yaml). It ends at once when too few
labels are new, by equal settings, and while new plans are being made (`label --replan`). What it
trained becomes the dataset's champion only if it is better beyond noise; else the old one stays.
An artifact says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from prefect.events import emit_event
from pydantic import Field

from flows.evaluate import evaluate
from flows.head import leave_page, retried, say, stage
from flows.parameters import DatasetPath, Overrides, Preset, Workers, absolute, configured
from flows.train import train

if TYPE_CHECKING:
    from relevance.evaluation import TrialConfig
    from relevance.networks import Record
    from relevance.store import Dataset

Share = Annotated[float, Field(ge=0, le=1)]


# Another try begins a trial anew; the record is written at its end alone.
@retried(name="trial")
def try_one(
    root: str, checkpoint: str, config: TrialConfig, learned: tuple[int, str]
) -> dict[str, Any]:
    """Hold a checkpoint against the champion: which stands now, whether it was promoted, why."""
    from relevance.evaluation import contend
    from relevance.networks import read_record
    from relevance.store import Dataset

    trial = contend(root, checkpoint, config, learned=learned)
    return {
        "champion": read_record(Dataset.open(root)).champion,
        "promoted": trial is not None and trial.promoted,
        "why": trial.why if trial else "it is the champion already",
    }


@stage()
def retrain(
    dataset: DatasetPath = "data/demo",
    preset: Preset | Literal["fitting"] = "fitting",
    overrides: Overrides | None = None,
    evaluation: Overrides | None = None,
    trial: Overrides | None = None,
    least_new: Share = 0.02,
    max_workers: Workers | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Train anew when there is new data, evaluate, and promote what is better beyond noise.

    Returns checkpoint, report, whether it is new, and whether it was promoted.

    Args:
        dataset: Folder of a labelled dataset.
        preset: Size and settings of training, evaluation and trial: smoke, demo, laptop or paper;
            fitting is the one that fits the dataset.
        overrides: Training settings that differ from the preset.
        evaluation: Evaluation settings that differ from the preset.
        trial: Settings that differ from the preset of how it is held against the champion, e.g.
            {"tasks": 100}.
        least_new: Share of the training labels that has to be new since the last time; with other
            training settings, or labels of another planner, all of them are.
        max_workers: Processes that evaluate at a time; the number of cores when empty.
        force: Train, evaluate and try even so, and when this model was there before.
    """
    from relevance.evaluation import EvaluationConfig, TrialConfig
    from relevance.networks import read_record
    from relevance.pipeline import fitting_preset, pending
    from relevance.store import Dataset, sql
    from relevance.training import TrainConfig, checkpoint_id

    root = absolute(dataset)
    there = Dataset.open(root)
    rest = {"checkpoint": None, "report": None, "new": False, "promoted": False}
    if pending(there) is not None:
        say("retrain: %s is being planned anew; `relevance label` finishes it", root)
        return rest
    if preset == "fitting":
        count = sql(root, "select count(*) from scenes where split = 'train'")[1][0][0]
        preset = fitting_preset(count)
        say("retrain: preset %s fits %d training scenes", preset, count)
    config = configured(TrainConfig, preset, overrides)
    configured(EvaluationConfig, preset, evaluation)  # refused now, not after an hour of training
    trying = configured(TrialConfig, preset, trial)
    name = checkpoint_id(there, config)
    same = [name] if there.has("checkpoints", name=name) else []
    evaluated = {name for (name,) in sql(root, "select distinct checkpoint_id from evaluations")[1]}
    record = read_record(there)
    learned = _learned(there, config.policy)
    done = bool(evaluated.intersection(same)) and record.tried(name)
    if not force and (done or not enough(there, record, config.content_hash, learned, least_new)):
        last = name if done else record.history[-1].checkpoint_id
        say("retrain: nothing, or too little, is new since %s", last)
        return rest | {"checkpoint": last}
    checkpoint = train(dataset=str(root), preset=preset, overrides=overrides)
    report = evaluate(
        dataset=str(root),
        checkpoint=checkpoint,
        preset=preset,
        overrides=evaluation,
        max_workers=max_workers,
    )
    found = try_one(str(root), checkpoint, trying, learned)
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


def _learned(dataset: Dataset, policy: str) -> tuple[int, str]:
    """How many training labels there are, and how they were made."""
    with dataset.connect(policy=policy, names=("labels",)) as connection:
        found = connection.execute(
            "select count(*) from labels where split = 'train' and policy = ?", [policy]
        ).fetchone()
    made = dataset.labelling
    labelling = f"{made.planner}/{made.config}/{policy}" if made else policy
    return (found[0] if found else 0), labelling


def enough(
    dataset: Dataset, record: Record, config_hash: str, learned: tuple[int, str], least_new: float
) -> bool:
    """Whether that share of the labels is new since a checkpoint of these settings was tried.

    Labels that were made otherwise are new, all of them.
    """
    alike = {
        row["checkpoint_id"]
        for row in dataset.read_rows("checkpoints")
        if row["config_hash"] == config_hash
    }
    before = [
        event.labels
        for event in record.history
        if event.checkpoint_id in alike and event.labelling == learned[1]
    ]
    return not before or learned[0] - max(before) >= max(least_new * learned[0], 1)
