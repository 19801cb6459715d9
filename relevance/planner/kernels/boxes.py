"""Separating-axis distances of boxes, with gradients; upright boxes are the obstacles.

An obstacle is a row of UPRIGHT numbers (`relevance.scene.geometry`).

`separation` looks along the six face normals, which is exact for two upright boxes, and where
that leaves less than NEAR along what is normal to two edges, too. It is never above the true
distance, so a margin kept here is a margin kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

NEAR = 0.003
"""More than what any bound asks two boxes to be apart, m."""


class Bodies(NamedTuple):
    """Boxes that move with the arm during one motion."""

    link: np.ndarray
    """(B,) index in LINKS."""
    centre: np.ndarray
    """(B, 3) in the link's frame, m."""
    half: np.ndarray
    """(B, 3) m."""
    turn: np.ndarray
    """(B,) about the link's y, of the body's axes against the link's, rad."""
    radius: np.ndarray
    """(B,) of the sphere around each, m."""


@njit(cache=True)
def separation(p, R, h, obstacle, n, x):
    """Distance of a box (centre p, axes R columns, half extents h) from an upright obstacle.

    obstacle (UPRIGHT,). Returns the distance; fills n (3,), the direction
    from the obstacle to the box, and x (3,), the contact point, such that for motions of
    box and obstacle d(distance) = n.(v + w x (x - p)) - n.(v' + w' x (x - p')).
    """
    dx, dy, dz = p[0] - obstacle[0], p[1] - obstacle[1], p[2] - obstacle[2]
    c, s = obstacle[8], obstacle[9]
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
    return best if best > NEAR else _between_edges(p, R, h, obstacle, best, n, x)


@njit(cache=True)
def _between_edges(p, R, h, obstacle, best, n, x):
    """The same as `separation`, where two edges are farther apart than the faces (best, m) are."""
    dx, dy, dz = p[0] - obstacle[0], p[1] - obstacle[1], p[2] - obstacle[2]
    c, s = obstacle[8], obstacle[9]
    which, nx, ny, nz = -1, 0.0, 0.0, 0.0
    for i in range(3):
        ex = c if i == 0 else (-s if i == 1 else 0.0)
        ey = s if i == 0 else (c if i == 1 else 0.0)
        ez = 1.0 if i == 2 else 0.0
        for k in range(3):
            ax = ey * R[2, k] - ez * R[1, k]
            ay = ez * R[0, k] - ex * R[2, k]
            az = ex * R[1, k] - ey * R[0, k]
            size = math.sqrt(ax * ax + ay * ay + az * az)
            if size < 0.05:  # as good as parallel: the faces say it
                continue
            ax, ay, az = ax / size, ay / size, az / size
            reach = (
                obstacle[4] * abs(ax * c + ay * s)
                + obstacle[5] * abs(ay * c - ax * s)
                + obstacle[6] * abs(az)
            )
            for j in range(3):
                reach += h[j] * abs(ax * R[0, j] + ay * R[1, j] + az * R[2, j])
            d = abs(ax * dx + ay * dy + az * dz) - reach
            if d > best + 1e-9:
                best, which, nx, ny, nz = d, 3 * i + k, ax, ay, az
    if which < 0:
        return best
    if nx * dx + ny * dy + nz * dz < 0:
        nx, ny, nz = -nx, -ny, -nz
    n[0], n[1], n[2] = nx, ny, nz
    i, k = which // 3, which % 3
    # The middles of both edges, then the point of the box's edge that is nearest to the other.
    qx, qy, qz = obstacle[0], obstacle[1], obstacle[2]
    x[0], x[1], x[2] = p[0], p[1], p[2]
    for j in range(3):
        ex = c if j == 0 else (-s if j == 1 else 0.0)
        ey = s if j == 0 else (c if j == 1 else 0.0)
        ez = 1.0 if j == 2 else 0.0
        if j != i:
            side = math.copysign(obstacle[4 + j], nx * ex + ny * ey + nz * ez)
            qx, qy, qz = qx + side * ex, qy + side * ey, qz + side * ez
        if j != k:
            side = -math.copysign(h[j], nx * R[0, j] + ny * R[1, j] + nz * R[2, j])
            for a in range(3):
                x[a] += side * R[a, j]
    ex = c if i == 0 else (-s if i == 1 else 0.0)
    ey = s if i == 0 else (c if i == 1 else 0.0)
    ez = 1.0 if i == 2 else 0.0
    rx, ry, rz = x[0] - qx, x[1] - qy, x[2] - qz
    b = ex * R[0, k] + ey * R[1, k] + ez * R[2, k]
    along = b * (ex * rx + ey * ry + ez * rz) - (R[0, k] * rx + R[1, k] * ry + R[2, k] * rz)
    along = min(max(along / (1 - b * b), -h[k]), h[k])
    for a in range(3):
        x[a] += along * R[a, k]
    return best


