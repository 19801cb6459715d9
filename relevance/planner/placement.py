"""Pose bound: can the hand take this box, and can the box stand there?

Everything is planar here. A box in the downward hand is a set of rectangles that share one
angle (box, finger tips, fingers, hand), each with the height of its underside; it comes
straight down, so an obstacle matters to a part iff it rises above that underside. Whether a
free pose exists in a region is decided by branch and bound over (x, y, angle): clearance is
Lipschitz, so a cell whose centre overlaps by more than its radius holds no free pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import njit

from relevance.planner.kinematics import panda
from relevance.scene import Box
from relevance.scene.geometry import UPRIGHT, rectangle_gap, upright

MARGIN = 0.003
"""Clearance that placements keep, m; the later bounds ask for less, so they never refuse it."""
PICK_MARGIN = 0.003
"""Clearance of the gripper around a box that it takes, m."""
DEPTH = 0.025
"""How far the finger tips reach below the top of the box that they hold, m."""
SPREAD = 0.005
"""How far each finger stands off the box before it closes, m."""
EDGE = 2e-4
"""A decision that turns over when something stands this much elsewhere is a close one, m."""
COMFORT = 0.008
"""Clearance beyond MARGIN with which a pose is taken at once, m."""
NODE_LIMIT = 4000
MAX_LEVEL = 6
LIFT = 0.08
"""Height by which a grasped box must be liftable within reach, m."""

FOUND, NONE, UNDECIDED = 1, 0, 2


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


def obstacle(box: Box) -> np.ndarray:
    """The box as an obstacle row (UPRIGHT,), m and rad."""
    row = np.empty(UPRIGHT)
    x, y, z = box.position
    upright(x, y, z, box.yaw, box.size[0] / 2, box.size[1] / 2, box.size[2] / 2, row)
    return row


@njit(cache=True)
def pick_blockers(i, axis, parts, obstacles, blocking):
    """Fill blocking (N,) bool: which boxes are in the way of taking box i with this grasp.

    obstacles (N, UPRIGHT): all the boxes. Returns how close the closest decision was, m.
    """
    closest = 1.0
    o = obstacles[i]
    angle = o[3] + axis * math.pi / 2
    bottom, top = o[2] - o[6], o[2] + o[6]
    for k in range(len(obstacles)):
        other = obstacles[k : k + 1]
        blocking[k] = False
        if k == i:
            continue
        gap = clearance(o[0], o[1], angle, bottom, parts[1:], other) - PICK_MARGIN
        if other[0, 2] - other[0, 6] >= top - 2e-3:  # what overhangs the box blocks the way up
            gap = min(gap, clearance(o[0], o[1], angle, top, parts[:1], other))
        blocking[k] = gap < 0
        closest = min(closest, abs(gap))
    return closest


@njit(cache=True)
def clearance(x, y, angle, bottom, parts, obstacles):
    """Smallest separating-axis distance of parts and the obstacles that rise above them, m."""
    best = 1.0
    c, s = math.cos(angle), math.sin(angle)
    for i in range(len(parts)):
        offset, along, across, under = parts[i, 0], parts[i, 1], parts[i, 2], parts[i, 3]
        px, py = x + c * offset, y + s * offset
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


@njit(cache=True)
def volumes(parts, pose, bottom, top, sky):
    """The box at a pose and the gripper that puts it there, as rows up to the sky, (P, UPRIGHT)."""
    rows = np.empty((len(parts), UPRIGHT))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(parts)):
        low, high = bottom + parts[i, 3], top if i == 0 else sky
        x, y = pose[0] + c * parts[i, 0], pose[1] + s * parts[i, 0]
        upright(
            x, y, (low + high) / 2, pose[2], parts[i, 1], parts[i, 2], (high - low) / 2, rows[i]
        )
    return rows


@njit(cache=True)
def slack(x, y, angle, bottom, parts, obstacles, table, base, near, far):
    """How well (x, y, angle) satisfies clearance, table edge and reach; feasible iff >= 0. m."""
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    along, across = parts[0, 1], parts[0, 2]
    worst = table[0] - abs(x) - c * along - s * across
    worst = min(worst, table[1] - abs(y) - s * along - c * across)
    r = math.sqrt((x - base[0]) ** 2 + (y - base[1]) ** 2)
    worst = min(worst, min(far - r, r - near))
    if worst < -0.2:
        return worst
    return min(worst, clearance(x, y, angle, bottom, parts, obstacles) - MARGIN)


@njit(cache=True)
def find_pose(region, prefer, bottom, parts, obstacles, table, base, near, far, ease, pose):
    """Branch and bound for a free pose whose centre lies in a rectangle.

    region: centre x, y, angle, half extents (5,). prefer (x, y): where to look first. ease: how
    much every constraint is relaxed, m. Fills pose (x, y, angle of the finger axis) with the
    first comfortable pose of the coarsest level that has a free one, or the clearest of that
    level. Returns (FOUND | NONE | UNDECIDED, the slack of the best pose seen, m).
    """
    a, b = region[3], region[4]
    c, s = math.cos(region[2]), math.sin(region[2])
    nx, ny, na = max(1, math.ceil(a / 0.025)), max(1, math.ceil(b / 0.025)), 6
    hx, hy, ha = a / nx, b / ny, math.pi / (2 * na)
    spin = 0.0
    for i in range(len(parts)):
        spin = max(spin, abs(parts[i, 0]) + math.sqrt(parts[i, 1] ** 2 + parts[i, 2] ** 2))
    count = nx * ny * na
    cells = np.empty((count, 3))
    key = np.empty(count)
    n = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(na):
                cells[n, 0] = -a + (2 * i + 1) * hx
                cells[n, 1] = -b + (2 * j + 1) * hy
                cells[n, 2] = (2 * k + 1) * ha
                wx = region[0] + c * cells[n, 0] - s * cells[n, 1]
                wy = region[1] + s * cells[n, 0] + c * cells[n, 1]
                key[n] = (wx - prefer[0]) ** 2 + (wy - prefer[1]) ** 2
                n += 1
    cells = cells[np.argsort(key, kind="mergesort")]
    evaluations = 0
    for level in range(MAX_LEVEL + 1):
        lipschitz = math.sqrt(hx * hx + hy * hy) + spin * ha
        best = -1.0
        keep = np.empty(len(cells), np.bool_)
        for n in range(len(cells)):
            x = region[0] + c * cells[n, 0] - s * cells[n, 1]
            y = region[1] + s * cells[n, 0] + c * cells[n, 1]
            value = slack(x, y, cells[n, 2], bottom, parts, obstacles, table, base, near, far)
            value += ease
            evaluations += 1
            keep[n] = value + lipschitz >= 0
            if value > best:
                best = value
                if value >= 0:
                    pose[0], pose[1], pose[2] = x, y, cells[n, 2]
            if best >= COMFORT:
                break
        if best >= 0:
            return FOUND, best
        alive = cells[keep]
        if len(alive) == 0:
            return NONE, best
        if level == MAX_LEVEL or evaluations + 8 * len(alive) > NODE_LIMIT + count:
            return UNDECIDED, best
        hx, hy, ha = hx / 2, hy / 2, ha / 2
        cells = np.empty((8 * len(alive), 3))
        for n in range(len(alive)):
            for child in range(8):
                cells[8 * n + child, 0] = alive[n, 0] + (hx if child & 1 else -hx)
                cells[8 * n + child, 1] = alive[n, 1] + (hy if child & 2 else -hy)
                cells[8 * n + child, 2] = alive[n, 2] + (ha if child & 4 else -ha)
    return UNDECIDED, best
