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

import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from itertools import compress, islice

from relevance.planner import logic
from relevance.planner.checking import broken
from relevance.planner.compiling import compile_once, other_half
from relevance.planner.grasps import fits, grasps
from relevance.planner.guides import Guide, ask, rounds
from relevance.planner.kernels.planar import reaching_into
from relevance.planner.keyframes import KeyframeBound
from relevance.planner.path import Motion, PathBound
from relevance.planner.pose import PoseBound
from relevance.planner.problem import Problem
from relevance.planner.result import (
    Counts,
    PlannerConfig,
    PlanResult,
    Seconds,
    Status,
    movable_names,
    replayed,
)
from relevance.scene import Box, Goal, Scene, goal_holds

TRIES = 200
"""How many sets are looked at to say what stands in the way."""
LOOK = 2
"""From how many objects on the search first asks which can be picked at all."""
ORDERS = 6
"""How many orders of a set `informed` tries."""
COST_TOLERANCE = 1e-3
"""Costs are compared after rounding to this, rad^2."""


class _Limit(Exception):
    """The node limit was reached."""


def plan(
    scene: Scene,
    goal: Goal | str,
    *,
    config: PlannerConfig | None = None,
    guide: Guide | None = None,
    movable: Collection[str] | None = None,
    replay: bool = True,
) -> PlanResult:
    """Find the shortest sequence of picks and places, and its motion, that makes the goal true.

    config None: the defaults. movable: the objects that may be moved (None: all). replay: whether
    the plan is executed again in the simulator, which has to confirm it; this is not counted in
    its seconds. Raises SceneError for an unknown predicate or object. A goal that cannot be
    reached is a result with a reason.
    """
    warm_up()
    found = _plan(scene, scene.goal(goal), config or PlannerConfig(), guide, movable)
    return replayed(scene, found) if replay else found


def _plan(
    scene: Scene,
    goal: Goal,
    config: PlannerConfig,
    guide: Guide | None,
    movable: Collection[str] | None,
) -> PlanResult:
    everything = movable_names(scene, movable)
    began = time.process_time()
    if goal_holds(scene.objects, goal, scene.robot):
        seconds = Seconds(total=time.process_time() - began)
        return PlanResult(
            goal=goal, status="solved", final={}, cost=0.0, check_ok=True, counts=Counts(),
            seconds=seconds,
        )  # fmt: skip
    bounds = _Bounds(problem=Problem(scene, goal))
    scored = time.process_time()
    scores = ask(guide, scene, goal)
    bounds.problem.seconds.guide = time.process_time() - scored
    todo = rounds(everything, goal, guide, scores)
    *early, last = todo.allowed
    budget, result = config.node_limit, None
    for allowed in early:  # these share one limit, the last round has it whole
        before = bounds.problem.counts.nodes
        result = _Search(bounds, config, allowed, todo.scores, budget).run(began)
        budget -= bounds.problem.counts.nodes - before
        if result.status == "solved":
            return result
        if budget <= 0:
            break
    result = _Search(bounds, config, last, todo.scores, config.node_limit).run(began)
    hopeless = result.status == "infeasible" and not result.blocking
    if result.status != "solved" and guide is not None and last != everything and not hopeless:
        kept = ", ".join(name for name in scene.names if name in last)
        reason = f"none that moves only what was kept ({kept}): {result.reason}"
        result = replace(result, reason=reason)
    return result


class Ours:
    """This planner, as the registry has it."""

    name = "ours"
    Config = PlannerConfig

    def require(self) -> None:
        """It always can."""

    def warm_up(self) -> None:
        """Compile the solvers."""
        warm_up()

    def plan(
        self,
        scene: Scene,
        goal: Goal | str,
        *,
        config: PlannerConfig | None = None,
        guide: Guide | None = None,
        movable: Collection[str] | None = None,
        replay: bool = True,
    ) -> PlanResult:
        """As `plan`."""
        return plan(scene, goal, config=config, guide=guide, movable=movable, replay=replay)


