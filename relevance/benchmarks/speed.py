"""Speed and truth: every task planned once, every plan judged by the replay."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from relevance.benchmarks.plots import speed_plot, truth_plot
from relevance.benchmarks.runs import (
    DEFAULTS,
    TIMES,
    Measured,
    Planned,
    Plot,
    Progress,
    interval,
    milliseconds,
    planned,
    share,
)
from relevance.benchmarks.tasks import Task
from relevance.planner import PlannerConfig, PlanResult, penetration, warm_up
from relevance.report.tables import Table
from relevance.simulation import MAX_PENETRATION, replay

BOUNDS = ("pose", "keyframe", "path", "rest")


def replayed(row: Planned, task: Task, result: PlanResult) -> Planned:
    """The row with what the replay says of the plan."""
    if not row.solved:
        return row
    began = time.process_time()
    verdict = replay(task.scene, task.goal, result.phases)
    return replace(
        row,
        replay_ok=verdict.ok,
        replay_max_penetration=verdict.max_penetration,
        replay_reason=verdict.reason,
        replay_cpu=time.process_time() - began,
    )


def rechecked(row: Planned, task: Task, result: PlanResult) -> Planned:
    """The row with the time of the dense check alone."""
    if not row.solved:
        return row
    began = time.process_time()
    penetration(task.scene, result)
    return replace(row, check_cpu=time.process_time() - began)


def measure_planning(
    tasks: Sequence[Task],
    *,
    config: PlannerConfig = DEFAULTS,
    speed: bool = True,
    truth: bool = True,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task on one core; `truth` replays every plan, `speed` adds the times' tables.

    One thing after the other for all tasks: what a replay leaves in the processor's caches is no
    matter of the next plan.
    """
    warm_up()
    rows, results = [], []
    total = (3 if truth else 1) * len(tasks)
    for task in tasks:
        row, result = planned(task, config)
        rows.append(row)
        results.append(result)
        progress(len(rows), total)
    for k, look in enumerate((rechecked, replayed) if truth else (), 1):
        for i, (task, result) in enumerate(zip(tasks, results, strict=True)):
            rows[i] = look(rows[i], task, result)
            progress(k * len(tasks) + i + 1, total)
    tables = [outcome_table(rows)]
    drawn: list[Plot] = []
    if speed:
        tables += [speed_table(rows), bounds_table(rows), boxes_table(rows)]
        drawn.append(Plot(name="speed", draw=partial(speed_plot, rows=rows), panels=2))
    if truth:
        tables += [truth_table(rows)]
        refused = [row for row in rows if row.replay_ok is False]
        if refused:
            tables.append(refused_table(refused))
        drawn.append(Plot(name="truth", draw=partial(truth_plot, rows=rows)))
    return Measured(name="tasks", rows=tuple(rows), tables=tuple(tables), plots=tuple(drawn))


def outcome_table(rows: Sequence[Planned]) -> Table:
    """How the tasks ended, by predicate."""
    lines = []
    for name in (*dict.fromkeys(row.predicate for row in rows), "all"):
        some = [row for row in rows if name in (row.predicate, "all")]
        ends = [sum(row.status == s for row in some) for s in ("solved", "infeasible", "limit")]
        moved = [len(row.moved) for row in some if row.solved]
        by_length = [sum(m == n for m in moved) for n in (1, 2)]
        longer = sum(m >= 3 for m in moved)
        flagged = sum(row.ambiguous for row in some)
        lines.append((name, len(some), *ends, *by_length, longer, flagged))
    columns = (
        "predicate", "tasks", "solved", "infeasible", "limit",
        "1 moved", "2 moved", "3 or more", "ambiguous",
    )  # fmt: skip
    return Table(name="outcomes", title="Outcomes", columns=columns, rows=tuple(lines))


