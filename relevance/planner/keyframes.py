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
import time
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit

from relevance.planner.grasps import Grasp, bodies, carried, hand_target, pick_target
from relevance.planner.kernels.boxes import (
    body_pose,
    dense_solve,
    near,
    point_gradient,
    separation,
    step_length,
)
from relevance.planner.kernels.kinematics import (
    FRAME,
    TARGET,
    Arm,
    hand_down,
    look_at_frames,
    look_at_grasp,
)
from relevance.planner.kernels.motions import reach_to
from relevance.planner.kernels.rows import assign
from relevance.planner.pose import Placement, PoseBound, moved_box
from relevance.robot import ARM, HOME, panda
from relevance.scene.geometry import UPRIGHT, upright

PICK_CLEARANCE, PLACE_CLEARANCE = 0.0008, 0.0025
"""Clearance asked of every pair at a switch, m (the pose bound's PICK_MARGIN and MARGIN are
larger)."""
TOLERANCE = 2e-4
"""Largest violation (m, rad) of a solved problem."""
STAY = (100.0, 1e5)
"""Weights of a placement's distance from what the pose bound found (m^-2), tried in turn: with
less, the pull of short joint motion drags boxes into wells between obstacles."""
SWINGS = (0.0, 0.6, -0.6)
"""By how much the elbow is turned aside in the first guess, rad, tried in turn where something
tall could be in its way."""
SMALL_STEP = 3e-3
"""Gauss-Newton stops after a step below this, rad or m; what is left is of the order of its
square."""
ROUGH_STEP = 1e-2
"""The same before the multipliers are set for the first time, rad or m."""
_OUTER, _INNER = 8, 12


class Switches(NamedTuple):
    """The switches of m moved boxes among W obstacles: what the NLP is about besides the arm."""

    start: np.ndarray
    """(7,) configuration before the first switch, rad."""
    pick: np.ndarray
    """(m, TARGET) hand target of each pick."""
    place_z: np.ndarray
    """(m,) height of the hand at each place, m."""
    turn: np.ndarray
    """(m, 5): angle of the finger axis minus the box's yaw, the placed box's height, how far the
    hand and its wrist are to the left of that axis, and how far the hand leans that way."""
    link: np.ndarray
    """(2m, B) bodies at each switch, as in `Bodies`; the first n_bodies[k] count."""
    centre: np.ndarray
    half: np.ndarray
    lean: np.ndarray
    radius: np.ndarray
    n_bodies: np.ndarray
    obstacles: np.ndarray
    """(W, UPRIGHT)."""
    stands: np.ndarray
    """(2m, W): whether obstacle w is there at switch k and is not the box in hand."""
    moved: np.ndarray
    """(W,) index of the obstacle among the moved boxes, or -1."""
    support: np.ndarray
    """(m,) obstacle on which box j is placed."""
    region: np.ndarray
    """(5,) goal region of the last box's centre: x, y, angle, half extents."""
    bounds: np.ndarray
    """(m, 4): of |x| and |y| of each placed box's corners, and of the wrist's distance from the
    base (near, far) so that the hand can rise from it."""
    footprint: np.ndarray
    """(m, 2) half extents of each placed box along and across the finger axis."""


