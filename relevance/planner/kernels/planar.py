"""Where a held box is free, in the plane.

Whether a free pose exists in a region is decided by branch and bound over (x, y, angle): clearance
is Lipschitz, so a cell whose centre overlaps by more than its radius holds no free pose.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from relevance.holding.clearances import clearance
from relevance.holding.hand import MARGIN
from relevance.scene.geometry import UPRIGHT, rectangle_gap, upright

COMFORT = 0.008
"""Clearance beyond MARGIN with which a pose is taken at once, m."""
FARTHEST = 1.2
"""Farther from the robot's base along an axis of a region, no hand puts anything down, m."""
NODE_LIMIT = 4000
MAX_LEVEL = 6
TURN, TURN_MARGIN, ANY_TURN = 0.1, 0.02, 4.0
"""What a turn of the last joint counts against a distance, m/rad (less than the hand is long);
what it keeps from its limit, and a half width that is none, rad."""

FOUND, NONE, UNDECIDED = 1, 0, 2


@njit(cache=True)
def reaching_into(area, bottom, spread, obstacles):
    """Which obstacles (W, UPRIGHT) can be in the way of what is put down, with its underside at
    this height, with its centre in a rectangle (5,: centre x, y, angle, half extents), (W,) bool.

    spread (K, 2): how far from its centre that and the hand reach, from which height over its
    underside on, m.
    """
    found = np.zeros(len(obstacles), np.bool_)
    c, s = math.cos(area[2]), math.sin(area[2])
    for w in range(len(obstacles)):
        o, wider = obstacles[w], -1.0
        for k in range(len(spread)):
            if o[2] + o[6] > bottom + spread[k, 1] - 2 * MARGIN:
                wider = max(wider, spread[k, 0] + 2 * MARGIN)
        if wider > 0:
            a, b = area[3] + wider, area[4] + wider
            gap = rectangle_gap(area[0], area[1], c, s, a, b, o[0], o[1], o[8], o[9], o[4], o[5])
            found[w] = gap <= 0
    return found


@njit(cache=True)
def volumes(parts, pose, bottom, top, sky):
    """The box at a pose and the gripper that puts it there, as rows up to the sky, (P, UPRIGHT)."""
    rows = np.empty((len(parts), UPRIGHT))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(parts)):
        low, high = bottom + parts[i, 4], top if i == 0 else sky
        x = pose[0] + c * parts[i, 0] - s * parts[i, 1]
        y = pose[1] + s * parts[i, 0] + c * parts[i, 1]
        upright(
            x, y, (low + high) / 2, pose[2], parts[i, 2], parts[i, 3], (high - low) / 2, rows[i]
        )
    return rows


@njit(cache=True)
def slack(x, y, angle, bottom, parts, obstacles, table, base, reach, enough):
    """How well (x, y, angle) satisfies clearance, table edge and reach; feasible iff >= 0. m.

    parts (V, P, 5), reach (V, 5: how far the wrist is to the left of the finger axis, the distances
    near and far that it may have, middle and half width of the finger axis' turn against its
    bearing): of the ways in which the hand may hold the box; the best counts.
    Below `-enough` it is not computed to the end. Returns (slack, which way).
    """
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    along, across = parts[0, 0, 2], parts[0, 0, 3]
    shared = table[0] - abs(x) - c * along - s * across
    shared = min(shared, table[1] - abs(y) - s * along - c * across)
    if shared < -0.2:
        return shared, 0
    shared = min(shared, clearance(x, y, angle, bottom, parts[0, :1], obstacles, 1.0) - MARGIN)
    if shared < -enough:
        return shared, 0
    best, which = -1.0, 0
    for v in range(len(parts)):
        left = reach[v, 0]
        wx, wy = x - left * math.sin(angle) - base[0], y + left * math.cos(angle) - base[1]
        r = math.sqrt(wx * wx + wy * wy)
        worst = min(shared, min(reach[v, 2] - r, r - reach[v, 1]))
        if reach[v, 4] < ANY_TURN:
            off = angle - math.atan2(wy, wx) - reach[v, 3]
            off -= 2 * math.pi * math.floor(off / (2 * math.pi) + 0.5)
            worst = min(worst, TURN * (reach[v, 4] - TURN_MARGIN - abs(off)))
        if worst > best:
            hand = clearance(x, y, angle, bottom, parts[v, 1:], obstacles, 1.0) - MARGIN
            worst = min(worst, hand)
            if worst > best:
                best, which = worst, v
        if best >= COMFORT or best >= shared:
            break
    return best, which


