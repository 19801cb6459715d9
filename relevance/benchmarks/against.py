"""Our planner and another on the same tasks; the replay judges the plans of both.

Two kinds of tasks: random ones, on which both take turns and are timed, and such as ours leaves
unsolved. An exception is a task in which the other planner does better.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from relevance.benchmarks.plots import against_plot
from relevance.benchmarks.runs import (
    DEFAULTS,
    TIMES,
    Measured,
    Plot,
    Progress,
    milliseconds,
    planned,
    ratio,
    share,
)
from relevance.benchmarks.speed import replayed
from relevance.benchmarks.tasks import Scenes, Task, draw
from relevance.planner import PlannerConfig, PlanResult, warm_up
from relevance.report.tables import Table
from relevance.scene import Goal, Scene
from relevance.simulation import replay

Peer = Callable[[Scene, Goal], PlanResult]
DRAWN = 100
"""Tasks drawn, at most, for each that ours is to leave unsolved."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Duel:
    """One task by both planners; CPU seconds, for the peer without loading its programs."""

    kind: str
    """`random`, or `unsolved`: drawn since ours has no plan."""
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

    @property
    def lost(self) -> bool:
        """Whether only the peer has a plan that replays."""
        return bool(self.replay_ok_peer) and not self.replay_ok

    @property
    def longer(self) -> bool:
        """Whether a plan of the peer replays and moves fewer boxes than ours, which does too."""
        both = bool(self.replay_ok and self.replay_ok_peer)
        return both and len(self.moved_peer) < len(self.moved)


