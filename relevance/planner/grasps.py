"""How the hand takes a box, and what then moves with the arm.

The hand points down over the box. In the plane it is a set of rectangles that share one angle
(box, finger tips, fingers, both halves of the palm); for the bounds that look at the arm it is boxes on its links.

A box has a family of grasps: across both edges that fit the hand, with the finger tips at several
depths, with the hand shifted along the box, and with the hand leaning along it (the box stays
level). A hold is sound when at least GRIP of the pads' height and the middle line of the pads,
INSET from the corner, lie on the face. Deep, centred and upright is preferred: what a hold lacks
of that is a price in the plan's cost.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from relevance.planner.kernels.boxes import Bodies
from relevance.planner.kernels.kinematics import upright_twin
from relevance.robot import HAND, panda
from relevance.scene import Box

DEPTH = 0.025
"""How far the finger tips reach below the top of the box that they hold, at most, m."""
SHALLOW = (0.012, 0.006)
"""Smaller depths, m; a box is held as deep as its neighbours allow."""
GRIP = 0.005
"""Least height of the pads that lies on the face of a held box, m."""
GROUND = 0.004
"""What the finger tips keep from what the box stands on, m."""
INSET = 0.01
"""Least distance of the pads' middle line from the corner of a held box, m."""
FARTHEST = 0.04
"""Farthest that the hand is shifted along a box, m."""
SPREAD = 0.002
"""How far each finger stands off the box before it closes, m."""
TILTS = (0.2, -0.2, 0.4, -0.4, 0.6, -0.6)
"""How far the hand may lean to the left of the finger axis, rad."""
PALM_ROOM = 0.003
"""What a leaning palm keeps from the box that it holds, m."""
PRICE = 20.0
"""Price of a hold for each metre that it is shallower, or farther from the middle, rad^2/m."""
LEAN_PRICE = 3.0
"""Price of a hold for each radian that the hand leans, rad^2/rad."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grasp:
    """The hand over a box, fingers along its x (axis 0) or y (axis 1)."""

    axis: int
    opening: float
    """Finger joint value before closing and after release, m."""
    closed: float
    """Finger joint value on the box, m."""
    above: float
    """Height of the hand's origin over the box's centre, m."""
    depth: float
    """How far the finger tips reach below the box's top, m."""
    shift: float
    """How far the hand's origin is from the box's centre, to the left of the finger axis, m."""
    tilt: float
    """How far the hand leans to the left of the finger axis, rad."""
    wrist: tuple[float, float]
    """What `shift` and `above` are for a hand that does not lean and has the same wrist, m."""
    price: float
    """What the plan's cost grows by, rad^2."""
    parts: np.ndarray
    """(P, 5): offset along the finger axis and to its left, half extents along and across it,
    height of the underside relative to the box's bottom; row 0 is the box itself. m."""

    @property
    def lopsided(self) -> bool:
        """Whether the hand, the other way round, would be elsewhere."""
        return self.shift != 0 or self.tilt != 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Family:
    """Some grasps of a box side by side; each is made when it is first asked for."""

    size: tuple[float, float, float]
    axes: np.ndarray
    """(G,)."""
    rows: np.ndarray
    """(G, 7): above, depth, shift, tilt, wrist (2) and price of each."""
    parts: np.ndarray
    """(G, P, 5)."""
    _made: dict[int, Grasp] = field(default_factory=dict)

    @property
    def wrists(self) -> np.ndarray:
        """(G, 2): `Grasp.wrist` of each."""
        return self.rows[:, 4:6]

    def __len__(self) -> int:
        return len(self.axes)

    def __getitem__(self, number: int) -> Grasp:
        if number not in self._made:
            axis = int(self.axes[number])
            above, depth, shift, tilt, left, height, price = self.rows[number].tolist()
            closed = self.size[axis] / 2
            self._made[number] = Grasp(
                axis=axis, opening=closed + SPREAD, closed=closed, above=above, depth=depth,
                shift=shift, tilt=tilt, wrist=(left, height), price=price,
                parts=self.parts[number],
            )  # fmt: skip
        return self._made[number]

    def __iter__(self) -> Iterator[Grasp]:
        return (self[number] for number in range(len(self)))


class _Ways(NamedTuple):
    """What a family chooses from, (G,) each."""

    tilts: np.ndarray
    """Index among 0 and TILTS."""
    shares: np.ndarray
    """Of the farthest shift of the pads."""
    depths: np.ndarray
    """0 for the deepest, else index + 1 in SHALLOW."""


_SHARES = (0.0, 0.5, -0.5, 1.0, -1.0)
_DEEP, _OTHERS, _LEANING = (
    _Ways(*map(np.array, zip(*ways, strict=True)))
    for ways in (
        [(0, 0.0, 0)],
        [*product((0,), _SHARES, range(1 + len(SHALLOW)))][1:],
        [*product(range(1, 1 + len(TILTS)), _SHARES, (0, 1))],
    )
)


