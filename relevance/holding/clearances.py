"""The hand in the plane: how far it is from what may be in its way.

A box in the hand is a set of rectangles that share one angle (box, finger tips, fingers, palm),
each with the height of its underside; it comes straight down, so an obstacle matters to a part
iff it rises above that underside.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from relevance.holding.hand import MARGIN, PICK_MARGIN
from relevance.scene.contacts import CONTACT_TOLERANCE
from relevance.scene.geometry import rectangle_gap

HAND_REACH = 0.2
"""Farther from a box nothing is in the way of the hand that takes it, m."""
OVERHANG = 2e-3
"""How far below a box's top what overhangs it may begin, m."""


@njit(cache=True)
def pick_gaps(i, axes, parts, obstacles, room, most, gaps):
    """Fill gaps (G, N), m: from taking box i with each grasp to each box, less `room` around the
    hand, `most` at most; negative where that is in the way.

    axes (G,), parts (G, P, 5): of the grasps. obstacles (N, UPRIGHT): all the boxes. Returns how
    close the closest decision was, m.
    """
    o, closest = obstacles[i], most
    bottom, top = o[2] - o[6], o[2] + o[6]
    gaps[:] = most
    lowest = np.inf
    for g in range(len(axes)):
        for p in range(1, parts.shape[1]):
            lowest = min(lowest, parts[g, p, 4])
    for k in range(len(obstacles)):
        other = obstacles[k : k + 1]
        dx, dy = o[0] - other[0, 0], o[1] - other[0, 1]
        apart = math.sqrt(dx * dx + dy * dy) - o[7] - other[0, 7]
        rise = other[0, 2] + other[0, 6] - bottom
        # the tips keep GROUND from what it stands on, also where it is sunk into that
        if k == i or apart > HAND_REACH or rise <= max(lowest - MARGIN, CONTACT_TOLERANCE):
            continue
        for g in range(len(axes)):
            angle = o[3] + axes[g] * math.pi / 2
            gap = clearance(o[0], o[1], angle, bottom, parts[g, 1:], other, most + room) - room
            if other[0, 2] - other[0, 6] >= top - OVERHANG:  # it blocks the way up
                over = clearance(o[0], o[1], angle, top, parts[g, :1], other, most)
                gap = min(gap, over + PICK_MARGIN - room)
            gaps[g, k] = gap
            closest = min(closest, abs(gap))
    return closest


@njit(cache=True)
def clearance(x, y, angle, bottom, parts, obstacles, most):
    """Smallest separating-axis distance of parts and the obstacles that rise above them, `most` at
    most, m."""
    best = most
    c, s = math.cos(angle), math.sin(angle)
    for i in range(len(parts)):
        offset, left = parts[i, 0], parts[i, 1]
        along, across, under = parts[i, 2], parts[i, 3], parts[i, 4]
        px, py = x + c * offset - s * left, y + s * offset + c * left
        radius = math.sqrt(along * along + across * across)
        for k in range(len(obstacles)):
            o = obstacles[k]
            above = o[2] + o[6] - bottom - under
            if above <= -MARGIN or (under == 0.0 and abs(above) < 1e-6):  # the box's own support
                continue
            flat = radius + o[7] + best
            dx, dy = o[0] - px, o[1] - py
            if dx * dx + dy * dy > flat * flat:
                continue
            gap = rectangle_gap(px, py, c, s, along, across, o[0], o[1], o[8], o[9], o[4], o[5])
            best = min(best, gap)
    return best
