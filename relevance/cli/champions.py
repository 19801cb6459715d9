"""The subcommand `champion`: which checkpoint of a dataset stands, and why."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
from collections.abc import Callable

import tyro

from relevance.cli.arguments import Command, DatasetArg, OptionalName, Preset, at_least
from relevance.cli.terminal import Format, UsageError, bar, say, show


def _champion(_: Preset) -> Callable[..., int]:
    from relevance.evaluation import TrialConfig

    start = TrialConfig()

    def champion(
        dataset: DatasetArg,
        promote: OptionalName = None,
        rollback: tyro.conf.FlagCreatePairsOff[bool] = False,
        force: tyro.conf.FlagCreatePairsOff[bool] = False,
        tasks: int = start.tasks,
        boxes: int = start.boxes,
        guide: str = start.guide,
        format: Format = "table",
    ) -> int:
        """Say which checkpoint is the champion and what became of the others; try another.

        A checkpoint is promoted only if, both beyond noise, true relevant does not fall on the
        test split and the planner's work on fresh crowded tasks is less than the champion's (than
        without a guide, where there is none). Refused: exit code 1. The champion is what
        `evaluate`, the flows and load_guide("champion", dataset=...) take.

        Args:
            dataset: Folder of a labelled dataset.
            promote: The checkpoint to try, an id or a file.
            rollback: Put the champion before the present one in its place.
            force: Promote without a trial.
            tasks: Fresh tasks of a trial; 400 take about a minute of CPU.
            boxes: Boxes of each.
            guide: How scores enter the search: any guide that loses no task.
            format: How to print the history.
        """
        from relevance.evaluation import checkpoint_id, contend, load_scorer
        from relevance.networks import crown, find_checkpoint, read_record, roll_back
        from relevance.store import Dataset

        at_least("--tasks", tasks, 2)
        at_least("--boxes", boxes, 3, 30)
        if rollback and promote is not None:
            raise UsageError("--promote and --rollback: expected one of them")
        if force and promote is None:
            raise UsageError("--force: expected --promote beside it")
        there = Dataset.open(dataset)
        if rollback:
            say(f"champion: {roll_back(there, 'by hand')}")
            return 0
        if promote is not None and force:
            path = find_checkpoint(dataset, promote)
            name = load_scorer(path, into=there).checkpoint_id
            crown(there, name, "by hand, without a trial")
            say(f"champion: {name}")
            return 0
        if promote is not None:
            config = TrialConfig(tasks=tasks, boxes=boxes, guide=guide)
            with bar("tasks") as progress:
                trial = contend(dataset, promote, config, progress=progress)
            if trial is None:
                say(f"{checkpoint_id(find_checkpoint(dataset, promote))} is the champion already")
                return 0
            say(f"{'promoted' if trial.promoted else 'refused'}: {trial.why}")
            return 0 if trial.promoted else 1
        record = read_record(there)
        columns = ("at", "checkpoint", "what", "why")
        rows = [[event.at, event.checkpoint_id, event.what, event.why] for event in record.history]
        if rows or format != "table":
            show(columns, rows, format)
        say(f"champion: {record.champion or 'none yet, the newest checkpoint counts'}")
        return 0

    return champion


COMMANDS = {
    "champion": Command(
        make=_champion,
        about="which checkpoint of a dataset stands; try another",
        examples=(
            "relevance champion data/demo",
            "relevance champion data/demo --promote glimpse-0123456789abcdef",
            "relevance champion data/demo --rollback",
        ),
    ),
}