def grasps(box: Box) -> tuple[Grasp, ...]:
    """The deep, centred grasps that the gripper's opening allows, narrower edge first."""
    return tuple(deep_grasps(box))


def deep_grasps(box: Box) -> Family:
    """The same side by side."""
    return _deep(box.size)


def other_grasps(box: Box) -> Family:
    """The shallower and shifted grasps, edge by edge, each shift from deep to shallow."""
    return _others(box.size)


def leaning_grasps(box: Box) -> Family:
    """The grasps of a hand that leans, edge by edge, each tilt and shift from deep to shallow."""
    return _leaning(box.size)


@lru_cache(maxsize=1024)
def _deep(size: tuple[float, float, float]) -> Family:
    return _family(size, _DEEP)


@lru_cache(maxsize=1024)
def _others(size: tuple[float, float, float]) -> Family:
    return _family(size, _OTHERS)


@lru_cache(maxsize=1024)
def _leaning(size: tuple[float, float, float]) -> Family:
    return _family(size, _LEANING)


def _family(size: tuple[float, float, float], ways: _Ways) -> Family:
    """The sound ones of some ways to take a box, narrower edge first."""
    hand, height = _hand(), size[2]
    deep = min(DEPTH, max(height - 0.012, 0.3 * height, min(0.010, height - GROUND)))
    tilts = np.array([0.0, *TILTS])[ways.tilts]
    s, c = np.sin(tilts), np.cos(tilts)
    deepest = np.minimum(deep, height - GROUND - hand.across[0] * abs(s))  # of the lower corner
    depths = np.where(ways.depths == 0, deepest, np.array([0.0, *SHALLOW])[ways.depths])
    fair = (depths >= GRIP) & ((ways.depths == 0) | (depths < deepest - 0.002))
    found = []
    for axis in (0, 1) if size[0] <= size[1] else (1, 0):
        opening, edge = size[axis] / 2 + SPREAD, size[1 - axis] / 2
        if opening > hand.max_opening:
            continue
        most = min(edge - INSET, FARTHEST)
        shifts = ways.shares * (most if most > INSET / 2 else 0.0)
        # Where, on the side that the hand leans to, the box's top is nearest to the palm.
        palm = len(hand.sides)
        end = np.minimum(edge - shifts * np.sign(s), (hand.across[palm] + depths * abs(s)) / c)
        sound = fair & (end * abs(s) + depths * c <= hand.near[palm] - PALM_ROOM)
        sound &= (shifts != 0) | (ways.shares == 0)
        shift, depth, tilt = shifts[sound], depths[sound], tilts[sound]
        parts = np.empty((len(shift), 1 + len(hand.near), 5))
        parts[:, 0] = 0.0, 0.0, size[axis] / 2, edge, 0.0
        parts[:, 1:] = _over_tips()[ways.tilts[sound]]
        parts[:, 1 : 1 + palm, 0] += hand.sides * opening
        parts[:, 1:, 1] += shift[:, None]
        parts[:, 1:, 4] += (height - depth)[:, None]
        left = shift + hand.tip * s[sound]
        above = height / 2 - depth + hand.tip * c[sound]
        price = PRICE * (deep - depth + abs(shift)) + LEAN_PRICE * abs(tilt)
        rows = above, depth, left, tilt, *upright_twin(left, above, tilt), price
        found.append((np.full(len(shift), axis), np.column_stack(rows), parts))
    if not found:
        return Family(
            size=size, axes=np.empty(0, int), rows=np.empty((0, 7)), parts=np.empty((0, 1, 5))
        )
    axes, rows, parts = map(np.concatenate, zip(*found, strict=True))
    return Family(size=size, axes=axes, rows=rows, parts=parts)


def fits(box: Box) -> bool:
    """Whether the hand opens wide enough for one of its edges."""
    return min(box.size[:2]) / 2 + SPREAD <= _hand().max_opening


def pick_target(box: Box, grasp: Grasp) -> np.ndarray:
    """Hand target (TARGET,) over a standing box, m and rad."""
    x, y, z = box.position
    return hand_target(x, y, z + grasp.above, box.yaw + grasp.axis * math.pi / 2, grasp)


def hand_target(x: float, y: float, z: float, angle: float, grasp: Grasp) -> np.ndarray:
    """Hand target (TARGET,) at the height z for a box at x, y whose finger axis has this angle."""
    s, c = math.sin(angle), math.cos(angle)
    return np.array([x - grasp.shift * s, y + grasp.shift * c, z, angle, grasp.tilt])


class Held(NamedTuple):
    """A box in the hand, in the hand's frame (y = finger axis)."""

    centre: np.ndarray
    """(3,) m."""
    half: np.ndarray
    """(3,) m."""
    turn: float
    """About y, rad."""