@cache
def warm_up() -> None:
    """Compile or load the solvers, once a process, so that no plan's time includes it."""
    compile_once(_one_of_each)


def _one_of_each() -> None:
    """Plans that need every kernel: a box in the way, one that its neighbours let the hand take
    by its top alone, and a tall one."""
    grey, cube = (0.5, 0.5, 0.5), (0.05, 0.05, 0.05)
    scene = Scene(
        objects=(
            Box(name="a", size=(0.05, 0.05, 0.06), position=(0.0, 0.2, 0.03), color=grey),
            Box(name="d", size=(0.05, 0.05, 0.04), position=(0.055, 0.2, 0.02), color=grey),
            Box(name="e", size=(0.05, 0.05, 0.04), position=(0.0, 0.255, 0.02), color=grey),
            Box(name="b", size=cube, position=(0.0, 0.0, 0.025), color=grey),
            Box(name="c", size=cube, position=(0.0, 0.0, 0.075), color=grey, on="b"),
            Box(name="f", size=(0.2, 0.04, 0.3), position=(0.1, -0.3, 0.15), color=grey),
        )
    )
    for goal in ("on(a, b)", "on-the-left(b, a)", "in-front(f, a)"):
        _plan(scene, scene.goal(goal), PlannerConfig(), None, None)
    other_half()


