"""The two searches side by side, and how both grow with the number of boxes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from relevance.benchmarks.plots import scaling_plot
from relevance.benchmarks.runs import (
    DEFAULTS,
    Measured,
    Planned,
    Plot,
    Progress,
    interval,
    planned,
    share,
)
from relevance.benchmarks.tasks import Task
from relevance.planner import PlannerConfig, warm_up
from relevance.report.tables import Table

SEARCHES = ("informed", "tree")
SIZES = (3, 5, 10, 15, 20, 30)
"""Numbers of boxes that scaling looks at."""
MAX_EDGE = 0.09
"""Longest edge of the boxes that scaling draws, m: thirty longer ones hardly fit in reach."""
NODE_LIMIT = 1_000_000
"""Most nodes that scaling gives a search for one goal: a cap that no clock decides."""
MOST_ACTIONS = 12
"""Longest plans that scaling looks for."""
CAPPED = replace(DEFAULTS, node_limit=NODE_LIMIT, max_actions=MOST_ACTIONS)
COUNTERS = ("nodes", "pose_checks", "keyframe_nlps", "path_nlps")


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """One task by both searches."""

    task: int
    scene_id: str
    goal: str
    n_objects: int
    status_informed: str
    status_tree: str
    moved_informed: tuple[str, ...]
    moved_tree: tuple[str, ...]
    ambiguous_informed: bool
    ambiguous_tree: bool
    nodes_informed: int
    nodes_tree: int
    pose_checks_informed: int
    pose_checks_tree: int
    keyframe_nlps_informed: int
    keyframe_nlps_tree: int
    path_nlps_informed: int
    path_nlps_tree: int
    cpu_informed: float
    cpu_tree: float

    @property
    def same(self) -> bool:
        """Whether both end alike and move the same set."""
        return self.status_informed == self.status_tree and set(self.moved_informed) == set(
            self.moved_tree
        )

    @property
    def flagged(self) -> bool:
        """Whether either search flags the row ambiguous."""
        return self.ambiguous_informed or self.ambiguous_tree


def measure_searches(
    tasks: Sequence[Task],
    *,
    config: PlannerConfig = DEFAULTS,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan every task by both searches, one after the other."""
    warm_up()
    pairs = []
    for done, task in enumerate(tasks, 1):
        by = {name: planned(task, _with(config, name))[0] for name in SEARCHES}
        pairs.append(_pair(task, by))
        progress(done, len(tasks))
    tables = [agreement_table(pairs), counters_table(pairs)]
    apart = [pair for pair in pairs if not pair.same and not pair.flagged]
    if apart:
        tables.append(_listed(apart))
    return Measured(name="searches", rows=tuple(pairs), tables=tuple(tables))


def measure_scaling(
    tasks: Mapping[int, Sequence[Task]],
    *,
    config: PlannerConfig = CAPPED,
    progress: Progress = lambda done, total: None,
) -> Measured:
    """Plan tasks, given by number of boxes, by both searches; nodes are capped by the config."""
    warm_up()
    rows: list[Planned] = []
    total = len(SEARCHES) * sum(map(len, tasks.values()))
    for task, search in _turns(tasks):
        rows.append(planned(task, _with(config, search))[0])
        progress(len(rows), total)
    return Measured(
        name="scaling",
        rows=tuple(rows),
        tables=(scaling_table(rows, config),),
        plots=(Plot(name="scaling", draw=partial(scaling_plot, rows=rows), panels=3),),
    )


def _turns(tasks: Mapping[int, Sequence[Task]]) -> Iterator[tuple[Task, str]]:
    """Both searches in turn on each task, small scenes first."""
    for _, some in sorted(tasks.items()):
        for task in some:
            for search in SEARCHES:
                yield task, search


def _with(config: PlannerConfig, search: str) -> PlannerConfig:
    return replace(config, search=search)