def speed_table(rows: Sequence[Planned]) -> Table:
    """CPU time a task with intervals, by outcome, and wall time."""
    groups = [
        ("CPU, all tasks", [row.cpu for row in rows]),
        ("CPU, solved", [row.cpu for row in rows if row.solved]),
        ("CPU, not solved", [row.cpu for row in rows if not row.solved]),
        ("wall, all tasks", [row.wall for row in rows]),
    ]
    return Table(
        name="speed",
        title="Planning time a task, ms (95% interval)",
        columns=("time", "tasks", *TIMES),
        rows=tuple((name, len(times), *milliseconds(times)) for name, times in groups),
    )


def bounds_table(rows: Sequence[Planned]) -> Table:
    """Where the CPU time goes."""
    whole = sum(row.cpu for row in rows)
    calls = {"pose": "pose_checks", "keyframe": "keyframe_nlps", "path": "path_nlps"}
    lines = []
    for bound in BOUNDS:
        spent = np.array([getattr(row, f"cpu_{bound}") for row in rows])
        count = sum(getattr(row, calls[bound]) for row in rows) if bound in calls else None
        lines.append(
            (
                bound,
                f"{interval(1e3 * spent, 'mean'):.2f}",
                f"{spent.sum() / whole:.1%}",
                "-" if count is None else f"{count / len(rows):.2f}",
                f"{1e3 * spent.sum() / count:.2f}" if count else "-",
            )
        )
    columns = ("bound", "ms a task, mean", "share", "calls a task", "ms a call")
    return Table(name="bounds", title="CPU time by bound", columns=columns, rows=tuple(lines))


def boxes_table(rows: Sequence[Planned]) -> Table:
    """CPU time by number of boxes."""
    lines = []
    for boxes in sorted({row.n_objects for row in rows}):
        some = [row for row in rows if row.n_objects == boxes]
        times = [row.cpu for row in some]
        nodes = float(np.mean([row.nodes for row in some]))
        lines.append((boxes, len(some), *milliseconds(times), f"{nodes:.1f}"))
    return Table(
        name="boxes",
        title="CPU time by number of boxes, ms (95% interval)",
        columns=("boxes", "tasks", *TIMES, "nodes, mean"),
        rows=tuple(lines),
    )


def truth_table(rows: Sequence[Planned]) -> Table:
    """What the replay says of the plans, and whether the planner's own check agrees."""
    judged = [row for row in rows if row.replay_ok is not None]
    own = np.array([row.max_penetration or 0.0 for row in judged])
    found = np.array([row.replay_max_penetration or 0.0 for row in judged])
    within = (own <= MAX_PENETRATION) == (found <= MAX_PENETRATION)
    apart = 1e3 * np.abs(own - found)
    lines = [
        ("plans that replay", share(sum(bool(row.replay_ok) for row in judged), len(judged))),
        ("check and replay agree on 1 mm", share(int(within.sum()), len(judged))),
    ]
    if len(judged):
        lines += [
            ("deepest penetration, replay, mm", f"{1e3 * found.max():.3f}"),
            ("deepest penetration, check, mm", f"{1e3 * own.max():.3f}"),
            ("check and replay apart, mm: median", f"{np.median(apart):.3f}"),
            ("check and replay apart, mm: p99", f"{np.quantile(apart, 0.99):.3f}"),
            ("check and replay apart, mm: max", f"{apart.max():.3f}"),
            ("replay deeper than check by, mm: max", f"{1e3 * (found - own).max():.3f}"),
            (
                "CPU of one replay, ms: mean",
                f"{1e3 * np.mean([row.replay_cpu or 0.0 for row in judged]):.0f}",
            ),
            (
                "CPU of one dense check, ms: mean (its geometry prepared anew)",
                f"{1e3 * np.mean([row.check_cpu or 0.0 for row in judged]):.2f}",
            ),
        ]
    return Table(name="truth", title="Truth of plans", columns=("what", "found"), rows=tuple(lines))


def refused_table(rows: Sequence[Planned]) -> Table:
    """The plans that the replay refuses, by task."""
    return Table(
        name="refused",
        title="Plans that the replay refuses",
        columns=("task", "goal", "reason"),
        rows=tuple(
            (row.task, f"{row.predicate}({row.subject}, {row.reference})", row.replay_reason)
            for row in rows
        ),
    )
