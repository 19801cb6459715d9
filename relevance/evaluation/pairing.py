"""The planner by several ways on one task, side by side: how every comparison of guides is timed.

- Paired and interleaved: all ways plan a task one right after the other in one process, in an
  order that is drawn for each task: a busy machine favours nobody, nor does who comes before (a
  network that looks leaves cold caches behind).
- Equal stops: a guide whose first plan counts stands beside an unguided search of which the first
  plan counts, every other one beside an unguided search that stops as it does.
- All of it counts: guided time includes the network and every fallback. The scene is encoded anew
  in each run, as though its goal came alone; `seconds_encoding` is what further goals of the scene
  would not pay again. The picture itself is the camera's work and is not timed.
- CPU time as the planner has it (all threads; networks have one), so that a shared machine does not
  blur it. rai works in a subprocess: its time there counts, that of loading it does not.
- The replay of a plan is on neither side: both would pay the same for it.
- Nor is Python's garbage collection, as in `timeit`: a full one looks through all that the process
  holds (0.1 s, as long as planning thirty easy tasks) and falls to whoever happens to run.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from relevance.evaluation.priors import prior_name
from relevance.evaluation.scorer import NetworkScorer, guide_by
from relevance.planner import (
    GUIDES,
    PLANNER_VERSION,
    PLANNERS,
    Guide,
    Planner,
    PlannerConfig,
    PlanResult,
    Scorer,
)
from relevance.scene import Goal, Scene

Stop = Literal["first", "level"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """A guided run that is asked for: whose scores, and how they enter the search."""

    prior: str
    """Who gives the scores."""
    scorer: Scorer
    mode: str
    """A name in GUIDES."""
    beta: float = 0.0

    @property
    def guide(self) -> Guide:
        """For the planner."""
        return guide_by(self.scorer, self.mode, self.beta)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timed:
    """One way to plan a task, timed; CPU seconds."""

    result: PlanResult
    seconds: float
    look: float = 0.0
    """Part of it that asking for scores took."""
    encoding: float = 0.0
    """Part of that which all goals of the scene share."""

    @property
    def solved(self) -> bool:
        """Whether there is a plan."""
        return self.result.status == "solved"

    @property
    def length(self) -> int | None:
        """Actions of the plan."""
        return len(self.result.actions) if self.solved else None

    @property
    def nlps(self) -> int:
        """Keyframe and path programs."""
        return self.result.counts.keyframe + self.result.counts.path


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """A guided run, and the unguided one that stops as it does."""

    asked: Asked
    stop: Stop
    unguided: Timed
    guided: Timed

    def row(self, scene: Scene, goal: Goal, kept: int | None = None) -> dict[str, Any]:
        """The columns of `evaluations` that one task and guide decide."""
        return {
            "prior": prior_name(self.asked.prior),
            "guide": self.asked.mode,
            "beta": self.asked.beta,
            "stop": self.stop,
            "scene_id": scene.id,
            "predicate": goal.predicate.name,
            "subject": goal.subject,
            "reference": goal.reference,
            "n_objects": len(scene.objects),
            "solved_unguided": self.unguided.solved,
            "solved_guided": self.guided.solved,
            "seconds_unguided": self.unguided.seconds,
            "seconds_guided": self.guided.seconds,
            "seconds_inference": self.guided.look,
            "seconds_encoding": self.guided.encoding,
            "looked": self.guided.result.looked,
            "nodes_unguided": self.unguided.result.counts.nodes,
            "nodes_guided": self.guided.result.counts.nodes,
            "nlps_unguided": self.unguided.nlps,
            "nlps_guided": self.guided.nlps,
            "sequences_unguided": self.unguided.result.counts.sequences,
            "sequences": self.guided.result.counts.sequences,
            "n_actions_unguided": self.unguided.length,
            "n_actions_guided": self.guided.length,
            "n_kept": kept,
            "planner_version": PLANNER_VERSION,
        }


def side_by_side(
    scene: Scene,
    goal: Goal,
    asked: Sequence[Asked],
    config: PlannerConfig,
    *,
    turn: int = 0,
    repeats: int = 1,
) -> list[Pair]:
    """Plan a task unguided and in every way that is asked for; one pair a way, in their order.

    `turn` draws who goes when; of `repeats` the median counts. Every scorer has to have seen the
    scene.
    """
    stops: list[Stop] = ["first" if GUIDES[each.mode].first else config.stop for each in asked]
    ways: list[tuple[Guide | None, PlannerConfig]] = [
        (None, replace(config, stop=stop)) for stop in dict.fromkeys(stops)
    ]
    ways += [(each.guide, config) for each in asked]
    ours = PLANNERS["ours"]
    runs: list[list[Timed]] = [[] for _ in ways]
    for repeat in range(repeats):
        for which in _drawn(len(ways), turn, repeat):
            guide, its = ways[which]
            runs[which].append(timed(ours, scene, goal, its, guide))
    middle = [_middle(some) for some in runs]
    unguided: Mapping[Stop, Timed] = dict(zip(dict.fromkeys(stops), middle, strict=False))
    return [
        Pair(asked=each, stop=stop, unguided=unguided[stop], guided=found)
        for each, stop, found in zip(asked, stops, middle[len(unguided) :], strict=True)
    ]


def _drawn(count: int, *which: int) -> list[int]:
    """An order of the ways, by which task and repeat it is of."""
    return np.random.default_rng(which).permutation(count).tolist()


def _middle(runs: Sequence[Timed]) -> Timed:
    """The first of equal runs, with the median times of all."""
    return replace(
        runs[0],
        **{
            name: float(np.median([getattr(run, name) for run in runs]))
            for name in ("seconds", "look", "encoding")
        },
    )


def beside_another(
    planner: Planner,
    scene: Scene,
    goal: Goal,
    asked: Callable[[PlanResult], Sequence[Asked]],
    config: Any,
    *,
    turn: int = 0,
) -> tuple[Timed, list[Pair]]:
    """Plan a task by another planner, unguided and then in every way that is asked for, given what
    it found; one pair a way, none where it finds no plan. Its first plan counts.

    `turn` draws who goes when of the guided ones.
    """
    unguided = timed(planner, scene, goal, config)
    ways = asked(unguided.result) if unguided.solved else []
    found: dict[int, Timed] = {}
    for which in _drawn(len(ways), turn):
        found[which] = timed(planner, scene, goal, config, ways[which].guide)
    return unguided, [
        Pair(asked=each, stop="first", unguided=unguided, guided=found[which])
        for which, each in enumerate(ways)
    ]


def timed(
    planner: Planner, scene: Scene, goal: Goal, config: Any, guide: Guide | None = None
) -> Timed:
    """One run, without the replay of its plan."""
    network = guide.scorer if guide and isinstance(guide.scorer, NetworkScorer) else None
    if network:
        network.forget()
    with _uncollected():
        result = planner.plan(scene, goal, config=config, guide=guide, replay=False)
    encoding = network.seconds_encoding if network and result.looked else 0.0
    return Timed(
        result=result,
        seconds=result.seconds.total,
        look=result.seconds.guide,
        encoding=encoding,
    )


@contextmanager
def _uncollected() -> Iterator[None]:
    """Without garbage collection; afterwards it is as it was."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
