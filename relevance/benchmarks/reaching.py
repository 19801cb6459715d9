"""The exhaustive reference's own inverse kinematics: where a hand can be, upright or leaning.

It is a referee of the planner's, so it shares none of its formulas: damped least squares on the
Panda's published parameters, on grids.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from relevance.robot import panda
from relevance.scene import Scene

LIFT = 0.05
"""Height by which a box must be liftable within reach, m."""

# The Panda as its maker publishes it (Denavit and Hartenberg, modified): a, d, alpha.
_LINKS = (
    (0.0, 0.333, 0.0), (0.0, 0.0, -math.pi / 2), (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2), (-0.0825, 0.384, -math.pi / 2), (0.0, 0.0, math.pi / 2),
    (0.088, 0.107, math.pi / 2),
)  # fmt: skip
_GRID = ((0.10, 0.90, 81), (-0.30, 0.90, 61))
"""Distances from the base's axis and heights over the base that are solved for, m."""
_LEAN_GRID = ((0.15, 0.90, 26), (-0.15, 0.60, 26), (-math.pi, math.pi, 17))
"""The same for a hand that leans, and where it leans to against its bearing, rad; one more joint
decides, and it takes longer."""
ASIDE = 1.0
"""How far the first joint may turn from where the leaning hand is, rad."""
_STARTS = ((0.0, -0.8, 0.0, -2.3, 0.0, 1.6), (0.0, 0.6, 0.0, -1.8, 0.0, 2.4))
_ROUNDS = 60


@cache
def reach_map() -> np.ndarray:
    """(R, Z) bool: where the downward hand can be, by damped least squares from two starts.

    The finger angle is the last joint's alone, which `reached` looks at.
    """
    arm = panda()
    lower, upper = arm.lower[:6], arm.upper[:6]
    r, z = np.meshgrid(*(np.linspace(*ends) for ends in _GRID), indexing="ij")
    target = np.stack([r.ravel(), np.zeros(r.size), z.ravel()], axis=1)
    reached = np.zeros(r.size, dtype=bool)
    for start in _STARTS:
        q = np.tile(start, (r.size, 1))
        for _ in range(_ROUNDS):
            error, jacobian = _hand_error(q, target)
            square = jacobian @ jacobian.transpose(0, 2, 1) + 1e-5 * np.eye(5)
            step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[..., None])
            q = np.clip(q - np.clip(step[..., 0], -0.4, 0.4), lower, upper)
        reached |= np.abs(_hand_error(q, target)[0]).max(axis=1) < 1e-4
    return reached.reshape(r.shape)


@cache
def lean_map(tilt: float) -> np.ndarray:
    """(R, Z, L) bool: where a hand can be that leans to the left of its finger axis by so much
    (rad, not 0); L: the direction to which it leans."""
    arm, found = panda(), False
    lean = np.meshgrid(*(np.linspace(*ends) for ends in _LEAN_GRID), indexing="ij")[2].ravel()
    fingers = math.copysign(1.0, tilt) * np.stack([np.sin(lean), -np.cos(lean), 0 * lean], axis=1)
    for solved, frame in _leaning(abs(tilt)):
        # What the last joint turns by from the frame in which it is 0 to the finger axis.
        along, across = ((frame[:, :, i] * fingers).sum(axis=1) for i in (1, 0))
        last = _wrapped(np.arctan2(-across, along) + math.pi / 4)
        found |= solved & (abs(last) <= arm.upper[6] - 0.05)
    return np.reshape(found, [count for _, _, count in _LEAN_GRID])


@cache
def _leaning(tilt: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """From each start: whether a hand that leans so far gets to each point of the grid, (N,) bool,
    and its axes there with the last joint at 0, (N, 3, 3)."""
    arm, found = panda(), []
    grid = np.meshgrid(*(np.linspace(*ends) for ends in _LEAN_GRID), indexing="ij")
    r, z, lean = (axis.ravel() for axis in grid)
    target = np.stack([r, 0 * r, z], axis=1)
    down = np.stack([-np.cos(lean), -np.sin(lean), 0 * lean], axis=1) * math.sin(tilt)
    down -= [0.0, 0.0, math.cos(tilt)]
    for start in _STARTS:
        q, left = np.tile(start, (r.size, 1)), np.arange(r.size)
        for _ in range(_ROUNDS):
            _, error, jacobian = _lean_error(q[left], target[left], down[left])
            square = jacobian @ jacobian.transpose(0, 2, 1) + 1e-5 * np.eye(6)
            step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[..., None])
            moved = q[left] - np.clip(step[..., 0], -0.4, 0.4)
            q[left] = np.clip(moved, arm.lower[:6], arm.upper[:6])
            left = left[abs(error).max(axis=1) > 1e-6]
        frame, error, _ = _lean_error(q, target, down)
        solved = (abs(error).max(axis=1) < 1e-4) & (abs(q[:, 0]) <= ASIDE)
        found.append((solved, frame))
    return found


