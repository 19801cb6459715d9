"""Subcommands that make datasets: estimate, generate, label, append, repair, suite, mine."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from relevance.cli.arguments import (
    CORES,
    Command,
    DatasetArg,
    DatasetPreset,
    OptionalCount,
    OptionalName,
    OptionalPath,
    Preset,
    Workers,
    at_least,
    check_workers,
)
from relevance.cli.processes import make, processes
from relevance.cli.terminal import Format, bar, say, show
from relevance.workers import gather


def _estimate(preset: DatasetPreset) -> Callable[..., int]:
    from relevance.pipeline import DatasetConfig, Quantities, actual, estimate, load_config
    from relevance.pipeline.estimating import Estimate, Job
    from relevance.store import Dataset, locate

    start: DatasetConfig = getattr(DatasetConfig, preset)()

    def quantities(found: Quantities, workers: int) -> list[tuple[str, float]]:
        return [
            ("scenes", found.scenes),
            ("goals", found.goals),
            ("plans that hold", found.plans),
            ("label rows", found.labels),
            ("gigabytes", found.gigabytes),
            ("process hours, scenes", found.hours_scenes),
            ("process hours, labels", found.hours_labels),
            ("hours", found.hours / workers),
        ]

    def estimating(
        dataset: DatasetArg,
        preset: DatasetPreset = preset,
        sample: int = 32,
        workers: Workers = CORES,
        format: Format = "table",
        config: Annotated[DatasetConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Tell rows, gigabytes and hours before a dataset is made; how far off it was after.

        Makes a sample of scenes and plans on this machine, says what the whole comes to, and
        keeps that in DATASET/estimate.json. For a dataset that is there, prints what it holds
        and took beside what was estimated, or measures now if that was nothing or of other
        settings.

        Args:
            dataset: Folder of the dataset, there or to be made.
            preset: Where the settings start from.
            sample: Scenes of each family that are made to measure.
            workers: Processes that will work at a time.
            format: How to print the rows.
        """
        at_least("--sample", sample, 4)
        check_workers(workers)
        there = (locate(dataset) / "dataset.json").is_file()
        wanted = load_config(Dataset.open(dataset)) if there else config
        found = Estimate.read(dataset)
        if found is None or found.config_hash != wanted.content_hash:

            def run(jobs: Sequence[Job]) -> list[Any]:
                units = {
                    str(number): _Unit(functools.partial(stage, *given), given[2].count)
                    for number, (stage, given) in enumerate(jobs)
                }
                total = sum(unit.size for unit in units.values())
                with processes("sample scenes", total, workers) as outcomes:
                    made = gather("estimate", units, outcomes, made=lambda _: None, warn=say)
                return [made[name] for name in units]

            found = estimate(wanted, sample=sample, workers=workers, run=run)
            found.write(dataset)
        columns = ["quantity", "estimate"]
        rows = [[name, value] for name, value in quantities(found.quantities, found.workers)]
        if there:
            real = quantities(actual(dataset), found.workers)
            columns += ["actual", "actual / estimate"]
            rows = [
                [*row, value, value / row[1] if row[1] else None]
                for row, (_, value) in zip(rows, real, strict=True)
            ]
        show(columns, rows, format, title=f"{dataset}, {found.workers} processes")
        if found.queries and format == "table":
            names, asked = _beside_paper(found.queries)
            show(names, asked, format, title="Queries, beside the paper's")
        say(
            f"from {found.sample_scenes} scenes and {found.sample_goals} goals; "
            f"planning time give or take {found.uncertainty:.0%}"
        )
        return 0

    return estimating


def _beside_paper(queries: Sequence[Any]) -> tuple[list[str], list[list[Any]]]:
    """Columns and rows of the queries that are foreseen, the paper's of that split beside them."""
    from relevance.report.paper import paper

    theirs = {
        (name, split): (scenes[name], found.relevant, found.irrelevant, found.share)
        for split, scenes, counts in (
            ("train", paper().scenes, paper().train),
            ("test", paper().test_scenes, paper().test),
        )
        for name, found in counts.items()
        if name in scenes
    }
    names = ["scenes", "relevant", "irrelevant", "share"]
    rows = [
        [
            *(q.group, q.split, q.scenes, q.relevant, q.irrelevant, q.share),
            *theirs.get((q.group, q.split), (None,) * len(names)),
        ]
        for q in queries
        if q.scenes
    ]
    return ["queries of", "split", *names, *(f"paper's {name}" for name in names)], rows


