"""What the planner's *no* and its shortest plans are worth: against the exhaustive reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from relevance.benchmarks.reference import CLEARANCE, possible, shortest
from relevance.benchmarks.runs import DEFAULTS, Measured, Progress, share, timed_plan
from relevance.benchmarks.tasks import Task
from relevance.planner import PlannerConfig, warm_up
from relevance.report.tables import Table

ROBUST = 0.003
"""Clearance with which a task counts as solvable beyond the reference's resolution, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One task, planned and solved by exhaustion."""

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
    alone: bool | None
    """Whether it could be done if no box but subject and reference were there; None: solved."""

    @property
    def solved(self) -> bool:
        """Whether the planner has a plan."""
        return self.status == "solved"

    @property
    def others(self) -> int:
        """Boxes that the plan moves before the subject."""
        return max(len(self.moved) - 1, 0)

    @property
    def refuted(self) -> bool:
        """Whether the planner has no plan where the reference has one, with room to spare."""
        return not self.solved and self.robust is not None

    @property
    def longer(self) -> bool:
        """Whether the plan moves more boxes than the reference needs, with room to spare."""
        return self.solved and self.robust is not None and self.others > self.robust


def measure_completeness(
    tasks: Sequence[Task],
    *,
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task and solve it by exhaustion."""
    warm_up()
    rows = []
    for done, task in enumerate(tasks, 1):
        rows.append(compared(task, config))
        progress(done, len(tasks))
    tables = [completeness_table(rows, config)]
    worth = [row for row in rows if row.refuted or row.longer]
    if worth:
        tables.append(_listed(worth))
    return Measured(
        name="completeness",
        rows=tuple(rows),
        tables=tuple(tables),
        exceptions=tuple(
            task for task, row in zip(tasks, rows, strict=True) if row.refuted or row.longer
        ),
    )


def compared(task: Task, config: PlannerConfig) -> Compared:
    """Plan one task and solve it by exhaustion, twice."""
    result, _, _ = timed_plan(task, config)
    most = config.max_actions // 2 - 1
    others = [n for n in task.scene.names if n not in (task.goal.subject, task.goal.reference)]
    # What is solvable with more clearance is solvable with less.
    robust = shortest(task.scene, task.goal, ROBUST, most)
    reference = robust if robust == 0 else shortest(task.scene, task.goal, CLEARANCE, most)
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
        alone=None if result.status == "solved" else possible(task.scene, task.goal, others),
    )


def completeness_table(rows: Sequence[Compared], config: PlannerConfig = DEFAULTS) -> Table:
    """Which verdicts the reference refutes, and which plans move more boxes than they must."""
    infeasible = [row for row in rows if row.status == "infeasible"]
    limit = [row for row in rows if row.status == "limit"]
    solved = [row for row in rows if row.solved]
    robust = [row for row in rows if row.robust is not None]
    firm = [row for row in robust if row.solved]
    over = [row for row in solved if row.reference is not None and row.others > row.reference]
    found = sum(row.reference is not None for row in infeasible)
    lost = [row for row in robust if not row.solved]
    needless = sum(row.others - (row.robust or 0) for row in firm if row.longer)
    lines = (
        ("called infeasible", share(len(infeasible), len(rows))),
        ("of these solvable by the reference", share(found, len(infeasible))),
        ("of these solvable with 2 mm to spare", share(_refuted(infeasible), len(infeasible))),
        ("of these not flagged ambiguous", share(_plain(infeasible), len(infeasible))),
        (
            "of these impossible even with all other boxes gone",
            share(sum(row.alone is False for row in infeasible), len(infeasible)),
        ),
        ("stopped at a limit, solvable with 2 mm to spare", share(_refuted(limit), len(limit))),
        ("solved", share(len(solved), len(rows))),
        ("of these fewer boxes must move", share(len(over), len(solved))),
        ("of these fewer with 2 mm to spare", share(sum(r.longer for r in firm), len(solved))),
        ("boxes moved needlessly, with 2 mm to spare", str(needless)),
        ("solvable by the reference with 2 mm to spare", share(len(robust), len(rows))),
        ("of these lost by the planner", share(len(lost), len(robust))),
        ("solved by the planner alone", str(sum(r.reference is None for r in solved))),
    )
    return Table(
        name="completeness",
        title=(
            "Completeness against exhaustion "
            f"(up to {config.max_actions // 2 - 1} boxes moved before the subject)"
        ),
        columns=("what", "found"),
        rows=lines,
    )


def _refuted(rows: Sequence[Compared]) -> int:
    return sum(row.refuted for row in rows)


def _plain(rows: Sequence[Compared]) -> int:
    return sum(row.refuted and not row.ambiguous for row in rows)


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
