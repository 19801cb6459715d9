"""How the hand takes a box, and what then moves with the arm.

The hand points down over the box. In the plane it is a set of rectangles that share one angle
(box, finger tips, fingers, palm); for the bounds that look at the arm it is boxes on its links.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from relevance.planner.kernels.boxes import Bodies
from relevance.robot import HAND, panda
from relevance.scene import Box

DEPTH = 0.025
"""How far the finger tips reach below the top of the box that they hold, m."""
SPREAD = 0.005
"""How far each finger stands off the box before it closes, m."""


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
    parts: np.ndarray
    """(5, 4): offset along the finger axis, half extents along and across it, height of the
    underside relative to the box's bottom; row 0 is the box itself. m."""


def grasps(box: Box) -> tuple[Grasp, ...]:
    """The grasps that the gripper's opening allows, narrower edge first."""
    hand = _hand()
    length, width, height = box.size
    above = height / 2 - min(DEPTH, max(height - 0.012, 0.3 * height)) + hand.tip
    found = []
    for axis in (0, 1) if length <= width else (1, 0):
        closed = box.size[axis] / 2
        opening = closed + SPREAD
        if opening > hand.max_opening:
            continue
        parts = np.empty((2 + len(hand.fingers), 4))
        parts[0] = 0.0, closed, box.size[1 - axis] / 2, 0.0
        parts[1:-1] = hand.fingers
        parts[1:-1, 0] += hand.sides * opening
        parts[-1] = hand.palm
        parts[1:, 3] += height / 2 + above  # of the hand over the box's bottom
        found.append(Grasp(axis=axis, opening=opening, closed=closed, above=above, parts=parts))
    return tuple(found)


def pick_target(box: Box, grasp: Grasp) -> np.ndarray:
    """Hand target (x, y, z, finger angle) over a standing box, (4,), m and rad."""
    x, y, z = box.position
    return np.array([x, y, z + grasp.above, box.yaw + grasp.axis * math.pi / 2])


def carried(box: Box, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half extents of the held box in the hand's frame (y = finger axis), m."""
    half = np.array([box.size[1 - grasp.axis], box.size[grasp.axis], box.size[2]]) / 2
    return np.array([0.0, 0.0, grasp.above]), half


def bodies(opening: float, carried: tuple | None = None) -> Bodies:
    """Arm, hand and fingers at this opening; last the carried box (centre, half), if any."""
    shut, sides = _shut_hand()
    count = len(sides) - (carried is None)
    link, centre, half, radius = (rows[:count].copy() for rows in shut)
    centre[:, 1] += opening * sides[:count]
    if carried is not None:
        centre[-1], half[-1] = carried
        radius[-1] = math.hypot(*half[-1])
    return Bodies(link, centre, half, radius)


@cache
def _shut_hand() -> tuple[Bodies, np.ndarray]:
    """Arm, hand, fingers at opening 0 and room for a box; and which way opening moves each in y."""
    arm = panda()
    rows, sides = list(arm.arm), [0.0] * len(arm.arm)
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            rows.append((HAND, (low + high) / 2 * [1.0, side, 1.0], (high - low) / 2))
            sides.append(side)
    rows.append((HAND, np.zeros(3), np.zeros(3)))
    link, centre, half = (np.array(column) for column in zip(*rows, strict=True))
    return Bodies(link, centre, half, np.sqrt((half**2).sum(1))), np.array([*sides, 0.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hand:
    """The downward hand as rectangles, like `Grasp.parts`, heights relative to its origin."""

    fingers: np.ndarray
    sides: np.ndarray
    palm: np.ndarray
    tip: float
    max_opening: float


@cache
def _hand() -> _Hand:
    arm = panda()
    rows, sides = [], []
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            across = max(abs(low[0]), abs(high[0]))
            rows.append((side * (low[1] + high[1]) / 2, (high[1] - low[1]) / 2, across, -high[2]))
            sides.append(side)
    _, centre, half = arm.arm[-1]
    reach = np.abs(centre) + half
    return _Hand(
        fingers=np.array(rows),
        sides=np.array(sides),
        palm=np.array([0.0, reach[1], reach[0], -(centre[2] + half[2])]),
        tip=arm.finger_tip,
        max_opening=arm.max_opening,
    )