def _pair(task: Task, by: Mapping[str, Planned]) -> Pair:
    kept = ("status", "moved", "ambiguous", "cpu", *COUNTERS)
    return Pair(
        task=task.index,
        scene_id=task.scene.id,
        goal=str(task.goal),
        n_objects=task.n_objects,
        **{f"{key}_{name}": getattr(row, key) for name, row in by.items() for key in kept},
    )


def agreement_table(pairs: Sequence[Pair]) -> Table:
    """Whether both searches move the same objects."""
    plain = [pair for pair in pairs if not pair.flagged]
    same = sum(pair.same for pair in pairs)
    lines = (
        ("same end and same moved set", share(same, len(pairs))),
        ("same, or flagged ambiguous", share(_excused(pairs), len(pairs))),
        ("same among rows not flagged", share(sum(pair.same for pair in plain), len(plain))),
        ("flagged by either", share(len(pairs) - len(plain), len(pairs))),
    )
    return Table(
        name="agreement", title="Tree against informed", columns=("what", "found"), rows=lines
    )


def _excused(pairs: Sequence[Pair]) -> int:
    return sum(pair.same or pair.flagged for pair in pairs)


def counters_table(pairs: Sequence[Pair]) -> Table:
    """Work of both searches, side by side."""
    lines = []
    for search in SEARCHES:
        times = [1e3 * getattr(pair, f"cpu_{search}") for pair in pairs]
        counts = [np.mean([getattr(p, f"{name}_{search}") for p in pairs]) for name in COUNTERS]
        statuses = [getattr(pair, f"status_{search}") for pair in pairs]
        lines.append(
            (
                search,
                len(pairs),
                statuses.count("solved"),
                *(f"{float(count):.2f}" for count in counts),
                f"{interval(times, 'median'):.1f}",
                f"{interval(times, 'mean'):.1f}",
            )
        )
    columns = (
        "search", "tasks", "solved", "nodes", "pose checks", "keyframe NLPs", "path NLPs",
        "CPU ms, median", "CPU ms, mean",
    )  # fmt: skip
    return Table(name="counters", title="Work a task, mean", columns=columns, rows=tuple(lines))


def scaling_table(rows: Sequence[Planned], config: PlannerConfig) -> Table:
    """Time, nodes and outcome by search and number of boxes."""
    lines = []
    for search in SEARCHES:
        for boxes in sorted({row.n_objects for row in rows}):
            some = [row for row in rows if row.search == search and row.n_objects == boxes]
            times = [1e3 * row.cpu for row in some]
            lines.append(
                (
                    search,
                    boxes,
                    len(some),
                    *(sum(r.status == s for r in some) for s in ("solved", "infeasible", "limit")),
                    sum(row.n_actions > DEFAULTS.max_actions for row in some),
                    f"{interval(times, 'median'):.1f}",
                    f"{interval(times, 'mean'):.1f}",
                    f"{max(times):.0f}",
                    f"{float(np.median([row.nodes for row in some])):.0f}",
                    f"{float(np.mean([row.nodes for row in some])):.0f}",
                )
            )
    columns = (
        "search", "boxes", "tasks", "solved", "infeasible", "limit",
        f"over {DEFAULTS.max_actions} actions", "CPU ms, median", "CPU ms, mean", "CPU ms, max",
        "nodes, median", "nodes, mean",
    )  # fmt: skip
    title = (
        f"Growth with the number of boxes (up to {config.max_actions} actions, at most "
        f"{config.node_limit} nodes a goal)"
    )
    return Table(name="scaling", title=title, columns=columns, rows=tuple(lines))


def _listed(pairs: Sequence[Pair]) -> Table:
    return Table(
        name="apart",
        title="Tasks on which the searches differ, not flagged",
        columns=("task", "goal", "boxes", "informed", "tree"),
        rows=tuple(
            (
                pair.task,
                pair.goal,
                pair.n_objects,
                " ".join(pair.moved_informed) or pair.status_informed,
                " ".join(pair.moved_tree) or pair.status_tree,
            )
            for pair in pairs
        ),
    )