@njit(cache=True)
def body_pose(frame, centre, turn, p, R):
    """World centre p (3,) and axes R (3, 3) of a body, from its link's frame (FRAME,)."""
    for i in range(3):
        for j in range(3):
            R[i, j] = frame[3 + 3 * i + j]
        p[i] = frame[i] + R[i, 0] * centre[0] + R[i, 1] * centre[1] + R[i, 2] * centre[2]
    if turn != 0.0:
        c, s = math.cos(turn), math.sin(turn)
        for i in range(3):
            x, z = R[i, 0], R[i, 2]
            R[i, 0], R[i, 2] = c * x - s * z, s * x + c * z


@njit(cache=True)
def point_gradient(frame, point, n, row):
    """Gradient (7,) of n . (velocity of a point fixed to the link) with respect to q."""
    rx, ry, rz = point[0] - frame[0], point[1] - frame[1], point[2] - frame[2]
    # n . (w x r) = w . (r x n)
    mx, my, mz = ry * n[2] - rz * n[1], rz * n[0] - rx * n[2], rx * n[1] - ry * n[0]
    for i in range(7):
        row[i] = (
            n[0] * frame[12 + i]
            + n[1] * frame[19 + i]
            + n[2] * frame[26 + i]
            + mx * frame[33 + i]
            + my * frame[40 + i]
            + mz * frame[47 + i]
        )


@njit(cache=True)
def near(p, radius, obstacle):
    """Whether a sphere (centre p, radius in m) may touch the obstacle; its footprint is a disk."""
    if abs(p[2] - obstacle[2]) > obstacle[6] + radius:
        return False
    flat = obstacle[7] + radius
    dx, dy = p[0] - obstacle[0], p[1] - obstacle[1]
    return dx * dx + dy * dy <= flat * flat


@njit(cache=True)
def apart(p, radius, obstacle):
    """By how much a sphere (centre p, radius in m) is clear of the obstacle, at least, m; 0 or less
    where they may touch. Its footprint is a disk."""
    over = abs(p[2] - obstacle[2]) - obstacle[6] - radius
    dx, dy = p[0] - obstacle[0], p[1] - obstacle[1]
    return max(over, math.sqrt(dx * dx + dy * dy) - obstacle[7] - radius)


@njit(cache=True)
def banded_solve(band, b):
    """Solve A x = b in place, A symmetric positive definite; band[j, d] = A[j + d, j].

    band (n, width), overwritten; entries beyond the last row are ignored. Returns False when A
    is not positive definite.
    """
    n, width = band.shape
    column = np.empty(width)
    for j in range(n):
        if band[j, 0] <= 0:
            return False
        m = min(width, n - j)
        inverse = 1.0 / math.sqrt(band[j, 0])
        for k in range(m):
            column[k] = band[j, k] * inverse
            band[j, k] = column[k]
        for k in range(1, m):
            factor = column[k]
            if factor != 0.0:
                row = band[j + k]
                for i in range(m - k):  # no reduction: vectorises with the same bits everywhere
                    row[i] -= factor * column[k + i]
    for j in range(n):
        b[j] /= band[j, 0]
        for k in range(1, min(width, n - j)):
            b[j + k] -= band[j, k] * b[j]
    for j in range(n - 1, -1, -1):
        total = b[j]
        for k in range(1, min(width, n - j)):
            total -= band[j, k] * b[j + k]
        b[j] = total / band[j, 0]
    return True


@njit(cache=True)
def dense_solve(A, b):
    """Solve A x = b for symmetric positive definite A (lower triangle) in place of b."""
    n = len(b)
    band = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            band[j, i - j] = A[i, j]
    return banded_solve(band, b)


@njit(cache=True)
def step_length(step, g):
    """Largest entry of a Newton step, its slope along the gradient g, and the share of it that
    moves nothing by more than 0.5 (rad or m)."""
    longest, slope = 0.0, 0.0
    for i in range(len(step)):
        longest = max(longest, abs(step[i]))
        slope += step[i] * g[i]
    return longest, slope, min(1.0, 0.5 / max(longest, 1e-12))