def measure_against(
    tasks: Sequence[Task],
    peer: Peer,
    *,
    name: str,
    unsolved: Sequence[Task] = (),
    processes: int = 1,
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task with ours and with the peer, alternating who goes first.

    `unsolved` tasks (see `find_unsolved`) are no race: they run in `processes` at a time, for
    which the peer has to be picklable.
    """
    warm_up()
    rows: list[Duel] = []
    total = len(tasks) + len(unsolved)
    for task in tasks:
        first = len(rows) % 2 == 0
        rows.append(duel(task, peer, name=name, config=config, kind="random", peer_first=first))
        progress(len(rows), total)
    fight = partial(duel, peer=peer, name=name, config=config, kind="unsolved")
    for row in _each(fight, unsolved, processes):
        rows.append(row)
        progress(len(rows), total)
    tables: list[Table] = []
    drawn: list[Plot] = []
    random = rows[: len(tasks)]
    if random:
        tables += [times_table(random), outcomes_table(random)]
        ours, theirs = [row.cpu for row in random], [row.cpu_peer for row in random]
        show = partial(against_plot, ours=ours, theirs=theirs, name=name)
        drawn.append(Plot(name=f"against-{name}", draw=show, panels=2))
    if unsolved:
        tables.append(unsolved_table(rows[len(tasks) :]))
    beaten = [row.lost or row.longer for row in rows]
    if any(beaten):
        tables.append(exceptions_table([row for row in rows if row.lost or row.longer]))
    both = (*tasks, *unsolved)
    return Measured(
        name=f"against-{name}",
        rows=tuple(rows),
        tables=tuple(tables),
        plots=tuple(drawn),
        exceptions=tuple(task for task, worse in zip(both, beaten, strict=True) if worse),
    )


def find_unsolved(
    count: int,
    seed: int,
    *,
    scenes: Scenes = "ours",
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> list[Task]:
    """The first `count` tasks that ours leaves unsolved, or as many as DRAWN times that hold."""
    warm_up()
    found: list[Task] = []
    for index in range(DRAWN * count):
        [task] = draw(1, seed, first=index, scenes=scenes, stream="bench unsolved")
        if planned(task, config)[0].status != "solved":
            found.append(task)
            progress(len(found), count)
        if len(found) == count:
            break
    return found


def duel(
    task: Task,
    peer: Peer,
    *,
    name: str,
    config: PlannerConfig,
    kind: str,
    peer_first: bool = False,
) -> Duel:
    """One task by both."""
    theirs = peer(task.scene, task.goal) if peer_first else None
    ours, plan = planned(task, config)
    theirs = theirs or peer(task.scene, task.goal)
    ours = replayed(ours, task, plan)
    solved = theirs.status == "solved"
    verdict = replay(task.scene, task.goal, theirs.phases) if solved else None
    return Duel(
        kind=kind,
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


def _each(work: Callable[[Task], Duel], tasks: Sequence[Task], processes: int) -> Iterable[Duel]:
    """The rows of all tasks, in order."""
    if processes == 1 or not tasks:
        yield from map(work, tasks)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, tasks)


def times_table(rows: Sequence[Duel]) -> Table:
    """CPU time of both, and the ratio of their medians."""
    name = rows[0].peer
    both = [row for row in rows if row.status == row.status_peer == "solved"]
    lines: list[tuple[str, ...]] = []
    for which, some in (("all tasks", rows), ("solved by both", both)):
        if not some:
            continue
        ours, theirs = [row.cpu for row in some], [row.cpu_peer for row in some]
        times = f"{ratio(theirs, ours, 'median'):.0f}"
        lines.append((f"ours, {which}", str(len(some)), *milliseconds(ours), "1"))
        lines.append((f"{name}, {which}", str(len(some)), *milliseconds(theirs), times))
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
        (f"solved by {name} and replays, not by ours", str(sum(row.lost for row in rows))),
        ("same moved set where both solve", share(_alike(both), len(both))),
        ("fewer boxes moved by ours where both solve", share(_fewer(both), len(both))),
        (
            f"fewer boxes moved by {name} where both replay",
            share(sum(row.longer for row in both), sum(bool(r.replay_ok_peer) for r in both)),
        ),
    ]
    if deepest:
        lines.append((f"deepest penetration, {name}, mm: median", f"{np.median(deepest):.2f}"))
    return Table(
        name="outcomes",
        title=f"What ours and {name} solve",
        columns=("what", "found"),
        rows=tuple(lines),
    )


def unsolved_table(rows: Sequence[Duel]) -> Table:
    """What the peer makes of the tasks that ours leaves unsolved."""
    name, count = rows[0].peer, len(rows)
    ends = [sum(row.status_peer == s for row in rows) for s in ("solved", "infeasible", "limit")]
    infeasible = sum(row.status == "infeasible" for row in rows)
    lines = (
        ("called infeasible by ours", share(infeasible, count)),
        (f"solved by {name}", share(ends[0], count)),
        (f"solved by {name} and replays", share(sum(row.lost for row in rows), count)),
        (f"called infeasible by {name}", share(ends[1], count)),
        (f"stopped at the limit, {name}", share(ends[2], count)),
    )
    return Table(
        name="unsolved",
        title=f"What {name} makes of {count} tasks that ours leaves unsolved",
        columns=("what", "found"),
        rows=lines,
    )


def exceptions_table(rows: Sequence[Duel]) -> Table:
    """The tasks in which the peer does better; their scenes are in exceptions.jsonl."""
    return Table(
        name="exceptions",
        title=f"Tasks in which {rows[0].peer} does better, its plan replayed",
        columns=("kind", "task", "scene", "goal", "boxes", "ours", "peer moves", "reason"),
        rows=tuple(
            (
                row.kind,
                row.task,
                row.scene_id,
                row.goal,
                row.n_objects,
                " ".join(row.moved) or row.status,
                " ".join(row.moved_peer),
                row.reason,
            )
            for row in rows
        ),
    )


def _limits(rows: Sequence[Duel]) -> int:
    return sum(row.status_peer == "limit" for row in rows)


def _alike(rows: Sequence[Duel]) -> int:
    return sum(set(row.moved) == set(row.moved_peer) for row in rows)


def _fewer(rows: Sequence[Duel]) -> int:
    return sum(len(row.moved) < len(row.moved_peer) for row in rows)
