"""An exhaustive reference: every sound hold of a box, every place on a dense grid, any blockers.

It is a referee of the planner's *no*, so it shares none of its assumptions: of the planner it
takes the URDF's numbers alone. The hand points down, or leans about the finger axis by TILTS, and
takes a box across either edge that fits, either way round, with any offset along the box and depth
of the finger tips (on a grid) that leaves enough of the pads on the faces (`HELD`). Reach comes
from its own inverse kinematics. Everything else is brute force over poses with a separating-axis
gap in numpy.

A goal is solvable with a set of boxes gone when they can be taken one after the other and put on
the table out of everybody's way, and then the subject can be taken and put at the goal in one
hold. The reference box stays where it is. Motions between the switches are not looked at, and of
the arm the hand and the link above it alone: a tall stack may still meet the forearm.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from relevance.benchmarks.reaching import reached
from relevance.robot import panda
from relevance.scene import Box, Goal, Scene

CLEARANCE = 0.001
"""What a placed box and the hand (its meshes in boxes, 1 mm wider) keep from everything, m."""
WIDEST = 0.075
"""Widest edge that the hand takes, m."""
SPREAD = 0.002
"""How far each finger stands off the box before it closes, m."""
OFFSET = 0.005
"""Step of the hand's offset along the box, m."""
DEPTH = 0.004
"""Step of the depth of the finger tips below the box's top, m."""
TILTS = (0.0, 0.25, -0.25, 0.5, -0.5)
"""How far the hand leans to the left of the finger axis, rad."""
PAD = 0.02
"""Width of a finger's pad along the box, m."""
HELD = (0.015, 0.006)
"""A hold is sound when this much of the pad's width and height lies on the face, m."""
CLEAR_BELOW = 0.002
"""How far the finger tips stay above the box's underside, and the palm above its top, m."""
CELLS = 13
"""Positions along each side of a goal region."""
ANGLES = 24
"""Yaws of a box over half a turn."""
STEP = 0.06
"""Distance of the positions that blockers may be put at, m."""
MOST = 2
"""Most boxes that are moved besides the subject."""
VARIANTS = 4
"""How many holds of the blockers are tried to put them out of the way."""
TOUCH = 0.002
"""What stands at most this much lower than a face counts as standing on it, m."""


def shortest(scene: Scene, goal: Goal, clearance: float, most: int = MOST) -> int | None:
    """Fewest boxes to move before the subject, by exhaustion; None when `most` do not suffice."""
    gone = blocking(scene, goal, clearance, most)
    return None if gone is None else len(gone)


def blocking(
    scene: Scene, goal: Goal, clearance: float, most: int = MOST
) -> tuple[str, ...] | None:
    """A smallest set of boxes to move before the subject, in order; None when there is none.

    What `clearance` (m) exceeds CLEARANCE by, the subject also stays inside its goal region: with
    more of it fewer tasks are solvable, namely those that do not hang on a millimetre.
    """
    return _Exhaustion(scene, goal, clearance).smallest(most)


def possible(scene: Scene, goal: Goal, gone: Sequence[str], clearance: float = CLEARANCE) -> bool:
    """Whether the subject could be taken and put at the goal if these boxes were not there."""
    found = _Exhaustion(scene, goal, clearance)
    return any(need <= set(gone) for need in found.needs())


# -- holds ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hold:
    """The hand over a box: direction, lean and offset, and the depths that are sound."""

    turn: float
    """Angle of the finger axis against the box's x, rad."""
    tilt: float
    """How far it leans to the left of the finger axis, rad."""
    offset: tuple[float, float]
    """Of the finger tips' middle from the box's, in the box's axes, m."""
    depths: np.ndarray
    """(D,): of the finger tips below the box's top, shallow to deep, m."""
    parts: np.ndarray
    """(P, 5): centre along the finger axis and across it, half extents likewise, height of the
    underside over the finger tips; m."""


