"""`relevance bench TARGET`: measurements from fresh seeds, printed and written to a folder.

A target is one more maker and one more entry `bench TARGET` of COMMANDS.
"""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import csv
import dataclasses
import functools
import itertools
import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from relevance.cli.arguments import OptionalName, over_zero, settings_of
from relevance.cli.terminal import UsageError, bar, say, show, to_json

Part = Literal["speed", "truth", "stability", "searches", "scaling", "completeness"]
PARTS: tuple[Part, ...] = (
    "speed", "truth", "stability", "searches", "scaling", "completeness",
)  # fmt: skip
Parts = Annotated[tuple[Part, ...] | None, tyro.conf.arg(metavar="PART")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="N")]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
OptionalCheckout = Annotated[Path | None, tyro.conf.arg(metavar="CHECKOUT")]
Count = Annotated[int, tyro.conf.arg(metavar="N")]
Seconds = Annotated[float, tyro.conf.arg(metavar="S")]
Scenes = Literal["ours", "foreign"]
EXCEPTIONS = "exceptions.jsonl"
"""Tasks of all parts in which a referee does better."""
Work = Callable[[Callable[[int, int], None]], Any]
"""A part of the benchmark: called with progress, returns what it measured."""


def bench_planner(_: Any) -> Callable[..., int]:
    """Maker of `relevance bench planner`."""

    def bench(
        tasks: Count = 1000,
        seed: OptionalInt = None,
        out: OptionalPath = None,
        parts: Parts = None,
        scenes: Scenes = "ours",
        against: OptionalName = None,
        unsolved: Count = 0,
        limit: Seconds = 30.0,
        versus: OptionalCheckout = None,
    ) -> int:
        """Measure the planner on random tasks that nothing was tuned on, on one core.

        Prints tables and writes them (summary.json), a CSV file with one row a task for every
        part, the scenes (JSON lines, for `relevance plan`) and plots (PNG and SVG). Tasks in
        which a referee does better than the planner are in exceptions.jsonl.

        Args:
            tasks: How many tasks speed, truth and stability look at; searches and completeness
                take half as many, scaling a 50th for each number of boxes, the growth of
                --versus a tenth.
            seed: Remakes the tasks of an earlier run; a fresh one when not given.
            out: Folder for rows and plots; data/bench/planner-SEED when not given.
            parts: What to measure; everything when not given (with --against or --versus
                only that).
            scenes: How the scenes are drawn: by our sampler, or boxes thrown anywhere within
                reach, as other people make them (scaling and growth: always ours).
            against: Another planner that takes turns with ours on the same tasks: rai, or any other
                that is registered (relevance.planner.PLANNERS).
            unsolved: With --against: how many tasks that ours leaves unsolved the other is asked
                besides, two at a time (at most 100 times as many are drawn for it).
            limit: CPU seconds that the other planner has for a task, where it has such a limit.
            versus: Folder of another checkout of this project, whose planner takes turns with
                this one on the same tasks, and on a tenth as many of 30 boxes.
        """
        _require("--tasks", tasks, tasks >= 1, "at least 1")
        _require("--seed", seed, seed is None or 0 <= seed < 2**63, "0 to 2**63 - 1")
        _require("--unsolved", unsolved, unsolved >= 0, "at least 0")
        _require("--unsolved", unsolved, not unsolved or against is not None, "--against as well")
        over_zero("--limit", limit)
        seed = secrets.randbits(32) if seed is None else seed
        if against:
            from relevance.planner import PLANNERS

            PLANNERS[against].require()
        chosen = parts if parts is not None else () if against or versus else PARTS
        folder = out or Path("data/bench") / f"planner-{seed}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / EXCEPTIONS).unlink(missing_ok=True)
        except OSError as error:
            raise UsageError(f"--out {folder}: {error.strerror}, expected a folder") from None
        say(f"--seed {seed} remakes these tasks; rows and plots go to {folder}")
        tables: list[Any] = []
        work = _work(tasks, seed, chosen, scenes, folder)
        if against:
            work = itertools.chain(
                _against(against, tasks, unsolved, limit, seed, scenes, folder), work
            )
        if versus:
            work = itertools.chain(_versus(versus, tasks, seed, scenes, folder), work)
        for name, measure in work:
            with bar(name) as progress:
                measured = measure(progress)
            hand_over(measured, folder)
            tables += measured.tables
            summary = {
                "seed": seed,
                "tasks": tasks,
                "scenes": scenes,
                "parts": list(chosen),
                "against": against,
                "versus": versus,
                "tables": [dataclasses.asdict(table) for table in tables],
            }
            (folder / "summary.json").write_text(to_json(summary) + "\n")
        return 0

    return bench


def _require(flag: str, value: object, good: bool, expected: str) -> None:
    if not good:
        raise UsageError(f"{flag} {value}: expected {expected}")


