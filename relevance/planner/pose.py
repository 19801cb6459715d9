"""Pose bound: can the hand take this box, and can the box stand there?

Everything is planar here. A box in the downward hand is a set of rectangles that share one
angle (box, finger tips, fingers, hand), each with the height of its underside; it comes
straight down, so an obstacle matters to a part iff it rises above that underside. Whether a
free pose exists in a region is decided by branch and bound over (x, y, angle): clearance is
Lipschitz, so a cell whose centre overlaps by more than its radius holds no free pose.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numba import njit

from relevance.planner.grasps import Grasp, grasps, pick_target
from relevance.planner.kernels.kinematics import reach_interval
from relevance.planner.problem import CLOSE, Problem, obstacle
from relevance.scene import Box
from relevance.scene.geometry import UPRIGHT, rectangle_gap, upright

MARGIN = 0.003
"""Clearance that placements keep, m; the later bounds ask for less, so they never refuse it."""
PICK_MARGIN = 0.003
"""Clearance of the gripper around a box that it takes, m."""
COMFORT = 0.008
"""Clearance beyond MARGIN with which a pose is taken at once, m."""
NODE_LIMIT = 4000
MAX_LEVEL = 6
LIFT = 0.08
"""Height by which a grasped box must be liftable within reach, m."""
TABLE_MARGIN = 0.005
"""Distance kept from the table's edge by what is only put aside, m."""
REACH_MARGIN = 0.004
"""Distance kept from the ends of the arm's reach, m."""
REFERENCE_PLACES = ((0.0, 0.0), (-0.1, 0.25), (-0.1, -0.25), (0.1, 0.15), (0.1, -0.15))
"""Where to look for room for a reference that is moved (x, y), m."""
SKY = 2.0
"""Height up to which the hand and what is above it count as an obstacle, m."""

