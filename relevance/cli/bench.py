"""`relevance bench TARGET`: measurements from fresh seeds, printed and written to a folder.

A target is one more maker and one more entry `bench TARGET` of COMMANDS.
"""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import csv
import dataclasses
import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from relevance.cli.terminal import UsageError, bar, say, show, to_json

Part = Literal["speed", "truth", "stability", "searches", "scaling", "completeness"]
PARTS: tuple[Part, ...] = (
    "speed", "truth", "stability", "searches", "scaling", "completeness",
)  # fmt: skip
Parts = Annotated[tuple[Part, ...] | None, tyro.conf.arg(metavar="PART")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="N")]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
Count = Annotated[int, tyro.conf.arg(metavar="N")]
Seconds = Annotated[float, tyro.conf.arg(metavar="S")]
Work = Callable[[Callable[[int, int], None]], Any]
"""A part of the benchmark: called with progress, returns what it measured."""


def bench_planner(_: Any) -> Callable[..., int]:
    """Maker of `relevance bench planner`."""

    def bench(
        tasks: Count = 1000,
        seed: OptionalInt = None,
        out: OptionalPath = None,
        parts: Parts = None,
        against: Literal["rai"] | None = None,
        limit: Seconds = 30.0,
    ) -> int:
        """Measure the planner on random tasks that nothing was tuned on, on one core.

        Prints tables and writes them (summary.json), a CSV file with one row a task for every
        part, the scenes (JSON lines, for `relevance plan`) and plots (PNG and SVG).

        Args:
            tasks: How many tasks speed, truth and stability look at; searches and completeness
                take half as many, scaling a 50th for each number of boxes.
            seed: Remakes the tasks of an earlier run; a fresh one when not given.
            out: Folder for rows and plots; data/bench/planner-SEED when not given.
            parts: What to measure; everything when not given (with --against only that).
            against: Another planner that takes turns with ours on the same tasks.
            limit: CPU seconds that the other planner has for a task.
        """
        if tasks < 1:
            raise UsageError(f"--tasks {tasks}: expected at least 1")
        if seed is not None and not 0 <= seed < 2**63:
            raise UsageError(f"--seed {seed}: expected 0 to 2**63 - 1")
        seed = secrets.randbits(32) if seed is None else seed
        if against:
            from relevance.planner.rai.planner import require_rai

            require_rai()
        chosen = parts if parts is not None else () if against else PARTS
        folder = out or Path("data/bench") / f"planner-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        say(f"--seed {seed} remakes these tasks; rows and plots go to {folder}")
        tables: list[Any] = []
        for name, work in _work(tasks, seed, chosen, against, limit, folder):
            with bar(name) as progress:
                measured = work(progress)
            hand_over(measured, folder)
            tables += measured.tables
            summary = {"seed": seed, "tasks": tasks, "parts": list(chosen), "against": against}
            summary["tables"] = [dataclasses.asdict(table) for table in tables]
            (folder / "summary.json").write_text(to_json(summary) + "\n")
        return 0

    return bench


def _work(
    tasks: int, seed: int, parts: Sequence[Part], against: str | None, limit: float, folder: Path
) -> Iterator[tuple[str, Work]]:
    """The parts to measure, with their names; each draws its tasks when its turn comes."""
    from relevance import benchmarks
    from relevance.benchmarks import draw

    drawn = draw(tasks, seed)
    _write_scenes(folder / "scenes.jsonl", drawn)
    if against:
        from relevance.planner.rai.planner import RaiConfig, plan_rai

        config = RaiConfig(seconds=limit)
        yield (
            f"ours and {against}",
            lambda progress: benchmarks.measure_against(
                drawn,
                lambda scene, goal: plan_rai(scene, goal, config=config, replay=False),
                name=against,
                progress=progress,
            ),
        )
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
        half = drawn[: max(tasks // 2, 1)]
        yield (
            "tasks by both searches",
            lambda progress: benchmarks.measure_searches(half, progress=progress),
        )
    if "completeness" in parts:
        small = draw(max(tasks // 2, 1), seed, boxes=(3, 5), stream="bench small")
        _write_scenes(folder / "scenes-completeness.jsonl", small)
        yield (
            "tasks solved by exhaustion",
            lambda progress: benchmarks.measure_completeness(small, progress=progress),
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


def hand_over(measured: Any, folder: Path) -> None:
    """Print a part's tables; write its rows and its plots."""
    from relevance.benchmarks import save

    for table in measured.tables:
        show(table.columns, table.rows, "table", title=table.title)
    records = measured.records()
    with (folder / f"{measured.name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
    for plot in measured.plots:
        save(plot, folder)


def _write_scenes(file: Path, tasks: Sequence[Any]) -> None:
    """The tasks as `relevance plan` reads them, one scene with its goal a line."""
    from relevance.scene import scene_to_json

    lines = [
        scene_to_json(dataclasses.replace(task.scene, goals=(str(task.goal),))) for task in tasks
    ]
    file.write_text("".join(f"{line}\n" for line in lines))