def _against(
    name: str, tasks: int, unsolved: int, limit: float, seed: int, scenes: Scenes, folder: Path
) -> Iterator[tuple[str, Work]]:
    """Ours and another planner."""
    from relevance import benchmarks
    from relevance.planner import PLANNERS

    peer = PLANNERS[name]
    peer.warm_up()
    config = settings_of(peer.Config, seconds=limit)
    drawn = benchmarks.draw(tasks, seed, scenes=scenes)
    write_scenes(folder / "scenes.jsonl", drawn)
    hard: list[Any] = []
    if unsolved:
        with bar("tasks that ours leaves unsolved") as progress:
            hard = benchmarks.find_unsolved(unsolved, seed, scenes=scenes, progress=progress)
        write_scenes(folder / "scenes-unsolved.jsonl", hard)
        if len(hard) < unsolved:
            say(f"only {len(hard)} tasks are unsolved of those drawn")
    yield (
        f"ours and {name}",
        lambda progress: benchmarks.measure_against(
            drawn,
            functools.partial(peer.plan, config=config, replay=False),
            name=name,
            unsolved=hard,
            processes=2,
            progress=progress,
        ),
    )


def _versus(
    checkout: Path, tasks: int, seed: int, scenes: Scenes, folder: Path
) -> Iterator[tuple[str, Work]]:
    """This planner and the one of another checkout."""
    from relevance import benchmarks

    drawn = benchmarks.draw(tasks, seed, scenes=scenes)
    most = benchmarks.SIZES[-1]
    grown = benchmarks.draw(
        max(tasks // 10, 1),
        seed,
        boxes=(most, most),
        max_edge=benchmarks.MAX_EDGE,
        stream="bench growth",
    )
    write_scenes(folder / "scenes.jsonl", drawn)
    write_scenes(folder / "scenes-growth.jsonl", grown)
    yield (
        "tasks by both checkouts",
        lambda progress: benchmarks.measure_versus(
            drawn, checkout, growth=grown, growth_config=benchmarks.CAPPED, progress=progress
        ),
    )


def _work(
    tasks: int, seed: int, parts: Sequence[Part], scenes: Scenes, folder: Path
) -> Iterator[tuple[str, Work]]:
    """The parts to measure, with their names; each draws its tasks when its turn comes."""
    from relevance import benchmarks
    from relevance.benchmarks import draw

    if not parts:
        return
    drawn = draw(tasks, seed, scenes=scenes)
    half = drawn[: max(tasks // 2, 1)]
    write_scenes(folder / "scenes.jsonl", drawn)
    if {"speed", "truth"} & set(parts):
        speed, truth = "speed" in parts, "truth" in parts
        yield (
            "tasks planned",
            lambda progress: benchmarks.measure_planning(
                drawn, speed=speed, truth=truth, progress=progress
            ),
        )
    if "stability" in parts:
        yield (
            "tasks jittered",
            lambda progress: benchmarks.measure_stability(drawn, seed=seed, progress=progress),
        )
    if "searches" in parts:
        yield (
            "tasks by both searches",
            lambda progress: benchmarks.measure_searches(half, progress=progress),
        )
    if "completeness" in parts:
        yield (
            "tasks solved by exhaustion",
            lambda progress: benchmarks.measure_completeness(half, progress=progress),
        )
    if "scaling" in parts:
        each = max(tasks // 50, 1)
        sizes = {
            size: draw(
                each,
                seed,
                boxes=(size, size),
                max_edge=benchmarks.MAX_EDGE,
                stream="bench scaling",
            )
            for size in benchmarks.SIZES
        }
        yield (
            "plans of growing scenes",
            lambda progress: benchmarks.measure_scaling(sizes, progress=progress),
        )


def hand_over(measured: Any, folder: Path, *, summary: bool = False) -> None:
    """Print a part's tables; write its rows and its plots."""
    for table in measured.tables:
        show(table.columns, table.rows, "table", title=table.title)
    write(measured, folder, summary=summary)


def write(measured: Any, folder: Path, *, summary: bool = False) -> None:
    """Write a part's rows and its plots; with `summary` its tables, too."""
    from relevance.benchmarks import save

    records = measured.records()
    with (folder / f"{measured.name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
    for plot in measured.plots:
        save(plot, folder)
    if summary:
        tables = [dataclasses.asdict(table) for table in measured.tables]
        (folder / "summary.json").write_text(to_json({"tables": tables}) + "\n")
    if measured.exceptions:
        write_scenes(folder / EXCEPTIONS, measured.exceptions, mode="a")


def write_scenes(file: Path, tasks: Sequence[Any], mode: Literal["w", "a"] = "w") -> None:
    """The tasks as `relevance plan` reads them, one scene with its goal a line."""
    from relevance.scene import scene_to_json

    lines = [
        scene_to_json(dataclasses.replace(task.scene, goals=(str(task.goal),))) for task in tasks
    ]
    with file.open(mode, encoding="utf-8") as opened:
        opened.writelines(f"{line}\n" for line in lines)