FOUND, NONE, UNDECIDED = 1, 0, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where a moved box goes and how it is held."""

    grasp: Grasp
    pose: tuple[float, float, float]
    """x, y, angle of the finger axis."""


class PoseBound:
    """Who is in the way of whom, and where boxes may stand; remembers what it was asked."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._blockers: dict[str, dict[Grasp, frozenset[str]]] = {}
        self._goal_poses: dict[tuple, tuple[float, float, float] | None] = {}

    def blockers(self, name: str) -> dict[Grasp, frozenset[str]]:
        """The grasps of an object, and who must have left before it can be picked that way."""
        problem = self.problem
        if name not in self._blockers:
            began = time.process_time()
            problem.counts.pose += 1
            i, box, found = problem.index[name], problem.boxes[name], {}
            count = len(problem.boxes)
            boxes, blocking = problem.obstacles[:count], np.zeros(count, np.bool_)
            for grasp in grasps(box):
                if self._reachable(box, grasp):
                    gap = pick_blockers(i, grasp.axis, grasp.parts, boxes, blocking)
                    problem.undecided |= gap < CLOSE
                    found[grasp] = frozenset(compress(problem.boxes, blocking.tolist()))
            self._blockers[name] = found
            problem.seconds.pose += time.process_time() - began
        return self._blockers[name]

    def grasps(self, name: str) -> tuple[Grasp, ...]:
        """The grasps with which an object can be reached where it stands at first."""
        return tuple(self.blockers(name))

    def pickable(self, name: str, gone: frozenset[str]) -> tuple[Grasp, ...]:
        """Grasps with which the object can be taken once the objects in `gone` have left."""
        self.problem.counts.pose += 1
        if not self.problem.above[name] <= gone:
            return ()
        return tuple(grasp for grasp, who in self.blockers(name).items() if who <= gone)

    def goal_pose(
        self, gone: frozenset[str], grasp: Grasp, reference: Box
    ) -> tuple[float, float, float] | None:
        """A free pose of the subject that makes the goal true once `gone` have left.

        None refuses every sequence that moves no others: whoever has left is ignored here, so
        the bound is a relaxation.
        """
        key = (gone, grasp.axis, reference.position, reference.yaw)
        if key in self._goal_poses:
            return self._goal_poses[key]
        problem = self.problem
        subject = problem.subject
        bottom = reference.top if problem.goal.predicate.stacked else 0.0
        standing = problem.standing(gone | {subject.name, reference.name})
        standing = np.vstack([standing, obstacle(reference)])
        area = problem.goal_region(reference)
        self._goal_poses[key] = self._find(area, area[:2], bottom, subject, grasp, standing)
        return self._goal_poses[key]

    def place_all(self, order: tuple[str, ...], grasp: Grasp) -> list[Placement] | None:
        """Poses for every moved box: first the subject's, then the others' around it.

        Placing the subject first loses fewer tasks than placing greedily in time order.
        """
        subject = self.problem.subject
        gone = frozenset(order)
        for reference in self._references(order):
            pose = self.goal_pose(gone - {subject.name}, grasp, reference)
            if pose is None:
                continue
            bottom = reference.top if self.problem.goal.predicate.stacked else 0.0
            kept = volumes(grasp.parts, pose, bottom, bottom + subject.size[2], SKY)
            found = self._place_blockers(order, kept, reference)
            if found is not None:
                return [*found, Placement(grasp=grasp, pose=pose)]
        return None

    def _reachable(self, box: Box, grasp: Grasp) -> bool:
        base = self.problem.scene.robot.base
        near, far = interval(base, box.bottom, box, grasp)
        r = math.hypot(box.position[0] - base[0], box.position[1] - base[1])
        self.problem.undecided |= min(abs(r - near), abs(r - far)) < CLOSE
        return near <= r <= far

    def _find(
        self,
        area: np.ndarray,
        prefer: Sequence[float] | np.ndarray,
        bottom: float,
        box: Box,
        grasp: Grasp,
        obstacles: np.ndarray,
    ) -> tuple[float, float, float] | None:
        """A pose in an area (5,) at which the box can be put down clear of obstacles (W, UPRIGHT).

        bottom: height of what it is put on, m.
        """
        began, problem = time.process_time(), self.problem
        problem.counts.pose += 1
        near, far = interval(problem.scene.robot.base, bottom, box, grasp)
        pose = np.zeros(3)

        def find(ease: float) -> tuple[int, float]:
            return find_pose(
                area, np.array(prefer), bottom, grasp.parts, obstacles, problem.table,
                problem.arm.base, near, far, ease, pose,
            )  # fmt: skip

        status, slack = find(0.0)
        found = (float(pose[0]), float(pose[1]), float(pose[2])) if status == FOUND else None
        close = slack < CLOSE if found else status == UNDECIDED or find(CLOSE)[0] != NONE
        problem.undecided |= close
        problem.seconds.pose += time.process_time() - began
        return found

    def _references(self, order: tuple[str, ...]) -> Iterator[Box]:
        """The reference where it stands, or where it might be put if the order moves it."""
        reference = self.problem.reference
        if reference.name not in order:
            yield reference
            return
        i = order.index(reference.name)
        obstacles = self._when_landing(order, i, reference)
        grasp = self.pickable(reference.name, frozenset(order[:i]))[0]
        for prefer in REFERENCE_PLACES:
            pose = self._find(self._table(), prefer, 0.0, reference, grasp, obstacles)
            if pose is not None:
                yield moved_box(reference, Placement(grasp=grasp, pose=pose))

    def _when_landing(self, order: tuple[str, ...], i: int, box: Box) -> np.ndarray:
        """What the i-th moved box must stay clear of: the boxes that still stand then, and where
        the gripper will be when it takes the later ones."""
        top = box.size[2] + MARGIN
        hands = np.vstack([np.empty((0, UPRIGHT)), *self._later_picks(order[i + 1 :])])
        standing = self.problem.standing(order[: i + 1])
        return np.vstack([standing, hands[_underside(hands) < top]])

    def _table(self) -> np.ndarray:
        return np.array([0.0, 0.0, 0.0, *(self.problem.table - TABLE_MARGIN)])

    def _place_blockers(
        self, order: tuple[str, ...], kept: np.ndarray, reference: Box
    ) -> list[Placement] | None:
        """Free table poses of all but the last, clear of what is still there when they land.

        kept (P, UPRIGHT): where the subject and the hand with it will be.
        """
        placed: list[Placement] = []
        landed = np.empty((0, UPRIGHT))
        for i, name in enumerate(order[:-1]):
            box = self.problem.boxes[name]
            prefer, area, reserved = box.position[:2], self._table(), kept
            if name == reference.name:
                prefer, reserved = reference.position[:2], kept[:0]  # kept was laid out around it
                area = np.array([*prefer, 0.0, 0.002, 0.002])
            elif reference.name in order[i:]:
                grasp = self.grasps(reference.name)[0]
                pose = (*reference.position[:2], reference.yaw + grasp.axis * math.pi / 2)
                there = volumes(grasp.parts, pose, 0.0, reference.top, SKY)
                reserved = np.vstack([kept, there])
            reserved = reserved[_underside(reserved) < box.size[2] + MARGIN]
            obstacles = np.vstack([self._when_landing(order, i, box), landed, reserved])
            found = None
            for grasp in self.pickable(name, frozenset(order[:i])):
                pose = self._find(area, prefer, 0.0, box, grasp, obstacles)
                if pose is not None:
                    found = Placement(grasp=grasp, pose=pose)
                    break
            if found is None:
                return None
            placed.append(found)
            landed = np.vstack([landed, obstacle(moved_box(box, found))])
        return placed

    def _later_picks(self, names: tuple[str, ...]) -> list[np.ndarray]:
        """Where the gripper will be when it takes these boxes."""
        found = []
        for name in names:
            box, grasp = self.problem.boxes[name], self.grasps(name)[0]
            x, y, _, angle = pick_target(box, grasp)
            found.append(volumes(grasp.parts, (x, y, angle), box.bottom, 0.0, SKY)[1:])
        return found


