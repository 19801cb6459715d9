"""An exhaustive reference for small scenes: every set of up to two moved boxes, on a dense grid.

It shares only the arm's reach and the gripper's rectangles with the planner; everything else is
brute force over positions and angles, with a separating-axis gap in numpy. A goal is solvable
with a set of boxes gone when each of them can be taken and put on the table in some order, and
then the subject can be taken and stand in the goal region, gripper included. Motions are not
looked at, and the reference box stays where it is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np

from relevance.planner.grasps import Grasp, grasps
from relevance.planner.kernels.kinematics import reach_interval
from relevance.planner.pose import LIFT
from relevance.scene import Box, Goal, Scene

CLEARANCE = 0.003
"""What the planner keeps clear as well, m."""
CELLS = 13
"""Positions along each side of a goal region."""
ANGLES = 24
"""Yaws over half a turn."""
STEP = 0.06
"""Distance of the positions that blockers may be put at, m."""
MOST = 2
"""Most boxes that are moved besides the subject."""


def shortest(scene: Scene, goal: Goal, clearance: float) -> int | None:
    """Fewest boxes to move before the subject, by exhaustion; None when MOST do not suffice.

    clearance: what a placed box and the gripper keep from everything, m. What it exceeds
    CLEARANCE by, the subject also stays inside its goal region: with more of it fewer tasks are
    solvable, namely those that do not hang on a millimetre.
    """
    others = [box.name for box in scene.objects if box.name not in (goal.subject, goal.reference)]
    for count in range(min(MOST, len(others)) + 1):
        for gone in itertools.combinations(others, count):
            away = {*gone, goal.subject}
            standing = [box for box in scene.objects if box.name not in away]
            if (
                any(_leave(scene, (*order, goal.subject)) for order in itertools.permutations(gone))
                and _stands(scene, goal, standing, clearance)
                # Any free place does for the blockers: scenes this small have room for each.
                and all(
                    _has_room(scene, scene[name], [*standing, scene[goal.subject]], clearance)
                    for name in gone
                )
            ):
                return count
    return None


def _leave(scene: Scene, order: Sequence[str]) -> bool:
    """Whether these boxes can be taken one after the other."""
    standing = list(scene.objects)
    for name in order:
        box = scene[name]
        standing.remove(box)
        if any(other.on == name for other in standing) or not _takes(scene, box, standing):
            return False
    return True


def _takes(scene: Scene, box: Box, standing: Sequence[Box]) -> bool:
    """Whether some grasp takes the box where it stands."""
    at = np.array([[*box.position[:2], box.yaw]])
    return any(
        _reachable(scene, at, box, box.bottom, grasp).any()
        and (_gaps(at, grasp, box.bottom, standing, hand_only=True) >= CLEARANCE).any()
        for grasp in grasps(box)
    )


def _stands(scene: Scene, goal: Goal, standing: Sequence[Box], clearance: float) -> bool:
    subject, reference = scene[goal.subject], scene[goal.reference]
    bottom = reference.top if goal.predicate.stacked else 0.0
    poses = _poses(_region(scene, goal, clearance - CLEARANCE))
    return _free(scene, subject, poses, bottom, standing, clearance)


def _has_room(scene: Scene, box: Box, standing: Sequence[Box], clearance: float) -> bool:
    half = np.array(scene.table.size) / 2
    axes = [np.arange(-h, h + STEP, STEP) for h in half]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    others = [other for other in standing if other.name != box.name]
    return _free(scene, box, _poses(points), 0.0, others, clearance)


def _region(scene: Scene, goal: Goal, inset: float) -> np.ndarray:
    """Grid points (N, 2) of the goal region for the subject's centre, from border to border."""
    steps = np.linspace(-1, 1, CELLS)
    there = goal.predicate.region(scene[goal.subject], scene[goal.reference], scene.robot)
    half = [max(extent - inset, 0.0) for extent in there.half]
    a, b = np.meshgrid(steps * half[0], steps * half[1])
    c, s = math.cos(there.angle), math.sin(there.angle)
    local = np.stack([c * a - s * b, s * a + c * b], axis=-1)
    return local.reshape(-1, 2) + np.array([there.x, there.y])


