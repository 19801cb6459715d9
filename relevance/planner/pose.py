"""Pose bound: can the hand take this box, and can the box stand there?

All of it in the plane (`kernels.planar`): the hand comes straight down.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress, islice

import numpy as np

from relevance.planner.grasps import Family, Grasp, deep_grasps, other_grasps, pick_target
from relevance.planner.kernels.kinematics import facing, reach_interval
from relevance.planner.kernels.planar import (
    ANY_TURN,
    FOUND,
    MARGIN,
    NONE,
    PICK_MARGIN,
    UNDECIDED,
    find_pose,
    pick_blockers,
    slack,
    volumes,
)
from relevance.planner.problem import CLOSE, Problem, obstacle
from relevance.scene import Box
from relevance.scene.geometry import UPRIGHT

LIFT = 0.08
"""Height by which a grasped box must be liftable within reach, m."""
TABLE_MARGIN = 0.005
"""Distance kept from the table's edge by what is only put aside, m."""
REACH_MARGIN = 0.004
"""Distance kept from the ends of the arm's reach, m."""
REFERENCE_PLACES = ((0.0, 0.0), (-0.1, 0.25), (-0.1, -0.25), (0.1, 0.15), (0.1, -0.15))
"""Where to look for room for a reference that is moved (x, y), m."""
SKY = 2.0
"""Height up to which the hand and what is above it count as an obstacle, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where a moved box goes and how it is held."""

    grasp: Grasp
    pose: tuple[float, float, float]
    """x, y, angle of the finger axis."""