def carried(box: Box, grasp: Grasp, way: float = 1.0) -> Held:
    """The box that is held so.

    way: 1 where the hand's y points along the finger angle, -1 where it points against it.
    """
    half = np.array([box.size[1 - grasp.axis], box.size[grasp.axis], box.size[2]]) / 2
    s, c = math.sin(grasp.tilt), math.cos(grasp.tilt)
    x, z = grasp.above * s - grasp.shift * c, grasp.above * c + grasp.shift * s
    return Held(np.array([way * x, 0.0, z]), half, way * grasp.tilt)


def bodies(opening: float, held: Held | None = None, *, upper: bool = False) -> Bodies:
    """Arm, hand and fingers at this opening; last the box in the hand, if any.

    upper: with the links near the base too. Not to be written to: it is kept.
    """
    if held is None:
        return _bodies_of(opening, None, None, 0.0, upper)
    centre, half, turn = held
    return _bodies_of(opening, tuple(centre.tolist()), tuple(half.tolist()), turn, upper)


@lru_cache(maxsize=256)
def _bodies_of(
    opening: float, centre: tuple | None, half: tuple | None, turn: float, upper: bool
) -> Bodies:
    shut, sides = _shut_hand(upper)
    count = len(sides) - (centre is None)
    link, centres, halves, turns, radius = (rows[:count].copy() for rows in shut)
    centres[:, 1] += opening * sides[:count]
    if half is not None:
        centres[-1], halves[-1], turns[-1] = centre, half, turn
        radius[-1] = math.hypot(*half)
    return Bodies(link, centres, halves, turns, radius)


@cache
def upper_bodies() -> Bodies:
    """The links near the base alone."""
    return _bodies(list(panda().upper_arm))


@cache
def _shut_hand(upper: bool) -> tuple[Bodies, np.ndarray]:
    """Arm, hand, fingers at opening 0 and room for a box; and which way opening moves each in y."""
    arm = panda()
    rows = [*(arm.upper_arm if upper else ()), *arm.arm]
    sides = [0.0] * len(rows)
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            rows.append((HAND, (low + high) / 2 * [1.0, side, 1.0], (high - low) / 2))
            sides.append(side)
    rows.append((HAND, np.zeros(3), np.zeros(3)))
    return _bodies(rows), np.array([*sides, 0.0])


def _bodies(rows: list[tuple[int, np.ndarray, np.ndarray]]) -> Bodies:
    link, centre, half = (np.array(column) for column in zip(*rows, strict=True))
    return Bodies(link, centre, half, np.zeros(len(link)), np.sqrt((half**2).sum(1)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hand:
    """The hand as boxes along its axes: the finger tips, the fingers, the halves of the palm."""

    middle: np.ndarray
    """(P,): of each along the finger axis, fingers shut, m."""
    along: np.ndarray
    """(P,): half extents along the finger axis, m."""
    across: np.ndarray
    """(P,): the same across it, either way round, m."""
    near: np.ndarray
    """(P,): where each begins, from the tips up, m."""
    far: np.ndarray
    """(P,): where it ends, m."""
    sides: np.ndarray
    """(P - 2,): which way opening moves each finger part along the finger axis."""
    tip: float
    max_opening: float


@cache
def _hand() -> _Hand:
    arm = panda()
    rows, sides = [], []
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            middle, across = side * (low[1] + high[1]) / 2, max(abs(low[0]), abs(high[0]))
            rows.append((middle, (high[1] - low[1]) / 2, across, high[2], low[2]))
            sides.append(side)
    for _, centre, half in arm.arm[-2:]:
        reach = np.abs(centre) + half
        rows.append((0.0, reach[1], reach[0], centre[2] + half[2], centre[2] - half[2]))
    middle, along, across, low, high = np.array(rows).T
    return _Hand(
        middle=middle, along=along, across=across, near=arm.finger_tip - low,
        far=arm.finger_tip - high, sides=np.array(sides), tip=arm.finger_tip,
        max_opening=arm.max_opening,
    )  # fmt: skip


@cache
def _over_tips() -> np.ndarray:
    """The hand with shut fingers over the middle of its tips, leaning by 0 and by TILTS, as
    `Grasp.parts` has it, (T, P, 5)."""
    hand, found = _hand(), []
    for tilt in (0.0, *TILTS):
        s, c = math.sin(tilt), math.cos(tilt)
        ends, aside = (hand.near * s, hand.far * s), hand.across * c
        low, high = np.minimum(*ends) - aside, np.maximum(*ends) + aside
        under = hand.near * c - hand.across * abs(s)
        columns = hand.middle, (low + high) / 2, hand.along, (high - low) / 2, under
        found.append(np.column_stack(columns))
    return np.array(found)