def holds(box: Box) -> tuple[Hold, ...]:
    """Every sound hold of a box on the grid, the most upright and centred first."""
    arm, found = panda(), []
    height = box.size[2]
    deepest = min(height, arm.finger_tip - arm.palm) - CLEAR_BELOW
    depths = np.arange(min(HELD[1], height / 2), deepest + 1e-9, DEPTH)
    for axis, tilt in itertools.product((0, 1), TILTS):
        if box.size[axis] > WIDEST:
            continue
        face = box.size[1 - axis]
        furthest = (face + PAD) / 2 - min(HELD[0], face)
        steps = math.floor(furthest / OFFSET + 1e-9)
        parts = _hand(box.size[axis] / 2 + SPREAD, tilt)
        for step, way in itertools.product(range(-steps, steps + 1), (0.0, math.pi)):
            along = step * OFFSET
            left = along if (axis == 0) == (way == 0.0) else -along
            sound = _clear_of_held(depths, height, face, left, tilt)
            if sound.any():
                found.append(
                    Hold(
                        turn=axis * math.pi / 2 + way,
                        tilt=tilt,
                        offset=(0.0, along) if axis == 0 else (along, 0.0),
                        depths=depths[sound],
                        parts=parts,
                    )
                )
    return tuple(sorted(found, key=lambda hold: (abs(hold.tilt), max(map(abs, hold.offset)))))


def _clear_of_held(
    depths: np.ndarray, height: float, face: float, left: float, tilt: float
) -> np.ndarray:
    """At which depths a hand whose tips are that far to the left of the middle of a face keeps
    its palm off the box, and its tips off what that stands on, (D,) bool."""
    arm, s, c = panda(), math.sin(tilt), math.cos(tilt)
    top = np.linspace(-face / 2 - left, face / 2 - left, 101)[:, None]
    over, aside = top * s + depths * c, top * c - depths * s
    palms = [(centre, half) for link, centre, half in arm.arm if link == 2]
    hit = np.zeros(len(depths), dtype=bool)
    for centre, half in palms:
        under = arm.finger_tip - centre[2] - half[2] - CLEAR_BELOW
        hit |= ((over > under) & (abs(aside) < abs(centre[0]) + half[0])).any(axis=0)
    corner = max(high[0] for _, high in arm.finger) * abs(s)
    return ~hit & (depths <= height - CLEAR_BELOW - corner)


def _hand(opening: float, tilt: float) -> np.ndarray:
    """The rectangles of a hand with its fingers that far apart, as `Hold.parts`."""
    arm, s, c = panda(), math.sin(tilt), math.cos(tilt)
    boxes = [(centre - half, centre + half) for link, centre, half in arm.arm if link == 2]
    for low, high in arm.finger:
        for side in (1.0, -1.0):  # the right finger is the left one turned by half a turn
            one, two = (side * (end + np.array([0.0, opening, 0.0])) for end in (low, high))
            one[2], two[2] = low[2], high[2]
            boxes.append((np.minimum(one, two), np.maximum(one, two)))
    rows = []
    for low, high in boxes:
        x, z = np.meshgrid((low[0], high[0]), (low[2], high[2]))
        over = arm.finger_tip - z
        left, up = x * c + over * s, over * c - x * s
        rows.append(
            (
                (low[1] + high[1]) / 2,
                (left.min() + left.max()) / 2,
                (high[1] - low[1]) / 2,
                (left.max() - left.min()) / 2,
                up.min(),
            )
        )
    return np.array(rows)


# -- exhaustion -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Way:
    """One way to take a box and put it somewhere."""

    hold: Hold
    depth: float
    pose: np.ndarray
    """(3,) x, y, yaw of the box where it is put, or where it stands."""


