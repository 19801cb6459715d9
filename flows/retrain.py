"""Flow `retrain`: train on what the dataset holds now, evaluate, promote or refuse, report.

Runs by schedule and whenever new labels were written (prefect.yaml). It ends at once when too few
labels are new, by equal settings, and while new plans are being made (`label --replan`); it fails
on a dataset that breaks its contracts. It learns twice, from scratch and, for a share of the
steps, on from the champion's weights: both runs end, both are measured on validation, and the
better one is held against the champion. (A look at both half-way would favour the one with a
head start.) It becomes the dataset's champion only if it is better beyond noise; else the old one
stays. An artifact says why.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from flows.check import check
from flows.evaluate import evaluate
from flows.head import leave_page, retried, say, stage
from flows.parameters import DatasetPath, Overrides, Preset, Workers, absolute, configured
from flows.telling import PROMOTED, REFUSED, tell
from flows.train import train, train_model
from relevance.errors import RelevanceError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from relevance.evaluation import TrialConfig
    from relevance.networks import Event, Learned, Record
    from relevance.store import Dataset
    from relevance.training import TrainConfig

Share = Annotated[float, Field(ge=0, le=1)]


# Another try begins a trial anew; the record is written at its end alone.
@retried(name="trial")
def try_one(root: str, checkpoint: str, config: TrialConfig, learned: Learned) -> dict[str, Any]:
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
    continued: Share = 0.25,
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
        continued: Share of the steps for which the champion's weights are also trained on, beside
            the training from scratch; the better of both on validation counts. 0: from scratch.
        max_workers: Processes that evaluate at a time; the number of cores when empty.
        force: Train, evaluate and try even so, and when this model was there before.
    """
    from relevance.evaluation import EvaluationConfig, TrialConfig
    from relevance.networks import read_record, refuse_remote
    from relevance.pipeline import fitting_preset, pending
    from relevance.store import Dataset, DatasetError, sql
    from relevance.training import TrainConfig, checkpoint_id

    root = absolute(dataset)
    there = Dataset.open(root)
    refuse_remote(there)
    rest = {"checkpoint": None, "report": None, "new": False, "promoted": False}
    if pending(there) is not None:
        say("retrain: %s is being planned anew; `relevance label` finishes it", root)
        return rest
    try:
        if preset == "fitting":
            count = sql(root, "select count(*) from scenes where split = 'train'")[1][0][0]
            preset = fitting_preset(count)
            say("retrain: preset %s fits %d training scenes", preset, count)
        config = configured(TrainConfig, preset, overrides)
        configured(EvaluationConfig, preset, evaluation)  # now, not after an hour of training
        trying = configured(TrialConfig, preset, trial)
        name = checkpoint_id(there, config)
        known = {row["checkpoint_id"] for row in there.read_rows("checkpoints")}
        seen = sql(root, "select distinct checkpoint_id from evaluations")[1]
        learned = _learned(there, config)
    except DatasetError:
        check(dataset=str(root), render=False)  # tells what is broken, and fails
        raise
    evaluated, record = {name for (name,) in seen}, read_record(there)
    done = name in known & evaluated and record.tried(name)
    like = tried_like(record, learned)
    if not force and (done or not enough(like, learned, least_new)):
        last = name if done else like[-1].checkpoint_id
        say("retrain: nothing, or too little, is new since %s", last)
        return rest | {"checkpoint": str(root / "checkpoints" / f"{last}.pt")}
    check(dataset=str(root), render=False)
    chosen = choose(root, config, record.champion, continued)
    checkpoint = train(dataset=str(root), preset=preset, overrides=(overrides or {}) | chosen.more)
    report = evaluate(
        dataset=str(root),
        checkpoint=checkpoint,
        preset=preset,
        overrides=evaluation,
        max_workers=max_workers,
    )
    found = try_one(str(root), checkpoint, trying, learned)
    name = absolute(checkpoint).stem
    verdict = "promoted" if found["promoted"] else "refused"
    leave_page(
        "champion",
        f"# {name}: {verdict}\n\n{found['why']}\n\nThe champion is `{found['champion']}`.\n\n"
        f"{chosen.why}\n",
        "Whether the new checkpoint became the champion, and why",
    )
    event = PROMOTED if found["promoted"] else REFUSED
    tell(root, event, checkpoint=name, why=found["why"], trained=chosen.why)
    say("retrain: %s %s: %s", name, verdict, found["why"])
    return {
        "checkpoint": checkpoint,
        "report": report,
        "new": name not in known,
        "promoted": found["promoted"],
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Chosen:
    """How the contender was trained."""

    why: str
    more: Overrides
    """Overrides of the settings that were asked for."""


def choose(root: Path, config: TrainConfig, champion: str | None, share: float) -> Chosen:
    """Train from scratch and on from the champion, where that is possible; the better one of both
    on validation."""
    from relevance.training import continued

    if champion is None or not share or config.start or config.continues:
        return Chosen(why="Trained from scratch.", more={})
    try:
        onward = continued(root, config, champion, share)
    except RelevanceError as error:
        say("retrain: from scratch: %s", error)
        return Chosen(why=f"Trained from scratch: {error}.", more={})
    scratch, its = (_precision(root, train_model(str(root), one, None)) for one in (config, onward))
    figures = (
        f"average precision on validation {its:.3f} after {onward.steps} steps on from "
        f"{champion}, {scratch:.3f} after {config.steps} from scratch"
    )
    say("retrain: %s", figures)
    if its > scratch:  # nan, where validation has no labels, is no better
        return Chosen(
            why=f"Trained on from the champion then: {figures}.",
            more={"continues": onward.continues, "steps": onward.steps},
        )
    return Chosen(why=f"Trained from scratch: {figures}.", more={})


def _precision(root: Path, checkpoint: str) -> float:
    """Of the validation split, as it was measured when training ended."""
    from relevance.store import Dataset
    from relevance.training import precision

    name = absolute(checkpoint).stem
    [row] = Dataset.open(root).read_rows("checkpoints", checkpoint_id=name)
    return precision(json.loads(row["metrics"]))


def _learned(dataset: Dataset, config: TrainConfig) -> Learned:
    """How many training labels there are, how they were made, and by what they are learned."""
    from relevance.networks import Learned

    policy = config.policy
    with dataset.connect(policy=policy, names=("labels",)) as connection:
        found = connection.execute(
            "select count(*) from labels where split = 'train' and policy = ?", [policy]
        ).fetchone()
    made = dataset.labelling
    return Learned(
        labels=found[0] if found else 0,
        labelling=f"{made.planner}/{made.config}/{policy}" if made else policy,
        settings=config.content_hash,
    )


def tried_like(record: Record, learned: Learned) -> list[Event]:
    """What became of checkpoints of equal settings and labels that were made alike, the oldest
    first."""
    return [
        event
        for event in record.history
        if (event.learned.settings, event.learned.labelling)
        == (learned.settings, learned.labelling)
    ]


def enough(like: Sequence[Event], learned: Learned, least_new: float) -> bool:
    """Whether that share of the labels is new since one of these was tried (see `tried_like`).

    Labels that were made otherwise are new, all of them.
    """
    before = [event.learned.labels for event in like]
    return not before or learned.labels - max(before) >= max(least_new * learned.labels, 1)