class _Bounds:
    """The bounds of one problem, in order of their cost."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.pose = PoseBound(problem)
        self.keyframes = KeyframeBound(self.pose)
        self.path = PathBound(problem)


class _Search:
    """One round: a search that may move some objects, within a number of nodes."""

    def __init__(
        self,
        bounds: _Bounds,
        config: PlannerConfig,
        allowed: frozenset[str],
        scores: Mapping[str, float] | None,
        limit: int,
    ) -> None:
        problem = bounds.problem
        self.problem, self.bounds, self.pose = problem, bounds, bounds.pose
        self.config, self.allowed = config, allowed
        self.order = [n for n in problem.boxes if n in allowed]
        if scores is not None:
            self.order.sort(key=lambda n: -scores[n])
        self.limit = problem.counts.nodes + limit
        self.refused_late = False
        self.stuck = frozenset[str]()
        """What can never be picked."""
        self.late = False
        """Whether the last set passed all relaxations, and failed after."""
        self.cut = False
        """Whether plans of more actions than allowed were left untried."""

    def run(self, began: float) -> PlanResult:
        problem, goal = self.problem, self.problem.goal
        found: list[Motion] = []
        status, reason, blocking = self._hopeless()
        if status is None:
            try:
                found = self._plans()
            except _Limit:
                status, reason = "limit", f"node limit: {self.config.node_limit} nodes were opened"
            if not found:
                blocking = self._blocking()
                if status is None:
                    undecided = self.cut or problem.open
                    status = "limit" if undecided and self._might() else "infeasible"
                reason = reason or self._exhausted(status, blocking)
        seconds = problem.seconds
        seconds.total = time.process_time() - began
        seconds.pose = seconds.total - seconds.keyframe - seconds.path - seconds.guide
        if not found:
            assert status is not None
            return PlanResult(
                goal=goal, status=status, reason=reason, blocking=blocking, final={},
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

    def _rank(self, motion: Motion) -> tuple[int, list[int]]:
        problem = self.problem
        return round(motion.cost / COST_TOLERANCE), [problem.index[n] for n in motion.order]

    def _hopeless(self) -> tuple[Status | None, str, tuple[str, ...]]:
        """Why no sequence can work even if everything else were gone; no status if one might."""
        goal, problem = self.problem.goal, self.problem
        if goal.subject not in self.allowed:
            return "infeasible", f"{goal.subject} may not be moved", (goal.subject,)
        if not self.pose.grasps(goal.subject):
            why = self._why_not(goal.subject)
            return "infeasible", f"{goal.subject} cannot be grasped: {why}", ()
        if not (self._within_reach() or self._reference_moves()):
            reason = "the goal region is out of reach, off the table or too tight for the hand"
            return ("limit" if problem.open else "infeasible"), reason, ()
        return None, "", ()

    def _might(self) -> bool:
        """Whether a plan is possible once all that can leave has left, or the reference moves."""
        goal = self.problem.goal
        gone = frozenset(self.order) - self.stuck - {goal.subject, goal.reference}
        return self._reference_moves() or self._works(gone)

    def _stuck(self) -> frozenset[str]:
        """What can never be picked: it cannot be grasped, or carries what does not leave first."""
        stays = set(self.problem.boxes) - self.allowed | {self.problem.goal.subject}
        stays |= {name for name in self.allowed if not self.pose.grasps(name)}
        return frozenset(name for name in self.allowed if self._carried_by(name) & stays) | stays

    def _exhausted(self, status: Status, blocking: tuple[str, ...]) -> str:
        """Why the search ended without a plan, in the words of the task."""
        goal, problem = self.problem.goal, self.problem
        said = []
        if blocking:
            said.append(f"{', '.join(blocking)} would have to leave first")
            leaving = frozenset(self._leaving([n for n in self.order if n not in self.stuck]))
            for name in blocking:
                if name not in self.allowed:
                    said.append(f"{name} may not be moved")
                elif goal.subject in self._carried_by(name):
                    said.append(
                        f"{goal.subject} stands on {name} and would have to move twice, "
                        "while a plan moves each object once"
                    )
                elif not self.pose.grasps(name):
                    said.append(f"{name} cannot be grasped: {self._why_not(name)}")
                elif beside := self.pose.missing(name, leaving):
                    names = [other for other in problem.boxes if other in beside]
                    stand = "stand" if len(names) > 1 else "stands"
                    said.append(f"{name} cannot be taken while {', '.join(names)} {stand} there")
        if self.cut and status == "limit":
            said.append(f"max_actions: no plan of up to {self.config.max_actions} actions")
        if status == "limit":
            said += [f"undecided: {what}" for what in sorted(problem.open)]
        return "; ".join(said) or "nothing that may be moved would help"

    def _carried_by(self, name: str) -> frozenset[str]:
        """All that stands on an object, over others too."""
        found, above = frozenset(), self.problem.above[name]
        while not above <= found:
            found |= above
            above = frozenset().union(*(self.problem.above[other] for other in found))
        return found

    def _blocking(self) -> tuple[str, ...]:
        """A smallest set without which the subject could be taken and put down; the first that
        is found within TRIES, empty if none is."""
        problem, near, tries = self.problem, self._beside_goal(), 0
        goal, frontier = problem.goal, [frozenset[str]()]
        while frontier:
            following: dict[frozenset[str], None] = {}
            for gone in frontier:
                tries += 1
                if tries > TRIES:
                    return ()
                if self.pose.pickable(goal.subject, gone) and any(
                    self.pose.goal_poses(gone, problem.reference)
                ):
                    return tuple(name for name in problem.boxes if name in gone)
                helpful = (near | self.pose.in_the_way(goal.subject)) - gone
                for name in sorted(helpful - {goal.subject, goal.reference}):
                    following[gone | {name}] = None
            frontier = list(following)
        return ()

    def _why_not(self, name: str) -> str:
        """Why an object cannot be grasped wherever the others are."""
        box = self.problem.boxes[name]
        if grasps(box):
            return "out of reach"
        return "too low for the fingers" if fits(box) else "too wide for the hand"

    def _within_reach(self) -> bool:
        """Whether the goal region has room for the subject where the reference stands."""
        problem, goal = self.problem, self.problem.goal
        others = frozenset(problem.boxes) - {goal.subject, goal.reference}
        return any(self.pose.goal_poses(others, problem.reference, everywhere=True))

    def _reference_moves(self) -> bool:
        reference = self.problem.goal.reference
        allowed = reference in self.allowed and self.config.max_actions >= 4
        return allowed and bool(self.pose.grasps(reference))

    def _visit(self) -> None:
        self.problem.counts.nodes += 1
        if self.problem.counts.nodes > self.limit:
            raise _Limit

    def _plans(self) -> list[Motion]:
        """All plans of the first level that has one.

        The reference is a landmark: sequences that move it count only when no other does it.
        """
        reference, found = self.problem.goal.reference, []
        self.stuck = self._stuck()
        movable = [name for name in self.order if name not in self.stuck]
        levels = self._sequences if self.config.search == "tree" else self._sets
        if self._within_reach():
            found = levels([name for name in movable if name != reference], frozenset())
        if not found and self._reference_moves():
            found = levels(movable, frozenset({reference}))
        return found

    def _sequences(self, movable: list[str], required: frozenset[str]) -> list[Motion]:
        """Breadth-first over sequences of objects moved before the subject."""
        subject = self.problem.goal.subject
        frontier: list[tuple[str, ...]] = [()]
        for level in range(self.config.max_actions // 2):
            found, following = [], []
            if level == LOOK:
                movable = self._leaving(movable)
                if not (required or self._works(frozenset(movable))):
                    return []
            for prefix in frontier:
                self._visit()
                if required <= set(prefix):
                    motion = self._finish(frozenset(prefix), [prefix])
                    if motion is not None:
                        found.append(motion)
                        if self.config.stop == "first":
                            return found
                for name in movable:
                    if name == subject or name in prefix:
                        continue
                    self._visit()
                    if self.pose.pickable(name, frozenset(prefix)):
                        self._visit()
                        following.append((*prefix, name))
            if found:
                return found
            frontier = following
        self.cut |= bool(frontier)
        return []

    def _sets(self, movable: list[str], required: frozenset[str]) -> list[Motion]:
        """Breadth-first over sets of objects moved before the subject. A set grows by what blocks
        a pick that it needs, else by what takes room at the goal: every set that would do has one
        of those besides."""
        subject, near = self.problem.goal.subject, self._beside_goal()
        rank = {name: i for i, name in enumerate(movable) if name != subject}
        frontier, rest = [frozenset[str]()], list[frozenset[str]]()
        for level in range(self.config.max_actions // 2):
            found, tried = [], list[tuple[frozenset[str], frozenset[str], bool]]()
            if level == LOOK:
                leaving = frozenset(self._leaving(list(rank)))
                if not (required or self._works(leaving)):
                    return []
                rank = {name: i for name, i in rank.items() if name in leaving}
                frontier = [chosen for chosen in frontier if chosen <= leaving]
                rest = [chosen for chosen in rest if chosen <= leaving]
            for chosen in self._tiers(frontier, rest, found):
                self._visit()
                self.late, open_picks = False, self._open_picks(chosen)
                if required <= chosen and not open_picks:
                    motion = self._finish(chosen, self._orders(chosen))
                    if motion is not None:
                        found.append(motion)
                        if self.config.stop == "first":
                            return found
                tried.append((chosen, open_picks, self.late))
            if found:
                return found
            following, others = set(), set()
            for chosen, open_picks, late in tried:
                # Whatever else leaves, one of these is among it.
                helpful = required - chosen or near
                if open_picks:
                    helpful = frozenset().union(*map(self.pose.in_the_way, open_picks))
                following |= {chosen | {name} for name in helpful - chosen if name in rank}
                if late:  # the others' leaving can make room for what is put aside
                    others |= {chosen | {name} for name in rank if name not in chosen}
            frontier = sorted(following, key=partial(_ranks, rank))
            rest = sorted(others - following, key=partial(_ranks, rank))
        self.cut |= bool(frontier or rest)
        return []

    def _leaving(self, names: list[str]) -> list[str]:
        """Those of these objects that can ever be picked: once what is in their way has left."""
        gone = frozenset[str]()
        while True:
            more = {name for name in names if name not in gone and self.pose.pickable(name, gone)}
            more.discard(self.problem.goal.subject)
            if not more:
                return [name for name in names if name in gone]
            gone |= more

    def _works(self, gone: frozenset[str]) -> bool:
        """Whether the subject can be taken and put down once these have left."""
        problem = self.problem
        return self.pose.pickable(problem.goal.subject, gone) and (
            any(self.pose.goal_poses(gone, problem.reference)) or bool(problem.open)
        )

    def _tiers(
        self, first: list[frozenset[str]], rest: list[frozenset[str]], found: list[Motion]
    ) -> Iterator[frozenset[str]]:
        """The likely sets of a level, and the rest where none of them has given a plan."""
        yield from first
        if not found:
            yield from rest

    def _beside_goal(self) -> frozenset[str]:
        """Objects whose leaving can make room in the goal region; and the reference."""
        problem = self.problem
        subject, reference = problem.subject, problem.reference
        boxes, near = problem.obstacles[: len(problem.boxes)], {reference.name}
        bottom = reference.top if problem.goal.predicate.stacked else 0.0
        spread = self.pose.spread(subject.name)
        for area in problem.goal_regions(reference):
            near.update(compress(problem.boxes, reaching_into(area, bottom, spread, boxes)))
        return frozenset(near) - {subject.name}

    def _open_picks(self, chosen: frozenset[str]) -> frozenset[str]:
        """What of a set, or else the subject, cannot be picked before others have left, too."""
        stays = chosen.difference(self._leaving(sorted(chosen)))
        subject = self.problem.goal.subject
        if stays or self.pose.pickable(subject, chosen):
            return stays
        return frozenset({subject})

    def _orders(self, chosen: frozenset[str]) -> Iterator[tuple[str, ...]]:
        """The orders in which a set can be picked; scores have no say in it."""
        names = [name for name in self.problem.boxes if name in chosen]
        if len(self._leaving(names)) < len(names):
            return iter(())  # what can be picked now can be picked later: no other order helps

        def extend(prefix: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
            if len(prefix) == len(chosen):
                yield prefix
            for name in names:
                if name not in prefix and self.pose.pickable(name, frozenset(prefix)):
                    yield from extend((*prefix, name))

        return extend(())

    def _finish(self, gone: frozenset[str], prefixes: Iterable[tuple[str, ...]]) -> Motion | None:
        """Pick the subject once `gone` have left and place it at the goal: all bounds in turn."""
        problem, goal = self.problem, self.problem.goal
        if not self.pose.pickable(goal.subject, gone):
            return None
        reference = problem.reference
        if reference.name not in gone and not any(self.pose.goal_poses(gone, reference)):
            return None
        self._visit()
        self.late = True
        prefixes = iter(prefixes)
        for prefix in islice(prefixes, ORDERS):
            order = (*prefix, goal.subject)
            tried = False
            for placements in self.pose.place_all(order):
                tried = True
                solved = self.bounds.keyframes.solve(order, placements)
                if solved is None:
                    problem.open.add("whether the arm reaches all switches at once")
                else:
                    motion = self.bounds.path.solve(order, placements, *solved)
                    if motion is not None and not broken(problem, motion):
                        return motion
                    problem.open.add("whether there is a motion between the switches")
                self.refused_late = True
            if not tried:
                problem.undecided = True
                problem.open.add("where to put what is in the way")
        if next(prefixes, None) is not None:
            problem.open.add(f"more than {ORDERS} orders of one set")
        return None


def _ranks(rank: Mapping[str, int], names: frozenset[str]) -> list[int]:
    return sorted(rank[name] for name in names)
