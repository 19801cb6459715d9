"""What a beta would cost the planner: read off the reruns that there are, at betas and between.

`prune` plans over the objects that are kept, and those grow with beta, one by one. So a task needs
no rerun at a beta that keeps as many objects as one at which it was rerun: it is that run. Between
two of them its time is between theirs (in logarithms: a search grows by factors), and what keeps
every object is the unguided run and a look.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from relevance.metrics import Interval, over_groups, ratio_of_sums

_LEAST = 1e-6
"""Seconds; less is no time to take a logarithm of."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One guided run of a task."""

    kept: int
    """Objects that it planned over, goal objects included."""
    solved: bool
    seconds: float
    """CPU seconds of planning, the network's left out."""
    exact: bool = True
    """Whether it was run; otherwise it lies between two that were."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweptTask:
    """A task that the unguided planner solves, with its guided runs and its queries' scores."""

    scene_id: str
    n_objects: int
    unguided: float
    """CPU seconds."""
    network: float
    """CPU seconds of a look."""
    runs: tuple[Run, ...]
    """By the number of objects that they kept, the last over all objects."""
    scores: tuple[float, ...]
    """Of its queries."""
    relevant: tuple[float, ...]
    """Scores of the relevant ones."""

    def kept(self, beta: float) -> int:
        """How many objects a beta keeps, the two of the goal included."""
        return 2 + sum(score > -beta for score in self.scores)

    def at(self, beta: float) -> Run:
        """The run at a beta: one that was made, or what lies between two."""
        kept = self.kept(beta)
        above = next(run for run in self.runs if run.kept >= kept)
        if above.kept == kept:
            return above
        solved = above.solved and all(score > -beta for score in self.relevant)
        below = next((run for run in reversed(self.runs) if run.kept < kept), None)
        if below is None:  # fewer than was ever tried
            return replace(above, kept=kept, solved=solved, exact=False)
        share = (kept - below.kept) / (above.kept - below.kept)
        low, high = (math.log(max(run.seconds, _LEAST)) for run in (below, above))
        seconds = math.exp(low + share * (high - low))
        return Run(kept=kept, solved=below.solved or solved, seconds=seconds, exact=False)

    def cost(self, beta: float) -> float:
        """CPU seconds at a beta: the look, the guided run, and after a miss the unguided one."""
        run = self.at(beta)
        return self.network + run.seconds + (0.0 if run.solved else self.unguided)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingPoint:
    """What a beta does to the planner."""

    beta: float
    speedup: Interval
    """Sum of unguided over sum of guided seconds, misses counted."""
    misses: int
    n_tasks: int
    kept: float
    """Share of the objects that is planned over."""
    exact: float
    """Share of the tasks whose run is one that was made."""


def swept(
    rows: Iterable[Mapping[str, Any]], scored: Iterable[Mapping[str, Any]]
) -> dict[str, list[SweptTask]]:
    """The tasks that `prune` was rerun on, by search, from rows of `evaluations`.

    `scored` gives each task's queries as the lists `scores` and `relevant`. Tasks without scores
    (no label, or another checkpoint's) and those that the unguided planner leaves are left out.
    """
    known = {_name(row): row for row in scored}
    found: dict[str, dict[tuple[Any, ...], list[Mapping[str, Any]]]] = {}
    for row in rows:
        if row["guide"] == "prune" and row["solved_unguided"] and row["n_kept"]:
            found.setdefault(row["search"], {}).setdefault(_name(row), []).append(row)
    return {
        search: [_task(of, known[name]) for name, of in tasks.items() if name in known]
        for search, tasks in found.items()
    }


def working_point(tasks: Sequence[SweptTask], beta: float) -> WorkingPoint:
    """What a beta does to these tasks."""
    runs = [task.at(beta) for task in tasks]
    return WorkingPoint(
        beta=beta,
        speedup=over_groups(
            [task.scene_id for task in tasks],
            ratio_of_sums,
            [task.unguided for task in tasks],
            [task.cost(beta) for task in tasks],
        ),
        misses=sum(not run.solved for run in runs),
        n_tasks=len(tasks),
        kept=sum(run.kept for run in runs) / max(sum(task.n_objects for task in tasks), 1),
        exact=sum(run.exact for run in runs) / max(len(runs), 1),
    )


def saved(tasks: Sequence[SweptTask], betas: Iterable[float]) -> list[float]:
    """The speed-up at each beta, as `working_point` has it, without intervals."""
    unguided = sum(task.unguided for task in tasks)
    return [unguided / sum(task.cost(beta) for task in tasks) for beta in betas]


def _name(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("scene_id", "predicate", "subject", "reference"))


def _task(rows: Sequence[Mapping[str, Any]], scored: Mapping[str, Any]) -> SweptTask:
    n_objects, unguided = rows[0]["n_objects"], rows[0]["seconds_unguided"]
    runs = {n_objects: Run(kept=n_objects, solved=True, seconds=unguided)}
    for kept in {row["n_kept"] for row in rows}:
        mine = [row for row in rows if row["n_kept"] == kept]
        seconds = median(row["seconds_guided"] - row["seconds_inference"] for row in mine)
        runs[kept] = Run(kept=kept, solved=mine[0]["solved_guided"], seconds=max(seconds, 0.0))
    queries = list(zip(scored["scores"], scored["relevant"], strict=True))
    return SweptTask(
        scene_id=rows[0]["scene_id"],
        n_objects=n_objects,
        unguided=unguided,
        network=median(row["seconds_inference"] for row in rows),
        runs=tuple(runs[kept] for kept in sorted(runs)),
        scores=tuple(score for score, _ in queries),
        relevant=tuple(score for score, is_relevant in queries if is_relevant),
    )