def interval(
    base: tuple[float, float, float], bottom: float, box: Box, grasp: Grasp
) -> tuple[float, float]:
    """Reach (near, far) for holding the box with its underside at this height, liftably, m."""
    z = bottom + box.size[2] / 2 + grasp.above - base[2]
    # Heights in whole millimetres, to compute each once; REACH_MARGIN covers the rest.
    near, far = reach_interval(round(z, 3))
    near_up, far_up = reach_interval(round(z + LIFT, 3))
    return max(near, near_up) + REACH_MARGIN, min(far, far_up) - REACH_MARGIN


def moved_box(box: Box, place: Placement) -> Box:
    """The box where it was put on the table."""
    x, y, angle = place.pose
    yaw = angle - place.grasp.axis * math.pi / 2
    return replace(box, position=(x, y, box.size[2] / 2), yaw=yaw, on=None)


def _underside(rows: np.ndarray) -> np.ndarray:
    """Heights of the undersides of obstacle rows, m."""
    return rows[:, 2] - rows[:, 6]


@njit(cache=True)
def pick_blockers(i, axis, parts, obstacles, blocking):
    """Fill blocking (N,) bool: which boxes are in the way of taking box i with this grasp.

    obstacles (N, UPRIGHT): all the boxes. Returns how close the closest decision was, m.
    """
    closest = 1.0
    o = obstacles[i]
    angle = o[3] + axis * math.pi / 2
    bottom, top = o[2] - o[6], o[2] + o[6]
    for k in range(len(obstacles)):
        other = obstacles[k : k + 1]
        blocking[k] = False
        if k == i:
            continue
        gap = clearance(o[0], o[1], angle, bottom, parts[1:], other) - PICK_MARGIN
        if other[0, 2] - other[0, 6] >= top - 2e-3:  # what overhangs the box blocks the way up
            gap = min(gap, clearance(o[0], o[1], angle, top, parts[:1], other))
        blocking[k] = gap < 0
        closest = min(closest, abs(gap))
    return closest


@njit(cache=True)
def clearance(x, y, angle, bottom, parts, obstacles):
    """Smallest separating-axis distance of parts and the obstacles that rise above them, m."""
    best = 1.0
    c, s = math.cos(angle), math.sin(angle)
    for i in range(len(parts)):
        offset, along, across, under = parts[i, 0], parts[i, 1], parts[i, 2], parts[i, 3]
        px, py = x + c * offset, y + s * offset
        radius = math.sqrt(along * along + across * across)
        for k in range(len(obstacles)):
            o = obstacles[k]
            above = o[2] + o[6] - bottom - under
            if above <= -MARGIN or (under == 0.0 and abs(above) < 1e-6):  # the box's own support
                continue
            flat = radius + o[7] + best
            dx, dy = o[0] - px, o[1] - py
            if dx * dx + dy * dy > flat * flat:
                continue
            gap = rectangle_gap(px, py, c, s, along, across, o[0], o[1], o[8], o[9], o[4], o[5])
            best = min(best, gap)
    return best


