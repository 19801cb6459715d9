"""Boxes as rows of plain numbers, for compiled loops that ask the same of many.

A row is x, y, z of the centre, half edges along its own x, y, z (m), cosine and sine of the yaw.
Neither fast math nor threads: equal rows give equal bits in every process.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numba import njit

from relevance.scene import Box

ROW = 8
"""Numbers a box."""


def rows(boxes: Iterable[Box]) -> np.ndarray:
    """The boxes' rows, (N, ROW)."""
    return np.array([row(box.size, box.position, box.yaw) for box in boxes])


def row(
    size: tuple[float, float, float], position: tuple[float, float, float], yaw: float
) -> tuple[float, ...]:
    """One box's row: edges and centre, m, yaw, rad."""
    (a, b, c), (x, y, z) = size, position
    return x, y, z, a / 2, b / 2, c / 2, math.cos(yaw), math.sin(yaw)


@njit(cache=True, error_model="numpy")
def crossing(box, x, y, z, dx, dy, dz):
    """Where the ray from (x, y, z) along (dx, dy, dz) enters and leaves a box (ROW,).

    In multiples of the direction; a ray that misses enters later than it leaves.
    """
    c, s = box[6], box[7]
    x, y, z = x - box[0], y - box[1], z - box[2]
    start = (c * x + s * y, c * y - s * x, z)
    along = (c * dx + s * dy, c * dy - s * dx, dz)
    enter, leave = -np.inf, np.inf
    for k in range(3):
        a, b = (-box[3 + k] - start[k]) / along[k], (box[3 + k] - start[k]) / along[k]
        # 0 / 0: the ray runs within a face; let the other axes decide.
        if not (math.isnan(a) or math.isnan(b)):
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave


@njit(cache=True)
def corners(box):
    """The eight corners of a box (ROW,) in the world frame, (8, 3), m: the lower four first."""
    points = np.empty((8, 3))
    c, s = box[6], box[7]
    for k in range(8):
        a = box[3] if k % 4 in (0, 3) else -box[3]
        b = box[4] if k % 4 < 2 else -box[4]
        points[k, 0] = box[0] + c * a - s * b
        points[k, 1] = box[1] + s * a + c * b
        points[k, 2] = box[2] + (box[5] if k > 3 else -box[5])
    return points


@njit(cache=True)
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


@njit(cache=True)
def extents(box):
    """Half extents of the footprint of a box (ROW,) along world x and y, m."""
    c, s = abs(box[6]), abs(box[7])
    return c * box[3] + s * box[4], s * box[3] + c * box[4]


@njit(cache=True)
def covers(box, x, y):
    """Whether the point (x, y) lies over the footprint of a box (ROW,)."""
    c, s, dx, dy = box[6], box[7], x - box[0], y - box[1]
    return abs(c * dx + s * dy) <= box[3] and abs(c * dy - s * dx) <= box[4]


@njit(cache=True)
def gap(a, b):
    """`footprint_gap` of two boxes (ROW,), m."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    c, s = abs(a[6] * b[6] + a[7] * b[7]), abs(a[6] * b[7] - a[7] * b[6])
    best = -np.inf
    for one, other in ((a, b), (b, a)):
        along, across = abs(one[6] * dx + one[7] * dy), abs(one[6] * dy - one[7] * dx)
        best = max(best, along - one[3] - c * other[3] - s * other[4])
        best = max(best, across - one[4] - s * other[3] - c * other[4])
    return best