@dataclasses.dataclass(frozen=True, slots=True)
class _Unit:
    run: Callable[..., Any]
    size: int


def _generate(preset: DatasetPreset) -> Callable[..., int]:
    from relevance.pipeline import DatasetConfig, scenes_work

    start: DatasetConfig = getattr(DatasetConfig, preset)()

    def generate(
        dataset: DatasetArg,
        preset: DatasetPreset = preset,
        workers: Workers = CORES,
        config: Annotated[DatasetConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Make random scenes and render them; finished shards are skipped.

        Args:
            dataset: Folder of the dataset; made when it is not there.
            preset: Where the other settings start from.
            workers: Processes that work at a time.
        """
        check_workers(workers)
        made = make("scenes", scenes_work(dataset, config), workers)
        say(f"{dataset}: {made.summary}")
        return 0

    return generate


def _label(_: Preset) -> Callable[..., int]:
    from relevance.pipeline import labels_work
    from relevance.scene import PREDICATES
    from relevance.store import sql

    def label(
        dataset: DatasetArg,
        predicates: tuple[str, ...] = tuple(PREDICATES),
        policy: OptionalName = None,
        replan: bool = False,
        goals_per_scene: OptionalCount = None,
        goals_seed: OptionalCount = None,
        workers: Workers = CORES,
    ) -> int:
        """Plan the goals of a dataset's scenes and label what each plan moves.

        Finished shards are skipped. Other labels never replace those that are there: another
        policy's lie beside them, and after --replan the old plans and labels do.

        Args:
            dataset: Folder of the dataset.
            predicates: Which predicates to plan.
            policy: found, necessary or any-minimal; the dataset's own when not given.
            replan: Plan anew with the planner of today, if that is another one.
            goals_per_scene: Plan another number of goals a scene (and replan).
            goals_seed: Plan another draw of goals (and replan).
            workers: Processes that work at a time.
        """
        check_workers(workers)
        at_least("--goals-per-scene", goals_per_scene, 1)
        at_least("--goals-seed", goals_seed, 0)
        work = labels_work(
            dataset,
            predicates=predicates,
            policy=policy,
            replan=replan,
            goals_per_scene=goals_per_scene,
            goals_seed=goals_seed,
        )
        made = make("scenes labelled", work, workers)
        _, [(tasks, holds)] = sql(dataset, "select count(*), count_if(holds) from plans")
        say(f"{dataset}: {made.summary}")
        say(f"{dataset}: {tasks} goals, {holds} have a plan that holds")
        return 0

    return label


def _append(_: Preset) -> Callable[..., int]:
    def append(
        dataset: DatasetArg,
        split: Literal["train", "validation", "test"] = "train",
        same_plane: int = 0,
        on: int = 0,
        stacks: int = 0,
    ) -> int:
        """Add scenes to a dataset, as further shards; nothing that is there is touched.

        They are made by the next `relevance generate DATASET --preset ...` or, at once, by
        `relevance repair DATASET`, which makes whatever is missing.

        Args:
            dataset: Folder of the dataset.
            split: Which split grows.
            same_plane: How many scenes for the same-plane predicates.
            on: How many scenes for `on`, one box on another.
            stacks: How many scenes with stacks everywhere.
        """
        from relevance.pipeline import append

        specs = append(dataset, split, same_plane=same_plane, on=on, stacks=stacks)
        say(f"{dataset}: {len(specs)} shards now")
        return 0

    return append


def _repair(_: Preset) -> Callable[..., int]:
    def repair(dataset: DatasetArg, workers: Workers = CORES) -> int:
        """Make anew what `relevance check` finds broken, and what is missing; equal bytes.

        Exit code 1 when something is left that cannot be made again: dataset.json itself,
        checkpoints, predictions, evaluations.

        Args:
            dataset: Folder of the dataset.
            workers: Processes that work at a time.
        """
        from relevance.pipeline import beyond_repair, missing
        from relevance.pipeline.checking import check

        check_workers(workers)
        with bar("files checked") as progress:
            named = [breach.file for breach in check(dataset, progress=progress)]
        for name in dict.fromkeys(named):
            say(f"broken: {name}")
        for name, why in beyond_repair(dataset, named).items():
            say(f"left as it is: {name}: {why}")
        for work in missing(dataset, named):
            make("shards made anew", work, workers)
        with bar("files checked") as progress:
            left = check(dataset, progress=progress)
        for breach in left:
            print(breach)
        say(f"{dataset}: {len(left)} breaches are left" if left else f"{dataset}: whole")
        return 1 if left else 0

    return repair


def _suite(_: Preset) -> Callable[..., int]:
    def suite(
        name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")],
        out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
        scenes: int = 100,
        workers: Workers = CORES,
    ) -> int:
        """Make a test set that is drawn otherwise than what networks learn from, labels too.

        `relevance suites` says which there are. Started again with more scenes it grows.

        Args:
            name: Which one, e.g. boxes-20.
            out: Folder of the dataset.
            scenes: Scenes of each of its families.
            workers: Processes that work at a time.
        """
        from relevance.evaluation import SUITES
        from relevance.pipeline import labels_work, scenes_work

        at_least("--scenes", scenes, 1)
        check_workers(workers)
        config = SUITES[name].config(scenes)
        made = make("scenes", scenes_work(out, config), workers)
        say(f"{out}: {made.summary}")
        made = make("scenes labelled", labels_work(out), workers)
        say(f"{out}: {made.summary}")
        return 0

    return suite


def _mine(_: Preset) -> Callable[..., int]:
    from relevance.pipeline import MiningConfig

    start = MiningConfig()

    def mine(
        dataset: DatasetArg,
        out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
        checkpoint: OptionalPath = None,
        workers: Workers = CORES,
        config: Annotated[MiningConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Make training scenes of a checkpoint's failures on validation scenes, labels too.

        Looks at every second validation shard, copies the scenes in which the checkpoint leaves
        out something relevant, nearly, and asks the goals that failed. `relevance merge DATASET OUT
        --into BOTH` joins both: the shards that were looked at are no validation shards there.

        Args:
            dataset: Folder of a labelled dataset.
            out: Folder of the new dataset.
            checkpoint: The model, a file or an id; the dataset's champion, else its newest.
            workers: Processes that work at a time.
        """
        from relevance.evaluation import load_scorer, predict
        from relevance.pipeline import labels_work, minable, mine, mined_of, scenes_work
        from relevance.store import Dataset
        from relevance.training import find_checkpoint

        check_workers(workers)
        path = find_checkpoint(dataset, checkpoint)
        scorer = load_scorer(path)
        kinds = {spec.family for spec in minable(Dataset.open(dataset))}

        def score(shards: Sequence[int]) -> None:
            with bar("shards scored") as progress:
                predict(dataset, path, split="validation", shards=shards, progress=progress)

        made = mine(dataset, out, scorer.checkpoint_id, config, score=score, policy=scorer.policy)
        if found := mined_of(Dataset.open(out)):
            goals = sum(len(failed.scene["goals"]) for failed in found.failed)
            spared = f"kinds with a shard to spare: {', '.join(sorted(kinds))}"
            say(
                f"{out}: {goals} goals failed in {len(found.failed)} of {len(found.looked_at)} "
                f"validation scenes ({spared})"
            )
        say(f"{out}: {make('scenes', scenes_work(out, made), workers).summary}")
        say(f"{out}: {make('scenes labelled', labels_work(out), workers).summary}")
        return 0

    return mine


COMMANDS = {
    "estimate": Command(
        make=_estimate,
        presets=get_args(DatasetPreset),
        about="rows, gigabytes and hours before a dataset is made, and how far off after",
        examples=("relevance estimate data/tables --preset laptop",),
    ),
    "generate": Command(
        make=_generate,
        presets=get_args(DatasetPreset),
        about="random scenes, rendered",
        examples=(
            "relevance generate data/tables --preset laptop --seed 7",
            "relevance generate data/few --preset smoke --train.on 0 --workers 1",
        ),
    ),
    "label": Command(
        make=_label,
        about="plans and labels for a dataset's scenes",
        examples=(
            "relevance label data/tables",
            "relevance label data/tables --predicates on",
            "relevance label data/tables --policy necessary",
        ),
    ),
    "append": Command(
        make=_append,
        about="more scenes for a dataset",
        examples=("relevance append data/tables --split train --on 500",),
    ),
    "repair": Command(
        make=_repair,
        about="make anew what is broken or missing",
        examples=("relevance repair data/tables",),
    ),
    "suite": Command(
        make=_suite,
        about="a test set away from what networks learned from",
        examples=("relevance suite boxes-20 data/boxes-20 --scenes 50",),
    ),
    "mine": Command(
        make=_mine,
        about="training scenes of what a model got wrong",
        examples=(
            "relevance mine data/tables data/mined --copies 4",
            "relevance mine data/tables data/random --copies 4 --random",
        ),
    ),
}
