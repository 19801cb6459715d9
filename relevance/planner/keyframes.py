"""Sequence bound: arm configurations and placements of all switches, in one small NLP.

Minimises the squared joint motion between switches subject to the grasp and placement
constraints, the goal region, joint limits, and clearance of arm, hand and held box from
everything that stands there at that switch (LGP's keyframe problem). Gauss-Newton augmented
Lagrangian; the numba loops below are the whole solver.

Variables: q (2m, 7), one per switch (pick and place of each of m moved boxes in order), then
(x, y, angle of the finger axis) of each placement (m, 3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from relevance.planner.kernels.boxes import dense_solve, near, separation
from relevance.planner.kernels.native import call
from relevance.planner.kinematics import ARM, FRAME, HAND, Panda

CLEARANCE = 0.0025
"""Clearance asked of every pair at a switch, m (the pose bound's MARGIN is larger)."""
TOLERANCE = 2e-4
"""Largest violation (m, rad) of a solved problem."""
STAY = (100.0, 1e5)
"""Weights of a placement's distance from what the pose bound found (m^-2), tried in turn: with
less, the pull of short joint motion drags boxes into wells between obstacles."""
_OUTER, _INNER = 8, 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Bodies:
    """Boxes that move with the arm during one motion, each aligned with its link's axes."""

    link: np.ndarray
    """(B,) index in LINKS."""
    centre: np.ndarray
    """(B, 3) in the link's frame, m."""
    half: np.ndarray
    """(B, 3) m."""


def bodies(arm: Panda, opening: float, carried: tuple | None = None) -> Bodies:
    """Arm, hand and fingers at this opening; last the carried box (centre, half), if any."""
    rows = list(arm.arm)
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            centre, half = (low + high) / 2, (high - low) / 2
            rows.append(
                (HAND, np.array([centre[0], side * (centre[1] + opening), centre[2]]), half)
            )
    if carried is not None:
        rows.append((HAND, *carried))
    return Bodies(
        link=np.array([row[0] for row in rows]),
        centre=np.array([row[1] for row in rows]),
        half=np.array([row[2] for row in rows]),
    )


@njit(cache=True)
def body_pose(frame, centre, p, R):
    """World centre p (3,) and axes R (3, 3) of a body, from its link's frame (FRAME,)."""
    for i in range(3):
        for j in range(3):
            R[i, j] = frame[3 + 3 * i + j]
        p[i] = frame[i] + R[i, 0] * centre[0] + R[i, 1] * centre[1] + R[i, 2] * centre[2]


@njit(cache=True)
def point_gradient(frame, point, n, row):
    """Gradient (7,) of n . (velocity of a point fixed to the link) with respect to q."""
    rx, ry, rz = point[0] - frame[0], point[1] - frame[1], point[2] - frame[2]
    # n . (w x r) = w . (r x n)
    mx, my, mz = ry * n[2] - rz * n[1], rz * n[0] - rx * n[2], rx * n[1] - ry * n[0]
    for i in range(ARM):
        row[i] = (
            n[0] * frame[12 + i]
            + n[1] * frame[19 + i]
            + n[2] * frame[26 + i]
            + mx * frame[33 + i]
            + my * frame[40 + i]
            + mz * frame[47 + i]
        )


@njit(cache=True)
def _push(H, g, index, row, count, value, multiplier, mu, equality):
    """Add one constraint row to the augmented Lagrangian; returns (merit, violation)."""
    shifted = value + multiplier / mu
    if not equality and shifted <= 0:
        return 0.0, max(value, 0.0)
    for a in range(count):
        g[index[a]] += mu * shifted * row[a]
        for b in range(count):
            H[index[a], index[b]] += mu * row[a] * row[b]
    return 0.5 * mu * shifted * shifted, abs(value) if equality else max(value, 0.0)


@njit(cache=True)
def _assemble(
    x, m, start, p0, weight, pick_target, place_z, turn, base, lower, upper, link, centre, half,
    n_bodies, obstacles, stands, moved, support, region, table, frames_x, frames_y, frames_f,
    grasp_x, grasp_y, grasp_f, eq, ineq, limit, edge, mu, update, H, g,
):  # fmt: skip
    """Merit, and H, g of the Gauss-Newton model; with `update`, new multipliers instead."""
    n, first = len(x), 2 * m * ARM
    merit, worst = 0.0, 0.0
    H[:, :] = 0.0
    g[:] = 0.0
    index = np.zeros(16, np.int64)
    row, part = np.zeros(16), np.zeros(ARM)
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    o = np.zeros(7)
    for k in range(2 * m):
        for i in range(ARM):
            a = k * ARM + i
            before = start[i] if k == 0 else x[a - ARM]
            d = x[a] - before
            merit += 0.5 * d * d
            g[a] += d
            H[a, a] += 1.0
            if k > 0:
                g[a - ARM] -= d
                H[a - ARM, a - ARM] += 1.0
                H[a, a - ARM] -= 1.0
                H[a - ARM, a] -= 1.0
    for i in range(3 * m):
        d = x[first + i] - p0[i]
        merit += 0.5 * weight[i] * d * d
        g[first + i] += weight[i] * d
        H[first + i, first + i] += weight[i]
    for k in range(2 * m):
        j, placing = k // 2, k % 2 == 1
        at = first + 3 * j
        for i in range(ARM):
            frames_x[i] = grasp_x[i] = x[k * ARM + i]
        for i in range(4):
            frames_x[ARM + i] = grasp_x[ARM + i] = base[i]
        if placing:
            grasp_x[11], grasp_x[12], grasp_x[13], grasp_x[14] = (
                x[at],
                x[at + 1],
                place_z[j],
                x[at + 2],
            )
        else:
            for i in range(4):
                grasp_x[11 + i] = pick_target[j, i]
        call(grasp_f)
        call(frames_f)
        for r in range(6):
            for i in range(ARM):
                index[i], row[i] = k * ARM + i, grasp_y[6 + r * ARM + i]
            count = ARM
            if placing:
                for i in range(3):
                    index[count], row[count] = at + i, grasp_y[48 + r * 4 + (3 if i == 2 else i)]
                    count += 1
            value = grasp_y[r]
            if update:
                eq[k, r] += mu * value
            got, violated = _push(H, g, index, row, count, value, eq[k, r], mu, True)
            merit += got
            worst = max(worst, violated)
        for i in range(ARM):
            for side in range(2):
                value = lower[i] - x[k * ARM + i] if side == 0 else x[k * ARM + i] - upper[i]
                index[0], row[0] = k * ARM + i, (-1.0 if side == 0 else 1.0)
                if update:
                    limit[k, i, side] = max(0.0, limit[k, i, side] + mu * value)
                got, violated = _push(H, g, index, row, 1, value, limit[k, i, side], mu, False)
                merit += got
                worst = max(worst, violated)
        for b in range(n_bodies[k]):
            frame = frames_y[link[k, b] * FRAME : (link[k, b] + 1) * FRAME]
            body_pose(frame, centre[k, b], p, R)
            for w in range(len(obstacles)):
                if not stands[k, w] or (placing and b == n_bodies[k] - 1 and w == support[j]):
                    continue
                o[:] = obstacles[w]
                other = moved[w]
                free = other >= 0 and other < j
                if free:
                    there = first + 3 * other
                    o[0], o[1] = x[there], x[there + 1]
                    o[2] = turn[other, 1]
                    o[3] = x[there + 2] - turn[other, 0]
                if ineq[k, b, w] == 0.0 and not near(p, half[k, b], o, 0.03):
                    continue
                d = separation(p, R, half[k, b], o, normal, contact)
                value = CLEARANCE - d
                if update:
                    ineq[k, b, w] = max(0.0, ineq[k, b, w] + mu * value)
                if value + ineq[k, b, w] / mu <= 0:
                    continue
                point_gradient(frame, contact, normal, part)
                for i in range(ARM):
                    index[i], row[i] = k * ARM + i, -part[i]
                count = ARM
                if free:
                    there = first + 3 * other
                    spin = normal[1] * (contact[0] - o[0]) - normal[0] * (contact[1] - o[1])
                    for i in range(3):
                        index[count] = there + i
                        row[count] = spin if i == 2 else normal[i]
                        count += 1
                got, violated = _push(H, g, index, row, count, value, ineq[k, b, w], mu, False)
                merit += got
                worst = max(worst, violated)
    for j in range(m):
        at = first + 3 * j
        for side in range(8):
            # 0..3: the goal region of the last placement; 4..7: the table's edge
            if side < 4 and j < m - 1:
                continue
            sign = 1.0 if side % 2 == 0 else -1.0
            if side < 4:
                c, s = math.cos(region[2]), math.sin(region[2])
                if side < 2:
                    row[0], row[1] = sign * c, sign * s
                else:
                    row[0], row[1] = -sign * s, sign * c
                bound = region[3] if side < 2 else region[4]
                value = row[0] * (x[at] - region[0]) + row[1] * (x[at + 1] - region[1]) - bound
            else:
                row[0], row[1] = (sign, 0.0) if side < 6 else (0.0, sign)
                value = row[0] * x[at] + row[1] * x[at + 1] - table[j, 0 if side < 6 else 1]
            index[0], index[1] = at, at + 1
            if update:
                edge[j, side] = max(0.0, edge[j, side] + mu * value)
            got, violated = _push(H, g, index, row, 2, value, edge[j, side], mu, False)
            merit += got
            worst = max(worst, violated)
    for i in range(n):
        H[i, i] += 1e-6
    return merit, worst


@njit(cache=True)
def solve(
    x, m, start, p0, weight, pick_target, place_z, turn, base, lower, upper, link, centre, half,
    n_bodies, obstacles, stands, moved, support, region, table, frames_x, frames_y, frames_f,
    grasp_x, grasp_y, grasp_f,
):  # fmt: skip
    """Improve x in place; returns the largest violation (m, rad) at the end.

    turn (m, 2): angle of the finger axis minus the box's yaw, and the placed box's height.
    stands (2m, W): whether obstacle w is there at switch k and is not the box in hand.
    moved (W,): index of the obstacle among the moved boxes, or -1. support (m,): obstacle on
    which box j is placed, or -1. table (m, 2): bounds of |x| and |y| of each placement.
    """
    n = len(x)
    H, g = np.zeros((n, n)), np.zeros(n)
    eq, limit, edge = np.zeros((2 * m, 6)), np.zeros((2 * m, ARM, 2)), np.zeros((m, 8))
    ineq = np.zeros((2 * m, link.shape[1], len(obstacles)))
    mu, worst, before = 1000.0, 1e9, 1e9
    for outer in range(_OUTER):
        for _ in range(_INNER):
            merit, worst = _assemble(
                x, m, start, p0, weight, pick_target, place_z, turn, base, lower, upper, link,
                centre, half, n_bodies, obstacles, stands, moved, support, region, table, frames_x,
                frames_y, frames_f, grasp_x, grasp_y, grasp_f, eq, ineq, limit, edge, mu, False,
                H, g,
            )  # fmt: skip
            step = -g.copy()
            if not dense_solve(H, step):
                return 1e9
            longest = np.max(np.abs(step))
            scale = min(1.0, 0.5 / max(longest, 1e-12))
            slope = np.dot(step, g)
            old = x.copy()
            for _ in range(8):
                x[:] = old + scale * step
                new, worst = _assemble(
                    x, m, start, p0, weight, pick_target, place_z, turn, base, lower, upper, link,
                    centre, half, n_bodies, obstacles, stands, moved, support, region, table,
                    frames_x, frames_y, frames_f, grasp_x, grasp_y, grasp_f, eq, ineq, limit, edge,
                    mu, False, H, g,
                )  # fmt: skip
                if new <= merit + 1e-4 * scale * slope + 1e-12:
                    break
                scale *= 0.4
            if scale * longest < 1e-4:
                break
        if worst < TOLERANCE / 2 and outer > 0:
            return worst
        if outer >= 3 and worst > 0.7 * before:
            return worst  # stuck
        before = worst
        _assemble(
            x, m, start, p0, weight, pick_target, place_z, turn, base, lower, upper, link, centre,
            half, n_bodies, obstacles, stands, moved, support, region, table, frames_x, frames_y,
            frames_f, grasp_x, grasp_y, grasp_f, eq, ineq, limit, edge, mu, True, H, g,
        )  # fmt: skip
        mu = min(mu * 5.0, 1e5)
    return worst
