"""Subcommands about models: train, ship, tune, evaluate."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro

from relevance.cli.arguments import Command, DatasetArg, OptionalName, OptionalPath, Preset
from relevance.cli.terminal import bar, say, show


def _start(preset: str, body: str | None) -> Any:
    """The settings of a preset of training, with another body if one is named."""
    from relevance.training import TrainConfig

    start: TrainConfig = getattr(TrainConfig, preset)()
    return start if body is None else start.with_body(body)


def _train(preset: str, body: str | None = None) -> Callable[..., int]:
    from relevance.training import TrainConfig

    start = _start(preset, body)

    # --preset is a setting of TrainConfig itself.
    def train(
        dataset: DatasetArg,
        out: OptionalPath = None,
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Train a relevance model; prints the path of its checkpoint.

        Args:
            dataset: Folder of a labelled dataset.
            out: Another folder for the checkpoint than DATASET/checkpoints.
        """
        from relevance.training import train

        with bar("steps") as progress:
            path = train(dataset, config, out=out, progress=progress)
        print(path)
        return 0

    return train


def _ship(preset: str, body: str | None = None) -> Callable[..., int]:
    from relevance.training import TrainConfig

    start = _start(preset, body)

    def ship(
        dataset: DatasetArg,
        out: Path = Path("data/models"),
        name: OptionalName = None,
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Make a model that comes with the package: train it, halve it, write a page about it.

        What was trained with these settings on this dataset is taken. Prints the path.

        Args:
            dataset: Folder of a labelled dataset.
            out: Folder of the models; those of a checkout are in data/models.
            name: What it is called; the body when not given.
        """
        from relevance.training import ship

        with bar("steps") as progress:
            path = ship(dataset, config, out, name=name or "", progress=progress)
        print(path)
        return 0

    return ship


def _tune(_: Preset) -> Callable[..., int]:
    from relevance.evaluation import TuningConfig

    start = TuningConfig()

    def tune(
        dataset: DatasetArg,
        checkpoint: OptionalPath = None,
        config: Annotated[TuningConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Choose when a lazy guide looks: the work that saves most on validation tasks.

        It is kept in the checkpoint's file, where guides find it; its id stays.

        Args:
            dataset: Folder of a labelled dataset.
            checkpoint: The model, a file or an id; the dataset's newest when not given.
        """
        from relevance import evaluation
        from relevance.training import find_checkpoint

        path = find_checkpoint(dataset, checkpoint)
        with bar("tasks") as progress:
            tuned = evaluation.tune(dataset, path, config, progress=progress)
        columns = ("patience", "work a task", "of unguided", "looked")
        rows = [
            (
                one.patience,
                one.work / tuned.runs,
                one.work / max(tuned.unguided, 1),
                one.looks / tuned.runs,
            )
            for one in tuned.tried
        ]
        show(columns, rows, "table", title=f"{tuned.runs} runs, to the first plan, looks included")
        say(f"{path}: a lazy guide looks after work of {tuned.patience}")
        return 0

    return tune


def _evaluate(preset: Preset) -> Callable[..., int]:
    from relevance.evaluation import EvaluationConfig

    start: EvaluationConfig = getattr(EvaluationConfig, preset)()

    def evaluate(
        dataset: DatasetArg,
        checkpoint: OptionalPath = None,
        preset: Preset = preset,
        config: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Rerun the planner on test scenes, unguided and guided by a checkpoint.

        Args:
            dataset: Folder of a labelled dataset.
            checkpoint: The model, a file or an id; the dataset's newest when not given.
            preset: Where the other settings start from.
        """
        from relevance import evaluation
        from relevance.training import find_checkpoint

        path = find_checkpoint(dataset, checkpoint)
        checkpoint_id = evaluation.checkpoint_id(path)
        with bar("shards scored") as progress:
            scored = evaluation.predict(dataset, path, split=config.split, progress=progress)
        with bar("tasks") as progress:
            rows = evaluation.evaluate(dataset, path, config, progress=progress)
        say(f"{dataset}: {scored} predictions, {rows} comparisons of {checkpoint_id}")
        return 0

    return evaluate


COMMANDS = {
    "train": Command(
        make=_train,
        about="a relevance model",
        examples=(
            "relevance train data/tables --preset laptop",
            "relevance train data/tables --steps 3000 --model.body vit --model.width 64",
            "relevance train data/tables --preset fair --model.body resnet",
        ),
        presets=(*get_args(Preset), "fair"),
        decides=("--model.body",),
    ),
    "ship": Command(
        make=_ship,
        about="make a model that comes with the package",
        examples=("relevance ship data/tables --preset laptop --model.body geometry",),
        presets=(*get_args(Preset), "fair"),
        decides=("--model.body",),
    ),
    "tune": Command(
        make=_tune,
        about="choose when a lazy guide looks",
        examples=("relevance tune data/tables", "relevance tune data/tables --tasks 100"),
    ),
    "evaluate": Command(
        make=_evaluate,
        about="rerun the planner with a model's guidance",
        examples=("relevance evaluate data/tables --tasks 100 --guides prune prune-then-full",),
    ),
}
