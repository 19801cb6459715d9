"""How the hand takes a box, and what then moves with the arm.

The hand points down over the box. In the plane it is a set of rectangles that share one angle
(box, finger tips, fingers, palm); for the bounds that look at the arm it is boxes on its links.

A box has a family of grasps: across both edges that fit the hand, with the finger tips at several
depths, and with the hand shifted along the box. A hold is sound when at least GRIP of the pads'
height and the middle line of the pads, INSET from the corner, lie on the face. Deep and centred
is preferred: what a hold lacks of that is a price in the plan's cost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from relevance.planner.kernels.boxes import Bodies
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
SPREAD = 0.005
"""How far each finger stands off the box before it closes, m."""
PRICE = 20.0
"""Price of a hold for each metre that it is shallower, or farther from the middle, rad^2/m."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grasp:
    """The hand pointing down over a box, fingers along its x (axis 0) or y (axis 1)."""

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
    """How far the hand is from the box's centre, to the left of the finger axis, m."""
    price: float
    """What the plan's cost grows by, rad^2."""
    parts: np.ndarray
    """(5, 5): offset along the finger axis and to its left, half extents along and across it,
    height of the underside relative to the box's bottom; row 0 is the box itself. m."""


class Family(NamedTuple):
    """Some grasps of a box, and what they are side by side."""

    grasps: tuple[Grasp, ...]
    axes: np.ndarray
    """(G,)."""
    parts: np.ndarray
    """(G, 5, 5)."""


def grasps(box: Box) -> tuple[Grasp, ...]:
    """The deep, centred grasps that the gripper's opening allows, narrower edge first."""
    return deep_grasps(box).grasps


def deep_grasps(box: Box) -> Family:
    """The same with their arrays."""
    return _deep(box.size)


def other_grasps(box: Box) -> Family:
    """The shallower and shifted grasps, edge by edge, each shift from deep to shallow."""
    return _others(box.size)


@lru_cache(maxsize=1024)
def _deep(size: tuple[float, float, float]) -> Family:
    hand, found = _hand(), []
    length, width, height = size
    depth = min(DEPTH, max(height - 0.012, 0.3 * height, min(0.010, height - GROUND)))
    sound = min(depth, height - GROUND) >= GRIP
    above = height / 2 - depth + hand.tip
    axes = (0, 1) if length <= width else (1, 0)
    parts = np.empty((2, 1 + len(hand.parts), 5))
    for axis in axes:
        closed = size[axis] / 2
        opening = closed + SPREAD
        if opening > hand.max_opening or not sound:
            continue
        one = parts[len(found)]
        one[0] = 0.0, 0.0, closed, size[1 - axis] / 2, 0.0
        one[1:] = hand.parts
        one[1:-1, 0] += hand.sides * opening
        one[1:, 4] += height / 2 + above  # of the hand over the box's bottom
        found.append(
            Grasp(
                axis=axis, opening=opening, closed=closed, above=above, depth=depth, shift=0.0,
                price=0.0, parts=one,
            )
        )  # fmt: skip
    return _family(found, parts[: len(found)])


@lru_cache(maxsize=1024)
def _others(size: tuple[float, float, float]) -> Family:
    found, parts = [], []
    for deep in _deep(size).grasps:
        most = min(size[1 - deep.axis] / 2 - INSET, FARTHEST)
        shifts = (0.0, 0.5 * most, -0.5 * most, most, -most) if most > INSET / 2 else (0.0,)
        depths = (deep.depth, *(depth for depth in SHALLOW if depth < deep.depth - 0.002))
        ways = [(shift, depth) for shift in shifts for depth in depths][1:]  # without the deep one
        if not ways:
            continue
        shifted, depth = np.array(ways).T
        there = np.repeat(deep.parts[None], len(ways), axis=0)
        there[:, 1:, 1] += shifted[:, None]
        there[:, 1:, 4] += (deep.depth - depth)[:, None]
        parts.append(there)
        for (shift, depth), one in zip(ways, there, strict=True):
            rise = deep.depth - depth
            found.append(
                Grasp(
                    axis=deep.axis, opening=deep.opening, closed=deep.closed,
                    above=deep.above + rise, depth=depth, shift=shift,
                    price=PRICE * (rise + abs(shift)), parts=one,
                )
            )  # fmt: skip
    return _family(found, np.concatenate(parts) if parts else np.empty((0, 5, 5)))


def _family(found: list[Grasp], parts: np.ndarray) -> Family:
    return Family(tuple(found), np.array([grasp.axis for grasp in found], np.int64), parts)


def fits(box: Box) -> bool:
    """Whether the hand opens wide enough for one of its edges."""
    return min(box.size[:2]) / 2 + SPREAD <= _hand().max_opening


def pick_target(box: Box, grasp: Grasp) -> np.ndarray:
    """Hand target (x, y, z, finger angle) over a standing box, (4,), m and rad."""
    x, y, z = box.position
    angle = box.yaw + grasp.axis * math.pi / 2
    return hand_target(x, y, z + grasp.above, angle, grasp.shift)


def hand_target(x: float, y: float, z: float, angle: float, shift: float) -> np.ndarray:
    """Hand target (4,) for a box at x, y whose finger axis has this angle."""
    return np.array([x - shift * math.sin(angle), y + shift * math.cos(angle), z, angle])


def carried(box: Box, grasp: Grasp, way: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half extents of the held box in the hand's frame (y = finger axis), m.

    way: 1 where the hand's y points along the finger angle, -1 where it points against it.
    """
    half = np.array([box.size[1 - grasp.axis], box.size[grasp.axis], box.size[2]]) / 2
    return np.array([-way * grasp.shift, 0.0, grasp.above]), half


def bodies(opening: float, carried: tuple | None = None, *, upper: bool = False) -> Bodies:
    """Arm, hand and fingers at this opening; last the carried box (centre, half), if any.

    upper: with the links near the base too. Not to be written to: it is kept.
    """
    if carried is None:
        return _bodies_of(opening, None, None, upper)
    return _bodies_of(opening, *(tuple(vector.tolist()) for vector in carried), upper)


@lru_cache(maxsize=256)
def _bodies_of(opening: float, centre: tuple | None, half: tuple | None, upper: bool) -> Bodies:
    shut, sides = _shut_hand(upper)
    count = len(sides) - (centre is None)
    link, centres, halves, radius = (rows[:count].copy() for rows in shut)
    centres[:, 1] += opening * sides[:count]
    if half is not None:
        centres[-1], halves[-1] = centre, half
        radius[-1] = math.hypot(*half)
    return Bodies(link, centres, halves, radius)


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
    return Bodies(link, centre, half, np.sqrt((half**2).sum(1)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hand:
    """The downward hand as rectangles, like `Grasp.parts`, heights relative to its origin."""

    parts: np.ndarray
    """(4, 5): finger tips and fingers, at opening 0, then the palm."""
    sides: np.ndarray
    """Which way opening moves each finger part along the finger axis."""
    tip: float
    max_opening: float


@cache
def _hand() -> _Hand:
    arm = panda()
    rows, sides = [], []
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            across = max(abs(low[0]), abs(high[0]))
            middle = side * (low[1] + high[1]) / 2
            rows.append((middle, 0.0, (high[1] - low[1]) / 2, across, -high[2]))
            sides.append(side)
    _, centre, half = arm.arm[-1]
    reach = np.abs(centre) + half
    return _Hand(
        parts=np.array([*rows, (0.0, 0.0, reach[1], reach[0], -(centre[2] + half[2]))]),
        sides=np.array(sides),
        tip=arm.finger_tip,
        max_opening=arm.max_opening,
    )
