"""Our planner and another, in turn on the same tasks; the replay judges the plans of both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from relevance.benchmarks import plots
from relevance.benchmarks.runs import (
    TIMES,
    Measured,
    Plot,
    Progress,
    milliseconds,
    ratio_of_medians,
    share,
)
from relevance.benchmarks.speed import DEFAULTS, planned, replayed
from relevance.benchmarks.tasks import Task
from relevance.planner import PlannerConfig, PlanResult, warm_up
from relevance.report.tables import Table
from relevance.scene import Goal, Scene
from relevance.simulation import replay

Peer = Callable[[Scene, Goal], PlanResult]


@dataclass(frozen=True, slots=True, kw_only=True)
class Duel:
    """One task by both planners; CPU seconds, for the peer without loading its programs."""

    task: int
    scene_id: str
    goal: str
    n_objects: int
    peer: str
    status: str
    status_peer: str
    reason: str
    reason_peer: str
    cpu: float
    cpu_peer: float
    moved: tuple[str, ...]
    moved_peer: tuple[str, ...]
    replay_ok: bool | None
    replay_ok_peer: bool | None
    replay_max_penetration_peer: float | None
    replay_reason_peer: str


def measure_against(
    tasks: Sequence[Task],
    peer: Peer,
    *,
    name: str,
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task with ours and with the peer, alternating who goes first."""
    warm_up()
    rows = []
    for done, task in enumerate(tasks, 1):
        theirs = peer(task.scene, task.goal) if done % 2 else None
        ours, plan = planned(task, config)
        theirs = theirs or peer(task.scene, task.goal)
        ours = replayed(ours, task, plan)
        solved = theirs.status == "solved"
        verdict = replay(task.scene, task.goal, theirs.phases) if solved else None
        rows.append(
            Duel(
                task=task.index,
                scene_id=task.scene.id,
                goal=str(task.goal),
                n_objects=task.n_objects,
                peer=name,
                status=ours.status,
                status_peer=theirs.status,
                reason=ours.reason,
                reason_peer=theirs.reason,
                cpu=ours.cpu,
                cpu_peer=theirs.seconds.total,
                moved=ours.moved,
                moved_peer=theirs.moved,
                replay_ok=ours.replay_ok,
                replay_ok_peer=None if verdict is None else verdict.ok,
                replay_max_penetration_peer=None if verdict is None else verdict.max_penetration,
                replay_reason_peer="" if verdict is None else verdict.reason,
            )
        )
        progress(done, len(tasks))
    drawn = partial(
        plots.against, ours=[row.cpu for row in rows], theirs=[row.cpu_peer for row in rows]
    )
    return Measured(
        name=f"against-{name}",
        rows=tuple(rows),
        tables=(times_table(rows), outcomes_table(rows)),
        plots=(Plot(name=f"against-{name}", draw=drawn, panels=2),),
    )


def times_table(rows: Sequence[Duel]) -> Table:
    """CPU time of both, and the ratio of their medians."""
    name = rows[0].peer
    both = [row for row in rows if row.status == row.status_peer == "solved"]
    lines: list[tuple[str, ...]] = []
    for which, some in (("all tasks", rows), ("solved by both", both)):
        if not some:
            continue
        ours, theirs = [row.cpu for row in some], [row.cpu_peer for row in some]
        ratio = f"{ratio_of_medians(theirs, ours):.0f}"
        lines.append((f"ours, {which}", str(len(some)), *milliseconds(ours), "1"))
        lines.append((f"{name}, {which}", str(len(some)), *milliseconds(theirs), ratio))
    return Table(
        name="against",
        title=f"Ours against {name}, CPU time a task in ms (95% interval)",
        columns=("planner", "tasks", *TIMES, "ratio of medians"),
        rows=tuple(lines),
    )


def outcomes_table(rows: Sequence[Duel]) -> Table:
    """How many tasks each solves, and how many of its plans the replay accepts."""
    name, count = rows[0].peer, len(rows)
    ours = [row for row in rows if row.status == "solved"]
    theirs = [row for row in rows if row.status_peer == "solved"]
    both = [row for row in ours if row.status_peer == "solved"]
    deepest = [1e3 * (row.replay_max_penetration_peer or 0.0) for row in theirs]
    lines = [
        ("solved by ours", share(len(ours), count)),
        (f"solved by {name}", share(len(theirs), count)),
        (f"stopped at the limit, {name}", share(_limits(rows), count)),
        ("plans that replay, ours", share(sum(bool(r.replay_ok) for r in ours), len(ours))),
        (
            f"plans that replay, {name}",
            share(sum(bool(r.replay_ok_peer) for r in theirs), len(theirs)),
        ),
        (f"solved by {name} and replays, not by ours", str(_only_peer(rows))),
        ("same moved set where both solve", share(_alike(both), len(both))),
        ("fewer boxes moved by ours where both solve", share(_fewer(both), len(both))),
    ]
    if deepest:
        lines.append((f"deepest penetration, {name}, mm: median", f"{np.median(deepest):.2f}"))
    return Table(
        name="outcomes",
        title=f"What ours and {name} solve",
        columns=("what", "found"),
        rows=tuple(lines),
    )


def _limits(rows: Sequence[Duel]) -> int:
    return sum(row.status_peer == "limit" for row in rows)


def _only_peer(rows: Sequence[Duel]) -> int:
    return sum(bool(row.replay_ok_peer) and row.status != "solved" for row in rows)


def _alike(rows: Sequence[Duel]) -> int:
    return sum(set(row.moved) == set(row.moved_peer) for row in rows)


def _fewer(rows: Sequence[Duel]) -> int:
    return sum(len(row.moved) < len(row.moved_peer) for row in rows)
