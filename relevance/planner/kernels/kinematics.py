"""The arm in motion: kinematics and switch constraints in casadi, the downward hand in closed form.

casadi is where they are defined, once; `native` makes them callable from the solvers. The base
pose is a parameter (x, y, z, yaw) of every function. Frames are those of `robot.LINKS`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numba import njit

from relevance.planner.kernels.native import Native, call, load
from relevance.robot import ARM, HAND, LINKS, UPPER_LINKS, panda

TARGET = 5
"""Numbers of a hand target: x, y, z of its origin (m), the finger axis' angle, and how far the hand
leans to the left of that axis (rad): 0 where it points straight down."""
FRAME = 54
"""Numbers a frame takes in the output of `frames`: p (3), R (9), Jv (21), Jw (21), row-major."""
FLANGE = 0.107
"""Distance of the hand's origin from the wrist, along the hand's z, m."""
LIMIT_MARGIN = 1e-3
"""How far inside the joint limits the solvers aim, rad: more than they may be off."""


class Functions(NamedTuple):
    """The arm's functions, compiled."""

    frames: Native
    """x = (q (7), base (4)); y = a frame of FRAME numbers for each of LINKS."""
    all_frames: Native
    """The same for LINKS and UPPER_LINKS."""
    grasp: Native
    """x = (q (7), base (4), target (5)); y = residual (6), d/dq (6 x 7), d/dtarget[:4] (6 x 4)."""


class Arm(NamedTuple):
    """What the solvers use of a Panda at its place; every array is float64 or a handle."""

    base: np.ndarray
    """(4,) x, y, z, yaw."""
    lower: np.ndarray
    """(7,) joint limits with LIMIT_MARGIN to spare, rad."""
    upper: np.ndarray
    velocity: np.ndarray
    frames_x: np.ndarray
    frames_y: np.ndarray
    frames_f: np.ndarray
    grasp_x: np.ndarray
    grasp_y: np.ndarray
    grasp_f: np.ndarray


def arm_at(base: np.ndarray, *, upper: bool = False) -> Arm:
    """The Panda at a base (x, y, z, yaw); upper: with the frames of the links near the base."""
    arm, (few, every, grasp) = panda(), functions()
    frames = every if upper else few
    return Arm(
        base, arm.lower + LIMIT_MARGIN, arm.upper - LIMIT_MARGIN, arm.velocity, frames.x, frames.y,
        frames.handle, grasp.x, grasp.y, grasp.handle,
    )  # fmt: skip


@njit(cache=True)
def look_at_frames(arm, q):
    """Fill arm.frames_y for the configuration q (7,)."""
    for i in range(ARM):
        arm.frames_x[i] = q[i]
    for i in range(4):
        arm.frames_x[ARM + i] = arm.base[i]
    call(arm.frames_f)


@njit(cache=True)
def look_at_grasp(arm, q, target):
    """Fill arm.grasp_y for the configuration q (7,) and a hand target (TARGET,)."""
    for i in range(ARM):
        arm.grasp_x[i] = q[i]
    for i in range(4):
        arm.grasp_x[ARM + i] = arm.base[i]
    for i in range(TARGET):
        arm.grasp_x[ARM + 4 + i] = target[i]
    call(arm.grasp_f)


@njit(cache=True)
def finger_turn(arm, q0, q1):
    """By how much the finger axis (the hand's y), level at both, turns from q0 to q1, rad."""
    return _finger_angle(arm, q1) - _finger_angle(arm, q0)


@njit(cache=True)
def finger_way(arm, q, angle):
    """1 where the hand's y points along this angle (rad) at q, -1 where against it."""
    return 1.0 if math.cos(_finger_angle(arm, q) - angle) > 0 else -1.0


@njit(cache=True)
def _finger_angle(arm, q):
    look_at_frames(arm, q)
    axis = HAND * FRAME + 3 + 1
    return math.atan2(arm.frames_y[axis + 3], arm.frames_y[axis])


