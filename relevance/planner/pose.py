"""Pose bound: can the hand take this box, and can the box stand there?

All of it in the plane (`kernels.planar`): the hand, leaning or not, comes straight down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, compress, islice, product
from typing import NamedTuple

import numpy as np

from relevance.holding.clearances import pick_gaps
from relevance.holding.hand import MARGIN, PICK_MARGIN
from relevance.planner.grasps import (
    Family,
    Grasp,
    deep_grasps,
    leaning_grasps,
    other_grasps,
)
from relevance.planner.kernels.kinematics import facing, reach_interval
from relevance.planner.kernels.planar import (
    ANY_TURN,
    FOUND,
    NONE,
    UNDECIDED,
    find_pose,
    slack,
    volumes,
)
from relevance.planner.problem import CLOSE, Problem, obstacle
from relevance.scene import Box
from relevance.scene.geometry import UPRIGHT, packed

LIFT = 0.08
"""Height by which a grasped box must be liftable within reach, m."""
TABLE_MARGIN = 0.005
"""Distance kept from the table's edge by what is only put aside, m."""
REACH_MARGIN = 0.004
"""Distance kept from the ends of the arm's reach, m."""
REFERENCE_PLACES = ((0.0, 0.0), (-0.1, 0.25), (-0.1, -0.25), (0.1, 0.15), (0.1, -0.15))
"""Where to look for room for a reference that is moved (x, y), m."""
ELSEWHERE = ((0.0, 0.3), (0.0, -0.3))
"""Where to look for room for what is put aside, should no arrangement beside where it stood hold
(x, y), m."""
FAMILIES = (deep_grasps, other_grasps, leaning_grasps)
"""The grasps of a box, the preferred first."""
TURNS = (0.0, math.pi / 12, math.pi / 24, math.pi / 8)
"""Angles at which a search for a pose begins, the next where it could not decide: in a narrow slot
the only angle may be at the edge of the first cells (along the axes it is), rad."""
SKY = 2.0
"""Height up to which the hand and what is above it count as an obstacle, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where a moved box goes and how it is held."""

    grasp: Grasp
    pose: tuple[float, float, float]
    """x, y, angle of the finger axis."""


class _Blocked(NamedTuple):
    """Who must have left before an object can be taken with each grasp of a family."""

    family: Family
    who: list[frozenset[str] | None]
    """None: out of reach."""
    sets: frozenset[frozenset[str]]
    least: tuple[frozenset[str], ...]
    """Of these sets, those of which no other is a part."""
    found: dict[frozenset[str], tuple[Grasp, ...]]
    """What `free` has answered."""

    def free(self, gone: frozenset[str]) -> tuple[Grasp, ...]:
        """The grasps that are free once these have left."""
        if gone not in self.found:
            able = {who for who in self.sets if who <= gone}
            numbers = enumerate(self.who) if able else ()
            self.found[gone] = tuple(self.family[g] for g, who in numbers if who in able)
        return self.found[gone]


