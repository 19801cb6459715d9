"""Stability: every box moved by 0.1 mm at random, the task planned again, labels compared.

Flips are rare, so every task is jittered several times.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from relevance.benchmarks.runs import DEFAULTS, Measured, Progress, share
from relevance.benchmarks.tasks import BenchmarkError, Task
from relevance.planner import PlannerConfig, PlanResult, plan, warm_up
from relevance.report.tables import Table
from relevance.scene import Scene, SceneError

JITTER = 1e-4
"""How far each box is moved, m, in a direction of its own."""
JITTERS = 5
"""How often each task is jittered."""
_DRAWS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Jittered:
    """One task planned as it is, and with every box moved by JITTER."""

    task: int
    jitter: int
    scene_id: str
    goal: str
    predicate: str
    n_objects: int
    status: str
    status_moved: str
    moved: tuple[str, ...]
    moved_moved: tuple[str, ...]
    ambiguous: bool
    ambiguous_moved: bool
    same_again: bool
    """Whether planning the very same scene again gave the same plan, bit for bit."""
    labels: int
    """Labels that both plans give (not of subject and reference); 0 without two plans."""
    flips: int
    """How many of these labels differ."""

    @property
    def flipped(self) -> bool:
        """Whether anything that is stored changed: solved or not, or the set of moved objects."""
        ended = (self.status == "solved") != (self.status_moved == "solved")
        return ended or set(self.moved) != set(self.moved_moved)


def measure_stability(
    tasks: Sequence[Task],
    *,
    seed: int,
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task, once more, and jittered; count the flips, and how the flag foretells."""
    warm_up()
    rows = []
    for done, task in enumerate(tasks, 1):
        rows += jittered(task, seed, config)
        progress(done, len(tasks))
    tables = [stability_table(rows)]
    silent = [row for row in rows if row.flipped and not row.ambiguous]
    if silent:
        tables.append(_listed(silent))
    return Measured(name="stability", rows=tuple(rows), tables=tuple(tables))


def jittered(task: Task, seed: int, config: PlannerConfig) -> Iterator[Jittered]:
    """Plan a task as it is, again, and JITTERS times with its boxes moved."""
    first = plan(task.scene, task.goal, config=config, replay=False)
    again = plan(task.scene, task.goal, config=config, replay=False)
    queries = [n for n in task.scene.names if n not in (task.goal.subject, task.goal.reference)]
    for draw in range(JITTERS):
        rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, draw, task.index]))
        moved = plan(jitter(task.scene, rng), task.goal, config=config, replay=False)
        comparable = first.status == moved.status == "solved"
        flips = [name for name in queries if (name in first.moved) != (name in moved.moved)]
        yield Jittered(
            task=task.index,
            jitter=draw,
            scene_id=task.scene.id,
            goal=str(task.goal),
            predicate=task.goal.predicate.name,
            n_objects=task.n_objects,
            status=first.status,
            status_moved=moved.status,
            moved=first.moved,
            moved_moved=moved.moved,
            ambiguous=first.ambiguous,
            ambiguous_moved=moved.ambiguous,
            same_again=equal_plans(first, again),
            labels=len(queries) if comparable else 0,
            flips=len(flips) if comparable else 0,
        )


def jitter(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with every box moved by JITTER along the table, still a possible scene.

    A box that stands on another goes along with it and is then moved itself. Raises
    BenchmarkError when no draw gives a possible scene.
    """
    for _ in range(_DRAWS):
        shift: dict[str | None, np.ndarray] = {None: np.zeros(2)}
        for box in scene.objects:
            angle = rng.uniform(0, 2 * math.pi)
            shift[box.name] = JITTER * np.array([math.cos(angle), math.sin(angle)])
        boxes = []
        for box in scene.objects:
            dx, dy = shift[box.name] + shift[next(iter(box.supports), None)]
            x, y, z = box.position
            boxes.append(replace(box, position=(x + float(dx), y + float(dy), z)))
        try:
            return replace(scene, id="", objects=tuple(boxes))
        except (SceneError, ValueError):
            continue
    raise BenchmarkError(f"scene {scene.id}: no room to move its boxes by {JITTER} m")


def equal_plans(a: PlanResult, b: PlanResult) -> bool:
    """Whether two plans are the same, bit for bit, motions included."""
    plain = (a.status, a.reason, a.actions, a.final, a.ambiguous, a.counts)
    if plain != (b.status, b.reason, b.actions, b.final, b.ambiguous, b.counts):
        return False
    return len(a.phases) == len(b.phases) and all(
        p.dt == q.dt and p.opening == q.opening and np.array_equal(p.q, q.q)
        for p, q in zip(a.phases, b.phases, strict=True)
    )


def stability_table(rows: Sequence[Jittered]) -> Table:
    """How many labels and rows flip, and what the flag says of it."""
    both = [row for row in rows if row.status == row.status_moved == "solved"]
    flipped = [row for row in rows if row.flipped]
    flagged = [row for row in rows if row.ambiguous]
    caught = [row for row in flipped if row.ambiguous]
    labels, flips = sum(row.labels for row in both), sum(row.flips for row in both)
    plain = [row for row in both if not row.ambiguous]
    lines = (
        ("same scene again, same plan bit for bit", share(_same(rows), len(rows))),
        ("labels that flip (both solved)", share(flips, labels)),
        (
            "labels that flip, rows not flagged",
            share(sum(row.flips for row in plain), sum(row.labels for row in plain)),
        ),
        ("goals whose moved set flips (both solved)", share(_sets(both), len(both))),
        ("goals that turn from solved to not or back", share(_ends(rows), len(rows))),
        ("goals flagged ambiguous", share(len(flagged), len(rows))),
        ("precision: flagged goals that flip", share(len(caught), len(flagged))),
        ("recall: flipped goals that were flagged", share(len(caught), len(flipped))),
        (
            "goals that flip unflagged",
            share(len(flipped) - len(caught), len(rows) - len(flagged)),
        ),
    )
    return Table(
        name="stability",
        title=f"Stability: every box moved by {1e3 * JITTER:g} mm, {JITTERS} times a task",
        columns=("what", "found"),
        rows=lines,
    )


def _same(rows: Sequence[Jittered]) -> int:
    return sum(row.same_again for row in rows)


def _sets(rows: Sequence[Jittered]) -> int:
    return sum(set(row.moved) != set(row.moved_moved) for row in rows)


def _ends(rows: Sequence[Jittered]) -> int:
    return sum((row.status == "solved") != (row.status_moved == "solved") for row in rows)


def _listed(rows: Sequence[Jittered]) -> Table:
    return Table(
        name="unflagged",
        title="Goals that flip though they are not flagged",
        columns=("task", "goal", "boxes", "as it is", "moved"),
        rows=tuple(
            (
                row.task,
                row.goal,
                row.n_objects,
                " ".join(row.moved) or row.status,
                " ".join(row.moved_moved) or row.status_moved,
            )
            for row in rows
        ),
    )
