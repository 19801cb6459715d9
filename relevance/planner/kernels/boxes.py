"""Separating-axis distances of boxes, with gradients; upright boxes are the obstacles.

`separation` looks along the six face normals only. That is exact for two upright boxes and
never above the true distance otherwise, so a margin kept here is a margin kept.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def rectangle_gap(ax, ay, ayaw, ahx, ahy, bx, by, byaw, bhx, bhy):
    """Separating-axis distance of two rectangles, m (exact depth when negative)."""
    dx, dy = bx - ax, by - ay
    ca, sa = math.cos(ayaw), math.sin(ayaw)
    cb, sb = math.cos(byaw), math.sin(byaw)
    c, s = abs(ca * cb + sa * sb), abs(sa * cb - ca * sb)
    gap = abs(ca * dx + sa * dy) - ahx - c * bhx - s * bhy
    gap = max(gap, abs(ca * dy - sa * dx) - ahy - s * bhx - c * bhy)
    gap = max(gap, abs(cb * dx + sb * dy) - bhx - c * ahx - s * ahy)
    return max(gap, abs(cb * dy - sb * dx) - bhy - s * ahx - c * ahy)


@njit(cache=True)
def separation(p, R, h, obstacle, n, x):
    """Distance of a box (centre p, axes R columns, half extents h) from an upright obstacle.

    obstacle: (x, y, z, yaw, hx, hy, hz). Returns the distance; fills n (3,), the direction
    from the obstacle to the box, and x (3,), the contact point, such that for motions of
    box and obstacle d(distance) = n.(v + w x (x - p)) - n.(v' + w' x (x - p')).
    """
    dx, dy, dz = p[0] - obstacle[0], p[1] - obstacle[1], p[2] - obstacle[2]
    c, s = math.cos(obstacle[3]), math.sin(obstacle[3])
    # axes of the obstacle in rows: (c, s, 0), (-s, c, 0), (0, 0, 1)
    best, which = -1e9, 0
    for i in range(3):
        if i == 0:
            nx, ny, nz = c, s, 0.0
        elif i == 1:
            nx, ny, nz = -s, c, 0.0
        else:
            nx, ny, nz = 0.0, 0.0, 1.0
        reach = obstacle[4 + i]
        for k in range(3):
            reach += h[k] * abs(nx * R[0, k] + ny * R[1, k] + nz * R[2, k])
        d = abs(nx * dx + ny * dy + nz * dz) - reach
        if d > best:
            best, which = d, i
    for k in range(3):
        nx, ny, nz = R[0, k], R[1, k], R[2, k]
        reach = (
            h[k]
            + obstacle[4] * abs(nx * c + ny * s)
            + obstacle[5] * abs(ny * c - nx * s)
            + obstacle[6] * abs(nz)
        )
        d = abs(nx * dx + ny * dy + nz * dz) - reach
        if d > best + 1e-12:
            best, which = d, 3 + k
    if which < 3:
        if which == 0:
            n[0], n[1], n[2] = c, s, 0.0
        elif which == 1:
            n[0], n[1], n[2] = -s, c, 0.0
        else:
            n[0], n[1], n[2] = 0.0, 0.0, 1.0
    else:
        n[0], n[1], n[2] = R[0, which - 3], R[1, which - 3], R[2, which - 3]
    if n[0] * dx + n[1] * dy + n[2] * dz < 0:
        n[0], n[1], n[2] = -n[0], -n[1], -n[2]
    if which < 3:  # the box's corner nearest to the obstacle's face
        x[0], x[1], x[2] = p[0], p[1], p[2]
        for k in range(3):
            d = n[0] * R[0, k] + n[1] * R[1, k] + n[2] * R[2, k]
            side = -h[k] if d > 1e-9 else (h[k] if d < -1e-9 else 0.0)
            for i in range(3):
                x[i] += side * R[i, k]
    else:  # the obstacle's corner nearest to the box's face
        x[0], x[1], x[2] = obstacle[0], obstacle[1], obstacle[2]
        d = n[0] * c + n[1] * s
        side = obstacle[4] if d > 1e-9 else (-obstacle[4] if d < -1e-9 else 0.0)
        x[0] += side * c
        x[1] += side * s
        d = n[1] * c - n[0] * s
        side = obstacle[5] if d > 1e-9 else (-obstacle[5] if d < -1e-9 else 0.0)
        x[0] -= side * s
        x[1] += side * c
        x[2] += obstacle[6] if n[2] > 1e-9 else (-obstacle[6] if n[2] < -1e-9 else 0.0)
    return best


@njit(cache=True)
def near(p, h, obstacle, reach):
    """Whether the bounding spheres come within `reach` (the table is always near in height)."""
    radius = math.sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2]) + reach
    if abs(p[2] - obstacle[2]) > obstacle[6] + radius:
        return False
    flat = math.sqrt(obstacle[4] * obstacle[4] + obstacle[5] * obstacle[5]) + radius
    dx, dy = p[0] - obstacle[0], p[1] - obstacle[1]
    return dx * dx + dy * dy <= flat * flat


@njit(cache=True)
def banded_solve(band, b):
    """Solve A x = b in place, A symmetric positive definite; band[i, d] = A[i, i - d].

    Returns False when A is not positive definite.
    """
    n, width = band.shape
    for i in range(n):
        for d in range(min(i, width - 1), -1, -1):
            j = i - d
            total = band[i, d]
            for k in range(max(0, i - width + 1, j - width + 1), j):
                total -= band[i, i - k] * band[j, j - k]
            if d == 0:
                if total <= 0:
                    return False
                band[i, 0] = math.sqrt(total)
            else:
                band[i, d] = total / band[j, 0]
    for i in range(n):
        total = b[i]
        for k in range(max(0, i - width + 1), i):
            total -= band[i, i - k] * b[k]
        b[i] = total / band[i, 0]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for k in range(i + 1, min(n, i + width)):
            total -= band[k, k - i] * b[k]
        b[i] = total / band[i, 0]
    return True


@njit(cache=True)
def dense_solve(A, b):
    """Solve A x = b for symmetric positive definite A (overwritten) in place of b."""
    n = len(b)
    band = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            band[i, i - j] = A[i, j]
    return banded_solve(band, b)
