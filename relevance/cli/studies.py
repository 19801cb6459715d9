"""The subcommand `study`: many networks trained and judged, in one table."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from relevance.cli.arguments import (
    Command,
    DatasetArg,
    OptionalCount,
    Preset,
    Workers,
    at_least,
    over_zero,
)
from relevance.cli.bench import hand_over
from relevance.cli.processes import pools
from relevance.cli.terminal import bar, say

StudyArg = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="STUDY")]
Words = Annotated[tuple[str, ...], tyro.conf.arg(metavar="WORD")]
OptionalMinutes = Annotated[float | None, tyro.conf.arg(metavar="MIN")]


def _study(_: Preset) -> Callable[..., int]:
    def study(
        dataset: DatasetArg,
        study: StudyArg,
        minutes: OptionalMinutes = None,
        workers: Workers = 1,
        only: Words = (),
        device: str = "cpu",
        goals: OptionalCount = None,
        out: Path = Path("data/studies"),
        models: Path = Path("data/models"),
    ) -> int:
        """Train a declared set of networks, each for some time of a core, and judge them.

        bodies: the five bodies by the fair recipe, the paper's three by its own, `on` alone,
        three ways of polling. data: accuracy against scenes, goals of each and time. best: ours
        and geometry for an hour, three seeds. ship: what comes with the package; crowd: what
        learns from many boxes.

        A few steps say how many fit into the time; reading is in it, validation is not. What is
        trained and judged already stays: killed and called again, a study goes on. Checkpoints
        and predictions stay in the dataset. Tables (STUDY.md, STUDY.csv, one line of JSON a run
        in STUDY.jsonl) and pictures of learning (PNG and SVG) are written to a folder.

        Args:
            dataset: Folder of a labelled dataset.
            study: Which set.
            minutes: Of a core, for each run; the study's own when not given.
            workers: Networks that are trained at a time, each on one thread.
            only: Runs with one of these words in their names; all when not given.
            device: Where they are trained.
            goals: Of each scene and predicate, the most that networks are judged by, 0 for all;
                the study's own when not given.
            out: Folder of the tables.
            models: Where what comes with the package is written to (study ship, study crowd).
        """
        from relevance.benchmarks.studies import markdown, tabulate
        from relevance.evaluation import calibrate, tune_once
        from relevance.store import replacing
        from relevance.training import Plan, TrainConfig, find_checkpoint, run_study, ship

        over_zero("--minutes", minutes)
        at_least("--goals", goals, 0)
        more = {"only": only, "device": device, "folder": out}
        plan = Plan.of(dataset, study, minutes=minutes, goals=goals, **more)

        rows = run_study(plan, pooled=pools(workers), told=say)
        with bar("runs judged") as progress:
            measured = tabulate(dataset, study, rows, progress)
        hand_over(measured, out)
        with replacing(out / f"{study}.md") as temporary:
            temporary.write_text(markdown(measured.tables))
        for row in rows:
            if row["ship"]:
                config = TrainConfig.from_dict(row["config"])
                with bar("tasks") as progress:
                    made = find_checkpoint(dataset, row["checkpoint_id"])
                    tune_once(dataset, made, progress=progress)
                path = ship(dataset, config, models, name=row["ship"])
                with bar("shards scored") as progress:
                    calibrate(dataset, path, progress=progress)
                print(path)
        return 0

    return study


COMMANDS = {
    "study": Command(
        make=_study,
        about="train and judge a declared set of networks, in one table",
        examples=(
            "relevance study data/tables bodies --workers 2",
            "relevance study data/tables data --minutes 5 --only geometry",
            "relevance study data/tables ship",
        ),
    ),
}
