"""One planning problem with its geometry prepared, and the three bounds as methods.

Holds what all nodes of a search share (obstacles, grasps, who blocks whom, memo of pose
bounds) and counts the work. Everything is deterministic: limits count evaluations.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np

from relevance.planner import keyframes, logic, path, placement
from relevance.planner.kernels.boxes import Bodies
from relevance.planner.kinematics import (
    ARM,
    HOME,
    Arm,
    arm_at,
    finger_turn,
    hand_down,
    panda,
    reach_interval,
)
from relevance.planner.placement import EDGE, FOUND, NONE, UNDECIDED, Grasp
from relevance.scene import Box, Goal, Phase, Pose, Scene
from relevance.scene.geometry import UPRIGHT, upright

REGION_MARGIN = 0.0005
"""How far inside the goal region a subject is placed, m."""
TABLE_MARGIN = 0.005
REACH_MARGIN = 0.004
"""Distance kept from the ends of the arm's reach, m."""
REFERENCE_PLACES = ((0.0, 0.0), (-0.1, 0.25), (-0.1, -0.25), (0.1, 0.15), (0.1, -0.15))
"""Where to look for room for a reference that is moved (x, y), m."""
SKY = 2.0
"""Height up to which the hand and what is above it count as an obstacle, m."""


@dataclass(slots=True, kw_only=True)
class Counts:
    """Work done: nodes of the search tree, and calls of each bound."""

    nodes: int = 0
    pose: int = 0
    keyframe: int = 0
    path: int = 0


