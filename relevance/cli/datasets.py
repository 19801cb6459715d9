"""Subcommands that look after datasets: estimate, append, merge, repair, compact, export."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import os
import secrets
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from relevance.cli.arguments import CORES, DatasetArg, Preset, Workers
from relevance.cli.processes import in_processes, make_shards
from relevance.cli.terminal import Format, UsageError, bar, say, show


def _estimate(preset: Preset) -> Callable[..., int]:
    from relevance.pipeline import DatasetConfig, actual, estimate, load_config
    from relevance.pipeline.estimating import Estimate, Job
    from relevance.store import Dataset, locate

    start: DatasetConfig = getattr(DatasetConfig, preset)()

    def estimating(
        dataset: DatasetArg,
        preset: Preset = preset,
        sample: int = 32,
        workers: Workers = CORES,
        format: Format = "table",
        config: Annotated[DatasetConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Tell rows, gigabytes and hours before a dataset is made; how far off it was after.

        Makes a sample of scenes and plans on this machine, says what the whole comes to, and
        keeps that in DATASET/estimate.json. For a dataset that is there, prints what it holds
        and took beside what was estimated, or measures now if nothing was.

        Args:
            dataset: Folder of the dataset, there or to be made.
            preset: Where the settings start from.
            sample: Scenes of each family that are made to measure.
            workers: Processes that will work at a time.
            format: How to print the rows.
        """
        if sample < 4:
            raise UsageError(f"--sample {sample}: expected at least 4")
        there = (locate(dataset) / "dataset.json").is_file()
        wanted = load_config(Dataset.open(dataset)) if there else config
        found = Estimate.read(dataset)
        if found is None or (not there and found.config_hash != wanted.content_hash):

            def run(jobs: Sequence[Job]) -> list[Any]:
                sizes = [job[1][2].count for job in jobs]
                return in_processes("sample scenes", jobs, sizes, workers)

            found = estimate(wanted, sample=sample, workers=workers, run=run)
            found.write(dataset)
        columns = ["quantity", "estimate"]
        rows = [[name, value] for name, value in _quantities(found.quantities, found.workers)]
        if there:
            real = _quantities(actual(dataset), found.workers)
            columns += ["actual", "actual / estimate"]
            rows = [
                [*row, value, value / row[1] if row[1] else None]
                for row, (_, value) in zip(rows, real, strict=True)
            ]
        show(columns, rows, format, title=f"{dataset}, {found.workers} processes")
        say(
            f"from {found.sample_scenes} scenes and {found.sample_goals} goals; "
            f"planning time give or take {found.uncertainty:.0%}"
        )
        return 0

    return estimating


def _quantities(found: Any, workers: int) -> list[tuple[str, float]]:
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


def _append(_: Preset) -> Callable[..., int]:
    def append(
        dataset: DatasetArg,
        split: Literal["train", "validation", "test"] = "train",
        same_plane: int = 0,
        on: int = 0,
    ) -> int:
        """Add scenes to a dataset, as further shards; nothing that is there is touched.

        They are made by the next `relevance generate DATASET --preset ...` or, at once, by
        `relevance repair DATASET`, which makes whatever is missing.

        Args:
            dataset: Folder of the dataset.
            split: Which split grows.
            same_plane: How many scenes for the same-plane predicates.
            on: How many scenes for `on`.
        """
        from relevance.pipeline import append

        specs = append(dataset, split, same_plane=same_plane, on=on)
        say(f"{dataset}: {len(specs)} shards now")
        return 0

    return append


def _merge(_: Preset) -> Callable[..., int]:
    def merge(
        datasets: Annotated[
            tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="DATASET...")
        ],
        into: Path,
    ) -> int:
        """Make a dataset of others by reference: no file is copied, every command works on it.

        Args:
            datasets: The datasets; equal schemas, no scene in common.
            into: Folder of the new one.
        """
        from relevance.pipeline import merge, shards_of

        merged = merge(datasets, into)
        say(f"{into}: {len(shards_of(merged))} shards of {len(merged.sources)} datasets")
        return 0

    return merge


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

        with bar("files checked") as progress:
            named = [breach.file for breach in check(dataset, progress=progress)]
        for name in dict.fromkeys(named):
            say(f"broken: {name}")
        for name, why in beyond_repair(dataset, named).items():
            say(f"left as it is: {name}: {why}")
        for work in missing(dataset, named):
            jobs = [(job.run, ()) for job in work.jobs]
            make_shards(dataset, jobs, [job.size for job in work.jobs], workers)
            work.finish()
        with bar("files checked") as progress:
            left = check(dataset, progress=progress)
        for breach in left:
            print(breach)
        say(f"{dataset}: {len(left)} breaches are left" if left else f"{dataset}: whole")
        return 1 if left else 0

    return repair


