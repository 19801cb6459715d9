"""The Panda: kinematics and switch constraints in casadi, geometry and limits from its URDF.

casadi is where they are defined, once; `kernels.native` makes them callable from the solvers.
Frames: `link5`, `link6` and `hand` (panda_hand; z out of the palm, fingers move along +-y).
The base pose is a parameter (x, y, z, yaw) of every function.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
from numba import njit

from relevance.planner.kernels.native import Native, call, load
from relevance.simulation import panda_urdf

ARM = 7
LINKS = ("panda_link5", "panda_link6", "panda_hand")
FRAME = 54
"""Numbers a frame takes in the output of `frames`: p (3), R (9), Jv (21), Jw (21), row-major."""
HAND = 2
"""Index of the hand in LINKS."""
HOME = np.array([0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398])
"""Franka's ready pose: hand down, high over the near part of the table."""
PADDING = 0.001
"""Added to every box that stands for a link's mesh, m (pybullet inflates hulls by as much)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panda:
    """What the planner knows of the arm."""

    lower: np.ndarray
    """(7,) rad."""
    upper: np.ndarray
    velocity: np.ndarray
    """(7,) rad/s."""
    arm: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    """Boxes around links: (index in LINKS, centre (3,), half extents (3,)) in that link's frame."""
    foot: tuple[np.ndarray, np.ndarray]
    """Box (centre, half extents) around the link that does not move, in the base's frame."""
    finger: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Boxes (low corner, high corner) of the left finger at opening 0, in the hand's frame."""
    finger_tip: float
    """Distance of the finger tips from the hand's origin, along its z, m."""
    palm: float
    """Distance of the palm from the hand's origin, along its z, m."""
    max_opening: float
    frames: Native
    """x = (q (7), base (4)); y = 3 frames of FRAME numbers."""
    grasp: Native
    """x = (q (7), base (4), target (4)); y = residual (6), d/dq (6 x 7), d/dtarget (6 x 4)."""


LIMIT_MARGIN = 1e-3
"""How far inside the joint limits the solvers aim, rad: more than they may be off."""


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


def arm_at(base: np.ndarray) -> Arm:
    """The Panda at a base (x, y, z, yaw)."""
    arm = panda()
    frames, grasp = arm.frames, arm.grasp
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
    """Fill arm.grasp_y for the configuration q (7,) and a hand target (4,)."""
    for i in range(ARM):
        arm.grasp_x[i] = q[i]
    for i in range(4):
        arm.grasp_x[ARM + i], arm.grasp_x[ARM + 4 + i] = arm.base[i], target[i]
    call(arm.grasp_f)


@njit(cache=True)
def finger_turn(arm, q0, q1):
    """By how much the downward hand's finger axis (its y) turns from q0 to q1, rad."""
    return _finger_angle(arm, q1) - _finger_angle(arm, q0)


@njit(cache=True)
def _finger_angle(arm, q):
    look_at_frames(arm, q)
    axis = HAND * FRAME + 3 + 1
    return math.atan2(arm.frames_y[axis + 3], arm.frames_y[axis])


@cache
def panda() -> Panda:
    """Read the URDF, build and compile the functions (once a process)."""
    path = panda_urdf()
    root = ElementTree.parse(path).getroot()
    joints = {joint.findtext("child") or _child(joint): joint for joint in root.iter("joint")}
    q, base, target = ca.SX.sym("q", ARM), ca.SX.sym("base", 4), ca.SX.sym("target", 4)
    T = ca.SX.eye(4)
    T[:3, :3] = _rotation(0, 0, base[3])
    T[:3, 3] = base[:3]
    names = [f"panda_link{i}" for i in range(1, 9)] + ["panda_hand"]
    T_world, axes, limits = {}, [], []
    for name in names:
        joint = joints[name]
        T = T @ _origin(joint)
        if joint.get("type") == "revolute":
            turn = ca.SX.eye(4)
            turn[:3, :3] = _rotation(0, 0, q[len(axes)])
            T = T @ turn  # every revolute joint of the Panda turns about its own z
            axes.append((T[:3, 2], T[:3, 3]))
            limit = joint.find("limit")
            assert limit is not None
            limits.append([float(limit.get(key, "nan")) for key in ("lower", "upper", "velocity")])
        T_world[name] = (T, len(axes))

    parts = []
    for name in LINKS:
        T, moved_by = T_world[name]
        Jv, Jw = ca.SX.zeros(3, ARM), ca.SX.zeros(3, ARM)
        for i, (axis, origin) in enumerate(axes[:moved_by]):
            Jv[:, i] = ca.cross(axis, T[:3, 3] - origin)
            Jw[:, i] = axis
        parts += [T[:3, 3], ca.vec(T[:3, :3].T), ca.vec(Jv.T), ca.vec(Jw.T)]
    frames = ca.Function("frames", [ca.vertcat(q, base)], [ca.cse(ca.densify(ca.vertcat(*parts)))])

    # Switch constraint: hand at target[:3], z axis down, finger axis (y) along angle target[3]
    # up to half turns (the gripper is symmetric).
    R, p = T_world["panda_hand"][0][:3, :3], T_world["panda_hand"][0][:3, 3]
    across = -ca.sin(target[3]) * R[0, 1] + ca.cos(target[3]) * R[1, 1]
    residual = ca.vertcat(p - target[:3], R[0, 2], R[1, 2], across)
    flat = ca.vertcat(
        residual,
        ca.vec(ca.jacobian(residual, q).T),
        ca.vec(ca.jacobian(residual, target).T),
    )
    grasp = ca.Function("grasp", [ca.vertcat(q, base, target)], [ca.cse(ca.densify(flat))])
    native_frames, native_grasp = load([frames, grasp])

    meshes = path.parent / "meshes" / "collision"
    turn7 = np.asarray(ca.DM(_origin(joints["panda_hand"])))[:3, :3]
    shift7 = np.array([0.0, 0.0, _numbers(joints["panda_link8"], "xyz")[2]])
    link7 = (_vertices(meshes / "link7.obj") - shift7) @ turn7
    arm = (
        (0, *_box(_vertices(meshes / "link5.obj"))),
        (1, *_box(_vertices(meshes / "link6.obj"))),
        (HAND, *_box(link7)),
        (HAND, *_box(_vertices(meshes / "hand.obj"))),
    )
    mount = _numbers(joints["panda_leftfinger"], "xyz")
    finger = _vertices(meshes / "finger.obj") + mount
    middle = 0.5 * (finger[:, 2].min() + finger[:, 2].max())
    bounds = np.array(limits)
    opening = joints["panda_leftfinger"].find("limit")
    assert opening is not None
    return Panda(
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        velocity=bounds[:, 2],
        arm=arm,
        foot=_box(_vertices(meshes / "link0.obj")),
        finger=(_slice(finger, middle, np.inf), _slice(finger, -np.inf, middle)),
        finger_tip=float(finger[:, 2].max()),
        palm=float(_vertices(meshes / "hand.obj")[:, 2].max()),
        max_opening=float(opening.get("upper", "nan")),
        frames=native_frames,
        grasp=native_grasp,
    )


