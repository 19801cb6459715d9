"""A smooth collision-free motion between two switches (LGP's k = 2 path problem).

Minimises squared joint accelerations over the rows of one motion, from rest to rest, with
vertical departure and approach, joint limits, and clearance of arm, hand and carried box from
everything, at the rows, half-way between them, and wherever a dense check of the result finds
it broken (those points join the problem and it is solved again). Gauss-Newton augmented
Lagrangian on a banded system. Velocity limits are kept by the time between rows.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from relevance.planner.kernels.boxes import (
    apart,
    banded_solve,
    body_pose,
    dense_solve,
    near,
    point_gradient,
    separation,
    step_length,
)
from relevance.planner.kernels.kinematics import FRAME, TARGET, look_at_frames, look_at_grasp
from relevance.planner.kernels.rows import (
    WIDTH,
    acceleration_cost,
    assign,
    smoothness,
    time_step,
)
from relevance.robot import ARM, HAND

ROWS = 20
"""Steps of a motion; it has ROWS + 1 rows."""
VERTICAL = 3
"""Rows beside a switch at which the hand is straight over it."""
RISING = VERTICAL + 1
"""Rows before this one, a box that is taken away still rises straight up."""
RISE = 0.06
"""Height of the vertical parts, m."""
CLEARANCE = 0.002
"""Clearance asked for along the way, m; less where a switch itself leaves less."""
SUBSTEPS = 8
"""Points of the dense check in each step."""
ALLOWED = 1e-3
"""Penetration up to which a plan holds, m."""
FAR = 0.01
"""Distances beyond this are not computed, m."""
LONGEST = 1.3
"""Farther from an axis of the arm nothing is that moves with it, m: what a radian can shift it."""
SMALL_STEP = 2e-3
"""Gauss-Newton stops after a step below this, rad; what is left is of the order of its square."""
ROUGH_STEP = 1e-2
"""The same before the multipliers are set for the first time, rad."""
TOLERANCE = 4e-4
"""Largest violation of a solved problem, m or rad."""
_EXCHANGES = 6


@njit(cache=True)
def reach_to(arm, q, target):
    """Move q (7,) in place to a hand target by damped Gauss-Newton; whether it got there."""
    A, b = np.zeros((ARM, ARM)), np.zeros(ARM)
    worst = 0.0
    for _ in range(25):
        look_at_grasp(arm, q, target)
        worst = 0.0
        for r in range(6):
            worst = max(worst, abs(arm.grasp_y[r]))
        if worst < 1e-8:
            return True
        for i in range(ARM):
            b[i] = 0.0
            for j in range(ARM):
                A[i, j] = 1e-7 if i == j else 0.0
            for r in range(6):
                ji = arm.grasp_y[6 + r * ARM + i]
                b[i] -= ji * arm.grasp_y[r]
                for j in range(ARM):
                    A[i, j] += ji * arm.grasp_y[6 + r * ARM + j]
        if not dense_solve(A, b):
            return False
        longest = 0.0
        for i in range(ARM):
            longest = max(longest, abs(b[i]))
        for i in range(ARM):
            q[i] += b[i] * min(1.0, 0.4 / max(longest, 1e-12))
    return worst < 1e-6


@njit(cache=True)
def distances(arm, q, bodies, obstacles, beside, out):
    """Separating-axis distance of every body and obstacle at q: out (B, W), m; 1 beyond FAR.

    beside (W, UPRIGHT): the obstacles as the last body meets them.
    """
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    look_at_frames(arm, q)
    for b in range(len(bodies.link)):
        at = bodies.link[b] * FRAME
        body_pose(arm.frames_y[at : at + FRAME], bodies.centre[b], bodies.turn[b], p, R)
        others = beside if b == len(bodies.link) - 1 else obstacles
        for w in range(len(others)):
            out[b, w] = 1.0
            if near(p, bodies.radius[b] + FAR, others[w]):
                out[b, w] = separation(p, R, bodies.half[b], others[w], normal, contact)


@njit(cache=True)
def assemble(
    X, arm, bodies, obstacles, beside, margin, samples, targets, seen, room, smooth, eq, ineq,
    limit, mu, gain, band, g,
):  # fmt: skip
    """Merit and Gauss-Newton model of the rows 1..T-1.

    With a gain above 0, the multipliers (eq, ineq, limit) are first moved along the violations.
    seen (S, 7), room (S, B): by how much each body was clear of everything at a configuration of
    each sample (m; 0 where it never was); it is not looked at again before it can have moved that
    far from there. beside: as `motion` has it. Returns (merit, violation) and fills band (n, WIDTH)
    as `banded_solve` wants it, g (n,).
    """
    T = len(X) - 1
    merit, worst = 0.0, 0.0
    for i in range(len(band)):
        assign(band[i], smooth[i])
    g[:] = 0.0
    for t in range(T + 1):
        for i in range(ARM):
            a = X[max(t - 1, 0), i] - 2 * X[t, i] + X[min(t + 1, T), i]
            merit += 0.5 * a * a
            if t > 1:
                g[(t - 2) * ARM + i] += a
            if 0 < t < T:
                g[(t - 1) * ARM + i] -= 2 * a
            if t < T - 1:
                g[t * ARM + i] += a
    for t in range(1, T):
        at = (t - 1) * ARM
        for i in range(ARM):
            for side in range(2):
                value = arm.lower[i] - X[t, i] if side == 0 else X[t, i] - arm.upper[i]
                limit[t, i, side] = max(0.0, limit[t, i, side] + gain * value)
                shifted = value + limit[t, i, side] / mu
                worst = max(worst, value)
                if shifted > 0:
                    merit += 0.5 * mu * shifted * shifted
                    g[at + i] += mu * shifted * (-1.0 if side == 0 else 1.0)
                    band[at + i, 0] += mu
        if targets[t, TARGET] > 0:  # straight over a switch
            look_at_grasp(arm, X[t], targets[t])
            for r in range(6):
                value = arm.grasp_y[r]
                eq[t, r] += gain * value
                shifted = value + eq[t, r] / mu
                worst = max(worst, abs(value))
                merit += 0.5 * mu * shifted * shifted
                for i in range(ARM):
                    ji = arm.grasp_y[6 + r * ARM + i]
                    g[at + i] += mu * shifted * ji
                    for j in range(i + 1):
                        band[at + j, i - j] += mu * ji * arm.grasp_y[6 + r * ARM + j]
    index, row = np.zeros(2 * ARM, np.int64), np.zeros(2 * ARM)
    part, q = np.zeros(ARM), np.zeros(ARM)
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for n in range(len(samples)):
        t, alpha = int(samples[n, 0]), samples[n, 1]
        for i in range(ARM):
            q[i] = X[t, i] if alpha == 0.0 else (1 - alpha) * X[t, i] + alpha * X[t + 1, i]
        looked, rising = False, beside if t < RISING else obstacles
        for b in range(len(bodies.link)):
            shift = 0.0
            for i in range(ARM):
                shift += LONGEST * abs(q[i] - seen[n, b, i])
            if room[n, b] > shift:
                continue
            assign(seen[n, b], q)
            if not looked:
                look_at_frames(arm, q)
                looked = True
            start = bodies.link[b] * FRAME
            frame = arm.frames_y[start : start + FRAME]
            body_pose(frame, bodies.centre[b], bodies.turn[b], p, R)
            room[n, b] = 1.0
            others = rising if b == len(bodies.link) - 1 else obstacles
            for w in range(len(others)):
                gap = apart(p, bodies.radius[b] + margin[b, w], others[w])
                if ineq[n, b, w] == 0.0 and gap > 0:
                    room[n, b] = min(room[n, b], gap)
                    continue
                room[n, b] = 0.0
                value = margin[b, w] - separation(p, R, bodies.half[b], others[w], normal, contact)
                ineq[n, b, w] = max(0.0, ineq[n, b, w] + gain * value)
                worst = max(worst, value)
                shifted = value + ineq[n, b, w] / mu
                if shifted <= 0:
                    continue
                merit += 0.5 * mu * shifted * shifted
                point_gradient(frame, contact, normal, part)
                count = 0
                for side in range(2):
                    s = t + side
                    share = 1 - alpha if side == 0 else alpha
                    if s < 1 or s > T - 1 or share == 0.0:
                        continue
                    for i in range(ARM):
                        index[count], row[count] = (s - 1) * ARM + i, -share * part[i]
                        count += 1
                for a in range(count):
                    g[index[a]] += mu * shifted * row[a]
                    for c in range(a + 1):
                        band[index[c], index[a] - index[c]] += mu * row[a] * row[c]
    return merit, worst


@njit(cache=True)
def solve(X, arm, bodies, obstacles, beside, margin, samples, targets):
    """Improve the rows X (T + 1, 7) in place, first and last fixed; returns the violation.

    targets (T + 1, TARGET + 1): hand target of the vertical rows, last column 1 there.
    samples (S, 2): (row, share of the next row) where clearance is asked for.
    """
    T = len(X) - 1
    n = (T - 1) * ARM
    smooth, band, g = smoothness(T), np.zeros((n, WIDTH)), np.zeros(n)
    eq, limit = np.zeros((T + 1, 6)), np.zeros((T + 1, ARM, 2))
    ineq = np.zeros((len(samples), len(bodies.link), len(obstacles)))
    room = np.zeros((len(samples), len(bodies.link)))
    seen = np.zeros((len(samples), len(bodies.link), ARM))
    old, step = X.copy(), np.zeros(n)
    mu, gain, worst = 3000.0, 0.0, 1e9
    for outer in range(8):
        merit, worst = assemble(
            X, arm, bodies, obstacles, beside, margin, samples, targets, seen, room, smooth, eq,
            ineq, limit, mu, gain, band, g,
        )  # fmt: skip
        for _ in range(12):
            for i in range(n):
                step[i] = -g[i]
            if not banded_solve(band, step):
                return 1e9
            longest, slope, scale = step_length(step, g)
            for t in range(T + 1):
                assign(old[t], X[t])
            new = merit
            for _ in range(6):
                for t in range(1, T):
                    for i in range(ARM):
                        X[t, i] = old[t, i] + scale * step[(t - 1) * ARM + i]
                new, worst = assemble(
                    X, arm, bodies, obstacles, beside, margin, samples, targets, seen, room,
                    smooth, eq, ineq, limit, mu, 0.0, band, g,
                )  # fmt: skip
                if new <= merit + 1e-4 * scale * slope + 1e-12:
                    break
                scale *= 0.4
            merit = new
            if scale * longest < (SMALL_STEP if outer else ROUGH_STEP):
                break
        if worst < TOLERANCE:
            return worst
        mu, gain = min(mu * 10.0, 1e5), mu
    return worst


@njit(cache=True)
def dense_check(X, arm, bodies, obstacles, beside, margin, broken):
    """Worst penetration (m, 0 if none) over all sub-steps of the rows X.

    Pairs that stay clear of each other during a step are not looked at more closely.
    beside: as `motion` has it. Fills broken (T, 2) for each step: the sub-step share where its
    margin is broken most, and by how much (m, 0 if kept).
    """
    pairs = np.zeros((len(bodies.link) * len(obstacles), 2), np.int64)
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    q, worst = np.zeros(ARM), 0.0
    broken[:, :] = 0.0
    for t in range(len(X) - 1):
        rising = beside if t < RISING else obstacles
        n = close_pairs(arm, X[t], X[t + 1], bodies, obstacles, rising, pairs)
        for k in range(SUBSTEPS + 1 if n else 0):
            share = k / SUBSTEPS
            for i in range(ARM):
                q[i] = (1 - share) * X[t, i] + share * X[t + 1, i]
            look_at_frames(arm, q)
            before = -1
            for i in range(n):
                b, w = pairs[i]
                if b != before:
                    at = bodies.link[b] * FRAME
                    body_pose(arm.frames_y[at : at + FRAME], bodies.centre[b], bodies.turn[b], p, R)
                    before = b
                others = rising if b == len(bodies.link) - 1 else obstacles
                gap = separation(p, R, bodies.half[b], others[w], normal, contact)
                worst = max(worst, -gap)
                if margin[b, w] - gap > broken[t, 1]:
                    broken[t, 0], broken[t, 1] = share, margin[b, w] - gap
    return worst


@njit(cache=True)
def close_pairs(arm, q0, q1, bodies, obstacles, beside, pairs):
    """Which bodies may come within CLEARANCE of which obstacles on the way from q0 to q1.

    By their distance half-way and how far each body moves from there, to first order with a
    quarter to spare for the rest. beside (W, UPRIGHT): the obstacles as the last body meets them.
    Fills pairs (B W, 2), body by body; returns how many.
    """
    q, count = np.zeros(ARM), 0
    for i in range(ARM):
        q[i] = 0.5 * (q0[i] + q1[i])
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    look_at_frames(arm, q)
    for b in range(len(bodies.link)):
        at = bodies.link[b] * FRAME
        frame = arm.frames_y[at : at + FRAME]
        body_pose(frame, bodies.centre[b], bodies.turn[b], p, R)
        x, y, z = bodies.centre[b, 0], bodies.centre[b, 1], bodies.centre[b, 2]
        arm_length = math.sqrt(x * x + y * y + z * z) + bodies.radius[b]
        shift, turn = 0.0, 0.0
        for axis in range(3):
            v, w = 0.0, 0.0
            for i in range(ARM):
                v += frame[12 + ARM * axis + i] * (q1[i] - q0[i])
                w += frame[33 + ARM * axis + i] * (q1[i] - q0[i])
            shift, turn = shift + v * v, turn + w * w
        reach = CLEARANCE + 0.625 * (math.sqrt(shift) + math.sqrt(turn) * arm_length)
        others = beside if b == len(bodies.link) - 1 else obstacles
        for w in range(len(others)):
            if not near(p, bodies.radius[b] + reach, others[w]):
                continue
            if separation(p, R, bodies.half[b], others[w], normal, contact) < reach:
                pairs[count, 0], pairs[count, 1] = b, w
                count += 1
    return count


@njit(cache=True)
def motion(X, arm, leave, leaving, arrive, bodies, obstacles, beside) -> tuple[float, float, float]:
    """Fill the rows X (ROWS + 1, 7) between its first and last.

    leave / arrive: hand targets of the two switches; without `leaving` the motion starts
    free. beside: the obstacles (W, UPRIGHT) as the last body, the box in the hand if there is one,
    meets them while it rises. Returns the worst penetration (m; -1 where no motion was found, or
    one that penetrates by more than 0.8 ALLOWED), the cost (rad^2) and the time between rows (s).
    """
    shape = (len(bodies.link), len(obstacles))
    first, last = np.zeros(shape), np.zeros(shape)
    distances(arm, X[0], bodies, obstacles, beside, first)
    distances(arm, X[ROWS], bodies, obstacles, obstacles, last)
    margin = first
    for b in range(len(first)):
        for w in range(len(obstacles)):
            margin[b, w] = min(CLEARANCE, first[b, w], last[b, w]) - 1e-4
            if margin[b, w] < -ALLOWED:
                return -1.0, 0.0, 0.0
    targets = np.zeros((ROWS + 1, TARGET + 1))
    if not _guess(X, arm, leave, leaving, arrive, bodies, obstacles, targets):
        return -1.0, 0.0, 0.0
    samples = np.zeros((2 * ROWS + (_EXCHANGES - 1) * ROWS, 2))
    n = 0
    for t in range(ROWS):
        for half in range(2):
            if t or half:
                samples[n, 0], samples[n, 1] = t, 0.5 * half
                n += 1
    broken = np.zeros((ROWS, 2))
    depth = 0.0
    for _ in range(_EXCHANGES):
        if solve(X, arm, bodies, obstacles, beside, margin, samples[:n], targets) > 1.5e-3:
            return -1.0, 0.0, 0.0
        depth = dense_check(X, arm, bodies, obstacles, beside, margin, broken)
        most = 0.0
        for t in range(ROWS):
            most = max(most, broken[t, 1])
        if depth <= 0.5 * ALLOWED and most < 1.2e-3:
            break
        for t in range(ROWS):
            if broken[t, 1] > TOLERANCE and n < len(samples) and 0 < broken[t, 0] < 1:
                samples[n, 0], samples[n, 1] = t, broken[t, 0]
                n += 1
    if depth > 0.8 * ALLOWED:
        return -1.0, 0.0, 0.0
    return depth, acceleration_cost(X), time_step(arm, X)


@njit(cache=True)
def _guess(X, arm, leave, leaving, arrive, bodies, obstacles, targets):
    """First rows: straight up, across at a safe height in joint space, straight down."""
    lowest = 0.0
    for b in range(len(bodies.link)):
        if bodies.link[b] == HAND:
            lowest = max(lowest, bodies.centre[b, 2] + bodies.half[b, 2])
    tallest = 0.0
    for w in range(len(obstacles)):
        tallest = max(tallest, obstacles[w, 2] + obstacles[w, 6])
    safe = tallest + lowest + 0.02
    start, end = VERTICAL if leaving else 0, ROWS - VERTICAL
    raised, lowered = X[0].copy(), X[ROWS].copy()
    for side in range(0 if leaving else 1, 2):
        q, switch = (raised, leave) if side == 0 else (lowered, arrive)
        row, direction = (1, 1) if side == 0 else (ROWS - 1, -1)
        if not _column(X, arm, q, switch, row, direction, safe, targets):
            return False
    up, down = (start + 3 if leaving else start), end - 3
    for t in range(start + 1, end):
        for i in range(ARM):
            if t < up:
                X[t, i] = X[start, i] + (raised[i] - X[start, i]) * (t - start) / (up - start)
            elif t <= down:
                X[t, i] = raised[i] + (lowered[i] - raised[i]) * (t - up) / (down - up)
            else:
                X[t, i] = lowered[i] + (X[end, i] - lowered[i]) * (t - down) / (end - down)
    return True


@njit(cache=True)
def _within_limits(arm, q):
    inside = True
    for i in range(ARM):
        inside = inside and arm.lower[i] <= q[i] <= arm.upper[i]
    return inside


@njit(cache=True)
def _column(X, arm, q, switch, row, direction, safe, targets):
    """Rows over one switch; q becomes the highest reachable configuration up to `safe`."""
    for k in range(VERTICAL):
        height = RISE * ((k + 1) / VERTICAL) ** 2
        for i in range(TARGET):
            targets[row, i] = switch[i]
        targets[row, 2] += height
        targets[row, TARGET] = 1.0
        if not reach_to(arm, q, targets[row]):
            return False
        assign(X[row], q)
        row += direction
    target = switch.copy()
    for k in range(4):
        top = q.copy()
        target[2] = switch[2] + RISE + (1.0 - 0.25 * k) * max(0.0, safe - switch[2] - RISE)
        if reach_to(arm, top, target) and _within_limits(arm, top):
            assign(q, top)
            break
    return True


@njit(cache=True)
def retreat(X, arm, leave, bodies, obstacles) -> tuple[float, float, float]:
    """Fill the rows X (2 * VERTICAL + 1, 7) after its first: straight up from a release, to rest.

    Returns the worst penetration (m; -1 out of reach), the cost (rad^2) and the time between
    rows (s).
    """
    steps = len(X) - 1
    target = leave.copy()
    for t in range(1, steps + 1):
        share = t / steps
        target[2] = leave[2] + RISE * share * share * (3 - 2 * share)
        assign(X[t], X[t - 1])
        if not reach_to(arm, X[t], target) or not _within_limits(arm, X[t]):
            return -1.0, 0.0, 0.0
    margin = np.zeros((len(bodies.link), len(obstacles)))
    depth = dense_check(X, arm, bodies, obstacles, obstacles, margin, np.zeros((steps, 2)))
    return depth, acceleration_cost(X), time_step(arm, X)