def _compact(_: Preset) -> Callable[..., int]:
    def compact(dataset: DatasetArg) -> int:
        """Gather many small label files into few large ones, which queries then read.

        The shards stay; when they change, queries read them again until the next compaction.

        Args:
            dataset: Folder of the dataset.
        """
        from relevance.store import Dataset, compact

        rows = compact(Dataset.open(dataset))
        say(f"{dataset}: {sum(rows.values())} rows gathered")
        return 0

    return compact


def _export(_: Preset) -> Callable[..., int]:
    def export(
        dataset: DatasetArg,
        out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
    ) -> int:
        """Write a dataset for Hugging Face `datasets`: Parquet with image bytes, and a card.

        Args:
            dataset: Folder of the dataset.
            out: Folder to write, empty or not there yet.
        """
        from relevance.store import Dataset, export

        with bar("files") as progress:
            path = export(Dataset.open(dataset), out, progress)
        print(path)
        return 0

    return export


Part = Literal["making", "reading", "queries", "crashes"]
PARTS: tuple[Part, ...] = ("making", "reading", "queries", "crashes")
OptionalSeed = Annotated[int | None, tyro.conf.arg(metavar="N")]
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


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

        Writes tables and a CSV file for each part; the datasets themselves are not kept.

        Args:
            scenes: Scenes of each family whose goals are labelled, once by 1 process and once by 2;
                scenes themselves are timed in shards of the laptop preset's size.
            rows: Synthetic label rows to query.
            shards: Files that they are in, for each predicate.
            kills: How often the making of a small dataset is disturbed.
            seed: Remakes an earlier run; a fresh one when not given.
            out: Folder for tables and rows; data/bench/dataset-SEED when not given.
            parts: What to measure.
        """
        if min(scenes, rows, shards, kills) < 1:
            raise UsageError("--scenes, --rows, --shards, --kills: expected at least 1")
        seed = secrets.randbits(31) if seed is None else seed
        folder = out or Path("data/bench") / f"dataset-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        say(f"seed {seed}, pid {os.getpid()}, to {folder}")
        from relevance.benchmarks import datasets
        from relevance.cli.bench import hand_over

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


COMMANDS: dict[str, tuple[Callable[[Preset], Callable[..., int]], dict[str, Any]]] = {
    "estimate": (
        _estimate,
        {
            "about": "rows, gigabytes and hours before a dataset is made, and how far off after",
            "examples": ("relevance estimate data/tables --preset laptop",),
        },
    ),
    "append": (
        _append,
        {
            "about": "more scenes for a dataset",
            "examples": ("relevance append data/tables --split train --on 500",),
        },
    ),
    "merge": (
        _merge,
        {
            "about": "several datasets as one, by reference",
            "examples": ("relevance merge data/tables data/more --into data/both",),
        },
    ),
    "repair": (
        _repair,
        {
            "about": "make anew what is broken or missing",
            "examples": ("relevance repair data/tables",),
        },
    ),
    "compact": (
        _compact,
        {
            "about": "gather small label files, for fast queries",
            "examples": ("relevance compact data/tables",),
        },
    ),
    "export": (
        _export,
        {
            "about": "for Hugging Face datasets",
            "examples": ("relevance export data/tables out/tables",),
        },
    ),
    "bench dataset": (
        _bench,
        {
            "about": "making, reading and asking datasets, and what they survive",
            "examples": (
                "relevance bench dataset",
                "relevance bench dataset --parts making --scenes 80",
                "relevance bench dataset --parts crashes --kills 40",
            ),
        },
    ),
}
"""Name -> (maker, what `Command` takes besides)."""