class _Exhaustion:
    """One task; sets of boxes are bits of a number, `names` says whose."""

    def __init__(self, scene: Scene, goal: Goal, clearance: float) -> None:
        self.scene, self.goal, self.clearance = scene, goal, clearance
        self.names = scene.names
        self.bit = {name: 1 << i for i, name in enumerate(self.names)}
        self.never = 1 << len(self.names)  # the robot's foot
        self.start = {box.name: _row(box) for box in scene.objects}
        self.rows = np.array([*self.start.values(), _foot(scene)])
        self.above = {
            name: sum(self.bit[box.name] for box in scene.objects if name in box.supports)
            for name in self.names
        }
        self._taken: dict[str, list[tuple[int, _Way]]] = {}

    def needs(self) -> list[set[str]]:
        """Sets of boxes (the reference among them never) that suffice to be gone, unordered."""
        return [{name for name in self.names if self.bit[name] & mask} for mask in self._ways]

    def smallest(self, most: int) -> tuple[str, ...] | None:
        """See `blocking`."""
        goal = self.goal
        others = [name for name in self.names if name not in (goal.subject, goal.reference)]
        ways = sorted(self._ways.items(), key=lambda item: item[0].bit_count())
        for count in range(min(most, len(others)) + 1):
            for chosen in itertools.combinations(others, count):
                gone = sum(self.bit[name] for name in chosen)
                fitting = [way for need, way in ways if not need & ~gone]
                if not fitting:
                    continue
                for order in self._orders(chosen):
                    if any(self._put_aside(order, way) for way in fitting):
                        return order
        return None

    @cached_property
    def _ways(self) -> dict[int, _Way]:
        """By who has to be gone: how the subject is taken and put at the goal then."""
        scene, goal = self.scene, self.goal
        subject, reference = scene[goal.subject], scene[goal.reference]
        fixed = self.never | self.bit[goal.reference]
        bottom = reference.top if goal.predicate.stacked else 0.0
        poses = _poses(self._region())
        poses = poses[_on_table(scene, subject, poses)]
        boxes = self._hit_by_box(subject, poses, bottom) & ~self.bit[goal.subject]
        poses, boxes = poses[boxes & fixed == 0], boxes[boxes & fixed == 0]
        here = self.start[goal.subject][None, :3]
        always = self.above[goal.subject] | self._overhanging(subject)
        found: dict[int, _Way] = {}
        if len(poses) == 0 or always & fixed:
            return found
        for hold in holds(subject):
            can = self._reaches(subject, here, subject.bottom, hold)
            can = can & self._reaches(subject, poses, bottom, hold)
            # The hand of a deeper hold hits whatever that of a shallower one does: the shallowest
            # that is within reach says it all.
            first = np.where(can.any(axis=1), can.argmax(axis=1), -1)
            for i in np.unique(first[first >= 0]).tolist():
                depth = float(hold.depths[i])
                taken = self._hit_by_hand(subject, here, subject.bottom, hold, depth)[0]
                taken = int(taken) & ~self.bit[goal.subject] | always
                if taken & fixed:
                    continue
                at = np.flatnonzero(first == i)
                put = self._hit_by_hand(subject, poses[at], bottom, hold, depth) | boxes[at]
                put &= ~self.bit[goal.subject]
                for need, where in zip(*np.unique(put, return_index=True), strict=True):
                    if not int(need) & fixed:
                        way = _Way(hold=hold, depth=depth, pose=poses[at[where]])
                        found.setdefault(int(need) | taken, way)
            if 0 in found:
                return {0: found[0]}
        return found

    def _region(self) -> np.ndarray:
        """Grid points (N, 2) of the goal region for the subject's centre, from border to border."""
        scene, goal = self.scene, self.goal
        steps, inset = np.linspace(-1, 1, CELLS), max(self.clearance - CLEARANCE, 0.0)
        region = goal.predicate.region(scene[goal.subject], scene[goal.reference], scene.robot)
        points = []
        for there in region.rectangles:
            half = [max(extent - inset, 0.0) for extent in there.half]
            a, b = np.meshgrid(steps * half[0], steps * half[1])
            c, s = math.cos(there.angle), math.sin(there.angle)
            local = np.stack([c * a - s * b, s * a + c * b], axis=-1)
            points.append(local.reshape(-1, 2) + np.array([there.x, there.y]))
        return np.concatenate(points)

    def _orders(self, chosen: Sequence[str]) -> Iterator[tuple[str, ...]]:
        """Orders in which these boxes can be taken one after the other."""
        for order in itertools.permutations(chosen):
            gone = 0
            for name in order:
                if not any(not mask & ~gone for mask, _ in self._takes(name)):
                    break
                gone |= self.bit[name]
            else:
                yield order

    def _takes(self, name: str) -> list[tuple[int, _Way]]:
        """Who has to be gone before a blocker can be taken, and how it is taken then."""
        if name not in self._taken:
            box, here = self.scene[name], self.start[name][None, :3]
            always = self.above[name] | self._overhanging(box)
            found: dict[int, list[_Way]] = {}
            for hold in holds(box):
                can = self._reaches(box, here, box.bottom, hold)[0]
                if not can.any():
                    continue
                depth = float(hold.depths[can.argmax()])
                mask = int(self._hit_by_hand(box, here, box.bottom, hold, depth)[0])
                mask = mask & ~self.bit[name] | always
                found.setdefault(mask, []).append(_Way(hold=hold, depth=depth, pose=here[0]))
            self._taken[name] = [
                (mask, way) for mask, ways in found.items() for way in ways[:VARIANTS]
            ]
        return self._taken[name]

    def _put_aside(self, order: Sequence[str], last: _Way) -> bool:
        """Whether the boxes can be put on the table, clear of all that is still to be done."""
        return not order or any(self._puts(order, last, k) for k in range(VARIANTS))

    def _puts(self, order: Sequence[str], last: _Way, variant: int) -> bool:
        scene, goal = self.scene, self.goal
        subject = scene[goal.subject]
        bottom = scene[goal.reference].top if goal.predicate.stacked else 0.0
        ways, gone = [], 0
        for name in order:
            fitting = [way for mask, way in self._takes(name) if not mask & ~gone]
            ways.append(fitting[variant % len(fitting)])
            gone |= self.bit[name]
        # Where the hand and the subject come through later: nothing may be put there.
        here = self.start[goal.subject][:3]
        ends = [_hand_rows(subject, here, subject.bottom, last)]
        ends += [_hand_rows(subject, last.pose, bottom, last)]
        a, b = subject.size[0] / 2, subject.size[1] / 2
        ends += [np.array([[*last.pose, a, b, bottom, bottom + subject.size[2]]])]
        picks = [
            _hand_rows(scene[name], way.pose, scene[name].bottom, way)
            for name, way in zip(order, ways, strict=True)
        ]
        standing = {**self.start, "": _foot(scene)}
        for i, (name, way) in enumerate(zip(order, ways, strict=True)):
            del standing[name]
            box, solid = scene[name], np.array(list(standing.values()))
            poses = _poses(self._places())
            poses = poses[_on_table(scene, box, poses)]
            poses = poses[_reached_by(scene, box, poses, 0.0, way)]
            later = np.vstack([*ends, *picks[i + 1 :]])
            later = later[later[:, 5] < box.size[2] + self.clearance]
            there = _hits(poses, _lying(box), np.array([0.0]), [solid, later], self.clearance)
            poses = poses[~there.any(axis=1)]
            tips = box.size[2] - way.depth
            hand = _over(poses, way.hold)
            there = _hits(
                hand, way.hold.parts, tips + way.hold.parts[:, 4], [solid], self.clearance
            )
            poses = poses[~there.any(axis=1)]
            if len(poses) == 0:
                return False
            standing[name] = np.array([*poses[0], *self.start[name][3:5], 0.0, box.size[2]])
        return True

    def _places(self) -> np.ndarray:
        half = np.array(self.scene.table.size) / 2
        axes = [np.arange(-h + STEP / 2, h, STEP) for h in half]
        return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

    def _overhanging(self, box: Box) -> int:
        """Who hangs over a box, so that it cannot be lifted."""
        here = self.start[box.name][None, :3]
        over = _hits(here, _lying(box), np.array([box.top]), [self.rows], 0.0)[0]
        over &= self.rows[:, 5] >= box.top - TOUCH
        return self._mask(over[None])[0]

    def _reaches(self, box: Box, poses: np.ndarray, bottom: float, hold: Hold) -> np.ndarray:
        """Which depths are within reach at the poses of the box, (N, D) bool."""
        hand = _over(poses, hold)
        tips = bottom + box.size[2] - hold.depths
        return reached(self.scene, hand[:, :1], hand[:, 1:2], tips, hand[:, 2:], hold.tilt)

    def _hit_by_box(self, box: Box, poses: np.ndarray, bottom: float) -> np.ndarray:
        """Who is in the way of a box that comes down there, (N,) sets."""
        low = np.array([bottom])
        return self._mask(_hits(poses, _lying(box), low, [self.rows], self.clearance))

    def _hit_by_hand(
        self, box: Box, poses: np.ndarray, bottom: float, hold: Hold, depth: float
    ) -> np.ndarray:
        """Who is in the way of the hand at the poses of the box, (N,) sets; perhaps the box."""
        low = bottom + box.size[2] - depth + hold.parts[:, 4]
        return self._mask(_hits(_over(poses, hold), hold.parts, low, [self.rows], self.clearance))

    def _mask(self, hits: np.ndarray) -> np.ndarray:
        return hits @ (1 << np.arange(hits.shape[1], dtype=np.int64))