class PoseBound:
    """Who is in the way of whom, and where boxes may stand; remembers what it was asked."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._blockers: dict[str, dict[Grasp, frozenset[str]]] = {}
        self._more: dict[str, dict[Grasp, frozenset[str]]] = {}
        self._close: dict[str, tuple[list[frozenset[str]], list[frozenset[str]]]] = {}
        """For objects about whose pick less than CLOSE may decide: who is in the way of each grasp
        with that much more room asked for, and less."""
        self._goal_poses: dict[tuple, Placement | None] = {}
        self._held: dict[tuple[tuple[Grasp, ...], float], tuple] = {}
        self._intervals: dict[float, tuple[float, float]] = {}

    def blockers(self, name: str) -> dict[Grasp, frozenset[str]]:
        """The deep, centred grasps of an object, and who must have left before it can be picked
        that way."""
        if name not in self._blockers:
            self._blockers[name] = self._blocked(name, deep_grasps(self.problem.boxes[name]))
        return self._blockers[name]

    def more_blockers(self, name: str) -> dict[Grasp, frozenset[str]]:
        """The same for the other grasps: each shift from deep to shallow."""
        if name not in self._more:
            self._more[name] = self._blocked(name, other_grasps(self.problem.boxes[name]))
        return self._more[name]

    def in_the_way(self, name: str) -> frozenset[str]:
        """Whoever blocks a pick of the object by some grasp, or stands on it."""
        sets = (*self.blockers(name).values(), *self.more_blockers(name).values())
        return self.problem.above[name].union(*sets)

    def grasps(self, name: str) -> tuple[Grasp, ...]:
        """The grasps with which an object can be reached where it stands at first."""
        return tuple(self.blockers(name)) or tuple(self.more_blockers(name))

    def pickable(self, name: str, gone: frozenset[str]) -> bool:
        """Whether the object can be taken once the objects in `gone` have left."""
        found = bool(self._deep(name, gone) or self._others(name, gone))
        if name in self._close and self.problem.above[name] <= gone:
            self.more_blockers(name)
            surely, perhaps = (any(who <= gone for who in sets) for sets in self._close[name])
            self.problem.undecided |= surely != perhaps
        return found

    def _deep(self, name: str, gone: frozenset[str]) -> tuple[Grasp, ...]:
        self.problem.counts.pose += 1
        if not self.problem.above[name] <= gone:
            return ()
        return tuple(grasp for grasp, who in self.blockers(name).items() if who <= gone)

    def _others(self, name: str, gone: frozenset[str]) -> tuple[Grasp, ...]:
        if not self.problem.above[name] <= gone:
            return ()
        return tuple(grasp for grasp, who in self.more_blockers(name).items() if who <= gone)

    def choices(self, name: str, gone: frozenset[str]) -> Iterator[tuple[Grasp, ...]]:
        """Ways to take an object, the best first: one deep grasp each, then all others across one
        edge."""
        yield from ((grasp,) for grasp in self._deep(name, gone))
        others = self._others(name, gone)
        for axis in dict.fromkeys(grasp.axis for grasp in others):
            yield tuple(grasp for grasp in others if grasp.axis == axis)

    def goal_poses(
        self, gone: frozenset[str], reference: Box, *, everywhere: bool = False
    ) -> Iterator[Placement]:
        """Free poses of the subject that make the goal true once `gone` have left, lazily.

        None at all refuses every sequence that moves no others: whoever has left is ignored here,
        so the bound is a relaxation. everywhere: by any grasp, whatever blocks or burdens it.
        """
        problem = self.problem
        subject = problem.subject
        standing: np.ndarray | None = None
        taken = frozenset(problem.boxes) if everywhere else gone
        choices = self.choices(subject.name, taken)
        areas = tuple(enumerate(problem.goal_regions(reference)))
        for choice, (number, area) in ((choice, area) for choice in choices for area in areas):
            key = (gone, choice, reference.position, reference.yaw, number)
            if key not in self._goal_poses:
                bottom = reference.top if problem.goal.predicate.stacked else 0.0
                if standing is None:
                    standing = problem.standing(gone | {subject.name, reference.name})
                    standing = np.vstack([standing, obstacle(reference)])
                found = self._find(area, area[:2], bottom, subject, choice, standing)
                self._goal_poses[key] = found
            found = self._goal_poses[key]
            if found is not None:
                yield found

    def place_all(self, order: tuple[str, ...], tries: int = 3) -> Iterator[list[Placement]]:
        """Poses for every moved box: first the subject's, then the others' around it.

        Placing the subject first loses fewer tasks than placing greedily in time order.
        """
        subject = self.problem.subject
        gone = frozenset(order) - {subject.name}
        for reference in self._references(order):
            for place in islice(self.goal_poses(gone, reference), tries):
                bottom = reference.top if self.problem.goal.predicate.stacked else 0.0
                parts = place.grasp.parts
                kept = volumes(parts, place.pose, bottom, bottom + subject.size[2], SKY)
                found = self._place_blockers(order, kept, reference)
                if found is not None:
                    yield [*found, place]
                    if place.grasp.shift:
                        yield from ([*found, twin] for twin in self._twins(gone, place))

    def _twins(self, gone: frozenset[str], place: Placement) -> Iterator[Placement]:
        """The subject taken on its other side and put down half a turn further: the hand ends at
        the same place, but the other way round."""
        x, y, angle = place.pose
        grasp = place.grasp
        for other in self._others(self.problem.goal.subject, gone):
            same = other.axis == grasp.axis and other.depth == grasp.depth
            if same and other.shift == -grasp.shift:
                yield Placement(grasp=other, pose=(x, y, angle + math.pi))

    def interval(self, bottom: float, box: Box, grasp: Grasp) -> tuple[float, float]:
        """Reach (near, far) for holding the box with its underside at this height, liftably, m."""
        # Heights in whole millimetres, to compute each once; REACH_MARGIN covers the rest.
        z = round(bottom + box.size[2] / 2 + grasp.above - self.problem.scene.robot.base[2], 3)
        if z not in self._intervals:
            near, far = reach_interval(z)
            near_up, far_up = reach_interval(round(z + LIFT, 3))
            reach = max(near, near_up) + REACH_MARGIN, min(far, far_up) - REACH_MARGIN
            self._intervals[z] = reach
        return self._intervals[z]

    def _blocked(self, name: str, family: Family) -> dict[Grasp, frozenset[str]]:
        problem, found = self.problem, {}
        problem.counts.pose += 1
        i, box, count = problem.index[name], problem.boxes[name], len(problem.boxes)
        x, y, _ = problem.scene.robot.base
        r = math.hypot(box.position[0] - x, box.position[1] - y)
        reached: dict[float, bool] = {}  # by the height of the hand
        for grasp in family.grasps:
            if grasp.above not in reached:
                near, far = self.interval(box.bottom, box, grasp)
                problem.undecided |= min(abs(r - near), abs(r - far)) < CLOSE
                reached[grasp.above] = near <= r <= far
        if any(reached.values()):
            blocking = np.zeros((len(family.grasps), count), np.bool_)
            boxes = problem.obstacles[:count]
            names, seen = list(problem.boxes), {}

            def blockers(room: float) -> tuple[list[frozenset[str]], float]:
                close = pick_blockers(i, family.axes, family.parts, boxes, room, blocking)
                sets = []
                for g, grasp in enumerate(family.grasps):
                    if reached[grasp.above]:
                        bits = blocking[g].tobytes()
                        if bits not in seen:
                            seen[bits] = frozenset(compress(names, blocking[g].tolist()))
                        sets.append(seen[bits])
                return sets, close

            sets, close = blockers(PICK_MARGIN)
            found = dict(zip((g for g in family.grasps if reached[g.above]), sets, strict=True))
            if close < CLOSE or name in self._close:
                before = list(self._blockers.get(name, {}).values())
                more, less = self._close.setdefault(name, (before, list(before)))
                more += blockers(PICK_MARGIN + CLOSE)[0]
                less += blockers(PICK_MARGIN - CLOSE)[0]
        return found

    def _find(
        self,
        area: np.ndarray,
        prefer: Sequence[float] | np.ndarray,
        bottom: float,
        box: Box,
        choice: tuple[Grasp, ...],
        obstacles: np.ndarray,
    ) -> Placement | None:
        """How the box can be put down in an area (5,), clear of obstacles (W, UPRIGHT).

        choice: grasps across one edge. Of those with equal shift the shallowest, which is in
        nobody's way when a deeper one is not, decides; the deepest that is as free is taken.
        bottom: height of what it is put on, m.
        """
        problem = self.problem
        problem.counts.pose += 1
        key = (choice, bottom)
        if key not in self._held:
            ways = self._ways(choice, box)
            self._held[key] = ways, *self._held_so(ways, box, bottom)
        ways, parts, reach = self._held[key]
        pose, prefer = np.zeros(4), np.asarray(prefer)
        table, at = problem.table, problem.arm.base

        def find(ease: float) -> tuple[int, float]:
            return find_pose(area, prefer, bottom, parts, obstacles, table, at, reach, ease, pose)

        status, spare = find(0.0)
        found = None
        if status == FOUND:
            x, y, angle, way = pose.tolist()
            grasp, turn = ways[int(way)]
            for deeper in choice:
                if deeper.shift == grasp.shift and deeper.depth > grasp.depth:
                    held, there = self._held_so([(deeper, turn)], box, bottom)
                    value, _ = slack(x, y, angle, bottom, held, obstacles, table, at, there, 0.0)
                    if value >= 0:
                        grasp = deeper
                        break
            found = Placement(grasp=grasp, pose=(x, y, angle + turn * math.pi))
        if len(choice) == 1:
            close = spare < CLOSE if found else status == UNDECIDED or find(CLOSE)[0] != NONE
        else:
            close = status == UNDECIDED
        if status == UNDECIDED:
            problem.open.add("whether there is a free pose")
        problem.undecided |= close
        return found

    def _ways(self, choice: tuple[Grasp, ...], box: Box) -> list[tuple[Grasp, int]]:
        """The shallowest grasp of each shift, and whether the hand is turned by half a turn.

        Shifted to one side, or to the other and turned, the hand is at the same place: the second
        counts where the first may not point everywhere.
        """
        shallow = {grasp.shift: grasp for grasp in choice}.values()
        sides = [
            (grasp.price, -grasp.shift if turn else grasp.shift, turn, grasp)
            for grasp in shallow
            for turn in ((0, 1) if grasp.shift else (0,))
        ]
        found, settled = [], set()
        for _, side, turn, grasp in sorted(sides, key=lambda one: one[:3]):
            if side not in settled:
                found.append((grasp, turn))
                if self._facing(box, grasp, turn)[1] == ANY_TURN:
                    settled.add(side)
        return found

    def _held_so(
        self, ways: list[tuple[Grasp, int]], box: Box, bottom: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Parts and reach of the ways in which a box can be put down, as `slack` has them."""
        parts = np.array([_turned(one.parts) if turn else one.parts for one, turn in ways])
        reach = np.array(
            [
                (*self.interval(bottom, box, one), *self._facing(box, one, turn))
                for one, turn in ways
            ]
        )
        return parts, reach

    def _facing(self, box: Box, grasp: Grasp, turn: int) -> tuple[float, float]:
        """Where the finger axis may point at the place, against its bearing from the robot: middle
        and half width, rad.

        A shifted hand is the same way round at pick and place, and its last joint has limits.
        """
        if grasp.shift == 0.0:
            return 0.0, ANY_TURN
        x, y, _, angle = pick_target(box, grasp).tolist()
        base, limit = self.problem.arm.base, float(self.problem.arm.upper[-1])
        seen = angle - math.atan2(y - base[1], x - base[0])
        ways = [way for way in (1.0, -1.0) if abs(_wrapped(seen - facing(way))) <= limit]
        if len(ways) != 1:
            return 0.0, ANY_TURN
        return facing(ways[0]) - turn * math.pi, limit

    def _references(self, order: tuple[str, ...]) -> Iterator[Box]:
        """The reference where it stands, or where it might be put if the order moves it."""
        reference = self.problem.reference
        if reference.name not in order:
            yield reference
            return
        i = order.index(reference.name)
        obstacles = self._when_landing(order, i, reference)
        choice = next(self.choices(reference.name, frozenset(order[:i])))
        for prefer in REFERENCE_PLACES:
            place = self._find(self._table(), prefer, 0.0, reference, choice, obstacles)
            if place is not None:
                yield moved_box(reference, place)

    def _when_landing(self, order: tuple[str, ...], i: int, box: Box) -> np.ndarray:
        """What the i-th moved box must stay clear of: the boxes that still stand then, and where
        the gripper will be when it takes the later ones."""
        top = box.size[2] + MARGIN
        hands = np.vstack([np.empty((0, UPRIGHT)), *self._later_picks(order[i + 1 :])])
        standing = self.problem.standing(order[: i + 1])
        return np.vstack([standing, hands[_underside(hands) < top]])

    def _table(self) -> np.ndarray:
        return np.array([0.0, 0.0, 0.0, *(self.problem.table - TABLE_MARGIN)])

    def _place_blockers(
        self, order: tuple[str, ...], kept: np.ndarray, reference: Box
    ) -> list[Placement] | None:
        """Free table poses of all but the last, clear of what is still there when they land.

        kept (P, UPRIGHT): where the subject and the hand with it will be.
        """
        placed: list[Placement] = []
        landed = np.empty((0, UPRIGHT))
        for i, name in enumerate(order[:-1]):
            box = self.problem.boxes[name]
            prefer, area, reserved = box.position[:2], self._table(), kept
            if name == reference.name:
                prefer, reserved = reference.position[:2], kept[:0]  # kept was laid out around it
                area = np.array([*prefer, 0.0, 0.002, 0.002])
            elif reference.name in order[i:]:
                grasp = self.grasps(reference.name)[0]
                angle = reference.yaw + grasp.axis * math.pi / 2
                pose = (*reference.position[:2], angle)
                there = volumes(grasp.parts, pose, 0.0, reference.top, SKY)
                reserved = np.vstack([kept, there])
            reserved = reserved[_underside(reserved) < box.size[2] + MARGIN]
            obstacles = np.vstack([self._when_landing(order, i, box), landed, reserved])
            found = None
            for choice in self.choices(name, frozenset(order[:i])):
                found = self._find(area, prefer, 0.0, box, choice, obstacles)
                if found is not None:
                    break
            if found is None:
                return None
            placed.append(found)
            landed = np.vstack([landed, obstacle(moved_box(box, found))])
        return placed

    def _later_picks(self, names: tuple[str, ...]) -> list[np.ndarray]:
        """Where the gripper will be when it takes these boxes."""
        found = []
        for name in names:
            box, grasp = self.problem.boxes[name], self.grasps(name)[0]
            angle = box.yaw + grasp.axis * math.pi / 2
            pose = (*box.position[:2], angle)
            found.append(volumes(grasp.parts, pose, box.bottom, 0.0, SKY)[1:])
        return found


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def moved_box(box: Box, place: Placement) -> Box:
    """The box where it was put on the table."""
    x, y, angle = place.pose
    yaw = angle - place.grasp.axis * math.pi / 2
    return replace(box, position=(x, y, box.size[2] / 2), yaw=yaw, on=None)


def _turned(parts: np.ndarray) -> np.ndarray:
    """The parts of a grasp (5, 5) turned by half a turn about the box."""
    turned = parts.copy()
    turned[:, 1] *= -1  # along the finger axis they come in pairs
    return turned


def _underside(rows: np.ndarray) -> np.ndarray:
    """Heights of the undersides of obstacle rows, m."""
    return rows[:, 2] - rows[:, 6]