@njit(cache=True)
def near_base(region, base):
    """The part of a rectangle (5,) that is not beyond FARTHEST, with half extents below 0 where
    none is; exactly the rectangle where all of it is near."""
    c, s = math.cos(region[2]), math.sin(region[2])
    dx, dy, near = base[0] - region[0], base[1] - region[1], region.copy()
    for axis in range(2):
        u, half = (c * dx + s * dy if axis == 0 else c * dy - s * dx), region[3 + axis]
        low, high = max(-half, u - FARTHEST), min(half, u + FARTHEST)
        middle = (low + high) / 2
        near[0] += middle * (c if axis == 0 else -s)
        near[1] += middle * (s if axis == 0 else c)
        near[3 + axis] = (high - low) / 2
    return near


@njit(cache=True)
def find_pose(region, prefer, bottom, parts, obstacles, table, base, reach, ease, turn, pose):
    """Branch and bound for a free pose whose centre lies in a rectangle.

    region: centre x, y, angle, half extents (5,). prefer (x, y): where to look first. parts,
    reach: as `slack` has them. ease: how much every constraint is relaxed, m. turn: angle at which
    the cells begin, rad. Fills pose (x, y, angle of the finger axis, which of the parts) with the
    first comfortable pose of the coarsest level that has a free one, or the clearest of that level.
    Returns (FOUND | NONE | UNDECIDED, the slack of the best pose seen, m).
    """
    region = near_base(region, base)  # the cells are as many as the region is large
    a, b = region[3], region[4]
    if min(a, b) < 0:
        return NONE, -1.0
    c, s = math.cos(region[2]), math.sin(region[2])
    nx, ny, na = max(1, math.ceil(a / 0.025)), max(1, math.ceil(b / 0.025)), 6
    hx, hy, ha = a / nx, b / ny, math.pi / (2 * na)
    spin = 0.0
    for v in range(len(parts)):
        spin = max(spin, abs(reach[v, 0]))
        for i in range(parts.shape[1]):
            offset, left = abs(parts[v, i, 0]), abs(parts[v, i, 1])
            if left == 0.0:
                outer = offset + math.sqrt(parts[v, i, 2] ** 2 + parts[v, i, 3] ** 2)
            else:
                outer = math.sqrt((offset + parts[v, i, 2]) ** 2 + (left + parts[v, i, 3]) ** 2)
            spin = max(spin, outer)
    count = nx * ny * na
    cells, key, order = np.empty((count, 3)), np.empty(nx * ny), np.empty(nx * ny, np.int64)
    for n in range(nx * ny):  # sorted as they come: numpy's own sorting takes seconds to compile
        u, v = -a + (2 * (n // ny) + 1) * hx, -b + (2 * (n % ny) + 1) * hy
        wx, wy = region[0] + c * u - s * v, region[1] + s * u + c * v
        far, m = (wx - prefer[0]) ** 2 + (wy - prefer[1]) ** 2, n
        while m > 0 and key[m - 1] > far:
            key[m], order[m] = key[m - 1], order[m - 1]
            m -= 1
        key[m], order[m] = far, n
    for n in range(count):
        at = order[n // na]
        cells[n, 0] = -a + (2 * (at // ny) + 1) * hx
        cells[n, 1] = -b + (2 * (at % ny) + 1) * hy
        cells[n, 2] = turn + (2 * (n % na) + 1) * ha
    evaluations = 0
    for level in range(MAX_LEVEL + 1):
        lipschitz = math.sqrt(hx * hx + hy * hy) + spin * ha
        best = -1.0
        keep = np.empty(len(cells), np.bool_)
        for n in range(len(cells)):
            x = region[0] + c * cells[n, 0] - s * cells[n, 1]
            y = region[1] + s * cells[n, 0] + c * cells[n, 1]
            value, which = slack(
                x, y, cells[n, 2], bottom, parts, obstacles, table, base, reach, lipschitz + ease
            )
            value += ease
            evaluations += 1
            keep[n] = value + lipschitz >= 0
            if value > best:
                best = value
                if value >= 0:
                    pose[0], pose[1], pose[2], pose[3] = x, y, cells[n, 2], which
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
