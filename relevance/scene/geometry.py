"""Upright boxes as rows of plain numbers: the one layout that every compiled loop shares.

A row is x, y, z of the centre, yaw, half edges along its own x, y, z (m), and, so that they are
computed once, the radius of the footprint and the cosine and sine of the yaw. Neither fast math
nor threads: equal rows give equal bits in every process. Import this module by its name; the
package leaves it out, so that reading a scene loads no compiler.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from relevance.scene.boxes import Box

UPRIGHT = 10
"""Numbers a box."""


@njit(cache=True)
def upright(x, y, z, yaw, hx, hy, hz, row):
    """Fill a box's row (UPRIGHT,): centre, yaw, half edges."""
    row[0], row[1], row[2], row[3] = x, y, z, yaw
    row[4], row[5], row[6] = hx, hy, hz
    row[7] = math.sqrt(hx * hx + hy * hy)
    row[8], row[9] = math.cos(yaw), math.sin(yaw)


def packed(size: Sequence[float], position: Sequence[float], yaw: float) -> np.ndarray:
    """One box's row (UPRIGHT,): edges and centre, m, yaw, rad."""
    row = np.empty(UPRIGHT)
    (a, b, c), (x, y, z) = size, position
    upright(float(x), float(y), float(z), float(yaw), a / 2, b / 2, c / 2, row)
    return row


def uprights(boxes: Sequence[Box]) -> np.ndarray:
    """The boxes' rows, (N, UPRIGHT)."""
    rows = np.empty((len(boxes), UPRIGHT))
    for i, box in enumerate(boxes):
        rows[i] = packed(box.size, box.position, box.yaw)
    return rows


@njit(cache=True)
def rectangle_gap(ax, ay, ca, sa, ahx, ahy, bx, by, cb, sb, bhx, bhy):
    """Separating-axis distance of two rectangles, m (exact depth when negative).

    Centre, cosine and sine of the yaw, and half extents of one, then of the other.
    """
    dx, dy = bx - ax, by - ay
    c, s = abs(ca * cb + sa * sb), abs(sa * cb - ca * sb)
    gap = abs(ca * dx + sa * dy) - ahx - c * bhx - s * bhy
    gap = max(gap, abs(ca * dy - sa * dx) - ahy - s * bhx - c * bhy)
    gap = max(gap, abs(cb * dx + sb * dy) - bhx - c * ahx - s * ahy)
    return max(gap, abs(cb * dy - sb * dx) - bhy - s * ahx - c * ahy)


@njit(cache=True)
def flat_gap(a, b):
    """`rectangle_gap` of the footprints of two boxes (UPRIGHT,), m."""
    return rectangle_gap(
        a[0], a[1], a[8], a[9], a[4], a[5], b[0], b[1], b[8], b[9], b[4], b[5]
    )  # fmt: skip


@njit(cache=True)
def extents(box, c, s):
    """Half extents of a box's (UPRIGHT,) footprint along axes turned by an angle, m.

    c, s: cosine and sine of that angle; 1 and 0 for the world's axes.
    """
    along, across = abs(box[8] * c + box[9] * s), abs(box[9] * c - box[8] * s)
    return along * box[4] + across * box[5], across * box[4] + along * box[5]


@njit(cache=True)
def covers(box, x, y):
    """Whether the point (x, y) lies over the footprint of a box (UPRIGHT,)."""
    c, s, dx, dy = box[8], box[9], x - box[0], y - box[1]
    return abs(c * dx + s * dy) <= box[4] and abs(c * dy - s * dx) <= box[5]


@njit(cache=True, error_model="numpy")
def crossing(box, x, y, z, dx, dy, dz):
    """Where the ray from (x, y, z) along (dx, dy, dz) enters and leaves a box (UPRIGHT,).

    In multiples of the direction; a ray that misses enters later than it leaves.
    """
    c, s = box[8], box[9]
    x, y, z = x - box[0], y - box[1], z - box[2]
    start = (c * x + s * y, c * y - s * x, z)
    along = (c * dx + s * dy, c * dy - s * dx, dz)
    enter, leave = -np.inf, np.inf
    for k in range(3):
        a, b = (-box[4 + k] - start[k]) / along[k], (box[4 + k] - start[k]) / along[k]
        # 0 / 0: the ray runs within a face; let the other axes decide.
        if not (math.isnan(a) or math.isnan(b)):
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave


@njit(cache=True)
def corners(box):
    """The eight corners of a box (UPRIGHT,) in the world frame, (8, 3), m: the lower four first."""
    points = np.empty((8, 3))
    c, s = box[8], box[9]
    for k in range(8):
        a = box[4] if k % 4 in (0, 3) else -box[4]
        b = box[5] if k % 4 < 2 else -box[5]
        points[k, 0] = box[0] + c * a - s * b
        points[k, 1] = box[1] + s * a + c * b
        points[k, 2] = box[2] + (box[6] if k > 3 else -box[6])
    return points


@njit(cache=True, error_model="numpy")  # what is level with the eye is endlessly far aside
def projected(points, eye, axes, focal):
    """Points (K, 3) as the camera has them, (K, 3): pixels right and down of the image's
    middle, and depth, m. Eye, axes and focal length as `pinhole` gives them."""
    seen = np.empty(points.shape)
    for k in range(len(points)):
        x, y, z = points[k, 0] - eye[0], points[k, 1] - eye[1], points[k, 2] - eye[2]
        depth = x * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]
        for i in range(2):
            seen[k, i] = (x * axes[0, i] + y * axes[1, i] + z * axes[2, i]) / depth * focal
        seen[k, 2] = depth
    return seen


@njit(cache=True)
def bound(points, bounds):
    """Fill bounds (4,): lowest x and y of points (K, 2 or more), then the highest."""
    bounds[0] = bounds[2] = points[0, 0]
    bounds[1] = bounds[3] = points[0, 1]
    for k in range(1, len(points)):
        for i in range(2):
            bounds[i] = min(bounds[i], points[k, i])
            bounds[2 + i] = max(bounds[2 + i], points[k, i])
