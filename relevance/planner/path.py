"""Path bound: a smooth collision-free motion between two switches (LGP's k = 2 path problem).

Minimises squared joint accelerations over the rows of one motion, from rest to rest, with
vertical departure and approach, joint limits, and clearance of arm, hand and carried box from
everything, at the rows, half-way between them, and wherever a dense check of the result finds
it broken (those points join the problem and it is solved again). Gauss-Newton augmented
Lagrangian on a banded system. Velocity limits are kept by the time between rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from relevance.planner.kernels.boxes import banded_solve, dense_solve, near, separation
from relevance.planner.kernels.native import call
from relevance.planner.keyframes import Bodies, body_pose, point_gradient
from relevance.planner.kinematics import ARM, FRAME, Panda

ROWS = 20
"""Steps of a motion; it has ROWS + 1 rows."""
VERTICAL = 3
"""Rows beside a switch at which the hand is straight over it."""
RISE = 0.06
"""Height of the vertical parts, m."""
STEP = 0.1
"""Shortest time between rows, s."""
SPEED = 0.9
"""Share of the velocity limits that motions use."""
CLEARANCE = 0.002
"""Clearance asked for along the way, m; less where a switch itself leaves less."""
SUBSTEPS = 8
"""Points of the dense check in each step."""
ALLOWED = 1e-3
"""Penetration up to which a plan holds, m."""
_WIDTH = 3 * ARM


def heights(rows: int = VERTICAL) -> np.ndarray:
    """Height over the switch of the rows beside it, nearest first (rows,), m."""
    return RISE * (np.arange(1, rows + 1) / rows) ** 2


@njit(cache=True)
def reach_to(q, target, base, grasp_x, grasp_y, grasp_f):
    """Move q (7,) in place to a hand target (4,) by damped Gauss-Newton; whether it got there."""
    A, b = np.zeros((ARM, ARM)), np.zeros(ARM)
    for _ in range(25):
        for i in range(ARM):
            grasp_x[i] = q[i]
        for i in range(4):
            grasp_x[ARM + i], grasp_x[11 + i] = base[i], target[i]
        call(grasp_f)
        worst = 0.0
        for r in range(6):
            worst = max(worst, abs(grasp_y[r]))
        if worst < 1e-8:
            return True
        for i in range(ARM):
            b[i] = 0.0
            for j in range(ARM):
                A[i, j] = 1e-7 if i == j else 0.0
            for r in range(6):
                ji = grasp_y[6 + r * ARM + i]
                b[i] -= ji * grasp_y[r]
                for j in range(ARM):
                    A[i, j] += ji * grasp_y[6 + r * ARM + j]
        if not dense_solve(A, b):
            return False
        longest = np.max(np.abs(b))
        for i in range(ARM):
            q[i] += b[i] * min(1.0, 0.4 / max(longest, 1e-12))
    return worst < 1e-6


@njit(cache=True)
def distances(q, base, link, centre, half, obstacles, frames_x, frames_y, frames_f, out):
    """Separating-axis distance of every body and obstacle at q: out (B, W), m."""
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for i in range(ARM):
        frames_x[i] = q[i]
    for i in range(4):
        frames_x[ARM + i] = base[i]
    call(frames_f)
    for b in range(len(link)):
        body_pose(frames_y[link[b] * FRAME : (link[b] + 1) * FRAME], centre[b], p, R)
        for w in range(len(obstacles)):
            out[b, w] = 1.0
            if near(p, half[b], obstacles[w], 0.05):
                out[b, w] = separation(p, R, half[b], obstacles[w], normal, contact)


@njit(cache=True)
def _assemble(
    X, base, lower, upper, link, centre, half, obstacles, margin, samples, n_samples, targets,
    frames_x, frames_y, frames_f, grasp_x, grasp_y, grasp_f, eq, ineq, limit, mu, update, band, g,
):  # fmt: skip
    """Merit and Gauss-Newton model of the rows 1..T-1; with `update`, new multipliers."""
    T = len(X) - 1
    merit, worst = 0.0, 0.0
    band[:, :] = 0.0
    g[:] = 0.0
    for t in range(T + 1):
        for i in range(ARM):
            before = X[max(t - 1, 0), i]
            after = X[min(t + 1, T), i]
            a = before - 2 * X[t, i] + after
            merit += 0.5 * a * a
            for u in range(-1, 2):
                s = t + u
                if s < 1 or s > T - 1:
                    continue
                cu = -2.0 if u == 0 else 1.0
                row = (s - 1) * ARM + i
                g[row] += cu * a
                for v in range(-1, u + 1):
                    s2 = t + v
                    if s2 < 1 or s2 > T - 1:
                        continue
                    cv = -2.0 if v == 0 else 1.0
                    band[row, (s - s2) * ARM] += cu * cv
    index, row = np.zeros(2 * ARM, np.int64), np.zeros(2 * ARM)
    part = np.zeros(ARM)
    for t in range(1, T):
        at = (t - 1) * ARM
        for i in range(ARM):
            for side in range(2):
                value = lower[i] - X[t, i] if side == 0 else X[t, i] - upper[i]
                if update:
                    limit[t, i, side] = max(0.0, limit[t, i, side] + mu * value)
                shifted = value + limit[t, i, side] / mu
                worst = max(worst, value)
                if shifted > 0:
                    merit += 0.5 * mu * shifted * shifted
                    g[at + i] += mu * shifted * (-1.0 if side == 0 else 1.0)
                    band[at + i, 0] += mu
        if targets[t, 4] > 0:  # straight over a switch
            for i in range(ARM):
                grasp_x[i] = X[t, i]
            for i in range(4):
                grasp_x[ARM + i], grasp_x[11 + i] = base[i], targets[t, i]
            call(grasp_f)
            for r in range(6):
                value = grasp_y[r]
                if update:
                    eq[t, r] += mu * value
                shifted = value + eq[t, r] / mu
                worst = max(worst, abs(value))
                merit += 0.5 * mu * shifted * shifted
                for i in range(ARM):
                    ji = grasp_y[6 + r * ARM + i]
                    g[at + i] += mu * shifted * ji
                    for j in range(i + 1):
                        band[at + i, i - j] += mu * ji * grasp_y[6 + r * ARM + j]
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for n in range(n_samples):
        t, alpha = int(samples[n, 0]), samples[n, 1]
        for i in range(ARM):
            frames_x[i] = X[t, i] if alpha == 0.0 else (1 - alpha) * X[t, i] + alpha * X[t + 1, i]
        for i in range(4):
            frames_x[ARM + i] = base[i]
        call(frames_f)
        for b in range(len(link)):
            frame = frames_y[link[b] * FRAME : (link[b] + 1) * FRAME]
            body_pose(frame, centre[b], p, R)
            for w in range(len(obstacles)):
                if ineq[n, b, w] == 0.0 and not near(p, half[b], obstacles[w], margin[b, w]):
                    continue
                value = margin[b, w] - separation(p, R, half[b], obstacles[w], normal, contact)
                if update:
                    ineq[n, b, w] = max(0.0, ineq[n, b, w] + mu * value)
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
                        band[index[a], index[a] - index[c]] += mu * row[a] * row[c]
    for i in range(len(band)):
        band[i, 0] += 1e-6
    return merit, worst


@njit(cache=True)
def solve(
    X, base, lower, upper, link, centre, half, obstacles, margin, samples, n_samples, targets,
    frames_x, frames_y, frames_f, grasp_x, grasp_y, grasp_f,
):  # fmt: skip
    """Improve the rows X (T + 1, 7) in place, first and last fixed; returns the violation.

    targets (T + 1, 5): hand target (x, y, z, finger angle) of the vertical rows, last column 1
    there. samples (S, 2): (row, share of the next row) where clearance is asked for.
    """
    T = len(X) - 1
    n = (T - 1) * ARM
    band, g = np.zeros((n, _WIDTH)), np.zeros(n)
    eq, limit = np.zeros((T + 1, 6)), np.zeros((T + 1, ARM, 2))
    ineq = np.zeros((len(samples), len(link), len(obstacles)))
    mu, worst = 50.0, 1e9
    for outer in range(8):
        for _ in range(12):
            merit, worst = _assemble(
                X, base, lower, upper, link, centre, half, obstacles, margin, samples, n_samples,
                targets, frames_x, frames_y, frames_f, grasp_x, grasp_y, grasp_f, eq, ineq, limit,
                mu, False, band, g,
            )  # fmt: skip
            step = -g
            slope_g = g.copy()
            if not banded_solve(band, step):
                return 1e9
            longest = np.max(np.abs(step))
            scale = min(1.0, 0.5 / max(longest, 1e-12))
            slope = np.dot(step, slope_g)
            old = X.copy()
            for _ in range(6):
                X[1:T] = old[1:T] + scale * step.reshape(T - 1, ARM)
                new, worst = _assemble(
                    X, base, lower, upper, link, centre, half, obstacles, margin, samples,
                    n_samples, targets, frames_x, frames_y, frames_f, grasp_x, grasp_y, grasp_f,
                    eq, ineq, limit, mu, False, band, g,
                )  # fmt: skip
                if new <= merit + 1e-4 * scale * slope + 1e-12:
                    break
                scale *= 0.4
            if scale * longest < 3e-4:
                break
        if worst < 2e-4 and outer > 0:
            return worst
        _assemble(
            X, base, lower, upper, link, centre, half, obstacles, margin, samples, n_samples,
            targets, frames_x, frames_y, frames_f, grasp_x, grasp_y, grasp_f, eq, ineq, limit, mu,
            True, band, g,
        )  # fmt: skip
        mu = min(mu * 4.0, 1e5)
    return worst


@njit(cache=True)
def dense_check(
    X, base, link, centre, half, obstacles, margin, frames_x, frames_y, frames_f, broken
):
    """Worst penetration (m, 0 if none) over all sub-steps of the rows X.

    Fills broken (T, 2) for each step: the sub-step share where its margin is broken most, and
    by how much (m, 0 if kept).
    """
    out = np.zeros((len(link), len(obstacles)))
    worst = 0.0
    broken[:, :] = 0.0
    for t in range(len(X) - 1):
        for k in range(SUBSTEPS + 1):
            share = k / SUBSTEPS
            q = (1 - share) * X[t] + share * X[t + 1]
            distances(q, base, link, centre, half, obstacles, frames_x, frames_y, frames_f, out)
            for b in range(len(link)):
                for w in range(len(obstacles)):
                    worst = max(worst, -out[b, w])
                    short = margin[b, w] - out[b, w]
                    if short > broken[t, 1]:
                        broken[t, 0], broken[t, 1] = share, short
    return worst


def motion(
    arm: Panda,
    base: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    leave: np.ndarray | None,
    arrive: np.ndarray,
    body: Bodies,
    obstacles: np.ndarray,
) -> tuple[np.ndarray, float] | None:
    """Rows (ROWS + 1, 7) from configuration `start` to `end`, and their worst penetration (m).

    leave / arrive: hand targets (4,) of the two switches; None when the motion starts free.
    Returns None where no motion was found that keeps the dense check within ALLOWED.
    """
    frames, grasp = arm.frames, arm.grasp
    fx = (frames.x, frames.y, frames.handle)
    gx = (grasp.x, grasp.y, grasp.handle)
    shape = (len(body.link), len(obstacles))
    ends = np.ones((2, *shape))
    for q, out in zip((start, end), ends, strict=True):
        distances(q, base, body.link, body.centre, body.half, obstacles, *fx, out)
    margin = np.minimum(CLEARANCE, ends.min(0)) - 1e-4
    if margin.min() < -ALLOWED:
        return None
    guess = _guess(arm, base, start, end, leave, arrive, body, obstacles)
    if guess is None:
        return None
    X, targets = guess
    samples = np.zeros((2 * ROWS + 3 * ROWS, 2))
    n = 0
    for t in range(ROWS):
        for share in (0.0, 0.5):
            if t or share:
                samples[n] = t, share
                n += 1
    broken = np.zeros((ROWS, 2))
    problem = (base, arm.lower, arm.upper, body.link, body.centre, body.half, obstacles, margin)
    for _ in range(4):
        violation = solve(X, *problem, samples, n, targets, *fx, *gx)
        if violation > 1.5e-3:
            return None
        depth = dense_check(
            X, base, body.link, body.centre, body.half, obstacles, margin, *fx, broken
        )
        bad = np.flatnonzero(broken[:, 1] > 1.2e-3)
        if depth <= 0.5 * ALLOWED and len(bad) == 0:
            return X, depth
        for t in bad:
            if n < len(samples) and 0 < broken[t, 0] < 1:
                samples[n] = t, broken[t, 0]
                n += 1
    return (X, depth) if depth <= 0.8 * ALLOWED else None


def retreat(
    arm: Panda, base: np.ndarray, start: np.ndarray, leave: np.ndarray
) -> np.ndarray | None:
    """Rows (2 * VERTICAL + 1, 7) straight up from a release, to rest; None out of reach."""
    rows = [start]
    steps = np.arange(1, 2 * VERTICAL + 1) / (2 * VERTICAL)
    for share in steps * steps * (3 - 2 * steps):
        q = rows[-1].copy()
        target = leave + np.array([0, 0, RISE * share, 0])
        if not reach_to(q, target, base, arm.grasp.x, arm.grasp.y, arm.grasp.handle):
            return None
        rows.append(q)
    X = np.array(rows)
    return X if ((arm.lower <= X) & (arm.upper >= X)).all() else None


def time_step(arm: Panda, X: np.ndarray) -> float:
    """Seconds between rows such that no joint exceeds its share of the velocity limit."""
    return float(max(STEP, (np.abs(np.diff(X, axis=0)) / arm.velocity).max() / SPEED))


def acceleration_cost(X: np.ndarray) -> float:
    """Sum of squared second differences of the rows, at rest before and after, rad^2."""
    rest = np.vstack([X[:1], X, X[-1:]])
    return float((np.diff(rest, n=2, axis=0) ** 2).sum())


def _guess(arm, base, start, end, leave, arrive, body, obstacles):
    """First rows: straight up, across at a safe height in joint space, straight down."""
    gx = (arm.grasp.x, arm.grasp.y, arm.grasp.handle)
    X, targets = np.zeros((ROWS + 1, ARM)), np.zeros((ROWS + 1, 5))
    X[0], X[ROWS] = start, end
    hand = body.link == 2
    lowest = float((body.centre[hand, 2] + body.half[hand, 2]).max())
    safe = float((obstacles[:, 2] + obstacles[:, 6]).max()) + lowest + 0.02

    def column(q, switch, order):
        """Rows over one switch, then the highest reachable configuration up to `safe`."""
        q = q.copy()
        for t, height in zip(order, heights(), strict=True):
            targets[t, :4] = switch + np.array([0, 0, height, 0])
            targets[t, 4] = 1.0
            if not reach_to(q, targets[t, :4], base, *gx):
                return None
            X[t] = q
        for share in (1.0, 0.75, 0.5, 0.25):
            top = q.copy()
            target = switch.copy()
            target[2] += RISE + share * max(0.0, safe - switch[2] - RISE)
            inside = reach_to(top, target, base, *gx)
            if inside and (top >= arm.lower).all() and (top <= arm.upper).all():
                return top
        return q

    first, last = 0, ROWS - VERTICAL
    raised = start
    if leave is not None:
        raised = column(start, leave, range(1, VERTICAL + 1))
        first = VERTICAL
    lowered = column(end, arrive, range(ROWS - 1, ROWS - VERTICAL - 1, -1))
    if raised is None or lowered is None:
        return None
    up, down = (first + 3 if leave is not None else first), last - 3
    knots_t = np.array(sorted({first, up, down, last}))
    knots = {first: X[first].copy(), up: raised, down: lowered, last: X[last].copy()}
    if leave is None:
        knots[first] = start
    for i in range(ARM):
        X[first : last + 1, i] = np.interp(
            np.arange(first, last + 1), knots_t, [knots[t][i] for t in knots_t]
        )
    return X, targets