def _poses(points: np.ndarray) -> np.ndarray:
    """(N * ANGLES, 3): every point with every yaw."""
    yaws = np.arange(ANGLES) * math.pi / ANGLES
    return np.column_stack([np.repeat(points, ANGLES, axis=0), np.tile(yaws, len(points))])


def _free(
    scene: Scene,
    box: Box,
    poses: np.ndarray,
    bottom: float,
    standing: Sequence[Box],
    clearance: float,
) -> bool:
    """Whether the box, in some grasp, fits in one of the poses (N, 3), x, y, yaw."""
    c, s = np.abs(np.cos(poses[:, 2])), np.abs(np.sin(poses[:, 2]))
    a, b = box.size[0] / 2, box.size[1] / 2
    extent = np.column_stack([c * a + s * b, s * a + c * b])
    poses = poses[(np.abs(poses[:, :2]) + extent <= np.array(scene.table.size) / 2).all(axis=1)]
    for grasp in grasps(box):
        kept = poses[_reachable(scene, poses, box, bottom, grasp)]
        if (_gaps(kept, grasp, bottom, standing) >= clearance).any():
            return True
    return False


def _reachable(
    scene: Scene, poses: np.ndarray, box: Box, bottom: float, grasp: Grasp
) -> np.ndarray:
    """Which positions the downward hand reaches, at the box and lifted (N,) bool."""
    base = scene.robot.base
    height = bottom + box.size[2] / 2 + grasp.above - base[2]
    r = np.hypot(poses[:, 0] - base[0], poses[:, 1] - base[1])
    good = np.ones(len(poses), dtype=bool)
    for z in (height, height + LIFT):
        near, far = reach_interval(round(z, 3))
        good &= (r >= near + 0.004) & (r <= far - 0.004)
    return good


def _gaps(
    poses: np.ndarray,
    grasp: Grasp,
    bottom: float,
    standing: Iterable[Box],
    *,
    hand_only: bool = False,
) -> np.ndarray:
    """Least gap (N,) of box and gripper to what rises above their undersides, m."""
    best = np.full(len(poses), np.inf)
    angle = poses[:, 2] + grasp.axis * math.pi / 2
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (N, 2), the finger axis
    for i, (offset, _, along, across, under) in enumerate(grasp.parts):
        if i == 0 and hand_only:
            continue
        centre = poses[:, :2] + offset * axes
        low = bottom + under
        for other in standing:
            # The box itself comes down onto its support, the gripper stays clear of it.
            if other.top > low + (1e-3 if i == 0 else -0.003):
                best = np.minimum(best, _gap(centre, axes, along, across, other))
    return best


def _gap(
    centre: np.ndarray, axes: np.ndarray, along: float, across: float, other: Box
) -> np.ndarray:
    """Separating-axis gap (N,) of N equal rectangles and a box's footprint, m."""
    d = np.array(other.position[:2]) - centre
    normal = np.stack([-axes[:, 1], axes[:, 0]], axis=-1)
    c, s = math.cos(other.yaw), math.sin(other.yaw)
    u, v = np.array([c, s]), np.array([-s, c])
    a, b = other.size[0] / 2, other.size[1] / 2
    cos, sin = np.abs(axes @ u), np.abs(axes @ v)  # of the angle between the two
    return np.max(
        [
            np.abs((d * axes).sum(axis=1)) - along - a * cos - b * sin,
            np.abs((d * normal).sum(axis=1)) - across - a * sin - b * cos,
            np.abs(d @ u) - a - along * cos - across * sin,
            np.abs(d @ v) - b - along * sin - across * cos,
        ],
        axis=0,
    )
