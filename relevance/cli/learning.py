"""Subcommands about models: train, ship, tune, evaluate, calibrate, coverage."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from relevance.cli.arguments import (
    Command,
    DatasetArg,
    OptionalName,
    OptionalPath,
    Preset,
    at_least,
)
from relevance.cli.terminal import Format, bar, say, show


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
        """Make a model that comes with the package: train it, choose when it looks as `lazy`, halve
        it, write a page about it, calibrate it.

        What was trained with these settings on this dataset is taken. Prints the path.

        Args:
            dataset: Folder of a labelled dataset.
            out: Folder of the models; those of a checkout are in data/models.
            name: What it is called; the body when not given.
        """
        from relevance.evaluation import calibrate, tune_once
        from relevance.training import ship, train

        with bar("steps") as progress:
            checkpoint = train(dataset, config, progress=progress)
        with bar("tasks") as progress:
            tune_once(dataset, checkpoint, progress=progress)
        with bar("steps") as progress:
            path = ship(dataset, config, out, name=name or "", progress=progress)
        with bar("shards scored") as progress:
            calibrate(dataset, path, progress=progress)
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
            checkpoint: The model, a file or an id; the dataset's champion, else its newest.
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
            checkpoint: The model, a file or an id; the dataset's champion, else its newest.
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


def _calibrate(_: Preset) -> Callable[..., int]:
    def calibrate(
        dataset: DatasetArg,
        checkpoint: OptionalPath = None,
        split: Literal["validation", "test"] = "validation",
        format: Format = "table",
    ) -> int:
        """Learn how much to keep so that nothing relevant is left out, with a stated probability.

        Stored in the checkpoint's file, for `relevance plan --coverage 0.95`. What was there of
        another calibration is replaced. Prints the beta of each predicate.

        Args:
            dataset: Folder of a labelled dataset whose scenes are drawn as those to come.
            checkpoint: The model, a file or an id; the dataset's champion, else its newest.
            split: Whose scenes; never those that it was trained on.
            format: How to print the rows.
        """
        from relevance import evaluation
        from relevance.training import find_checkpoint

        path = find_checkpoint(dataset, checkpoint)
        with bar("shards scored") as progress:
            found = evaluation.calibrate(dataset, path, split=split, progress=progress)
        columns = ("predicate", "family", "scenes", "goals", *map(_percent, evaluation.LEVELS))
        rows = [
            [name, family, needs.scenes, needs.goals, *map(needs.beta, evaluation.LEVELS)]
            for name, families in found.needs.items()
            for family, needs in families.items()
        ]
        show(columns, rows, format, title=f"beta that keeps all that is relevant: {path}")
        return 0

    return calibrate


def _coverage(preset: Preset) -> Callable[..., int]:
    from relevance.evaluation import LEVELS

    def coverage(
        dataset: DatasetArg,
        checkpoint: OptionalPath = None,
        levels: Annotated[tuple[float, ...], tyro.conf.arg(metavar="SHARE")] = LEVELS,
        split: Literal["validation", "test"] = "test",
        tasks: int = 0,
        format: Format = "table",
    ) -> int:
        """Hold a calibrated checkpoint to its promises: what was kept whole of unseen goals.

        One goal a scene counts for the exact 95% interval (low, high): goals of one scene are not
        independent. `breached` says that the whole interval lies below what was promised.

        Args:
            dataset: Folder of a labelled dataset, any.
            checkpoint: The model, a file or an id; the dataset's champion, else its newest.
            levels: The coverages to look at.
            split: Whose scenes.
            tasks: Goals of each predicate that are also planned, unguided and pruned at every
                coverage; 0 plans none.
            format: How to print the rows.
        """
        from relevance import evaluation
        from relevance.store import Dataset
        from relevance.training import find_checkpoint

        at_least("--tasks", tasks, 0)
        path = find_checkpoint(dataset, checkpoint)
        calibration = evaluation.read_calibration(path, levels)
        with bar("shards scored") as progress:
            evaluation.predict(dataset, path, split=split, progress=progress)
        scored = Dataset.open(dataset)
        predictions = evaluation.read_predictions(
            scored, evaluation.checkpoint_id(path), split=split
        )
        for why in evaluation.out_of_reach(predictions, calibration, levels=levels):
            say(why)
        columns = ("goals of", "promised", "reached", "low", "high", "scenes", "all goals")
        columns = (*columns, "beta", "boxes", "kept", "breached")
        rows = [
            [
                *(c.group, c.coverage, c.reached.value, c.reached.low, c.reached.high),
                *(c.reached.n, c.reached_all, c.beta, c.objects, c.kept),
                c.breached if format == "json" else "yes" if c.breached else "no",
            ]
            for c in evaluation.covered(predictions, calibration, levels=levels)
        ]
        show(columns, rows, format, title=f"coverage of {path} on {dataset}")
        if tasks:
            guides = "prune", "prune-then-full"  # others leave nothing out
            config = evaluation.EvaluationConfig(tasks=tasks, split=split, guides=guides)
            with bar("tasks") as progress:
                speeds = evaluation.covered_speeds(
                    dataset, path, config, levels=levels, progress=progress
                )
            columns = ("promised", "search", "guide", "tasks", "solvable", "missed", "kept")
            columns = (*columns, "speed-up", "speed-up, misses left out")
            rows = [
                [
                    *(level, c.search, c.guide, c.n_tasks, c.n_solvable, c.misses, c.kept),
                    *(c.speedup.value, c.speedup_both.value),
                ]
                for level, found in speeds.items()
                for c in found
            ]
            show(columns, rows, format, title="speed-up at each coverage, misses counted")
        return 0

    return coverage


def _percent(share: float) -> str:
    return f"{100 * share:g}%"


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
    "calibrate": Command(
        make=_calibrate,
        about="how much to keep for a promised recall",
        examples=("relevance calibrate data/tables",),
    ),
    "coverage": Command(
        make=_coverage,
        about="what a promised recall came to on unseen scenes",
        examples=(
            "relevance coverage data/tables",
            "relevance coverage data/tables --levels 0.9 0.95 --tasks 40",
        ),
    ),
}
