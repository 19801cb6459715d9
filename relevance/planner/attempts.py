"""One attempt at a problem: what every search does with a set of moved objects, and its verdict.

An attempt may move some objects, within a number of nodes. Each set is tested by the bounds in
order of their cost: logic, pose, keyframe, path. What a bound refused is remembered for all
attempts at the problem: no other tries it again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import compress, islice

from relevance.planner import logic
from relevance.planner.checking import broken
from relevance.planner.grasps import fits, grasps
from relevance.planner.kernels.planar import reaching_into
from relevance.planner.keyframes import KeyframeBound
from relevance.planner.path import Motion, PathBound
from relevance.planner.pose import Placement, PoseBound
from relevance.planner.problem import Problem
from relevance.planner.result import PlannerConfig, PlanResult, Status

TRIES = 200
"""How many sets are looked at to say what stands in the way."""
LOOK = 2
"""From how many objects on a search first asks which can be picked at all."""
ORDERS = 6
"""How many orders of a set are tried."""
COST_TOLERANCE = 1e-3
"""Costs are compared after rounding to this, rad^2."""

Turns = Generator[None, None, None]
"""A search that pauses after every set, so that another may take its turn."""


class _Limit(Exception):
    """The node limit was reached."""


@dataclass(slots=True)
class _Tries:
    """The arrangements of an order that nobody has tried yet; none of the others has a motion."""

    placements: Iterator[list[Placement]]
    begun: bool = False
    """Whether there was any."""


class Bounds:
    """The bounds of one problem, in order of their cost, and what they refused."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.pose = PoseBound(problem)
        self.keyframes = KeyframeBound(self.pose)
        self.path = PathBound(problem)
        self.tried = dict[tuple[str, ...], _Tries]()
        """What is left to try of each order."""
        self.blocked = set[frozenset[str]]()
        """Sets whose leaving does not let the subject be taken and put at the goal."""


