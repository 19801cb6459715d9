"""Multi-bound tree search over pick and place, and how scores guide it.

Breadth-first by plan length. Each node is tested by the bounds in order of their cost: logic,
pose, keyframe, path; a refused prefix is dropped with all below it. The level in which a plan
is found is finished, and the plan of lowest cost counts (rounded, ties by object index), so
that labels do not depend on the order of search.

`tree` extends every sequence by every object (the paper's uninformed search). `informed` goes
through sets of objects, not sequences, and adds to a set only what could help: what reaches
into the goal region, or is in the way of a pick that the set needs. It plans one order of a
set, the others only when that fails.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import Any, Literal, Protocol

from relevance.planner import logic
from relevance.planner.problem import Counts, Motion, Problem, Seconds
from relevance.registry import Registry
from relevance.scene import (
    Action,
    Box,
    Goal,
    Phase,
    Pose,
    Scene,
    SceneError,
    footprint_gap,
    goal_holds,
)

PLANNER_VERSION = "4"
ORDERS = 6
"""How many orders of a set `informed` tries."""
COST_TOLERANCE = 1e-3
"""Costs are compared after rounding to this, rad^2."""
GUIDES = ("none", "prune", "prune-then-full", "expand", "order")
Mode = Literal["none", "prune", "prune-then-full", "expand", "order"]


class Scorer(Protocol):
    """Says how relevant each object is."""

    def scores(self, scene: Scene, goal: Goal) -> Mapping[str, float]:
        """Logit of relevance for every object of the scene."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Guide:
    """How scores enter the search (DESIGN section 2); goal objects always stay."""

    scorer: Scorer
    mode: Mode = "prune-then-full"
    beta: float = 0.0
    """An object is kept iff its score > -beta; a larger beta keeps more."""

    def __post_init__(self) -> None:
        if self.mode not in GUIDES:
            raise ValueError(f"guide {self.mode!r}: expected one of {', '.join(GUIDES)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannerConfig:
    """Settings that labels depend on; their hash is stored with every row."""

    search: Literal["tree", "informed"] = "informed"
    max_actions: int = 6
    node_limit: int = 20_000

    def __post_init__(self) -> None:
        if self.search not in ("tree", "informed"):
            raise ValueError(f"search {self.search!r}: expected tree or informed")
        if self.max_actions < 2 or self.max_actions % 2:
            raise ValueError(f"max_actions {self.max_actions}: expected an even number >= 2")
        if self.node_limit < 1:
            raise ValueError(f"node_limit {self.node_limit}: expected at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanResult:
    """What the planner found, and what it cost to find it."""

    goal: Goal
    status: Literal["solved", "infeasible", "limit", "refused"]
    reason: str = ""
    actions: tuple[Action, ...] = ()
    moved: tuple[str, ...] = ()
    """Moved objects, in order."""
    alternatives: tuple[tuple[str, ...], ...] = ()
    """Moved objects of every plan of this length that was found, in order; the best first."""
    final: dict[str, Pose]
    cost: float = math.nan
    """Squared joint accelerations, summed over rows, rad^2."""
    ambiguous: bool = False
    """Whether another set of moved objects does as well, a bound was left open or a late one
    refused, or a box standing 0.2 mm elsewhere might have changed a decision."""
    counts: Counts
    check_ok: bool = False
    max_penetration: float = 0.0
    """Deepest penetration at the sub-steps of the dense check, m."""
    phases: tuple[Phase, ...] = ()
    seconds: Seconds
    replay: Any = None
    """The verdict of the replay in the simulator; None where the plan was not replayed."""


class _Limit(Exception):
    """The node limit was reached."""


def plan(
    scene: Scene,
    goal: Goal | str,
    *,
    config: PlannerConfig = PlannerConfig(),
    guide: Guide | None = None,
    movable: Collection[str] | None = None,
    replay: bool = False,
) -> PlanResult:
    """Find the shortest sequence of picks and places, and its motion, that makes the goal true.

    movable: the objects that may be moved (None: all). replay: whether the simulator has to
    confirm the plan; this is not counted in its seconds. Raises SceneError for an unknown
    predicate or object. A goal that cannot be reached is a result with a reason.
    """
    found = _plan(scene, scene.goal(goal), config, guide, movable)
    return replayed(scene, found) if replay else found


def replayed(scene: Scene, result: PlanResult) -> PlanResult:
    """The result with the replay's verdict; a plan that the replay does not confirm is refused."""
    if result.status != "solved":
        return result
    from relevance.simulation import replay

    verdict = replay(scene, result.goal, result.phases)
    if verdict.ok:
        return replace(result, replay=verdict)
    reason = f"the replay does not confirm the plan: {verdict.reason}"
    return replace(result, status="refused", reason=reason, replay=verdict)


def _plan(
    scene: Scene,
    goal: Goal,
    config: PlannerConfig,
    guide: Guide | None,
    movable: Collection[str] | None,
) -> PlanResult:
    everything = frozenset(scene.names if movable is None else movable)
    for name in everything - set(scene.names):
        raise SceneError(f"movable: no object {name!r}, expected some of {', '.join(scene.names)}")
    began = time.process_time()
    if goal_holds(scene.objects, goal, scene.robot):
        seconds = Seconds(total=time.process_time() - began)
        return PlanResult(
            goal=goal, status="solved", final={}, cost=0.0, check_ok=True, counts=Counts(),
            seconds=seconds,
        )  # fmt: skip
    problem = Problem(scene, goal)
    scores = None
    if guide is not None and guide.mode != "none":
        scored = time.process_time()
        scores = guide.scorer.scores(scene, goal)
        problem.seconds.guide = time.process_time() - scored
    result = None
    for allowed in rounds(everything, goal, guide, scores):
        search = _Search(problem, config, allowed, scores if _ordered(guide) else None)
        result = search.run(began)
        if result.status == "solved":
            break
    assert result is not None
    return result


def penetration(scene: Scene, result: PlanResult) -> float:
    """Worst penetration (m) of a plan by the planner's own dense check, from the plan alone."""
    motion = Motion(
        order=result.moved, phases=result.phases, final=result.final, cost=result.cost,
        max_penetration=result.max_penetration,
    )  # fmt: skip
    return Problem(scene, result.goal).penetration(motion)


@cache
def warm_up() -> None:
    """Compile the solvers now (once a process), so that no plan's time includes it."""
    color = (0.5, 0.5, 0.5)
    boxes = [
        Box(name=name, size=(0.05, 0.05, 0.05), position=(0.0, y, 0.025), color=color)
        for name, y in (("a", 0.2), ("b", 0.0))
    ]
    plan(Scene(objects=tuple(boxes)), "on(a, b)", replay=False)


class Ours:
    """This planner, as the registry has it."""

    Config = PlannerConfig
    plan = staticmethod(plan)
    warm_up = staticmethod(warm_up)

    def require(self) -> None:
        """It always can."""


PLANNERS: Registry[Any] = Registry("planner")
PLANNERS.register("ours", Ours())


def _ordered(guide: Guide | None) -> bool:
    return guide is not None and guide.mode == "order"


def rounds(everything: frozenset[str], goal: Goal, guide: Guide | None, scores):
    """The object sets that a guide lets the search move, one after the other."""
    if guide is None or scores is None or guide.mode == "order":
        yield everything
        return
    always = everything & {goal.subject, goal.reference}
    kept = frozenset(n for n in everything if scores[n] > -guide.beta or n in always)
    yield kept
    if guide.mode == "prune-then-full" and kept != everything:
        yield everything
    if guide.mode == "expand":
        for name in sorted(everything - kept, key=lambda n: -scores[n]):
            kept |= {name}
            yield kept


class _Search:
    def __init__(self, problem: Problem, config: PlannerConfig, allowed, scores) -> None:
        self.problem, self.config, self.allowed, self.scores = problem, config, allowed, scores
        self.order = [n for n in problem.boxes if n in allowed]
        if scores is not None:
            self.order.sort(key=lambda n: -scores[n])
        self.index = {name: i for i, name in enumerate(problem.boxes)}
        self.reason = ""
        self.refused_late = False

    def run(self, began: float) -> PlanResult:
        problem, goal = self.problem, self.problem.goal
        self.reason = self._hopeless()
        found: list[Motion] = []
        status = "infeasible"
        if not self.reason:
            self.reason = f"no plan of up to {self.config.max_actions} actions"
            try:
                found = self._plans()
            except _Limit:
                status, self.reason = "limit", f"node limit {self.config.node_limit} reached"
        problem.seconds.total = time.process_time() - began
        if not found:
            return PlanResult(
                goal=goal, status=status, reason=self.reason, final={},
                ambiguous=problem.undecided or self.refused_late, counts=problem.counts,
                seconds=problem.seconds,
            )  # fmt: skip
        found.sort(key=self._rank)
        best = found[0]
        sets = {frozenset(motion.order) for motion in found}
        return PlanResult(
            goal=goal,
            status="solved",
            actions=logic.actions(goal, best.order),
            moved=best.order,
            alternatives=tuple(motion.order for motion in found),
            final=best.final,
            cost=best.cost,
            ambiguous=problem.undecided or self.refused_late or len(sets) > 1,
            counts=problem.counts,
            check_ok=True,
            max_penetration=best.max_penetration,
            phases=best.phases,
            seconds=problem.seconds,
        )

    def _rank(self, motion: Motion):
        return round(motion.cost / COST_TOLERANCE), [self.index[n] for n in motion.order]

    def _hopeless(self) -> str:
        """Why no sequence can work even if everything else were gone; empty if one might."""
        problem, goal = self.problem, self.problem.goal
        if goal.subject not in self.allowed:
            return f"{goal.subject} may not be moved"
        if not problem.grasps(goal.subject):
            return f"{goal.subject} cannot be grasped: too wide for the hand or out of reach"
        if not (self._within_reach() or self._reference_moves()):
            return "the goal region is out of reach, off the table or too tight for the hand"
        return ""

    def _within_reach(self) -> bool:
        """Whether the goal region has room for the subject where the reference stands."""
        problem, goal = self.problem, self.problem.goal
        others = frozenset(problem.boxes) - {goal.subject, goal.reference}
        return any(
            problem.goal_pose(others, grasp, problem.boxes[goal.reference]) is not None
            for grasp in problem.grasps(goal.subject)
        )

    def _reference_moves(self) -> bool:
        reference = self.problem.goal.reference
        allowed = reference in self.allowed and self.config.max_actions >= 4
        return allowed and bool(self.problem.grasps(reference))

    def _visit(self) -> None:
        self.problem.counts.nodes += 1
        if self.problem.counts.nodes > self.config.node_limit:
            raise _Limit

    def _plans(self) -> list[Motion]:
        """All plans of the first level that has one.

        The reference is a landmark: sequences that move it count only when no other does it.
        """
        reference, found = self.problem.goal.reference, []
        levels = self._sequences if self.config.search == "tree" else self._sets
        if self._within_reach():
            found = levels([name for name in self.order if name != reference], frozenset())
        if not found and self._reference_moves():
            found = levels(self.order, frozenset({reference}))
        return found

    def _sequences(self, movable: list[str], required: frozenset[str]) -> list[Motion]:
        """Breadth-first over sequences of objects moved before the subject."""
        subject = self.problem.goal.subject
        frontier: list[tuple[str, ...]] = [()]
        for _ in range(self.config.max_actions // 2):
            found, following = [], []
            for prefix in frontier:
                self._visit()
                if required <= set(prefix):
                    motion = self._finish(frozenset(prefix), [prefix])
                    if motion is not None:
                        found.append(motion)
                        if self.scores is not None:
                            return found
                for name in movable:
                    if name == subject or name in prefix:
                        continue
                    self._visit()
                    if self.problem.pickable(name, frozenset(prefix)):
                        self._visit()
                        following.append((*prefix, name))
            if found:
                return found
            frontier = following
        return []

    def _sets(self, movable: list[str], required: frozenset[str]) -> list[Motion]:
        """Breadth-first over sets of objects moved before the subject, grown by what could help."""
        subject, near = self.problem.goal.subject, beside_goal(self.problem)
        rank = {name: i for i, name in enumerate(movable) if name != subject}
        frontier: list[frozenset[str]] = [frozenset()]
        for _ in range(self.config.max_actions // 2):
            found, following = [], set()
            for chosen in frontier:
                self._visit()
                if required <= chosen:
                    motion = self._finish(chosen, islice(self._orders(chosen), ORDERS))
                    if motion is not None:
                        found.append(motion)
                        if self.scores is not None:
                            return found
                helpful = near | self._in_the_way(chosen)
                following |= {chosen | {name} for name in helpful - chosen if name in rank}
            if found:
                return found
            frontier = sorted(following, key=lambda names: sorted(rank[name] for name in names))
        return []

    def _in_the_way(self, chosen: frozenset[str]) -> frozenset[str]:
        """What blocks the picks that a set needs: the subject's by any grasp, and its own."""
        problem, goal = self.problem, self.problem.goal
        needed = [goal.subject, *(n for n in chosen if not problem.pickable(n, chosen))]
        found = frozenset().union(*(problem.above[name].union(*problem.blockers(name).values())
                                    for name in needed))  # fmt: skip
        return found - {goal.subject}

    def _orders(self, chosen: frozenset[str]) -> Iterator[tuple[str, ...]]:
        """The orders in which a set can be picked."""

        def extend(prefix: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
            if len(prefix) == len(chosen):
                yield prefix
            for name in self.order:
                if name not in chosen or name in prefix:
                    continue
                if self.problem.pickable(name, frozenset(prefix)):
                    yield from extend((*prefix, name))

        return extend(())

    def _finish(self, gone: frozenset[str], prefixes: Iterable[tuple[str, ...]]) -> Motion | None:
        """Pick the subject once `gone` have left and place it at the goal: all bounds in turn."""
        problem, goal = self.problem, self.problem.goal
        options = problem.pickable(goal.subject, gone)
        if goal.reference not in gone:
            reference = problem.boxes[goal.reference]
            options = [g for g in options if problem.goal_pose(gone, g, reference) is not None]
        if not options:
            return None
        self._visit()
        for prefix in prefixes:
            order = (*prefix, goal.subject)
            for grasp in options:
                placements = problem.place_all(order, grasp)
                if placements is None:
                    problem.undecided = True
                    continue
                solved = problem.keyframes(order, placements)
                if solved is not None:
                    motion = problem.paths(order, placements, *solved)
                    if motion is not None:
                        return motion
                self.refused_late = True
        return None


def beside_goal(problem: Problem) -> frozenset[str]:
    """Objects whose leaving can make room in the goal region; and the reference."""
    goal = problem.goal
    subject, reference = problem.boxes[goal.subject], problem.boxes[goal.reference]
    x, y, angle, a, b = problem.goal_region(reference)
    spread = max(
        math.hypot(abs(part[0]) + part[1], part[2])
        for grasp in problem.grasps(subject.name)
        for part in grasp.parts
    )
    area = Box(
        name="area",
        size=(2 * (a + spread) + 0.02, 2 * (b + spread) + 0.02, 1.0),
        position=(x, y, 0.5),
        yaw=angle,
        color=(0.0, 0.0, 0.0),
    )
    near = {box.name for box in problem.scene.objects if footprint_gap(area, box) <= 0}
    return frozenset(near | {reference.name}) - {subject.name}
