"""How the hand takes boxes and what room it asks for, in numbers."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from relevance.robot import panda

DEPTH = 0.025
"""How far the finger tips reach below the top of the box that they hold, at most, m."""
SHALLOW = (0.012, 0.006)
"""Smaller depths, m; a box is held as deep as its neighbours allow."""
GRIP = 0.005
"""Least height of the pads that lies on the face of a held box, m."""
GROUND = 0.004
"""What the finger tips keep from what the box stands on, m."""
INSET = 0.005
"""Least distance of the pads' middle line from the corner of a held box, m."""
FARTHEST = 0.055
"""Farthest that the hand is shifted along a box, m."""
SPREAD = 0.002
"""How far each finger stands off the box before it closes, m."""
TILTS = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6)
"""How far the hand may lean to the left of the finger axis, rad."""
PALM_ROOM = 0.003
"""What a leaning palm keeps from the box that it holds, m."""
MARGIN = 0.003
"""Clearance that placements keep, m; the later bounds ask for less, so they never refuse it."""
PICK_MARGIN = 0.001
"""Clearance of the gripper around a box that it takes, m."""
REGION_MARGIN = 0.0005
"""How far inside the goal region a subject is placed, m."""


class HandBoxes(NamedTuple):
    """The hand as boxes along its axes: the finger tips, the fingers, the halves of the palm."""

    shape: np.ndarray
    """(P, 3): half extent across the finger axis, distance over the tips, and which way opening
    moves it, of finger tips, fingers and both halves of the palm; m."""
    over: np.ndarray
    """(T, P, 5): for each of TILTS, fingers shut, over the middle of its tips: offset along the
    finger axis and to its left, half extents along and across it, height of the underside; m."""
    tip: float
    """Length of the hand, m."""
    max_opening: float
    """The widest, m."""


@cache
def hand_boxes() -> HandBoxes:
    """Read off the meshes, once a process."""
    arm, boxes = panda(), []
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            middle, across = side * (low[1] + high[1]) / 2, max(abs(low[0]), abs(high[0]))
            boxes.append((middle, (high[1] - low[1]) / 2, across, high[2], low[2], side))
    for _, centre, half in arm.arm[-2:]:
        reach = np.abs(centre) + half
        boxes.append((0.0, reach[1], reach[0], centre[2] + half[2], centre[2] - half[2], 0.0))
    middle, along, across, low, high, sides = np.array(boxes).T
    near, far, over = arm.finger_tip - low, arm.finger_tip - high, []
    for s, c in ((math.sin(tilt), math.cos(tilt)) for tilt in TILTS):
        left = np.minimum(near * s, far * s) - across * c
        right = np.maximum(near * s, far * s) + across * c
        under = near * c - across * abs(s)
        columns = middle, (left + right) / 2, along, (right - left) / 2, under
        over.append(np.column_stack(columns))
    shape = np.column_stack([across, near, sides])
    return HandBoxes(shape, np.array(over), arm.finger_tip, arm.max_opening)
