"""The planners of two checkouts on the same tasks, in one run: what a change does to the times.

Each planner runs in a process of its own (`runner.py`) that imports the package from its checkout
and is asked over pipes; tasks take turns, so that both meet the same machine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relevance.benchmarks.runs import (
    DEFAULTS,
    TIMES,
    Measured,
    Progress,
    milliseconds,
    ratio,
    share,
)
from relevance.benchmarks.tasks import BenchmarkError, Task
from relevance.planner import PlannerConfig
from relevance.report.tables import Table
from relevance.scene import scene_to_json

ROOT = Path(__file__).parents[2]
"""The checkout that this file is part of."""
CHECKED = ("median", "mean")
"""Ratios that are reported with their intervals."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Versus:
    """One task by this planner and by the one of the other checkout; CPU seconds."""

    part: str
    """`tasks`, or `growth`: many boxes and longer plans."""
    task: int
    scene_id: str
    goal: str
    n_objects: int
    status: str
    status_other: str
    reason: str
    reason_other: str
    moved: tuple[str, ...]
    moved_other: tuple[str, ...]
    cpu: float
    cpu_other: float


class Runner:
    """The planner of a checkout, in a process of its own."""

    def __init__(self, checkout: Path) -> None:
        """Start it and wait until its solvers are compiled; BenchmarkError when it cannot be."""
        self.checkout = checkout.resolve()
        if not (self.checkout / "relevance" / "planner").is_dir():
            raise BenchmarkError(f"{checkout}: no relevance/planner in it, expected a checkout")
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("runner.py"))],
            env={**os.environ, "PYTHONPATH": str(self.checkout), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )
        try:
            place = Path(self._answer()["package"])
            if not place.is_relative_to(self.checkout):
                raise BenchmarkError(f"{checkout}: its package came from {place}")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.terminate()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def plan(self, task: Task, config: PlannerConfig) -> dict[str, Any]:
        """status, reason, moved and cpu (s) of one task."""
        assert self.process.stdin is not None
        asked = {
            "scene": scene_to_json(task.scene),
            "goal": str(task.goal),
            "config": {"max_actions": config.max_actions, "node_limit": config.node_limit},
        }
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise BenchmarkError(f"{self.checkout}: its planner stopped; its message is above")
        return json.loads(line)


def measure_versus(
    tasks: Sequence[Task],
    checkout: Path,
    *,
    growth: Sequence[Task] = (),
    config: PlannerConfig = DEFAULTS,
    growth_config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task with this planner and with that of `checkout`, alternating who goes first."""
    rows: list[Versus] = []
    total = len(tasks) + len(growth)
    with ExitStack() as stack:
        runners = [stack.enter_context(Runner(place)) for place in (ROOT, checkout)]
        for part, some, settings in (("tasks", tasks, config), ("growth", growth, growth_config)):
            for task in some:
                turns = runners if len(rows) % 2 == 0 else runners[::-1]
                found = {runner: runner.plan(task, settings) for runner in turns}
                rows.append(_row(part, task, *(found[runner] for runner in runners)))
                progress(len(rows), total)
    tables = [
        table
        for part in ("tasks", "growth")
        for some in [[row for row in rows if row.part == part]]
        if some
        for table in (times_table(part, some), verdicts_table(part, some))
    ]
    return Measured(
        name="versus",
        rows=tuple(rows),
        tables=tuple(tables),
        exceptions=tuple(
            task
            for task, row in zip((*tasks, *growth), rows, strict=True)
            if _lost(row) or _longer(row)
        ),
    )


def _row(part: str, task: Task, ours: dict[str, Any], other: dict[str, Any]) -> Versus:
    return Versus(
        part=part,
        task=task.index,
        scene_id=task.scene.id,
        goal=str(task.goal),
        n_objects=task.n_objects,
        status=ours["status"],
        status_other=other["status"],
        reason=ours["reason"],
        reason_other=other["reason"],
        moved=tuple(ours["moved"]),
        moved_other=tuple(other["moved"]),
        cpu=ours["cpu"],
        cpu_other=other["cpu"],
    )


def times_table(part: str, rows: Sequence[Versus]) -> Table:
    """CPU time of both, and the ratios of this planner's to the other's."""
    lines: list[tuple[str | int, ...]] = []
    both = [row for row in rows if row.status == row.status_other == "solved"]
    for which, some in (("all tasks", rows), ("solved by both", both)):
        if not some:
            continue
        ours, other = [row.cpu for row in some], [row.cpu_other for row in some]
        ratios = [f"{ratio(ours, other, name):.2f}" if name in CHECKED else "-" for name in TIMES]
        ratios[-1] = f"{max(ours) / max(other):.2f}"
        lines += [
            (f"this, {which}", len(some), *milliseconds(ours)),
            (f"other, {which}", len(some), *milliseconds(other)),
            (f"this over other, {which}", len(some), *ratios),
        ]
    return Table(
        name=f"versus-{part}",
        title=f"This planner and the other, {part}, CPU time a task in ms (95% interval)",
        columns=("planner", "tasks", *TIMES),
        rows=tuple(lines),
    )


def verdicts_table(part: str, rows: Sequence[Versus]) -> Table:
    """Whether both solve the same tasks by moving the same boxes."""
    count = len(rows)
    both = [row for row in rows if row.status == row.status_other == "solved"]
    lines = (
        ("solved by this", share(sum(row.status == "solved" for row in rows), count)),
        ("solved by the other", share(sum(row.status_other == "solved" for row in rows), count)),
        ("solved by the other alone", str(sum(map(_lost, rows)))),
        ("same moved set where both solve", share(sum(map(_alike, both)), len(both))),
        ("fewer boxes moved by this", share(sum(map(_shorter, both)), len(both))),
        ("fewer boxes moved by the other", share(sum(map(_longer, both)), len(both))),
    )
    return Table(
        name=f"verdicts-{part}",
        title=f"What both planners make of them, {part}",
        columns=("what", "found"),
        rows=lines,
    )


def _lost(row: Versus) -> bool:
    return row.status != "solved" and row.status_other == "solved"


def _alike(row: Versus) -> bool:
    return set(row.moved) == set(row.moved_other)


def _shorter(row: Versus) -> bool:
    return len(row.moved) < len(row.moved_other)


def _longer(row: Versus) -> bool:
    return row.status == row.status_other == "solved" and len(row.moved) > len(row.moved_other)