@dataclass(slots=True, kw_only=True)
class Seconds:
    """CPU seconds, in all and by bound; guide is the time spent on scoring."""

    total: float = 0.0
    pose: float = 0.0
    keyframe: float = 0.0
    path: float = 0.0
    guide: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where a moved box goes and how it is held."""

    grasp: Grasp
    pose: tuple[float, float, float]
    """x, y, angle of the finger axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A solved sequence."""

    order: tuple[str, ...]
    phases: tuple[Phase, ...]
    final: dict[str, Pose]
    cost: float
    max_penetration: float


@dataclass
class Problem:
    """A scene and a goal, ready for search."""

    scene: Scene
    goal: Goal
    counts: Counts = field(default_factory=Counts)
    seconds: Seconds = field(default_factory=Seconds)
    undecided: bool = False
    """Whether a pose bound was left open on the way, or decided by less than `placement.EDGE`:
    the row is flagged ambiguous."""
    boxes: dict[str, Box] = field(init=False)
    above: dict[str, frozenset[str]] = field(init=False)
    obstacles: np.ndarray = field(init=False)
    """(N + 2, UPRIGHT): the boxes as they stand at first, then the table and the robot's foot."""
    arm: Arm = field(init=False)
    _blockers: dict[str, dict[Grasp, frozenset[str]]] = field(init=False, default_factory=dict)
    _memo: dict = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.boxes = {box.name: box for box in self.scene.objects}
        self.index = {name: i for i, name in enumerate(self.boxes)}
        self.arm = arm_at(np.array([*self.scene.robot.base, self.scene.robot.yaw]))
        self.table = np.array(self.scene.table.size) / 2
        standing = [placement.obstacle(box) for box in self.scene.objects]
        self.obstacles = np.array([*standing, *self._fixtures()])
        self.above = logic.stacked_on(self.scene)

    def _fixtures(self) -> list[np.ndarray]:
        """What always stands there, as obstacles: the table and the robot's foot."""
        table, foot = np.empty(UPRIGHT), np.empty(UPRIGHT)
        upright(0.0, 0.0, -0.05, 0.0, self.table[0], self.table[1], 0.05, table)
        (x, y, z), (hx, hy, hz) = panda().foot
        bx, by, bz, yaw = self.arm.base
        c, s = math.cos(yaw), math.sin(yaw)
        upright(bx + c * x - s * y, by + s * x + c * y, bz + z, yaw, hx, hy, hz, foot)
        return [table, foot]

    def _standing(self, gone: Collection[str]) -> np.ndarray:
        """The boxes that have not gone, as obstacles."""
        stays = [i for name, i in self.index.items() if name not in gone]
        return self.obstacles[stays]

    def _interval(self, bottom: float, box: Box, grasp: Grasp) -> tuple[float, float]:
        """Reach (near, far) for holding the box with its underside at this height, liftably."""
        z = bottom + box.size[2] / 2 + grasp.above - self.scene.robot.base[2]
        # Heights in whole millimetres, to compute each once; REACH_MARGIN covers the rest.
        near, far = reach_interval(round(z, 3))
        near_up, far_up = reach_interval(round(z + placement.LIFT, 3))
        return max(near, near_up) + REACH_MARGIN, min(far, far_up) - REACH_MARGIN

    def _reachable(self, box: Box, grasp: Grasp) -> bool:
        near, far = self._interval(box.bottom, box, grasp)
        base = self.scene.robot.base
        r = math.hypot(box.position[0] - base[0], box.position[1] - base[1])
        self.undecided |= min(abs(r - near), abs(r - far)) < EDGE
        return near <= r <= far

    # -- pose bound ---------------------------------------------------------------------------

    def blockers(self, name: str) -> dict[Grasp, frozenset[str]]:
        """The grasps of an object, and who must have left before it can be picked that way."""
        if name not in self._blockers:
            began = time.process_time()
            self.counts.pose += 1
            i, box, found = self.index[name], self.boxes[name], {}
            boxes, blocking = self.obstacles[: len(self.boxes)], np.zeros(len(self.boxes), np.bool_)
            for grasp in placement.grasps(box):
                if self._reachable(box, grasp):
                    gap = placement.pick_blockers(i, grasp.axis, grasp.parts, boxes, blocking)
                    self.undecided |= gap < EDGE
                    found[grasp] = frozenset(compress(self.boxes, blocking.tolist()))
            self._blockers[name] = found
            self.seconds.pose += time.process_time() - began
        return self._blockers[name]

    def grasps(self, name: str) -> tuple[Grasp, ...]:
        """The grasps with which an object can be reached where it stands at first."""
        return tuple(self.blockers(name))

    def pickable(self, name: str, gone: frozenset[str]) -> tuple[Grasp, ...]:
        """Grasps with which the object can be taken once the objects in `gone` have left."""
        self.counts.pose += 1
        if not self.above[name] <= gone:
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
        if key in self._memo:
            return self._memo[key]
        subject = self.boxes[self.goal.subject]
        bottom = reference.top if self.goal.predicate.stacked else 0.0
        standing = self._standing(gone | {subject.name, reference.name})
        standing = np.vstack([standing, placement.obstacle(reference)])
        area = self.goal_region(reference)
        self._memo[key] = self._find(area, area[:2], bottom, subject, grasp, standing)
        return self._memo[key]

    def goal_region(self, reference: Box) -> np.ndarray:
        """Rectangle for the subject's centre: x, y, angle, half extents (5,)."""
        subject = self.boxes[self.goal.subject]
        there = self.goal.predicate.region(subject, reference, self.scene.robot)
        half = [max(extent - REGION_MARGIN, 0.0) for extent in there.half]
        return np.array([there.x, there.y, there.angle, *half])

    def _find(self, area, prefer, bottom, box, grasp, obstacles):
        began = time.process_time()
        self.counts.pose += 1
        near, far = self._interval(bottom, box, grasp)
        pose = np.zeros(3)

        def find(ease: float) -> tuple[int, float]:
            return placement.find_pose(
                area, np.array(prefer), bottom, grasp.parts, obstacles, self.table, self.arm.base,
                near, far, ease, pose,
            )  # fmt: skip

        status, slack = find(0.0)
        found = (float(pose[0]), float(pose[1]), float(pose[2])) if status == FOUND else None
        close = slack < EDGE if found else status == UNDECIDED or find(EDGE)[0] != NONE
        self.undecided |= close
        self.seconds.pose += time.process_time() - began
        return found

    def place_all(self, order: tuple[str, ...], grasp: Grasp) -> list[Placement] | None:
        """Poses for every moved box: first the subject's, then the others' around it.

        Placing the subject first loses fewer tasks than placing greedily in time order.
        """
        subject = self.boxes[self.goal.subject]
        gone = frozenset(order)
        for reference in self._references(order):
            pose = self.goal_pose(gone - {subject.name}, grasp, reference)
            if pose is None:
                continue
            bottom = reference.top if self.goal.predicate.stacked else 0.0
            kept = placement.volumes(grasp.parts, pose, bottom, bottom + subject.size[2], SKY)
            found = self._place_blockers(order, kept, reference)
            if found is not None:
                return [*found, Placement(grasp=grasp, pose=pose)]
        return None

    def _references(self, order: tuple[str, ...]) -> Iterator[Box]:
        """The reference where it stands, or where it might be put if the order moves it."""
        reference = self.boxes[self.goal.reference]
        if reference.name not in order:
            yield reference
            return
        i = order.index(reference.name)
        obstacles = self._when_landing(order, i, reference)
        grasp = self.pickable(reference.name, frozenset(order[:i]))[0]
        for prefer in REFERENCE_PLACES:
            pose = self._find(self._table(), prefer, 0.0, reference, grasp, obstacles)
            if pose is not None:
                yield _moved_box(reference, grasp, pose, 0.0, None)

    def _when_landing(self, order: tuple[str, ...], i: int, box: Box) -> np.ndarray:
        """What the i-th moved box must stay clear of: the boxes that still stand then, and where
        the gripper will be when it takes the later ones."""
        top = box.size[2] + placement.MARGIN
        hands = np.vstack([np.empty((0, UPRIGHT)), *self._later_picks(order[i + 1 :])])
        return np.vstack([self._standing(order[: i + 1]), hands[_underside(hands) < top]])

    def _table(self) -> np.ndarray:
        return np.array([0.0, 0.0, 0.0, *(self.table - TABLE_MARGIN)])

    def _place_blockers(self, order, kept, reference: Box) -> list[Placement] | None:
        """Free table poses of all but the last, clear of what is still there when they land."""
        placed: list[Placement] = []
        landed = np.empty((0, UPRIGHT))
        for i, name in enumerate(order[:-1]):
            box = self.boxes[name]
            prefer, area, reserved = box.position[:2], self._table(), kept
            if name == reference.name:
                prefer, reserved = reference.position[:2], kept[:0]  # kept was laid out around it
                area = np.array([*prefer, 0.0, 0.002, 0.002])
            elif reference.name in order[i:]:
                grasp = self.grasps(reference.name)[0]
                pose = (*reference.position[:2], reference.yaw + grasp.axis * math.pi / 2)
                there = placement.volumes(grasp.parts, pose, 0.0, reference.top, SKY)
                reserved = np.vstack([kept, there])
            reserved = reserved[_underside(reserved) < box.size[2] + placement.MARGIN]
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
            there = placement.obstacle(_moved_box(box, found.grasp, found.pose, 0.0, None))
            landed = np.vstack([landed, there])
        return placed

    def _later_picks(self, names: tuple[str, ...]) -> list[np.ndarray]:
        """Where the gripper will be when it takes these boxes."""
        found = []
        for name in names:
            box, grasp = self.boxes[name], self.grasps(name)[0]
            x, y, _, angle = self.pick_target(box, grasp)
            found.append(placement.volumes(grasp.parts, (x, y, angle), box.bottom, 0.0, SKY)[1:])
        return found

    # -- keyframe bound -----------------------------------------------------------------------

    def keyframes(self, order: tuple[str, ...], placements: list[Placement]):
        """Solve the keyframe NLP; (configurations (2m, 7), placement poses (m, 3)) or None."""
        began = time.process_time()
        self.counts.keyframe += 1
        found = self._solve_keyframes(order, placements)
        self.seconds.keyframe += time.process_time() - began
        return found

    def _solve_keyframes(self, order, placements):
        arm, m = panda(), len(order)
        moved = np.full(len(self.obstacles), -1)
        stands = np.ones((2 * m, len(self.obstacles)), np.bool_)
        supports = np.full(m, len(self.boxes))  # the table
        widest = len(arm.arm) + 2 * len(arm.finger) + 1
        link, n_bodies = np.zeros((2 * m, widest), np.int64), np.zeros(2 * m, np.int64)
        centre, half = np.zeros((2 * m, widest, 3)), np.zeros((2 * m, widest, 3))
        radius = np.zeros((2 * m, widest))
        pick, place_z, turn = np.zeros((m, 4)), np.zeros(m), np.zeros((m, 2))
        bounds = np.zeros((m, 4))
        x = np.zeros(17 * m)
        p0, weight = np.zeros(3 * m), np.zeros(3 * m)
        reference = self.boxes[self.goal.reference]
        if reference.name in order:
            place = placements[order.index(reference.name)]
            reference = _moved_box(reference, place.grasp, place.pose, 0.0, None)
        for j, (name, place) in enumerate(zip(order, placements, strict=True)):
            box, grasp = self.boxes[name], place.grasp
            bottom = 0.0
            if name == self.goal.subject and self.goal.predicate.stacked:
                supports[j], bottom = self.index[reference.name], reference.top
            moved[self.index[name]] = j
            pick[j] = self.pick_target(box, grasp)
            place_z[j] = bottom + box.size[2] / 2 + grasp.above
            turn[j] = grasp.axis * math.pi / 2, bottom + box.size[2] / 2
            p0[3 * j : 3 * j + 3] = place.pose
            for k in (2 * j, 2 * j + 1):
                body = self.bodies(name, grasp, holding=k % 2 == 1, opening=grasp.opening)
                n_bodies[k] = count = len(body.link)
                link[k, :count], centre[k, :count], half[k, :count], radius[k, :count] = body
                stands[k, self.index[name]] = False
            c, s = abs(math.cos(place.pose[2])), abs(math.sin(place.pose[2]))
            along, across = grasp.parts[0, 1], grasp.parts[0, 2]
            bounds[j, :2] = self.table
            bounds[j, :2] -= c * along + s * across, s * along + c * across
            bounds[j, 2:] = self._interval(bottom, box, grasp)
            target = np.array([*place.pose[:2], place_z[j], place.pose[2]])
            for k, t in ((2 * j, pick[j]), (2 * j + 1, target)):
                q = x[k * ARM : (k + 1) * ARM]
                if not hand_down(t, self.arm.base, self.arm.lower, self.arm.upper, q):
                    return None
        x[14 * m :] = p0
        switches = keyframes.Switches(
            HOME, pick, place_z, turn, link, centre, half, radius, n_bodies, self.obstacles, stands,
            moved, supports, self.goal_region(reference), bounds,
        )  # fmt: skip
        start = x.copy()
        for stay in keyframes.STAY:
            weight[:] = stay
            if reference.name in order:  # the subject's region was laid out around it
                j = order.index(reference.name)
                weight[3 * j : 3 * j + 3] = 1e6
            x[:] = start
            if keyframes.solve(x, self.arm, switches, p0, weight) <= keyframes.TOLERANCE:
                return x[: 14 * m].reshape(2 * m, ARM), x[14 * m :].reshape(m, 3)
        return None

    def bodies(self, name: str, grasp: Grasp, *, holding: bool, opening: float) -> Bodies:
        """What moves with the arm before (and after) taking a box, or while holding it."""
        key = (name, grasp.axis, holding, opening)
        if key not in self._memo:
            carried = _carried(self.boxes[name], grasp) if holding else None
            self._memo[key] = keyframes.bodies(opening, carried)
        return self._memo[key]

    def pick_target(self, box: Box, grasp: Grasp) -> np.ndarray:
        """Hand target (x, y, z, finger angle) over a standing box."""
        x, y, z = box.position
        return np.array([x, y, z + grasp.above, box.yaw + grasp.axis * math.pi / 2])

    # -- path bound ---------------------------------------------------------------------------

    def paths(self, order, placements, q: np.ndarray, poses: np.ndarray) -> Motion | None:
        """Motions through the keyframes, densely checked; None when one cannot be found."""
        began = time.process_time()
        found = self._solve_paths(order, placements, q, poses)
        self.seconds.path += time.process_time() - began
        return found

    def _solve_paths(self, order, placements, q, poses) -> Motion | None:
        obstacles = self.obstacles.copy()
        there = np.ones(len(obstacles), np.bool_)
        phases: list[Phase] = []
        final: dict[str, Pose] = {}
        sequence = logic.actions(self.goal, order)
        cost, worst = 0.0, 0.0
        at, leave, leaving = HOME, np.zeros(4), False
        for j, (name, place) in enumerate(zip(order, placements, strict=True)):
            box, grasp, i = self.boxes[name], place.grasp, self.index[name]
            last = name == self.goal.subject
            on = self.goal.reference if last and self.goal.predicate.stacked else None
            bottom = 0.0
            if on is not None:
                bottom = obstacles[self.index[on], 2] + obstacles[self.index[on], 6]
            take = self.pick_target(box, grasp)
            z = bottom + box.size[2] / 2 + grasp.above
            put = np.array([poses[j, 0], poses[j, 1], z, poses[j, 2]])
            free = self.bodies(name, grasp, holding=False, opening=grasp.opening)
            held = self.bodies(name, grasp, holding=True, opening=grasp.closed)
            for k, (arrive, body, opening) in enumerate(
                ((take, free, grasp.opening), (put, held, grasp.closed))
            ):
                self.counts.path += 1
                there[i] = k == 0
                X = np.empty((path.ROWS + 1, ARM))
                X[0], X[-1] = at, q[2 * j + k]
                depth, effort, dt = path.motion(
                    X, self.arm, leave, leaving, arrive, body, obstacles[there]
                )
                if depth < 0:
                    return None
                action, carried = sequence[2 * j + k], name if k else None
                phases.append(Phase(action=action, q=X, dt=dt, opening=opening, carried=carried))
                cost, worst = cost + effort, max(worst, depth)
                at, leave, leaving = X[-1], arrive, True
            there[i] = True
            turned = finger_turn(self.arm, q[2 * j], q[2 * j + 1])
            yaw = (box.yaw + turned + math.pi) % (2 * math.pi) - math.pi
            position = (float(poses[j, 0]), float(poses[j, 1]), bottom + box.size[2] / 2)
            x, y, z = position
            hx, hy, hz = obstacles[i, 4:7]
            upright(x, y, z, yaw, hx, hy, hz, obstacles[i])
            final[name] = Pose(position=position, yaw=yaw, on=on)
            X = np.empty((2 * path.VERTICAL + 1, ARM))
            X[0] = at
            depth, effort, dt = path.retreat(X, self.arm, put, free, obstacles[there])
            if not 0 <= depth <= path.ALLOWED:
                return None
            phases.append(Phase(action=None, q=X, dt=dt, opening=grasp.opening, carried=None))
            cost, worst = cost + effort, max(worst, depth)
            at, leaving = X[-1], False
        return Motion(
            order=order, phases=tuple(phases), final=final, cost=cost, max_penetration=worst
        )

    def penetration(self, motion: Motion) -> float:
        """Worst penetration (m) of a solved sequence by the dense check alone.

        The solver has done the same while it solved; this goes by the plan's phases and poses.
        """
        obstacles = self.obstacles.copy()
        there = np.ones(len(obstacles), np.bool_)
        worst = 0.0
        for k, phase in enumerate(motion.phases):
            name, holding = motion.order[k // 3], k % 3 == 1
            i = self.index[name]
            opening = "closed" if holding else "opening"
            grasp = next(g for g in self.grasps(name) if getattr(g, opening) == phase.opening)
            there[i] = not holding
            if k % 3 == 2:  # the retreat
                pose = motion.final[name]
                x, y, z = pose.position
                hx, hy, hz = obstacles[i, 4:7]
                upright(x, y, z, pose.yaw, hx, hy, hz, obstacles[i])
            body = self.bodies(name, grasp, holding=holding, opening=phase.opening)
            margin, broken = (
                np.zeros((len(body.link), there.sum())),
                np.zeros((len(phase.q) - 1, 2)),
            )
            depth = path.dense_check(phase.q, self.arm, body, obstacles[there], margin, broken)
            worst = max(worst, depth)
        return worst


def _underside(rows: np.ndarray) -> np.ndarray:
    """Heights of the undersides of obstacle rows, m."""
    return rows[:, 2] - rows[:, 6]


def _carried(box: Box, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half extents of the held box in the hand's frame (y = finger axis)."""
    half = np.array([box.size[1 - grasp.axis], box.size[grasp.axis], box.size[2]]) / 2
    return np.array([0.0, 0.0, grasp.above]), half


def _moved_box(box: Box, grasp: Grasp, pose, bottom: float, on: str | None) -> Box:
    return replace(
        box,
        position=(pose[0], pose[1], bottom + box.size[2] / 2),
        yaw=pose[2] - grasp.axis * math.pi / 2,
        on=on,
    )