def _row(box: Box) -> np.ndarray:
    """x, y, yaw, half extents, underside, top (7,)."""
    x, y, _ = box.position
    return np.array([x, y, box.yaw, box.size[0] / 2, box.size[1] / 2, box.bottom, box.top])


def _foot(scene: Scene) -> np.ndarray:
    """The part of the robot that never moves, as a box's row."""
    (x, y, z), (a, b, h) = panda().foot
    base, yaw = scene.robot.base, scene.robot.yaw
    c, s = math.cos(yaw), math.sin(yaw)
    at = base[0] + c * x - s * y, base[1] + s * x + c * y
    return np.array([*at, yaw, a, b, base[2] + z - h, base[2] + z + h])


def _lying(box: Box) -> np.ndarray:
    """A box as one part of a hand over its own centre, (1, 5)."""
    return np.array([[0.0, 0.0, box.size[0] / 2, box.size[1] / 2, 0.0]])


def _poses(points: np.ndarray) -> np.ndarray:
    """(N * ANGLES, 3): every point with every yaw."""
    yaws = np.arange(ANGLES) * math.pi / ANGLES
    return np.column_stack([np.repeat(points, ANGLES, axis=0), np.tile(yaws, len(points))])


def _on_table(scene: Scene, box: Box, poses: np.ndarray) -> np.ndarray:
    c, s = np.abs(np.cos(poses[:, 2])), np.abs(np.sin(poses[:, 2]))
    a, b = box.size[0] / 2, box.size[1] / 2
    extent = np.column_stack([c * a + s * b, s * a + c * b])
    spare = np.array(scene.table.size) / 2 - np.abs(poses[:, :2]) - extent
    return spare.min(axis=1) >= 0