@cache
def functions() -> Functions:
    """Build and compile the functions (once a process)."""
    q, base, target = ca.SX.sym("q", ARM), ca.SX.sym("base", 4), ca.SX.sym("target", TARGET)
    T = ca.SX.eye(4)
    T[:3, :3] = _about_z(base[3])
    T[:3, 3] = base[:3]
    T_world, axes = {}, []
    for joint in panda().chain:
        T = T @ ca.sparsify(ca.DM(joint.origin))
        if joint.revolute:
            turn = ca.SX.eye(4)
            turn[:3, :3] = _about_z(q[len(axes)])
            T = T @ turn
            axes.append((T[:3, 2], T[:3, 3]))
        T_world[joint.child] = (T, len(axes))

    def frames_of(name: str, links: tuple[str, ...]) -> ca.Function:
        parts = []
        for link in links:
            T, moved_by = T_world[link]
            Jv, Jw = ca.SX.zeros(3, ARM), ca.SX.zeros(3, ARM)
            for i, (axis, origin) in enumerate(axes[:moved_by]):
                Jv[:, i] = ca.cross(axis, T[:3, 3] - origin)
                Jw[:, i] = axis
            parts += [T[:3, 3], ca.vec(T[:3, :3].T), ca.vec(Jv.T), ca.vec(Jw.T)]
        flat = ca.cse(ca.densify(ca.vertcat(*parts)))
        return ca.Function(name, [ca.vertcat(q, base)], [flat])

    frames = frames_of("frames", LINKS)
    all_frames = frames_of("all_frames", (*LINKS, *UPPER_LINKS))

    # Switch constraint: hand at target[:3], its z axis down but for the lean target[4] about the
    # finger axis (y), which is along angle target[3] up to half turns (the gripper is symmetric).
    R, p = T_world["panda_hand"][0][:3, :3], T_world["panda_hand"][0][:3, 3]
    along = ca.vertcat(ca.cos(target[3]), ca.sin(target[3]), 0)
    left = ca.vertcat(-ca.sin(target[3]), ca.cos(target[3]), 0)
    aside = ca.cos(target[4]) * left - ca.sin(target[4]) * ca.vertcat(0, 0, 1)
    down, fingers = R[:, 2], R[:, 1]
    level = ca.vertcat(ca.dot(down, along), ca.dot(down, aside), ca.dot(fingers, aside))
    residual = ca.vertcat(p - target[:3], level)
    flat = ca.vertcat(
        residual,
        ca.vec(ca.jacobian(residual, q).T),
        ca.vec(ca.jacobian(residual, target)[:, :4].T),
    )
    grasp = ca.Function("grasp", [ca.vertcat(q, base, target)], [ca.cse(ca.densify(flat))])
    return Functions(*load([frames, all_frames, grasp]))


def _about_z(angle):
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


# Hand-down inverse kinematics in closed form: with q3 = q5 = 0 the arm is planar, and the hand
# points down exactly when q6 = q2 - q4.
_SHOULDER, _UPPER, _OFFSET, _FORE, _WRIST = 0.333, 0.316, 0.0825, 0.384, 0.088
_L1, _L2 = math.hypot(_UPPER, _OFFSET), math.hypot(_FORE, _OFFSET)
_A1, _A2 = math.atan2(_OFFSET, _UPPER), math.atan2(_OFFSET, _FORE)


@njit(cache=True)
def hand_down(target, base, lower, upper, q, way=0.0):
    """Fill q (7,) with the planar solution for a hand target (x, y, z, finger angle) that does
    not lean.

    way: 1 or -1 for the hand's y along or against the finger angle, 0 for what turns least.
    Returns whether it exists within the joint limits.
    """
    c, s = math.cos(base[3]), math.sin(base[3])
    dx, dy = target[0] - base[0], target[1] - base[1]
    x, y = c * dx + s * dy, c * dy - s * dx
    wrist = math.sqrt(x * x + y * y) - _WRIST
    height = target[2] - base[2] + FLANGE - _SHOULDER
    reach = math.sqrt(wrist * wrist + height * height)
    if reach >= _L1 + _L2 or reach <= abs(_L1 - _L2) or reach < 1e-6:
        return False
    gamma = math.atan2(wrist, height)
    a = gamma - math.acos((_L1 * _L1 + reach * reach - _L2 * _L2) / (2 * _L1 * reach))
    b = gamma + math.acos((_L2 * _L2 + reach * reach - _L1 * _L1) / (2 * _L2 * reach))
    q[0] = math.atan2(y, x)
    q[1] = a - _A1
    q[2] = 0.0
    q[3] = q[1] - b - _A2
    q[4] = 0.0
    q[5] = q[1] - q[3]
    turn = math.pi / 2 + q[0] - (target[3] - base[3])
    if way == 0.0:
        q[6] = math.pi / 4 + turn - math.pi * math.floor(turn / math.pi + 0.5)
    else:  # the limits are not far from half a turn to both sides
        q[6] = math.pi / 4 + turn + (math.pi if way > 0 else 0.0)
        q[6] -= 2 * math.pi * math.floor(q[6] / (2 * math.pi) + 0.5)
    return (q >= lower).all() and (q <= upper).all()


def facing(way: float) -> float:
    """The finger angle against the hand's bearing from the base at which the last joint of the
    planar solution is in its middle, rad; way as in `hand_down`."""
    return 0.75 * math.pi + (math.pi if way > 0 else 0.0)


@cache
def reach_interval(height: float) -> tuple[float, float]:
    """Distances (near, far) from the base's axis that the downward hand reaches, m.

    height: of the hand over the base, m. (1, 0) when there are none. Resolution 2 mm.
    """
    arm = panda()
    return _reach_interval(height, arm.lower, arm.upper)


@njit(cache=True)
def _reach_interval(height, lower, upper):
    q, target, base = np.zeros(7), np.zeros(4), np.zeros(4)
    near, far = 1.0, 0.0
    target[2] = height
    for i in range(350):
        target[0] = 0.15 + 0.002 * i
        if hand_down(target, base, lower, upper, q, 0.0):
            near, far = min(near, target[0]), max(far, target[0])
    return near, far
