"""What is physically possible: boxes that stand, on the table, apart, and clear of the robot.

Masses are unknown: a box stands where its own centre is over what carries it, and a stack may
be as high as its boxes allow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from relevance.scene.boxes import Box, Robot, Table, footprint_gap
from relevance.scene.checks import SceneError

CONTACT_TOLERANCE = 0.001
"""How far a box may sink into or float over what it touches, m; half of what is thinner."""

# The collision meshes of the Panda's base (link 0) and first link, in the robot's frame: prisms
# inside them that hold whatever the first joint does. Outline (N, 2), from and to which height, m.
_FOOT = (
    np.array(
        [
            [-0.1316, -0.0688], [-0.0012, -0.0946], [0.0083, -0.0918], [0.0543, -0.0469],
            [0.0674, -0.0245], [0.0716, -0.0013], [0.0686, 0.0208], [0.0526, 0.0488],
            [0.0077, 0.0923], [-0.0005, 0.0947], [-0.1316, 0.0688], [-0.1454, 0.0509],
            [-0.1541, -0.0055], [-0.1488, -0.0421],
        ]
    ),
    0.0,
    0.008,
)  # fmt: skip
_TURNS = np.arange(16) * math.tau / 16
_COLUMN = (0.054 * np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1), 0.0, 0.205)
ROBOT_RADIUS = 0.16
"""Around the base's axis, m: no box farther than this touches the foot of the robot."""
_SLAB = 0.1  # how thick the table is taken to be, m


def check_boxes(objects: Sequence[Box], table: Table, robot: Robot) -> None:
    """Raise SceneError, naming the box, for the first thing that cannot be."""
    by_name: dict[str, Box] = {}
    for i, box in enumerate(objects):
        if box.name in by_name or box.name == "table":
            raise SceneError(
                f"objects.{i} ({box.name!r}): name is taken, "
                "expected distinct names other than 'table'"
            )
        by_name[box.name] = box
    radii = [math.hypot(*box.size[:2]) / 2 for box in objects]
    for i, box in enumerate(objects):
        where = f"objects.{i} ({box.name!r})"
        _check_on_table(where, box, table)
        _check_standing(where, box, by_name)
        for j, other in enumerate(objects[:i]):
            if math.dist(box.position[:2], other.position[:2]) > radii[i] + radii[j]:
                continue
            depth = -max(box.bottom - other.top, other.bottom - box.top, footprint_gap(box, other))
            if depth > 0 and depth > _tolerance(box, other):
                raise SceneError(
                    f"{where}: overlaps {other.name!r} by {1000 * depth:.1f} mm, "
                    "expected boxes apart or touching"
                )
        if robot_depth(box, robot) > _tolerance(box):
            raise SceneError(
                f"{where}: stands in the robot, whose base is at {list(robot.base)}, "
                "expected a box clear of it"
            )
    _check_cycles(objects, by_name)
    check_robot(table, robot)


def check_robot(table: Table, robot: Robot) -> None:
    """Raise SceneError when the robot stands in the table."""
    if robot.base[2] >= -CONTACT_TOLERANCE:
        return
    top = Box(name="top", size=(*table.size, _SLAB), position=(0, 0, -_SLAB / 2), color=(0, 0, 0))
    if robot_depth(top, robot) > CONTACT_TOLERANCE:
        raise SceneError(f"robot: base {list(robot.base)} is in the table, expected z at least 0")


def with_all_supports(box: Box, objects: Sequence[Box]) -> Box:
    """The box, on all that carry it where the one that its `on` names could not do so alone.

    Files of other tools name one support of a bridge.
    """
    below = next((other for other in objects if other.name == box.on), None)
    if below is None or below.covers(*box.position[:2]):
        return box
    carriers = tuple(
        other.name
        for other in objects
        if other is not box
        and abs(box.bottom - other.top) <= _tolerance(box)
        and footprint_gap(box, other) < 0
    )
    return replace(box, on=carriers) if len(carriers) > 1 and box.on in carriers else box


def _tolerance(*boxes: Box) -> float:
    """How deep these may overlap: less than what would let a thin box vanish in another."""
    return min(CONTACT_TOLERANCE, *(min(box.size) / 2 for box in boxes))


def _check_on_table(where: str, box: Box, table: Table) -> None:
    reach = (abs(at) + extent for at, extent in zip(box.position, box.extents, strict=False))
    if any(far > edge / 2 + CONTACT_TOLERANCE for far, edge in zip(reach, table.size, strict=True)):
        raise SceneError(
            f"{where}: position {list(box.position)} is off the table, "
            f"expected its footprint within +-{table.size[0] / 2:g}, +-{table.size[1] / 2:g} m"
        )


