"""Completeness on small scenes: the planner against the exhaustive reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from relevance.benchmarks.reference import CLEARANCE, shortest
from relevance.benchmarks.runs import Measured, Progress, share
from relevance.benchmarks.speed import DEFAULTS, timed_plan
from relevance.benchmarks.tasks import Task
from relevance.planner import PlannerConfig, warm_up
from relevance.report.tables import Table

BOXES = (3, 5)
ROBUST = 0.005
"""Clearance with which a task counts as solvable beyond the reference's resolution, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One small task, planned and solved by exhaustion."""

    task: int
    scene_id: str
    goal: str
    predicate: str
    n_objects: int
    status: str
    reason: str
    ambiguous: bool
    moved: tuple[str, ...]
    reference: int | None
    """Fewest boxes to move before the subject, by the reference; None: it finds nothing."""
    robust: int | None
    """The same with ROBUST clearance."""

    @property
    def solved(self) -> bool:
        """Whether the planner has a plan."""
        return self.status == "solved"

    @property
    def others(self) -> int:
        """Boxes that the plan moves before the subject."""
        return max(len(self.moved) - 1, 0)


def measure_completeness(
    tasks: Sequence[Task],
    *,
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task and solve it by exhaustion; tasks should have at most five boxes."""
    warm_up()
    rows = []
    for done, task in enumerate(tasks, 1):
        rows.append(compared(task, config))
        progress(done, len(tasks))
    tables = [completeness_table(rows)]
    worth = [row for row in rows if row.robust is not None and not row.solved]
    worth += [row for row in rows if row.solved and row.robust is not None and longer(row)]
    if worth:
        tables.append(_listed(worth))
    return Measured(name="completeness", rows=tuple(rows), tables=tuple(tables))


def compared(task: Task, config: PlannerConfig) -> Compared:
    """Plan one task and solve it by exhaustion, twice."""
    result, _, _ = timed_plan(task, config)
    # What is solvable with more clearance is solvable with less.
    robust = shortest(task.scene, task.goal, ROBUST)
    reference = robust if robust == 0 else shortest(task.scene, task.goal, CLEARANCE)
    return Compared(
        task=task.index,
        scene_id=task.scene.id,
        goal=str(task.goal),
        predicate=task.goal.predicate.name,
        n_objects=task.n_objects,
        status=result.status,
        reason=result.reason,
        ambiguous=result.ambiguous,
        moved=result.moved,
        reference=reference,
        robust=robust,
    )


def longer(row: Compared) -> bool:
    """Whether the plan moves more boxes than the robust reference needs."""
    return row.robust is not None and row.others > row.robust


def completeness_table(rows: Sequence[Compared]) -> Table:
    """What is lost, what is called infeasible, and whether plans are of minimal length."""
    solvable = [row for row in rows if row.reference is not None]
    robust = [row for row in rows if row.robust is not None]
    both = [row for row in solvable if row.solved]
    lost = [row for row in solvable if not row.solved]
    firm = [row for row in robust if not row.solved]
    minimal = sum(row.others <= (row.reference or 0) for row in both)
    clear = sum(not longer(row) for row in both if row.robust is not None)
    refused = sum(row.status == "infeasible" for row in firm)
    lines = (
        ("solvable by the reference", share(len(solvable), len(rows))),
        ("of these lost by the planner", share(len(lost), len(solvable))),
        ("solvable by the reference with 2 mm to spare", share(len(robust), len(rows))),
        ("of these lost by the planner", share(len(firm), len(robust))),
        ("of these called infeasible", share(refused, len(robust))),
        ("of these lost and not flagged ambiguous", share(_plain(firm), len(robust))),
        ("plans no longer than the reference's", share(minimal, len(both))),
        (
            "plans no longer than the reference's with 2 mm to spare",
            share(clear, sum(row.robust is not None for row in both)),
        ),
        ("solved by the planner alone", str(sum(r.solved and r.reference is None for r in rows))),
    )
    return Table(
        name="completeness",
        title="Completeness against exhaustion (up to two boxes moved before the subject)",
        columns=("what", "found"),
        rows=lines,
    )


def _plain(rows: Sequence[Compared]) -> int:
    return sum(not row.ambiguous for row in rows)


def _listed(rows: Sequence[Compared]) -> Table:
    return Table(
        name="lost",
        title="Lost or longer than needed, with 2 mm to spare",
        columns=("task", "goal", "boxes", "planner", "reference needs", "reason"),
        rows=tuple(
            (
                row.task,
                row.goal,
                row.n_objects,
                f"moves {row.others} before" if row.solved else row.status,
                f"{row.robust} before",
                row.reason,
            )
            for row in rows
        ),
    )