class PoseBound:
    """Who is in the way of whom, and where boxes may stand; remembers what it was asked."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._blocked: dict[tuple[str, Callable[[Box], Family]], _Blocked] = {}
        self._close: dict[str, tuple[set[frozenset[str]], set[frozenset[str]]]] = {}
        """For objects about whose pick less than CLOSE may decide: who is in the way of each grasp
        with that much more room and reach asked for, and less."""
        self._in_the_way: dict[str, frozenset[str]] = {}
        self._goal_poses: dict[tuple, Placement | None] = {}
        self._held: dict[tuple[tuple[Grasp, ...], float], tuple] = {}
        self._intervals: dict[float, tuple[float, float]] = {}
        self._facings: dict[tuple[Grasp, int], tuple[float, float]] = {}
        self._rooms: dict[tuple, bool] = {}

    def in_the_way(self, name: str) -> frozenset[str]:
        """Whoever blocks a pick of the object by some grasp, or stands on it."""
        if name not in self._in_the_way:
            blocked = (self._blockers(name, family) for family in FAMILIES)
            who = (who for some in blocked for who in some.sets)
            self._in_the_way[name] = self.problem.above[name].union(*who)
        return self._in_the_way[name]

    def grasps(self, name: str) -> tuple[Grasp, ...]:
        """The preferred grasps with which an object can be reached where it stands at first."""
        everything = frozenset(self.problem.boxes)
        blocked = (self._blockers(name, family) for family in FAMILIES)
        return next((some.free(everything) for some in blocked if some.sets), ())

    def spread(self, name: str) -> np.ndarray:
        """How far from the object's centre anything reaches that holds it, and how high over its
        underside that begins, (K, 2), m."""
        found = []
        for family in FAMILIES:
            parts = self._blockers(name, family).family.parts
            if len(parts):
                size = abs(parts)
                x, y = size[..., 0] + size[..., 2], size[..., 1] + size[..., 3]
                found.append(np.array([np.hypot(x, y).max(0), parts[..., 4].min(0)]).T)
        return np.concatenate(found)

    def pickable(self, name: str, gone: frozenset[str]) -> bool:
        """Whether the object can be taken once the objects in `gone` have left."""
        self.problem.counts.pose += 1
        if not self.problem.above[name] <= gone:
            return False
        free = gone.issuperset
        found = any(any(map(free, self._blockers(name, family).least)) for family in FAMILIES)
        if name in self._close:
            for family in FAMILIES:
                self._blockers(name, family)
            surely, perhaps = (any(map(free, sets)) for sets in self._close[name])
            self.problem.undecided |= surely != perhaps
        return found

    def missing(self, name: str, gone: frozenset[str]) -> frozenset[str]:
        """A smallest set that still has to leave before the object can be taken."""
        sets = chain.from_iterable(self._blockers(name, family).sets for family in FAMILIES)
        still = (who - gone for who in sets)
        fewest = min(still, key=lambda who: (len(who), sorted(who)), default=frozenset())
        return fewest | self.problem.above[name] - gone

    def choices(self, name: str, gone: frozenset[str]) -> Iterator[tuple[Grasp, ...]]:
        """Ways to take an object, the best first: one deep grasp each, then all others across one
        edge, then all that lean."""
        self.problem.counts.pose += 1
        if not self.problem.above[name] <= gone:
            return
        for family in FAMILIES:
            free = self._blockers(name, family).free(gone)
            if family is deep_grasps:
                yield from ((grasp,) for grasp in free)
                continue
            for axis in dict.fromkeys(grasp.axis for grasp in free):
                yield tuple(grasp for grasp in free if grasp.axis == axis)

    def goal_poses(
        self, gone: frozenset[str], reference: Box, *, everywhere: bool = False
    ) -> Iterator[Placement]:
        """Free poses of the subject that make the goal true once `gone` have left, lazily.

        None at all refuses every sequence that moves no others: whoever has left is ignored here,
        so the bound is a relaxation. everywhere: by any grasp, whatever blocks or burdens it.
        """
        problem = self.problem
        subject = problem.subject
        deep = set(self._blockers(subject.name, deep_grasps).family)
        standing: np.ndarray | None = None
        taken = frozenset(problem.boxes) if everywhere else gone
        choices = self.choices(subject.name, taken)
        areas = tuple(enumerate(problem.goal_regions(reference)))
        once = ((choice, *area) for choice in choices for area in areas)
        again = list[tuple]()
        for choice, number, area in chain(once, again):
            key = (gone, choice, reference.position, reference.yaw, number)
            if key not in self._goal_poses:
                bottom = reference.top if problem.goal.predicate.stacked else 0.0
                if standing is None:
                    standing = problem.standing(gone | {subject.name, reference.name})
                    standing = np.vstack([standing, obstacle(reference)])
                where = area, bottom, subject, standing
                found = None
                if choice[0] in deep or self._roomy((gone, *key[2:]), *where):
                    found = self._find(area, area[:2], bottom, subject, choice, standing)
                self._goal_poses[key] = found
            found = self._goal_poses[key]
            if found is not None:
                yield found
                # Should later bounds refuse all of these, there are the other sides.
                side = _side(found.grasp)
                if rest := tuple(grasp for grasp in choice if _side(grasp) != side):
                    again.append((rest, number, area))

    def _corner_poses(self, reference: Box) -> Iterator[Placement]:
        """Free poses of the subject in the corners of the goal region, by every grasp, while all
        others stand: beside something tall later bounds may refuse what `goal_poses` has."""
        subject, gone = self.problem.subject, frozenset[str]()
        bottom = reference.top if self.problem.goal.predicate.stacked else 0.0
        standing = self.problem.standing({subject.name, reference.name})
        obstacles = np.vstack([standing, obstacle(reference)])
        choices = tuple(self.choices(subject.name, gone))
        for area in self.problem.goal_regions(reference):
            for corner in _corners(area):
                for choice in choices:
                    found = self._find(corner, corner[:2], bottom, subject, choice, obstacles)
                    if found is not None:
                        yield found

    def place_all(self, order: tuple[str, ...], tries: int = 8) -> Iterator[list[Placement]]:
        """Poses for every moved box: first the subject's, then the others' around it.

        Placing the subject first loses fewer tasks than placing greedily in time order. The others
        stay near where they stood; should later bounds refuse all of that, they go elsewhere.
        """
        yield from self._arrangements(order, None, tries)
        if frozenset(order) - {self.problem.goal.subject, self.problem.goal.reference}:
            for aside in ELSEWHERE:
                yield from self._arrangements(order, aside, 1)
        elif len(order) == 1:
            yield from ([place] for place in self._corner_poses(self.problem.reference))

    def _arrangements(
        self, order: tuple[str, ...], aside: tuple[float, float] | None, tries: int
    ) -> Iterator[list[Placement]]:
        """`place_all` with the others near `aside` (x, y), m; None for where they stood."""
        subject = self.problem.subject
        gone = frozenset(order) - {subject.name}
        for reference in self._references(order):
            for place in islice(self.goal_poses(gone, reference), tries):
                bottom = reference.top if self.problem.goal.predicate.stacked else 0.0
                parts = place.grasp.parts
                kept = volumes(parts, place.pose, bottom, bottom + subject.size[2], SKY)
                found = self._place_blockers(order, kept, reference, aside)
                if found is not None:
                    yield [*found, place]
                    if place.grasp.lopsided:
                        yield from ([*found, twin] for twin in self._twins(gone, place))

    def _twins(self, gone: frozenset[str], place: Placement) -> Iterator[Placement]:
        """The subject taken on its other side and put down half a turn further: the hand ends at
        the same place, but the other way round."""
        x, y, angle = place.pose
        grasp = place.grasp
        family = leaning_grasps if grasp.tilt else other_grasps
        for other in self._blockers(self.problem.goal.subject, family).free(gone):
            same = other.axis == grasp.axis and other.depth == grasp.depth
            if same and _side(other) == _side(grasp, 1):
                yield Placement(grasp=other, pose=(x, y, angle + math.pi))

    def interval(self, bottom: float, box: Box, grasp: Grasp) -> tuple[float, float]:
        """Reach (near, far) of the wrist that holds the box with its underside at this height,
        liftably, m."""
        return self._interval(bottom + box.size[2] / 2 + grasp.wrist[1])

    def _interval(self, height: float) -> tuple[float, float]:
        if height not in self._intervals:
            # In whole millimetres, to compute each once; REACH_MARGIN covers the rest.
            z = round(height - self.problem.scene.robot.base[2], 3)
            near, far = reach_interval(z)
            near_up, far_up = reach_interval(round(z + LIFT, 3))
            reach = max(near, near_up) + REACH_MARGIN, min(far, far_up) - REACH_MARGIN
            self._intervals[height] = reach
        return self._intervals[height]

    def _blockers(self, name: str, family: Callable[[Box], Family]) -> _Blocked:
        """Who blocks a pick of the object with each grasp of one of its FAMILIES."""
        if (name, family) not in self._blocked:
            self._blocked[name, family] = self._measure(name, family(self.problem.boxes[name]))
        return self._blocked[name, family]

    def _measure(self, name: str, family: Family) -> _Blocked:
        problem = self.problem
        problem.counts.pose += 1
        i, count = problem.index[name], len(problem.boxes)
        spare = self._spare_reach(problem.boxes[name], family)
        if not (spare >= -CLOSE).any():
            return _Blocked(family, [None] * len(family), frozenset(), (), {})
        gaps = np.empty((len(family), count))
        boxes, names, seen = problem.obstacles[:count], list(problem.boxes), {}

        def blockers(ease: float) -> tuple[list[frozenset[str] | None], float]:
            room = PICK_MARGIN - ease
            close = pick_gaps(i, family.axes, family.parts, boxes, room, 1.0, gaps)
            who = list[frozenset[str] | None]()
            rows = (gaps < 0).tobytes()
            for g, within in enumerate((spare >= -ease).tolist()):
                bits = rows[g * count : (g + 1) * count]
                if within and bits not in seen:
                    seen[bits] = frozenset(compress(names, bits))
                who.append(seen[bits] if within else None)
            return who, close

        who, close = blockers(0.0)
        sets = frozenset(one for one in who if one is not None)
        if min(close, abs(spare).min()) < CLOSE or name in self._close:
            before = set[frozenset[str]]().union(
                *(some.sets for (other, _), some in self._blocked.items() if other == name)
            )
            more, less = self._close.setdefault(name, (before, set(before)))
            more.update(one for one in blockers(-CLOSE)[0] if one is not None)
            less.update(one for one in blockers(CLOSE)[0] if one is not None)
        least = list[frozenset[str]]()
        for one in sorted(sets, key=len):
            if not any(map(one.issuperset, least)):
                least.append(one)
        return _Blocked(family, who, sets, tuple(least), {})

    def _spare_reach(self, box: Box, family: Family) -> np.ndarray:
        """By how much each grasp is within reach where the box stands, (G,), m."""
        if not len(family):
            return np.empty(0)
        x, y, _ = self.problem.scene.robot.base
        angles, left = box.yaw + family.axes * (math.pi / 2), family.wrists[:, 0]
        r = np.hypot(
            box.position[0] - x - left * np.sin(angles), box.position[1] - y + left * np.cos(angles)
        )
        levels, which = family.levels
        heights = (box.bottom + box.size[2] / 2 + levels).tolist()
        near, far = np.array([self._interval(height) for height in heights]).T[:, which]
        return np.minimum(r - near, far - r)

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

        choice: grasps across one edge. Of those with equal shift and tilt the shallowest, which is
        in nobody's way when a deeper one is not, decides; the deepest that is as free is taken.
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
            status, spare = UNDECIDED, 0.0
            for turn in TURNS:
                status, spare = find_pose(
                    area, prefer, bottom, parts, obstacles, table, at, reach, ease, turn, pose
                )
                if status != UNDECIDED:
                    break
            return status, spare

        status, spare = find(0.0)
        found = None
        if status == FOUND:
            x, y, angle, way = pose.tolist()
            grasp, turn = ways[int(way)]
            for deeper in choice:
                if _side(deeper) == _side(grasp) and deeper.depth > grasp.depth:
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

    def _roomy(
        self, key: tuple, area: np.ndarray, bottom: float, box: Box, obstacles: np.ndarray
    ) -> bool:
        """Whether there is room for the box alone: where there is none, no hold helps."""
        if key not in self._rooms:
            self.problem.counts.pose += 1
            alone = np.array([[[0.0, 0.0, box.size[0] / 2, box.size[1] / 2, 0.0]]])
            reach = np.array([[0.0, 0.0, SKY, 0.0, ANY_TURN]])
            table, at, pose = self.problem.table, self.problem.arm.base, np.zeros(4)
            status, _ = find_pose(
                area, area[:2], bottom, alone, obstacles, table, at, reach, CLOSE, TURNS[0], pose
            )
            self._rooms[key] = status != NONE
        return self._rooms[key]

    def _ways(self, choice: tuple[Grasp, ...], box: Box) -> list[tuple[Grasp, int]]:
        """The shallowest grasp of each shift and tilt, and whether the hand is turned by half a
        turn.

        To one side, or to the other and turned, the hand is at the same place: the second counts
        where the first may not point everywhere.
        """
        shallow = {_side(grasp): grasp for grasp in choice}.values()
        sides = [
            (grasp.price, _side(grasp, turn), turn, grasp)
            for grasp in shallow
            for turn in ((0, 1) if grasp.lopsided else (0,))
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
                (
                    -one.wrist[0] if turn else one.wrist[0],
                    *self.interval(bottom, box, one),
                    *self._facing(box, one, turn),
                )
                for one, turn in ways
            ]
        )
        return parts, reach

    def _facing(self, box: Box, grasp: Grasp, turn: int) -> tuple[float, float]:
        """Where the finger axis may point at the place, against its bearing from the robot: middle
        and half width, rad.

        A lopsided hold is the same way round at pick and place, and the last joint has limits.
        """
        if not grasp.lopsided:
            return 0.0, ANY_TURN
        if (grasp, turn) not in self._facings:
            self._facings[grasp, turn] = self._turns(box, grasp, turn)
        return self._facings[grasp, turn]

    def _turns(self, box: Box, grasp: Grasp, turn: int) -> tuple[float, float]:
        base, limit = self.problem.arm.base, float(self.problem.arm.upper[-1])
        angle, left = box.yaw + grasp.axis * math.pi / 2, grasp.wrist[0]
        x, y = box.position[0] - left * math.sin(angle), box.position[1] + left * math.cos(angle)
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
        self,
        order: tuple[str, ...],
        kept: np.ndarray,
        reference: Box,
        aside: tuple[float, float] | None,
    ) -> list[Placement] | None:
        """Free table poses of all but the last, clear of what is still there when they land.

        kept (P, UPRIGHT): where the subject and the hand with it will be.
        """
        placed: list[Placement] = []
        landed = np.empty((0, UPRIGHT))
        for i, name in enumerate(order[:-1]):
            box = self.problem.boxes[name]
            prefer, area, reserved = aside or box.position[:2], self._table(), kept
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
            landed = np.vstack([landed, packed(box.size, *_put(box, found))])
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


def _corners(area: np.ndarray) -> list[np.ndarray]:
    """The corners of an area (5,): four rectangles of a third of its edges."""
    x, y, turn, a, b = area
    c, s, found = math.cos(turn), math.sin(turn), list[np.ndarray]()
    for u, v in product((-2 * a / 3, 2 * a / 3), (-2 * b / 3, 2 * b / 3)):
        found.append(np.array([x + c * u - s * v, y + s * u + c * v, turn, a / 3, b / 3]))
    return found


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def moved_box(box: Box, place: Placement) -> Box:
    """The box where it was put on the table."""
    position, yaw = _put(box, place)
    return replace(box, position=position, yaw=yaw, on=None)


def _put(box: Box, place: Placement) -> tuple[tuple[float, float, float], float]:
    """Position (m) and yaw (rad) of a box that is put on the table."""
    x, y, angle = place.pose
    return (x, y, box.size[2] / 2), angle - place.grasp.axis * math.pi / 2


def _side(grasp: Grasp, turn: int = 0) -> tuple[float, float]:
    """To which side of the box the hand is; turn: after half a turn."""
    return (-grasp.shift, -grasp.tilt) if turn else (grasp.shift, grasp.tilt)


def _turned(parts: np.ndarray) -> np.ndarray:
    """The parts of a grasp (P, 5) turned by half a turn about the box."""
    turned = parts.copy()
    turned[:, 1] *= -1  # along the finger axis they come in pairs
    return turned


def _underside(rows: np.ndarray) -> np.ndarray:
    """Heights of the undersides of obstacle rows, m."""
    return rows[:, 2] - rows[:, 6]
