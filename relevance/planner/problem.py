"""One planning problem: scene, goal, what stands there, and the count of the work.

What all nodes of a search and all bounds share. Everything is deterministic: limits count
evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import njit

from relevance.holding.hand import REGION_MARGIN
from relevance.planner import logic
from relevance.planner.kernels.kinematics import Arm, arm_at
from relevance.planner.result import Counts, Seconds
from relevance.robot import panda
from relevance.scene import CONTACT_TOLERANCE, Box, Goal, Rectangle, Scene, footprint_gap
from relevance.scene.geometry import UPRIGHT, upright

LOW = 0.2
"""Height over the robot's base below which only the hand and the forearm can be, m."""
ROUNDING = 1e-9
"""A box that is sunk less into what is below it stands on that, m."""
CLOSE = 2e-4
"""A decision that turns over when something stands this much elsewhere is a close one, m."""


@dataclass
class Problem:
    """A scene and a goal, ready for search."""

    scene: Scene
    goal: Goal
    counts: Counts = field(default_factory=Counts)
    seconds: Seconds = field(default_factory=Seconds)
    undecided: bool = False
    """Whether a pose bound was left open on the way, or decided by less than CLOSE: the row is
    flagged ambiguous."""
    open: set[str] = field(default_factory=set)
    """What the bounds were asked and could not decide."""
    boxes: dict[str, Box] = field(init=False)
    index: dict[str, int] = field(init=False)
    above: dict[str, frozenset[str]] = field(init=False)
    """For each object, the objects that stand directly on it."""
    table: np.ndarray = field(init=False)
    """(2,) half extents, m."""
    obstacles: np.ndarray = field(init=False)
    """(N + 2, UPRIGHT): the boxes as they stand at first, then the table and the robot's foot."""
    tall: bool = field(init=False)
    """Whether a box is so high that it could meet the links near the base."""
    arm: Arm = field(init=False)
    _regions: dict[tuple, tuple[np.ndarray, ...]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.boxes = {box.name: box for box in self.scene.objects}
        self.index = {name: i for i, name in enumerate(self.boxes)}
        base = np.array([*self.scene.robot.base, self.scene.robot.yaw])
        self.arm = arm_at(base)
        self.table = np.array(self.scene.table.size) / 2
        standing = [obstacle(box) for box in self.scene.objects]
        self.obstacles = np.array([*standing, *self._fixtures()])
        tops = [box.top for box in self.scene.objects]
        self.tall = max(tops) - self.scene.robot.base[2] > LOW
        self.above = logic.stacked_on(self.scene)

    @cached_property
    def whole_arm(self) -> Arm:
        """The arm with the links near the base."""
        return arm_at(self.arm.base, upper=True)

    @property
    def subject(self) -> Box:
        """What the goal is about, where it stands at first."""
        return self.boxes[self.goal.subject]

    @property
    def reference(self) -> Box:
        """What the goal relates it to, where it stands at first."""
        return self.boxes[self.goal.reference]

    @cached_property
    def _sunk(self) -> dict[int, dict[int, float]]:
        """How deep boxes are sunk into others beside them (a scene may have that), m."""
        found: dict[int, dict[int, float]] = {}
        for i, k in _neighbours(self.obstacles[: len(self.boxes)]).tolist():
            sunk = -footprint_gap(self.scene.objects[i], self.scene.objects[k])
            if sunk > 0:
                found.setdefault(i, {})[k] = found.setdefault(k, {})[i] = sunk
        return found

    @cached_property
    def _sunk_under(self) -> dict[int, dict[int, float]]:
        """How deep boxes are sunk into what is below them, the table too, m."""
        count = len(self.boxes)
        found: dict[int, dict[int, float]] = {}
        tops = self.obstacles[: count + 1, 2] + self.obstacles[: count + 1, 6]
        for i, box in enumerate(self.scene.objects):
            deep = tops - box.bottom
            for k in np.flatnonzero((deep > ROUNDING) & (deep <= CONTACT_TOLERANCE)).tolist():
                if k == count or footprint_gap(box, self.scene.objects[k]) < 0:
                    found.setdefault(i, {})[k] = float(deep[k])
        return found

    def beside(self, i: int, obstacles: np.ndarray) -> np.ndarray:
        """Obstacles as box i meets them while it rises from where it stood at first: what it is
        sunk into and still stands there is shrunk or lowered, so that they only touch."""
        rows = obstacles.copy()
        for k, sunk in self._sunk.get(i, {}).items():
            if (rows[k] == self.obstacles[k]).all():
                x, y, z, yaw, hx, hy, hz = rows[k, :7]
                hx, hy = max(hx - sunk, 1e-4), max(hy - sunk, 1e-4)
                upright(x, y, z, yaw, hx, hy, hz, rows[k])
        for k, sunk in self._sunk_under.get(i, {}).items():
            if (rows[k] == self.obstacles[k]).all():
                x, y, z, yaw, hx, hy, hz = rows[k, :7]
                upright(x, y, z - sunk, yaw, hx, hy, hz, rows[k])
        return rows

    def _fixtures(self) -> list[np.ndarray]:
        """What always stands there, as obstacles: the table and the robot's foot."""
        table = np.empty(UPRIGHT)
        upright(0.0, 0.0, -0.05, 0.0, self.table[0], self.table[1], 0.05, table)
        return [table, self._of_robot(*panda().foot)]

    @cached_property
    def shoulder(self) -> np.ndarray:
        """(1, UPRIGHT): the arm's first link, where joint 1 is at 0."""
        return self._of_robot(*panda().shoulder)[None]

    @cached_property
    def pillar(self) -> np.ndarray:
        """(1, UPRIGHT): about what the first link fills, wherever joint 1 is."""
        (_, _, z), (_, across, high) = panda().shoulder
        return self._of_robot(np.array([0.0, 0.0, z]), np.array([across, across, high]))[None]

    def _of_robot(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """A box of the base's frame as an obstacle."""
        row, (bx, by, bz, yaw) = np.empty(UPRIGHT), self.arm.base
        (x, y, z), (hx, hy, hz) = centre, half
        c, s = math.cos(yaw), math.sin(yaw)
        upright(bx + c * x - s * y, by + s * x + c * y, bz + z, yaw, hx, hy, hz, row)
        return row

    def standing(self, gone: Collection[str]) -> np.ndarray:
        """The boxes that have not gone, as obstacles."""
        stays = [i for name, i in self.index.items() if name not in gone]
        return self.obstacles[stays]

    def goal_regions(self, reference: Box) -> tuple[np.ndarray, ...]:
        """Rectangles for the subject's centre: x, y, angle, half extents (5,) each."""
        place = (reference.position, reference.yaw)
        if place not in self._regions:
            region = self.goal.predicate.region(self.subject, reference, self.scene.robot)
            self._regions[place] = tuple(map(_area, region.rectangles))
        return self._regions[place]

    def goal_region(self, reference: Box, x: float, y: float) -> np.ndarray:
        """The one of them that a point lies in, the deepest."""
        return min(self.goal_regions(reference), key=lambda area: _outside(area, x, y))


def _area(there: Rectangle) -> np.ndarray:
    half = [max(extent - REGION_MARGIN, 0.0) for extent in there.half]
    return np.array([there.x, there.y, there.angle, *half])


def _outside(area: np.ndarray, x: float, y: float) -> float:
    """How far a point lies outside a rectangle (5,), along its axes; negative inside, m."""
    c, s = math.cos(area[2]), math.sin(area[2])
    dx, dy = x - area[0], y - area[1]
    return max(abs(c * dx + s * dy) - area[3], abs(c * dy - s * dx) - area[4])


@njit(cache=True)
def _neighbours(rows):
    """The pairs (K, 2) of boxes (N, UPRIGHT) whose footprints could overlap at the same height."""
    found, count = np.empty((len(rows) * (len(rows) - 1) // 2, 2), np.int64), 0
    for i in range(len(rows)):
        for k in range(i + 1, len(rows)):
            a, b = rows[i], rows[k]
            apart = math.hypot(a[0] - b[0], a[1] - b[1])
            # what stands on another is not beside it
            if apart < a[7] + b[7] and abs(a[2] - b[2]) < a[6] + b[6] - 1e-3:
                found[count, 0], found[count, 1] = i, k
                count += 1
    return found[:count]


def obstacle(box: Box) -> np.ndarray:
    """The box as an obstacle row (UPRIGHT,), m and rad."""
    row = np.empty(UPRIGHT)
    x, y, z = box.position
    upright(x, y, z, box.yaw, box.size[0] / 2, box.size[1] / 2, box.size[2] / 2, row)
    return row