def _lean_error(
    q: np.ndarray, target: np.ndarray, down: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes of the hands (N, 3, 3), how far they are off the targets and off pointing `down`
    (N, 6), and d/dq."""
    frame, hand, axes, origins = _forward(q)
    jacobian = np.empty((len(q), 6, 6))
    for i in range(6):
        jacobian[:, :3, i] = np.cross(axes[i], hand - origins[i])
        jacobian[:, 3:, i] = np.cross(axes[i], frame[:, :, 2])
    return frame, np.concatenate([hand - target, frame[:, :, 2] - down], axis=1), jacobian


def _hand_error(q: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the hands (N, 6) are off the targets and off pointing down (N, 5), and d/dq."""
    frame, hand, axes, origins = _forward(q)
    down = frame[:, :, 2]
    # Twice the distance of `down` from straight down: its x and y vanish when it points up too.
    tilt = down[:, :2] * (2.0 + down[:, 2:])
    jacobian = np.empty((len(q), 5, 6))
    for i in range(6):
        jacobian[:, :3, i] = np.cross(axes[i], hand - origins[i])
        turned = np.cross(axes[i], down)
        jacobian[:, 3:, i] = turned[:, :2] * (2.0 + down[:, 2:]) + down[:, :2] * turned[:, 2:]
    up = np.where(down[:, 2:] > 0, 1.0, 0.0)
    return np.concatenate([hand - target, tilt + up], axis=1), jacobian


def _forward(
    q: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Axes (N, 3, 3) and origin (N, 3) of the last frame, its joint at 0, of configurations (N, 6);
    axis and origin of every joint."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    axes, origins = [], []
    for i, (a, d, alpha) in enumerate(_LINKS):
        c, s = (np.cos(q[:, i]), np.sin(q[:, i])) if i < 6 else (np.ones(len(q)), np.zeros(len(q)))
        ca, sa = math.cos(alpha), math.sin(alpha)
        zero, one = np.zeros(len(q)), np.ones(len(q))
        step = np.array(
            [
                [c, -s, zero, a * one],
                [s * ca, c * ca, -sa * one, -d * sa * one],
                [s * sa, c * sa, ca * one, d * ca * one],
                [zero, zero, zero, one],
            ]
        ).transpose(2, 0, 1)
        T = T @ step
        axes.append(T[:, :3, 2])
        origins.append(T[:, :3, 3])
    return T[:, :3, :3], origins[-1], axes, origins


def reached(
    scene: Scene, x: np.ndarray, y: np.ndarray, tips: np.ndarray, angle: np.ndarray, tilt: float
) -> np.ndarray:
    """Whether the tips of a hand can be at these places and heights, and LIFT above them; arrays
    that broadcast.

    angle: of the finger axis, rad; the two ways round are two angles. tilt: how far it leans to
    the left of that, rad.
    """
    base, yaw, length = scene.robot.base, scene.robot.yaw, panda().finger_tip
    dx = x - base[0] - length * math.sin(tilt) * np.sin(angle)
    dy = y - base[1] + length * math.sin(tilt) * np.cos(angle)
    z = tips - base[2] + length * math.cos(tilt)
    bearing, r = np.arctan2(dy, dx), np.hypot(dx, dy)
    ahead, limits = abs(_wrapped(bearing - yaw)), panda().upper
    if tilt == 0.0:
        last = _wrapped(bearing - angle - math.pi / 4)
        good = (ahead <= limits[0] - 0.05) & (abs(last) <= limits[6] - 0.05)
        grid, more = _GRID, ()
    else:
        lean = _wrapped(angle + math.copysign(math.pi / 2, tilt) - bearing)
        good = ahead <= limits[0] - ASIDE
        grid, more = _LEAN_GRID, (lean,)
    for height in (z, z + LIFT):
        cells = []
        for value, (low, high, count) in zip((r, height, *more), grid, strict=True):
            cell = np.floor((value - low) / (high - low) * (count - 1)).astype(int)
            good = good & (cell >= 0) & (cell < count - 1)
            cells.append(np.clip(cell, 0, count - 2))
        good = good & _cells(tilt)[tuple(cells)]
    return good


@cache
def _cells(tilt: float) -> np.ndarray:
    """The cells of the map for this lean of whose corners all are true, so that it is so in
    between."""
    found = lean_map(tilt) if tilt else reach_map()
    for axis in range(found.ndim):
        ends = np.moveaxis(found, axis, 0)
        found = np.moveaxis(ends[:-1] & ends[1:], 0, axis)
    return found


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angles within half a turn of 0, rad."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
