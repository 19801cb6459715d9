"""The subcommands `bench planner`, `guides`, `dataset`, `training` and `sight`."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import os
import secrets
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from relevance.cli.arguments import Command, Preset, at_least, one_of, over_zero, settings_of
from relevance.cli.bench import bench_planner, hand_over, write, write_scenes
from relevance.cli.terminal import bar, say

Part = Literal["making", "reading", "queries", "crashes"]
PARTS: tuple[Part, ...] = ("making", "reading", "queries", "crashes")
OptionalSeed = Annotated[int | None, tyro.conf.arg(metavar="N")]
Bodies = Annotated[tuple[str, ...], tyro.conf.arg(metavar="BODY")]
Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")]
Sizes = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N")]
EVERY, SHARE = 120.0, 0.05
"""Seconds after which tables and plots of a run that goes on are written again, and the most of its
time that this takes."""
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


def _guides(_: Preset) -> Callable[..., int]:
    def bench(
        tasks: int = 500,
        goals: int = 5,
        sizes: Sizes = (3, 5, 10, 15, 20, 30),
        priors: Names = ("glimpse",),
        guides: Names = (),
        searches: tuple[Literal["tree", "informed"], ...] = ("tree", "informed"),
        node_limit: int = 200_000,
        max_actions: int = 12,
        repeats: int = 1,
        planner: str = "ours",
        seconds: float = 30.0,
        seed: OptionalSeed = None,
        out: OptionalFolder = None,
    ) -> int:
        """Measure what guides save the planner, by the number of boxes, on fresh random tasks.

        Each task is planned unguided, with every prior and guide, and with true labels, in turns in
        one process. Prints tables and writes them (summary.json), one row a run (guides.csv), the
        scenes and plots, now and then: a killed run goes on with --out and the same
        settings, more tasks or sizes included. For steady times let nothing else run.

        Args:
            tasks: How many tasks of each size.
            goals: Most goals of a scene; the look is given alone and shared by them.
            sizes: Numbers of boxes.
            priors: Who scores the objects: models of the package (glimpse, crowd,
                geometry), files (model.pt), or true, all, none, random, distance, swept. True
                labels are always rerun.
            guides: How the scores enter the search: prune, prune-then-full, expand, order,
                shortest, lazy; order and lazy when not given, of another planner prune-then-full.
            searches: The paper's breadth-first tree, our informed search, or both.
            node_limit: Most nodes that a search may open for a goal.
            max_actions: Most picks and places in a plan.
            repeats: Timed runs of each task and guide; the median counts.
            planner: Whose planner is guided: ours, or another of relevance.planner.PLANNERS (rai),
                once a guide: what it solves unguided is asked further, the replay judges its
                plans. Then searches, node limit and repeats mean nothing.
            seconds: CPU seconds that another planner has for a task and a guide.
            seed: Remakes the tasks of an earlier run; a fresh one when not given.
            out: Folder for rows, tables and plots; data/bench/guides-SEED when not given.
        """
        from relevance.planner import PLANNERS, PlannerConfig

        for flag, count in (("tasks", tasks), ("goals", goals), ("node-limit", node_limit)):
            at_least(f"--{flag}", count, 1)
        at_least("--max-actions", max_actions, 2)
        at_least("--repeats", repeats, 1)
        at_least("--seed", seed, 0, 2**31)
        for size in sizes:
            at_least("--sizes", size, 3)
        over_zero("--seconds", seconds)
        PLANNERS[planner].require()
        seed = secrets.randbits(31) if seed is None else seed
        folder = out or Path("data/bench") / f"guides-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        say(f"seed {seed}, pid {os.getpid()}, to {folder}")
        from relevance import benchmarks

        ours = planner == benchmarks.OURS
        limits = PlannerConfig(node_limit=node_limit, max_actions=max_actions)
        settings = benchmarks.Settings(
            seed=seed,
            goals=goals,
            searches=searches,
            priors=priors,
            guides=guides or (("order", "lazy") if ours else ("prune-then-full",)),
            repeats=repeats,
            planner=limits,
            by=planner,
            peer=None if ours else settings_of(PLANNERS[planner].Config, seconds=seconds),
        )
        measured = benchmarks.measured_guides if ours else benchmarks.measured_peer
        rows, due = [], time.monotonic() + EVERY
        with bar("tasks") as progress:
            for rows in benchmarks.rerun_guides(
                settings,
                folder,
                tasks=tasks,
                sizes=sizes,
                scenes=partial(write_scenes, folder / "scenes.jsonl", mode="a"),
                progress=progress,
            ):
                if (began := time.monotonic()) > due:
                    write(measured(rows), folder, summary=True)
                    took = time.monotonic() - began
                    due = began + took + max(EVERY, took / SHARE)
        hand_over(measured(rows), folder, summary=True)
        return 0

    return bench


def _bench(_: Preset) -> Callable[..., int]:
    def bench(
        scenes: int = 320,
        rows: int = 50_000_000,
        shards: int = 100,
        kills: int = 24,
        seed: OptionalSeed = None,
        out: OptionalFolder = None,
        parts: tuple[Part, ...] = PARTS,
    ) -> int:
        """Measure how datasets are made, read and asked, and kill processes that make one.

        Prints tables and writes a CSV file for each part; the datasets themselves are not kept.

        Args:
            scenes: Scenes of each family whose goals are labelled, once by 1 process and once by 2;
                scenes themselves are timed in shards of the laptop preset's size.
            rows: Synthetic label rows to query.
            shards: Files that they are in, for each predicate.
            kills: How often the making of a small dataset is disturbed.
            seed: Remakes an earlier run; a fresh one when not given.
            out: Folder for rows and plots; data/bench/dataset-SEED when not given.
            parts: What to measure.
        """
        for flag, count in (("scenes", scenes), ("rows", rows), ("shards", shards)):
            at_least(f"--{flag}", count, 1)
        at_least("--kills", kills, 1)
        at_least("--seed", seed, 0, 2**31)
        seed = secrets.randbits(31) if seed is None else seed
        folder = out or Path("data/bench") / f"dataset-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        say(f"seed {seed}, pid {os.getpid()}, to {folder}")
        from relevance.benchmarks import datasets

        with tempfile.TemporaryDirectory(prefix="relevance-bench-") as scratch:
            place = Path(scratch)
            if "making" in parts:
                with bar("units of work") as progress:
                    made = datasets.measure_making(
                        place, scenes=scenes, seed=seed, progress=progress
                    )
                hand_over(made, folder)
            if "reading" in parts:
                hand_over(datasets.measure_reading(place, seed=seed), folder)
            if "queries" in parts:
                with bar("files") as progress:
                    asked = datasets.measure_queries(
                        place, rows=rows, shards=shards, progress=progress
                    )
                hand_over(asked, folder)
            if "crashes" in parts:
                with bar("disturbances") as progress:
                    survived = datasets.measure_crashes(
                        place, kills=kills, seed=seed, progress=progress
                    )
                hand_over(survived, folder)
        return 0

    return bench


def _training(_: Preset) -> Callable[..., int]:
    from relevance.training import TrainConfig

    def bench(
        sizes: tuple[Literal["cpu", "paper"], ...] = ("cpu",),
        bodies: Bodies = (),
        scenes: int = 4,
        goals: int = 4,
        objects: int = 10,
        queries: int = 50,
        seconds: float = 2.0,
        device: str = TrainConfig().device,
        bfloat16: Literal["auto", "on", "off"] = TrainConfig().bfloat16,
        out: OptionalFolder = None,
    ) -> int:
        """Measure how fast every body trains and looks, on made-up pictures.

        Queries a second are given twice: with one encoding of a scene for all its goals where
        the body can share it, and with an encoding for every query, as in the paper. On a CPU
        times are those of one core.

        (`relevance study DATASET bodies` says what every body learns in equal time.)

        Args:
            sizes: Widths that a CPU can train, the paper's, or both.
            bodies: Which; all when not given.
            scenes: Of a batch.
            goals: Of each scene.
            objects: In each scene; each is asked about in every goal.
            queries: Of a batch that encodes each alone.
            seconds: How long each of a body's three measurements goes on.
            device: Where; auto is the accelerator if there is one.
            bfloat16: As of `relevance train`.
            out: Folder for the table's rows as CSV; data/bench/training when not given.
        """
        from relevance.benchmarks.training import measure_training
        from relevance.models import BODIES, unequal

        for flag, count in (("scenes", scenes), ("goals", goals), ("queries", queries)):
            at_least(f"--{flag}", count, 1)
        at_least("--objects", objects, 3)
        at_least("--seconds", seconds, 0)
        for body in bodies:
            one_of("--bodies", body, BODIES)
        folder = out or Path("data/bench/training")
        folder.mkdir(parents=True, exist_ok=True)
        with bar("bodies") as progress:
            measured = measure_training(
                TrainConfig(device=device, bfloat16=bfloat16),
                sizes=sizes,
                bodies=bodies,
                scenes=scenes,
                goals=goals,
                objects=objects,
                queries=queries,
                seconds=seconds,
                progress=progress,
            )
        hand_over(measured, folder)
        for line in unequal(bodies or BODIES):
            print(line)
        return 0

    return bench


def _sight(_: Preset) -> Callable[..., int]:
    def bench(
        dataset: tyro.conf.Positional[Path],
        sees: str = "glimpse",
        told: str = "geometry",
        split: Literal["train", "validation", "test"] = "test",
        scenes: int = 60,
        out: OptionalFolder = None,
    ) -> int:
        """Measure what seeing costs: where objects are seen, and which part of it costs accuracy.

        A network that is told where objects are is told what another one sees instead, all of it
        or a part.

        Args:
            dataset: Folder of a labelled dataset.
            sees: Checkpoint of a body that sees where objects are: an id, a file, a name.
            told: Checkpoint of a body that is told that.
            split: Whose scenes.
            scenes: The first so many of each shard.
            out: Folder for tables (summary.json) and rows (CSV); data/bench/sight when not given.
        """
        from relevance.benchmarks.sight import measure_sight

        at_least("--scenes", scenes, 1)
        folder = out or Path("data/bench/sight")
        folder.mkdir(parents=True, exist_ok=True)
        with bar("shards") as progress:
            measured = measure_sight(
                dataset, sees=sees, told=told, split=split, scenes=scenes, progress=progress
            )
        hand_over(measured, folder, summary=True)
        return 0

    return bench


COMMANDS = {
    "bench planner": Command(
        make=bench_planner,
        about="the planner's speed, truth, stability and completeness",
        examples=(
            "relevance bench planner --tasks 1000",
            "relevance bench planner --tasks 200 --seed 7 --parts speed truth",
            "relevance bench planner --tasks 60 --against rai",
        ),
    ),
    "bench guides": Command(
        make=_guides,
        about="what guides save the planner, by the number of boxes",
        examples=(
            "relevance bench guides",
            "relevance bench guides --tasks 30 --sizes 10 20 --seed 7",
            "relevance bench guides --priors glimpse geometry swept --guides order lazy expand",
        ),
    ),
    "bench dataset": Command(
        make=_bench,
        about="making, reading and asking datasets, and what they survive",
        examples=(
            "relevance bench dataset",
            "relevance bench dataset --parts making --scenes 80",
            "relevance bench dataset --parts crashes --kills 40",
        ),
    ),
    "bench training": Command(
        make=_training,
        about="how fast every body trains and looks",
        examples=(
            "relevance bench training",
            "relevance bench training --sizes paper --device cuda --scenes 16 --seconds 20",
        ),
    ),
    "bench sight": Command(
        make=_sight,
        about="what it costs to see where objects are",
        examples=("relevance bench sight data/tables",),
    ),
}