def _child(joint: ElementTree.Element) -> str:
    child = joint.find("child")
    assert child is not None
    return child.get("link", "")


def _numbers(joint: ElementTree.Element, key: str) -> np.ndarray:
    origin = joint.find("origin")
    text = origin.get(key, "0 0 0") if origin is not None else "0 0 0"
    return np.array([float(part) for part in text.split()])


def _rotation(roll, pitch, yaw):
    cr, sr, cp, sp = ca.cos(roll), ca.sin(roll), ca.cos(pitch), ca.sin(pitch)
    cy, sy = ca.cos(yaw), ca.sin(yaw)
    return ca.vertcat(
        ca.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        ca.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        ca.horzcat(-sp, cp * sr, cp * cr),
    )


def _origin(joint: ElementTree.Element):
    T = ca.DM.eye(4)
    T[:3, :3] = np.round(np.asarray(ca.DM(_rotation(*_numbers(joint, "rpy")))), 12)
    T[:3, 3] = _numbers(joint, "xyz")
    return ca.sparsify(T)


def _vertices(path: Path) -> np.ndarray:
    lines = (line.split() for line in path.read_text().splitlines() if line.startswith("v "))
    return np.array([[float(part) for part in line[1:4]] for line in lines])


def _box(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = vertices.min(0), vertices.max(0)
    return (low + high) / 2, (high - low) / 2 + PADDING


def _slice(vertices: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box of the part of the convex hull between two heights."""
    # Here and not above: it takes most of a second to load, and only reading the URDF needs it.
    from scipy.spatial import ConvexHull

    inside = vertices[(vertices[:, 2] >= low) & (vertices[:, 2] <= high)]
    cuts = [inside]
    for plane in (low, high):
        if np.isfinite(plane):
            edges = ConvexHull(vertices).simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
            a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
            crosses = (a[:, 2] - plane) * (b[:, 2] - plane) < 0
            a, b = a[crosses], b[crosses]
            t = (plane - a[:, 2]) / (b[:, 2] - a[:, 2])
            cuts.append(a + t[:, None] * (b - a))
    part = np.vstack(cuts)
    return part.min(0) - PADDING, part.max(0) + PADDING


# Hand-down inverse kinematics in closed form: with q3 = q5 = 0 the arm is planar, and the hand
# points down exactly when q6 = q2 - q4.
_SHOULDER, _UPPER, _OFFSET, _FORE, _WRIST, _FLANGE = 0.333, 0.316, 0.0825, 0.384, 0.088, 0.107
_L1, _L2 = math.hypot(_UPPER, _OFFSET), math.hypot(_FORE, _OFFSET)
_A1, _A2 = math.atan2(_OFFSET, _UPPER), math.atan2(_OFFSET, _FORE)


@njit(cache=True)
def hand_down(target, base, lower, upper, q):
    """Fill q (7,) with the planar solution for a hand target (x, y, z, finger angle).

    Returns whether it exists within the joint limits.
    """
    c, s = math.cos(base[3]), math.sin(base[3])
    dx, dy = target[0] - base[0], target[1] - base[1]
    x, y = c * dx + s * dy, c * dy - s * dx
    wrist = math.sqrt(x * x + y * y) - _WRIST
    height = target[2] - base[2] + _FLANGE - _SHOULDER
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
    q[6] = math.pi / 4 + turn - math.pi * math.floor(turn / math.pi + 0.5)
    return (q >= lower).all() and (q <= upper).all()


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
        if hand_down(target, base, lower, upper, q):
            near, far = min(near, target[0]), max(far, target[0])
    return near, far