def _over(poses: np.ndarray, hold: Hold) -> np.ndarray:
    """Where the hand is (N, 3), x, y, angle of the finger axis, when the box is at the poses."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    a, b = hold.offset
    x, y = poses[:, 0] + c * a - s * b, poses[:, 1] + s * a + c * b
    return np.column_stack([x, y, poses[:, 2] + hold.turn])


def _reached_by(scene: Scene, box: Box, poses: np.ndarray, bottom: float, way: _Way) -> np.ndarray:
    hand = _over(poses, way.hold)
    tips = np.full(len(hand), bottom + box.size[2] - way.depth)
    return reached(scene, hand[:, 0], hand[:, 1], tips, hand[:, 2], way.hold.tilt)


def _hand_rows(box: Box, pose: np.ndarray, bottom: float, way: _Way) -> np.ndarray:
    """The hand at a box as rows up to the sky, (P, 7)."""
    [(x, y, angle)] = _over(pose[None, :3], way.hold)
    c, s = math.cos(angle), math.sin(angle)
    low = bottom + box.size[2] - way.depth
    return np.array(
        [
            (x + c * y0 - s * x0, y + s * y0 + c * x0, angle, half_y, half_x, low + up, math.inf)
            for y0, x0, half_y, half_x, up in way.hold.parts
        ]
    )


def _hits(
    poses: np.ndarray,
    parts: np.ndarray,
    low: np.ndarray,
    rows: Sequence[np.ndarray],
    clearance: float,
) -> np.ndarray:
    """Which rows are nearer than `clearance` to parts that come straight down, (N, K) bool.

    low (P,): heights of the undersides. What stays below them is in nobody's way; the support of
    a box, which its underside touches, neither.
    """
    there = np.vstack(rows)
    found = np.zeros((len(poses), len(there)), dtype=bool)
    along = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    for (offset, aside, a, b, up), under in zip(parts, low, strict=True):
        centre = poses[:, :2] + offset * along + aside * across
        spare = TOUCH if len(parts) == 1 and up == 0.0 else -clearance
        for k in np.flatnonzero(there[:, 6] > under + spare):
            near = np.hypot(*(centre - there[k, :2]).T) < (
                math.hypot(a, b) + math.hypot(there[k, 3], there[k, 4]) + clearance
            )
            near &= ~found[:, k]
            at = np.flatnonzero(near)
            gap = footprints_gap(centre[at], along[at], a, b, there[k])
            found[at[gap < clearance], k] = True
    return found


def footprints_gap(
    centre: np.ndarray, along: np.ndarray, a: float, b: float, row: np.ndarray
) -> np.ndarray:
    """Separating-axis gap (N,) of N equal rectangles and the one of a row, m.

    centre (N, 2); along (N, 2): unit vectors of the edges 2 a; the others are 2 b.
    """
    d = row[:2] - centre
    across = np.column_stack([-along[:, 1], along[:, 0]])
    u = np.array([math.cos(row[2]), math.sin(row[2])])
    v = np.array([-u[1], u[0]])
    cos, sin = np.abs(along @ u), np.abs(along @ v)  # of the angle between the two
    return np.max(
        [
            np.abs((d * along).sum(axis=1)) - a - row[3] * cos - row[4] * sin,
            np.abs((d * across).sum(axis=1)) - b - row[3] * sin - row[4] * cos,
            np.abs(d @ u) - row[3] - a * cos - b * sin,
            np.abs(d @ v) - row[4] - a * sin - b * cos,
        ],
        axis=0,
    )