class Attempt(ABC):
    """A search that may move some objects, within a number of nodes."""

    def __init__(
        self, bounds: Bounds, config: PlannerConfig, allowed: frozenset[str], limit: int
    ) -> None:
        self.problem, self.bounds, self.pose = bounds.problem, bounds, bounds.pose
        self.config, self.allowed = config, allowed
        self.order = [name for name in self.problem.boxes if name in allowed]
        self.left = limit
        """Nodes that it may still open."""
        self.exhausted = True
        """Whether the search ended by itself, not at its limit."""
        self.found = list[Motion]()
        """The plans among which the best is chosen; at its limit, of those so far."""
        self.refused_late = False
        self._staying = dict[str, bool]()
        self.late = False
        """Whether the last set passed all relaxations, and failed after."""
        self.cut = False
        """Whether plans of more actions than allowed were left untried."""

    @abstractmethod
    def _search(self) -> Turns:
        """Fill `found`."""

    def run(self) -> PlanResult:
        """The result, in one go."""
        turns = self.turns()
        while True:
            try:
                next(turns)
            except StopIteration as ended:
                return ended.value

    def turns(self) -> Generator[None, None, PlanResult]:
        """The result, with pauses."""
        try:
            yield from self._search()
        except _Limit:
            self.exhausted = False
        return self._solved() if self.found else self._unsolved()

    def _unsolved(self) -> PlanResult:
        """There is no plan: why."""
        problem = self.problem
        if self.hopeless is not None:
            status, reason, blocking = self.hopeless
        else:
            blocking, undecided = self._blocking(), self.cut or problem.open
            if not self.exhausted:
                status, reason = "limit", f"node limit: {self.config.node_limit} nodes were opened"
            else:
                status = "limit" if undecided and self._might() else "infeasible"
                reason = self._exhausted(status, blocking)
        return PlanResult(
            goal=problem.goal, status=status, reason=reason, blocking=blocking, final={},
            ambiguous=problem.undecided or self.refused_late, counts=problem.counts,
            seconds=problem.seconds,
        )  # fmt: skip

    def _solved(self) -> PlanResult:
        """The best of the plans."""
        problem, goal = self.problem, self.problem.goal
        found = sorted(self.found, key=self._rank)
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
            ambiguous=problem.undecided or self.refused_late or len(sets) > 1 or not self.exhausted,
            counts=problem.counts,
            check_ok=True,
            max_penetration=best.max_penetration,
            phases=best.phases,
            seconds=problem.seconds,
        )

    def _rank(self, motion: Motion) -> tuple[int, list[int]]:
        problem = self.problem
        return round(motion.cost / COST_TOLERANCE), [problem.index[n] for n in motion.order]

    @cached_property
    def hopeless(self) -> tuple[Status, str, tuple[str, ...]] | None:
        """Why no sequence can work even if everything else were gone; None if one might."""
        goal, problem = self.problem.goal, self.problem
        if inside := self.bounds.path.in_the_arm:
            names = f"{', '.join(inside)} {'stand' if len(inside) > 1 else 'stands'}"
            return "infeasible", f"{names} where the arm is at first", ()
        if goal.subject not in self.allowed:
            return "infeasible", f"{goal.subject} may not be moved", (goal.subject,)
        if not self.pose.grasps(goal.subject):
            why = self._why_not(goal.subject)
            return "infeasible", f"{goal.subject} cannot be grasped: {why}", ()
        if not (self._within_reach() or self._reference_moves()):
            reason = "the goal region is out of reach, off the table or too tight for the hand"
            return ("limit" if problem.open else "infeasible"), reason, ()
        return None

    def _might(self) -> bool:
        """Whether a plan is possible once all that can leave has left, or the reference moves."""
        goal = self.problem.goal
        if self._reference_moves():
            return True
        gone = frozenset(name for name in self.order if not self._stays(name))
        return self._works(gone - {goal.subject, goal.reference})

    def _stays(self, name: str) -> bool:
        """Whether an object can never be picked: it cannot be grasped, or carries what does not
        leave first."""
        if name not in self._staying:
            carried = self._carried_by(name)
            self._staying[name] = (
                self.problem.goal.subject in carried
                or not carried <= self.allowed
                or not all(self.pose.grasps(each) for each in (name, *carried))
            )
        return self._staying[name]

    def _exhausted(self, status: Status, blocking: tuple[str, ...]) -> str:
        """Why the search ended without a plan, in the words of the task."""
        goal, problem = self.problem.goal, self.problem
        said = []
        if blocking:
            said.append(f"{', '.join(blocking)} would have to leave first")
            leaving = frozenset(self._leaving(self.order))
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
        self.left -= 1
        if self.left < 0:
            raise _Limit

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

    def _passes(self, gone: frozenset[str]) -> bool:
        """Whether the subject could be picked once these have left, and be put at the goal."""
        problem, blocked = self.problem, self.bounds.blocked
        if gone in blocked:
            return False
        reference = problem.reference
        if not self.pose.pickable(problem.goal.subject, gone) or (
            reference.name not in gone and not any(self.pose.goal_poses(gone, reference))
        ):
            blocked.add(gone)
            return False
        self._visit()
        self.late = True
        return True

    def _motion(self, prefixes: Iterable[tuple[str, ...]]) -> Generator[None, None, Motion | None]:
        """Move these in order, then the subject: what passes all bounds, of the first orders."""
        problem, prefixes = self.problem, iter(prefixes)
        for prefix in islice(prefixes, ORDERS):
            order = (*prefix, problem.goal.subject)
            tries = self.bounds.tried.setdefault(order, _Tries(self.pose.place_all(order)))
            self.refused_late |= tries.begun
            for placements in tries.placements:
                problem.counts.sequences += not tries.begun
                problem.counts.squares += len(order) ** 2
                tries.begun = True
                solved = self.bounds.keyframes.solve(order, placements)
                if solved is None:
                    problem.open.add("whether the arm reaches all switches at once")
                else:
                    motion = self.bounds.path.solve(order, placements, *solved)
                    if motion is not None and not broken(problem, motion):
                        return motion
                    problem.open.add("whether there is a motion between the switches")
                self.refused_late = True
                yield
            if not tries.begun:
                problem.undecided = True
                problem.open.add("where to put what is in the way")
        if next(prefixes, None) is not None:
            problem.open.add(f"more than {ORDERS} orders of one set")
        return None
