"""Runs of the planner as rows, figures with intervals, and how every part hands over its finds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.stats import binomtest

from relevance.benchmarks.tasks import Task
from relevance.metrics import Interval, bootstrap
from relevance.planner import PlannerConfig, PlanResult, plan
from relevance.report.tables import Table

# -- figures: one place knows how an interval is made ----------------------------------------------

CONFIDENCE = 0.95
STATISTICS: Mapping[str, Callable[..., Any]] = {
    "median": np.median,
    "mean": np.mean,
    "p90": lambda x, axis=None: np.quantile(x, 0.9, axis=axis),
    "p99": lambda x, axis=None: np.quantile(x, 0.99, axis=axis),
}


def interval(values: Sequence[float] | np.ndarray, statistic: str) -> Interval:
    """A statistic of a sample (N,) with its 95% interval; NaN throughout when empty."""
    sample = np.asarray(values, dtype=float)
    return bootstrap((sample,), STATISTICS[statistic], confidence=CONFIDENCE)


def ratio(a: Sequence[float], b: Sequence[float], statistic: str) -> Interval:
    """A statistic of `a` over that of `b`, the same tasks, with its paired 95% interval."""
    one = STATISTICS[statistic]

    def compute(x: np.ndarray, y: np.ndarray, axis: int = -1) -> Any:
        return one(x, axis=axis) / one(y, axis=axis)

    samples = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return bootstrap(samples, compute, confidence=CONFIDENCE)


def share(part: int, whole: int) -> str:
    """`995 of 1000 = 99.5% (98.8 to 99.8)`, Wilson's interval; `0 of 0` when there is nothing."""
    if whole == 0:
        return "0 of 0"
    ends = binomtest(part, whole).proportion_ci(CONFIDENCE, method="wilson")
    return f"{part} of {whole} = {part / whole:.1%} ({100 * ends.low:.1f} to {100 * ends.high:.1f})"


TIMES = (*STATISTICS, "max")


def milliseconds(seconds: Sequence[float] | np.ndarray) -> tuple[str, ...]:
    """Median, mean, p90, p99 with intervals and the largest, ms; the columns of TIMES."""
    ms = 1e3 * np.asarray(seconds, dtype=float)
    if len(ms) == 0:
        return ("-",) * len(TIMES)
    return (*(f"{interval(ms, name):.1f}" for name in STATISTICS), f"{ms.max():.1f}")


# -- what a part hands over ------------------------------------------------------------------------

Draw = Callable[..., None]
Progress = Callable[[int, int], None]
"""progress(done, total)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """A figure that is still to be drawn: draw(*axes)."""

    name: str
    draw: Draw
    panels: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What one part of a benchmark found."""

    name: str
    """Stem of its files."""
    rows: tuple[Any, ...]
    """Dataclasses of one kind, one a task."""
    tables: tuple[Table, ...]
    plots: tuple[Plot, ...] = field(default=())
    exceptions: tuple[Task, ...] = field(default=())
    """Tasks in which the planner does less than a referee."""

    def records(self) -> list[dict[str, Any]]:
        """The rows as flat dicts, sequences as one text."""
        return [
            {
                key: " ".join(map(str, value)) if isinstance(value, tuple) else value
                for key, value in asdict(row).items()
            }
            for row in self.rows
        ]


# -- a run of the planner --------------------------------------------------------------------------

DEFAULTS = PlannerConfig()
"""What is measured unless said otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Planned:
    """One task planned by us, and what the replay said of the plan; s and m."""

    task: int
    scene_id: str
    predicate: str
    subject: str
    reference: str
    n_objects: int
    search: str
    status: str
    reason: str
    n_actions: int
    moved: tuple[str, ...]
    ambiguous: bool
    nodes: int
    pose_checks: int
    keyframe_nlps: int
    path_nlps: int
    cpu: float
    wall: float
    cpu_pose: float
    cpu_keyframe: float
    cpu_path: float
    max_penetration: float | None = None
    """By the planner's own dense check; None where there is no plan."""
    replay_ok: bool | None = None
    replay_max_penetration: float | None = None
    replay_reason: str = ""
    replay_cpu: float | None = None
    check_cpu: float | None = None
    """Of the dense check alone, made again from the finished plan, its geometry prepared anew."""

    @property
    def solved(self) -> bool:
        """Whether there is a plan."""
        return self.status == "solved"

    @property
    def cpu_rest(self) -> float:
        """What no bound accounts for: logic, search, bookkeeping, s."""
        return self.cpu - self.cpu_pose - self.cpu_keyframe - self.cpu_path


def planned(task: Task, config: PlannerConfig) -> tuple[Planned, PlanResult]:
    """Plan one task, timed."""
    result, cpu, wall = timed_plan(task, config)
    row = Planned(
        task=task.index,
        scene_id=task.scene.id,
        predicate=task.goal.predicate.name,
        subject=task.goal.subject,
        reference=task.goal.reference,
        n_objects=task.n_objects,
        search=config.search,
        status=result.status,
        reason=result.reason,
        n_actions=len(result.actions),
        moved=result.moved,
        ambiguous=result.ambiguous,
        nodes=result.counts.nodes,
        pose_checks=result.counts.pose,
        keyframe_nlps=result.counts.keyframe,
        path_nlps=result.counts.path,
        cpu=cpu,
        wall=wall,
        cpu_pose=result.seconds.pose,
        cpu_keyframe=result.seconds.keyframe,
        cpu_path=result.seconds.path,
        max_penetration=result.max_penetration if result.status == "solved" else None,
    )
    return row, result


def timed_plan(task: Task, config: PlannerConfig) -> tuple[PlanResult, float, float]:
    """The plan, and the CPU and wall seconds that it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = plan(task.scene, task.goal, config=config, replay=False)
    return result, time.process_time() - cpu, time.perf_counter() - wall