@njit(cache=True)
def volumes(parts, pose, bottom, top, sky):
    """The box at a pose and the gripper that puts it there, as rows up to the sky, (P, UPRIGHT)."""
    rows = np.empty((len(parts), UPRIGHT))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(parts)):
        low, high = bottom + parts[i, 3], top if i == 0 else sky
        x, y = pose[0] + c * parts[i, 0], pose[1] + s * parts[i, 0]
        upright(
            x, y, (low + high) / 2, pose[2], parts[i, 1], parts[i, 2], (high - low) / 2, rows[i]
        )
    return rows


@njit(cache=True)
def slack(x, y, angle, bottom, parts, obstacles, table, base, near, far):
    """How well (x, y, angle) satisfies clearance, table edge and reach; feasible iff >= 0. m."""
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    along, across = parts[0, 1], parts[0, 2]
    worst = table[0] - abs(x) - c * along - s * across
    worst = min(worst, table[1] - abs(y) - s * along - c * across)
    r = math.sqrt((x - base[0]) ** 2 + (y - base[1]) ** 2)
    worst = min(worst, min(far - r, r - near))
    if worst < -0.2:
        return worst
    return min(worst, clearance(x, y, angle, bottom, parts, obstacles) - MARGIN)


@njit(cache=True)
def find_pose(region, prefer, bottom, parts, obstacles, table, base, near, far, ease, pose):
    """Branch and bound for a free pose whose centre lies in a rectangle.

    region: centre x, y, angle, half extents (5,). prefer (x, y): where to look first. ease: how
    much every constraint is relaxed, m. Fills pose (x, y, angle of the finger axis) with the
    first comfortable pose of the coarsest level that has a free one, or the clearest of that
    level. Returns (FOUND | NONE | UNDECIDED, the slack of the best pose seen, m).
    """
    a, b = region[3], region[4]
    c, s = math.cos(region[2]), math.sin(region[2])
    nx, ny, na = max(1, math.ceil(a / 0.025)), max(1, math.ceil(b / 0.025)), 6
    hx, hy, ha = a / nx, b / ny, math.pi / (2 * na)
    spin = 0.0
    for i in range(len(parts)):
        spin = max(spin, abs(parts[i, 0]) + math.sqrt(parts[i, 1] ** 2 + parts[i, 2] ** 2))
    count = nx * ny * na
    cells = np.empty((count, 3))
    key = np.empty(count)
    n = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(na):
                cells[n, 0] = -a + (2 * i + 1) * hx
                cells[n, 1] = -b + (2 * j + 1) * hy
                cells[n, 2] = (2 * k + 1) * ha
                wx = region[0] + c * cells[n, 0] - s * cells[n, 1]
                wy = region[1] + s * cells[n, 0] + c * cells[n, 1]
                key[n] = (wx - prefer[0]) ** 2 + (wy - prefer[1]) ** 2
                n += 1
    cells = cells[np.argsort(key, kind="mergesort")]
    evaluations = 0
    for level in range(MAX_LEVEL + 1):
        lipschitz = math.sqrt(hx * hx + hy * hy) + spin * ha
        best = -1.0
        keep = np.empty(len(cells), np.bool_)
        for n in range(len(cells)):
            x = region[0] + c * cells[n, 0] - s * cells[n, 1]
            y = region[1] + s * cells[n, 0] + c * cells[n, 1]
            value = slack(x, y, cells[n, 2], bottom, parts, obstacles, table, base, near, far)
            value += ease
            evaluations += 1
            keep[n] = value + lipschitz >= 0
            if value > best:
                best = value
                if value >= 0:
                    pose[0], pose[1], pose[2] = x, y, cells[n, 2]
            if best >= COMFORT:
                break
        if best >= 0:
            return FOUND, best
        alive = cells[keep]
        if len(alive) == 0:
            return NONE, best
        if level == MAX_LEVEL or evaluations + 8 * len(alive) > NODE_LIMIT + count:
            return UNDECIDED, best
        hx, hy, ha = hx / 2, hy / 2, ha / 2
        cells = np.empty((8 * len(alive), 3))
        for n in range(len(alive)):
            for child in range(8):
                cells[8 * n + child, 0] = alive[n, 0] + (hx if child & 1 else -hx)
                cells[8 * n + child, 1] = alive[n, 1] + (hy if child & 2 else -hy)
                cells[8 * n + child, 2] = alive[n, 2] + (ha if child & 4 else -ha)
    return UNDECIDED, best