class KeyframeBound:
    """Solves the keyframe NLP of an order of moves."""

    def __init__(self, pose: PoseBound) -> None:
        self.problem, self.pose = pose.problem, pose

    def solve(
        self, order: tuple[str, ...], placements: list[Placement]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Configurations (2m, 7) and placement poses (m, 3), or None."""
        began = time.process_time()
        self.problem.counts.keyframe += 1
        found = self._solve(order, placements)
        self.problem.seconds.keyframe += time.process_time() - began
        return found

    def _solve(
        self, order: tuple[str, ...], placements: list[Placement]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        arm, at, problem, m = panda(), self.problem.arm, self.problem, len(order)
        obstacles, every = problem.obstacles, problem.tall
        if every:  # with the links near the base, which are over the robot's foot
            at, obstacles = problem.whole_arm, obstacles[:-1]
        moved = np.full(len(obstacles), -1)
        stands = np.ones((2 * m, len(obstacles)), np.bool_)
        supports = np.full(m, len(problem.boxes))  # the table
        widest = len(arm.arm) + every * len(arm.upper_arm) + 2 * len(arm.finger) + 1
        link, n_bodies = np.zeros((2 * m, widest), np.int64), np.zeros(2 * m, np.int64)
        centre, half = np.zeros((2 * m, widest, 3)), np.zeros((2 * m, widest, 3))
        lean, radius = np.zeros((2 * m, widest)), np.zeros((2 * m, widest))
        pick, place_z, turn = np.zeros((m, TARGET)), np.zeros(m), np.zeros((m, 5))
        bounds, footprint = np.zeros((m, 4)), np.zeros((m, 2))
        x = np.zeros(17 * m)
        p0, weight = np.zeros(3 * m), np.zeros(3 * m)
        reference = problem.reference
        if reference.name in order:
            reference = moved_box(reference, placements[order.index(reference.name)])
        for j, (name, place) in enumerate(zip(order, placements, strict=True)):
            box, grasp = problem.boxes[name], place.grasp
            bottom = 0.0
            if name == problem.goal.subject and problem.goal.predicate.stacked:
                supports[j], bottom = problem.index[reference.name], reference.top
            moved[problem.index[name]] = j
            pick[j] = pick_target(box, grasp)
            place_z[j] = bottom + box.size[2] / 2 + grasp.above
            turn[j, :2] = grasp.axis * math.pi / 2, bottom + box.size[2] / 2
            turn[j, 2:] = grasp.shift, grasp.wrist[0], grasp.tilt
            put = hand_target(*place.pose[:2], place_z[j], place.pose[2], grasp)
            way = _start(at, (pick[j], put), x[14 * j : 14 * j + 14], grasp)
            if way == 0:
                return None
            p0[3 * j : 3 * j + 3] = place.pose
            for k in (2 * j, 2 * j + 1):
                held = carried(box, grasp, way) if k % 2 else None
                body = bodies(grasp.opening, held, upper=every)
                n_bodies[k] = count = len(body.link)
                rows = link, centre, half, lean, radius
                for row, value in zip(rows, body, strict=True):
                    row[k, :count] = value
                stands[k, problem.index[name]] = False
            footprint[j] = grasp.parts[0, 2:4]
            bounds[j, :2] = problem.table
            bounds[j, 2:] = self.pose.interval(bottom, box, grasp)
        x[14 * m :] = p0
        switches = Switches(
            HOME, pick, place_z, turn, link, centre, half, lean, radius, n_bodies, obstacles,
            stands, moved, supports, problem.goal_region(reference, *p0[-3:-1]), bounds, footprint,
        )  # fmt: skip
        start, elbow = x.copy(), x[2 : 14 * m : ARM]
        for swing, stay in product(SWINGS if every else SWINGS[:1], STAY):
            weight[:] = stay
            if reference.name in order:  # the subject's region was laid out around it
                j = order.index(reference.name)
                weight[3 * j : 3 * j + 3] = 1e6
            x[:] = start
            elbow += swing
            if solve(x, at, switches, p0, weight) <= TOLERANCE:
                return x[: 14 * m].reshape(2 * m, ARM), x[14 * m :].reshape(m, 3)
        return None


def _start(arm: Arm, targets: tuple[np.ndarray, ...], q: np.ndarray, grasp: Grasp) -> float:
    """Fill q (14,) with configurations for the pick and the place of one box.

    Returns which way round the hand is (1, -1), 0 where it does not reach both: a lopsided hold
    must be the same way round at both, any other is symmetric.
    """
    for way in (1.0, -1.0) if grasp.lopsided else (0.0,):
        if all(
            _reach(arm, target, q[k * ARM : (k + 1) * ARM], grasp, way)
            for k, target in enumerate(targets)
        ):
            return way or 1.0
    return 0.0


def _reach(arm: Arm, target: np.ndarray, q: np.ndarray, grasp: Grasp, way: float) -> bool:
    """Fill q (7,) for a hand target: in closed form, from there on by iteration if it leans."""
    upright = target.copy()
    if grasp.tilt:
        left, rise = grasp.wrist[0] - grasp.shift, grasp.wrist[1] - grasp.above
        upright[0] -= left * math.sin(target[3])
        upright[1] += left * math.cos(target[3])
        upright[2] += rise
    there = hand_down(upright, arm.base, arm.lower, arm.upper, q, way)
    return there and (not grasp.tilt or reach_to(arm, q, target))


@njit(cache=True)
def _push(H, g, index, row, count, value, multiplier, mu, lowest):
    """Add one constraint row to the augmented Lagrangian; returns (merit, violation).

    lowest: 0 for an inequality, -inf for an equality. Callers say int64 of their counts and give
    no bool: each literal would be compiled once more.
    """
    shifted = value + multiplier / mu
    if shifted <= lowest:
        return 0.0, max(value, 0.0)
    for a in range(count):
        g[index[a]] += mu * shifted * row[a]
        for b in range(a + 1):  # indices ascend: the lower triangle
            H[index[a], index[b]] += mu * row[a] * row[b]
    return 0.5 * mu * shifted * shifted, abs(value) if lowest < 0 else max(value, 0.0)


@njit(cache=True)
def assemble(x, arm, switches, p0, weight, eq, ineq, limit, edge, mu, gain, H, g):
    """Merit, violation; fills g and H (lower triangle) of the Gauss-Newton model.

    With a gain above 0, the multipliers (eq, ineq, limit, edge) are first moved along the
    violations.
    """
    n, m = len(x), len(switches.place_z)
    first = 2 * m * ARM
    obstacles, region = switches.obstacles, switches.region
    merit, worst = 0.0, 0.0
    H[:, :] = 0.0
    g[:] = 0.0
    index = np.zeros(16, np.int64)
    row, part = np.zeros(16), np.zeros(ARM)
    p, R, normal, contact = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    there, target = np.zeros((len(obstacles), UPRIGHT)), np.zeros(TARGET)
    for k in range(2 * m):
        for i in range(ARM):
            a = k * ARM + i
            before = switches.start[i] if k == 0 else x[a - ARM]
            d = x[a] - before
            merit += 0.5 * d * d
            g[a] += d
            H[a, a] += 1.0
            if k > 0:
                g[a - ARM] -= d
                H[a - ARM, a - ARM] += 1.0
                H[a, a - ARM] -= 1.0
    for i in range(3 * m):
        d = x[first + i] - p0[i]
        merit += 0.5 * weight[i] * d * d
        g[first + i] += weight[i] * d
        H[first + i, first + i] += weight[i]
    for k in range(2 * m):
        j, placing = k // 2, k % 2 == 1
        at = first + 3 * j
        if placing:
            shift = switches.turn[j, 2]
            c, s = math.cos(x[at + 2]), math.sin(x[at + 2])
            target[0], target[1] = x[at] - shift * s, x[at + 1] + shift * c
            target[2], target[3] = switches.place_z[j], x[at + 2]
            target[4] = switches.turn[j, 4]
        else:
            assign(target, switches.pick[j])
        q = x[k * ARM : (k + 1) * ARM]
        clearance = PLACE_CLEARANCE if placing else PICK_CLEARANCE
        look_at_grasp(arm, q, target)
        look_at_frames(arm, q)
        for r in range(6):
            for i in range(ARM):
                index[i], row[i] = k * ARM + i, arm.grasp_y[6 + r * ARM + i]
            count = np.int64(ARM)
            if placing:
                for i in range(3):
                    index[count] = at + i
                    row[count] = arm.grasp_y[48 + r * 4 + (3 if i == 2 else i)]
                    if i == 2:
                        dx, dy = arm.grasp_y[48 + r * 4], arm.grasp_y[48 + r * 4 + 1]
                        row[count] -= shift * (c * dx + s * dy)
                    count += 1
            value = arm.grasp_y[r]
            eq[k, r] += gain * value
            got, violated = _push(H, g, index, row, count, value, eq[k, r], mu, -np.inf)
            merit += got
            worst = max(worst, violated)
        for i in range(ARM):
            for side in range(2):
                value = arm.lower[i] - q[i] if side == 0 else q[i] - arm.upper[i]
                index[0], row[0] = k * ARM + i, (-1.0 if side == 0 else 1.0)
                limit[k, i, side] = max(0.0, limit[k, i, side] + gain * value)
                got, violated = _push(
                    H, g, index, row, np.int64(1), value, limit[k, i, side], mu, 0.0
                )
                merit += got
                worst = max(worst, violated)
        for w in range(len(obstacles)):
            other = switches.moved[w]
            assign(there[w], obstacles[w])
            if 0 <= other < j:
                a, o = first + 3 * other, there[w]
                yaw, height = x[a + 2] - switches.turn[other, 0], switches.turn[other, 1]
                upright(x[a], x[a + 1], height, yaw, o[4], o[5], o[6], o)
        for b in range(switches.n_bodies[k]):
            link = switches.link[k, b] * FRAME
            frame = arm.frames_y[link : link + FRAME]
            body_pose(frame, switches.centre[k, b], switches.lean[k, b], p, R)
            for w in range(len(obstacles)):
                held = b == switches.n_bodies[k] - 1
                if not switches.stands[k, w]:
                    continue
                o, other = there[w], switches.moved[w]
                if placing and held:  # what is not above its support is not in its way
                    under = switches.turn[j, 1] - switches.half[k, b, 2]
                    if w == switches.support[j] or o[2] + o[6] <= under + 1e-6:
                        continue
                if ineq[k, b, w] == 0.0 and not near(p, switches.radius[k, b] + clearance, o):
                    continue
                d = separation(p, R, switches.half[k, b], o, normal, contact)
                value = clearance - d
                ineq[k, b, w] = max(0.0, ineq[k, b, w] + gain * value)
                if value + ineq[k, b, w] / mu <= 0:
                    continue
                point_gradient(frame, contact, normal, part)
                for i in range(ARM):
                    index[i], row[i] = k * ARM + i, -part[i]
                count = np.int64(ARM)
                if 0 <= other < j:
                    spin = normal[1] * (contact[0] - o[0]) - normal[0] * (contact[1] - o[1])
                    for i in range(3):
                        index[count] = first + 3 * other + i
                        row[count] = spin if i == 2 else normal[i]
                        count += 1
                got, violated = _push(H, g, index, row, count, value, ineq[k, b, w], mu, 0.0)
                merit += got
                worst = max(worst, violated)
    for j in range(m):
        at = first + 3 * j
        c, s = math.cos(x[at + 2]), math.sin(x[at + 2])
        left = switches.turn[j, 3]
        ox, oy = x[at] - left * s - arm.base[0], x[at + 1] + left * c - arm.base[1]
        distance = max(math.sqrt(ox * ox + oy * oy), 1e-6)
        for side in range(10):
            # 0..3: the goal region of the last placement; 4..7: the table's edge; 8, 9: reach
            if side < 4 and j < m - 1:
                continue
            sign = 1.0 if side % 2 == 0 else -1.0
            row[2] = 0.0
            if side < 4:
                cr, sr = math.cos(region[2]), math.sin(region[2])
                if side < 2:
                    row[0], row[1] = sign * cr, sign * sr
                else:
                    row[0], row[1] = -sign * sr, sign * cr
                bound = region[3] if side < 2 else region[4]
                value = row[0] * (x[at] - region[0]) + row[1] * (x[at + 1] - region[1]) - bound
            elif side < 8:
                row[0], row[1] = (sign, 0.0) if side < 6 else (0.0, sign)
                along = switches.footprint[j, 0 if side < 6 else 1]
                across = switches.footprint[j, 1 if side < 6 else 0]
                bound = switches.bounds[j, 0 if side < 6 else 1] - abs(c) * along - abs(s) * across
                row[2] = math.copysign(c, c * s) * across - math.copysign(s, c * s) * along
                value = row[0] * x[at] + row[1] * x[at + 1] - bound
            else:
                row[0], row[1] = sign * ox / distance, sign * oy / distance
                row[2] = -left * (c * row[0] + s * row[1])
                value = sign * (distance - switches.bounds[j, 3 if side == 8 else 2])
            index[0], index[1], index[2] = at, at + 1, at + 2
            edge[j, side] = max(0.0, edge[j, side] + gain * value)
            got, violated = _push(H, g, index, row, np.int64(3), value, edge[j, side], mu, 0.0)
            merit += got
            worst = max(worst, violated)
    for i in range(n):
        H[i, i] += 1e-6
    return merit, worst


@njit(cache=True)
def solve(x, arm, switches, p0, weight):
    """Improve x (17m,) in place; returns the largest violation (m, rad) at the end.

    p0, weight (3m,): where the placements are wanted, and how much.
    """
    n, m = len(x), len(switches.place_z)
    H, g = np.zeros((n, n)), np.zeros(n)
    eq, limit, edge = np.zeros((2 * m, 6)), np.zeros((2 * m, ARM, 2)), np.zeros((m, 10))
    ineq = np.zeros((2 * m, switches.link.shape[1], len(switches.obstacles)))
    old, step = x.copy(), np.zeros(n)
    mu, gain, worst, before = 1000.0, 0.0, 1e9, 1e9
    for outer in range(_OUTER):
        merit, worst = assemble(x, arm, switches, p0, weight, eq, ineq, limit, edge, mu, gain, H, g)
        for _ in range(_INNER):
            for i in range(n):
                step[i] = -g[i]
            if not dense_solve(H, step):
                return 1e9
            longest, slope, scale = step_length(step, g)
            assign(old, x)
            new = merit
            for _ in range(8):
                for i in range(n):
                    x[i] = old[i] + scale * step[i]
                new, worst = assemble(
                    x, arm, switches, p0, weight, eq, ineq, limit, edge, mu, 0.0, H, g
                )
                if new <= merit + 1e-4 * scale * slope + 1e-12:
                    break
                scale *= 0.4
            merit = new
            if scale * longest < (SMALL_STEP if outer else ROUGH_STEP):
                break
        if worst < TOLERANCE / 2 and outer > 0:
            return worst
        if outer >= 3 and worst > 0.7 * before:
            return worst  # stuck
        before = worst
        mu, gain = min(mu * 5.0, 1e5), mu
    return worst