def _check_standing(where: str, box: Box, by_name: dict[str, Box]) -> None:
    """It touches all that it stands on, and its centre is over them."""
    for name in box.supports:
        if name == box.name or name not in by_name:
            raise SceneError(
                f"{where}: on = {name!r}, expected null or another object's name, or a list"
            )
    below = [by_name[name] for name in box.supports]
    for support in below or [None]:
        name, floor = ("the table", 0.0) if support is None else (repr(support.name), support.top)
        if support is not None and len(below) > 1 and footprint_gap(box, support) >= 0:
            raise SceneError(f"{where}: is not over {name}, expected to stand on all of its on")
        if abs(box.bottom - floor) > _tolerance(box):
            state = "floating above" if box.bottom > floor else "sunk into"
            raise SceneError(
                f"{where}: {state} {name}, expected position z {floor + box.size[2] / 2:g}, "
                f"found {box.position[2]:g}"
            )
    x, y, _ = box.position
    if len(below) == 1 and not below[0].covers(x, y):
        raise SceneError(
            f"{where}: floating or falling over, expected its centre over {below[0].name!r}"
        )
    if len(below) > 1 and not _within(x, y, [p for s in below for p in _contact(box, s)]):
        raise SceneError(
            f"{where}: falls over, expected its centre between the boxes that it stands on, "
            f"{list(box.supports)}"
        )


def _check_cycles(objects: Sequence[Box], by_name: dict[str, Box]) -> None:
    """Boxes thinner than the tolerance could otherwise carry each other."""
    grounded = {box.name for box in objects if not box.supports}
    waiting = [box for box in objects if box.supports]
    while ready := [box for box in waiting if grounded.issuperset(box.supports)]:
        grounded |= {box.name for box in ready}
        waiting = [box for box in waiting if box.name not in grounded]
    if waiting:
        names = [box.name for box in waiting]
        raise SceneError(f"objects: {names} carry each other, expected a way down to the table")


def _contact(a: Box, b: Box) -> np.ndarray:
    """Corners of where two footprints overlap, (K, 2), m: each edge of b cuts a."""
    points, edges = list(a.corners()), b.corners()
    for k in range(4):
        start, along = edges[k - 1], edges[k] - edges[k - 1]
        side = [along[0] * (p[1] - start[1]) - along[1] * (p[0] - start[0]) for p in points]
        kept = []
        for i, p in enumerate(points):
            if side[i - 1] * side[i] < 0:
                share = side[i - 1] / (side[i - 1] - side[i])
                kept.append(points[i - 1] + share * (p - points[i - 1]))
            if side[i] >= 0:
                kept.append(p)
        points = kept
    return np.array(points).reshape(-1, 2)


def _within(x: float, y: float, points: Sequence[np.ndarray]) -> bool:
    """Whether a point lies in the convex hull of others: they leave no half plane empty."""
    angles = sorted(math.atan2(q - y, p - x) for p, q in points)
    gaps = (after - before for before, after in pairwise(angles))
    last = [math.tau + angles[0] - angles[-1]] if angles else [math.inf]
    return max([*gaps, *last]) <= math.pi + 1e-9


def robot_depth(box: Box, robot: Robot) -> float:
    """How deep a box is in the foot or the column of the robot, m; at most 0 when it is in neither.

    A lower bound of what its meshes say.
    """
    dx, dy = box.position[0] - robot.base[0], box.position[1] - robot.base[1]
    if max(abs(dx), abs(dy)) - math.hypot(*box.size[:2]) / 2 > ROBOT_RADIUS:
        return 0.0
    c, s = math.cos(robot.yaw), math.sin(robot.yaw)
    corners = (box.corners() - robot.base[:2]) @ np.array([[c, -s], [s, c]])
    return max(0.0, *(_depth(corners, box, robot.base[2], part) for part in (_FOOT, _COLUMN)))


def _depth(
    corners: np.ndarray, box: Box, base: float, part: tuple[np.ndarray, float, float]
) -> float:
    """Separating-axis depth of a box, its corners in the robot's frame (4, 2), and a prism."""
    outline, low, high = part
    edges = np.vstack([np.diff(outline, axis=0, append=outline[:1]), np.diff(corners[:3], axis=0)])
    normals = np.stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1)
    ours, its = corners @ normals, outline @ normals
    flat = np.minimum(ours.max(axis=0) - its.min(axis=0), its.max(axis=0) - ours.min(axis=0)).min()
    return float(min(flat, box.top - base - low, base + high - box.bottom))
