"""One planning problem with its geometry prepared, and the three bounds as methods.

Holds what all nodes of a search share (obstacles, grasps, who blocks whom, memo of pose
bounds) and counts the work. Everything is deterministic: limits count evaluations.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from relevance.planner import keyframes, logic, path, placement
from relevance.planner.kernels.native import call
from relevance.planner.kinematics import ARM, FRAME, HAND, HOME, hand_down, panda, reach_interval
from relevance.planner.placement import FOUND, UNDECIDED, Grasp
from relevance.scene import Box, Goal, Phase, Pose, Predicate, Scene, region

REGION_MARGIN = 0.001
"""How far inside the goal region a subject is placed, m."""
TABLE_MARGIN = 0.005


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
    """Whether a pose bound was left open on the way: the row is flagged ambiguous."""
    boxes: dict[str, Box] = field(init=False)
    grasps: dict[str, tuple[Grasp, ...]] = field(init=False)
    blockers: dict[str, tuple[frozenset[str], ...]] = field(init=False)
    """Per object and grasp: who must have left before it can be picked that way."""
    above: dict[str, frozenset[str]] = field(init=False)
    _memo: dict = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        began = time.process_time()
        self.boxes = {box.name: box for box in self.scene.objects}
        self.base = np.array([*self.scene.robot.base, self.scene.robot.yaw])
        self.above = logic.stacked_on(self.scene)
        self.grasps, self.blockers, self._reach = {}, {}, {}
        for box in self.scene.objects:
            others = [other for other in self.scene.objects if other.name != box.name]
            usable = [g for g in placement.grasps(box) if self._reachable(box, g)]
            self.grasps[box.name] = tuple(usable)
            self.blockers[box.name] = tuple(placement.pick_blockers(box, g, others) for g in usable)
        self.counts.pose += len(self.boxes)
        self.seconds.pose += time.process_time() - began

    def _interval(self, bottom: float, box: Box, grasp: Grasp) -> tuple[float, float]:
        """Reach (near, far) for holding the box with its underside at this height, liftably."""
        arm, z = panda(), bottom + box.size[2] / 2 + grasp.above
        key = round(z, 4)
        if key not in self._reach:
            ends = [
                reach_interval(height, self.base, arm.lower, arm.upper)
                for height in (z, z + placement.LIFT)
            ]
            self._reach[key] = (
                max(near for near, _ in ends) + 0.004,
                min(far for _, far in ends) - 0.004,
            )
        return self._reach[key]

    def _reachable(self, box: Box, grasp: Grasp) -> bool:
        near, far = self._interval(box.bottom, box, grasp)
        r = math.hypot(box.position[0] - self.base[0], box.position[1] - self.base[1])
        return near <= r <= far

    # -- pose bound ---------------------------------------------------------------------------

    def pickable(self, name: str, gone: frozenset[str]) -> tuple[Grasp, ...]:
        """Grasps with which the object can be taken once the objects in `gone` have left."""
        self.counts.pose += 1
        if not self.above[name] <= gone:
            return ()
        pairs = zip(self.grasps[name], self.blockers[name], strict=True)
        return tuple(grasp for grasp, blocking in pairs if blocking <= gone)

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
        bottom = reference.top if self.goal.predicate is Predicate.ON else 0.0
        standing = [
            placement.obstacle(box)
            for box in self.scene.objects
            if box.name not in gone and box.name not in (subject.name, reference.name)
        ]
        standing.append(placement.obstacle(reference))
        area = self.goal_region(reference)
        self._memo[key] = self._find(area, area[:2], bottom, subject, grasp, standing)
        return self._memo[key]

    def goal_region(self, reference: Box) -> np.ndarray:
        """Rectangle for the subject's centre: x, y, angle, half extents (5,)."""
        if self.goal.predicate is Predicate.ON:
            half = [max(edge / 2 - REGION_MARGIN, 0.0) for edge in reference.size[:2]]
            return np.array([*reference.position[:2], reference.yaw, *half])
        u = self.goal.predicate.direction
        assert u is not None
        low, high, width = region(self.boxes[self.goal.subject], reference, self.goal.predicate)
        middle = (low + high) / 2
        depth, width = (high - low) / 2 - REGION_MARGIN, max(width - REGION_MARGIN, 0.0)
        x, y = reference.position[0] + middle * u[0], reference.position[1] + middle * u[1]
        return np.array([x, y, 0.0, *((depth, width) if u[0] else (width, depth))])

    def _find(self, area, prefer, bottom, box, grasp, obstacles):
        began = time.process_time()
        self.counts.pose += 1
        near, far = self._interval(bottom, box, grasp)
        pose = np.zeros(3)
        table = np.array(self.scene.table.size) / 2
        stacked = np.array(obstacles).reshape(-1, 7)
        status, _ = placement.find_pose(
            area, np.array(prefer), bottom, grasp.parts, stacked, table, self.base, near, far, pose
        )
        self.seconds.pose += time.process_time() - began
        if status == UNDECIDED:
            self.undecided = True
        return (float(pose[0]), float(pose[1]), float(pose[2])) if status == FOUND else None

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
            bottom = reference.top if self.goal.predicate is Predicate.ON else 0.0
            kept = _volumes(subject, grasp, pose, bottom)
            found = self._place_blockers(order, kept, reference)
            if found is not None:
                return [*found, Placement(grasp=grasp, pose=pose)]
        return None

    def _references(self, order: tuple[str, ...]) -> list[Box]:
        """The reference where it stands, or where it might be put if the order moves it."""
        reference = self.boxes[self.goal.reference]
        if reference.name not in order:
            return [reference]
        found, gone = [], frozenset(order)
        standing = [placement.obstacle(box) for box in self.scene.objects if box.name not in gone]
        for grasp in self.pickable(reference.name, frozenset(order[: order.index(reference.name)])):
            for prefer in ((0.0, 0.0), (-0.1, 0.25), (-0.1, -0.25), (0.1, 0.15), (0.1, -0.15)):
                pose = self._find(self._table(), prefer, 0.0, reference, grasp, standing)
                if pose is not None:
                    found.append(_moved_box(reference, grasp, pose, 0.0, None))
            break
        return found

    def _table(self) -> np.ndarray:
        half = np.array(self.scene.table.size) / 2 - TABLE_MARGIN
        return np.array([0.0, 0.0, 0.0, *half])

    def _place_blockers(self, order, kept, reference: Box) -> list[Placement] | None:
        """Free table poses of all but the last, clear of what is still there when they land."""
        placed: list[Placement] = []
        landed: list[np.ndarray] = []
        for i, name in enumerate(order[:-1]):
            box = self.boxes[name]
            gone = frozenset(order[: i + 1])
            standing = [placement.obstacle(b) for b in self.scene.objects if b.name not in gone]
            top = box.size[2] + placement.MARGIN
            later = [o for o in self._later_picks(order[i + 1 :]) if o[2] - o[6] < top]
            reserved = [o for o in kept if o[2] - o[6] < top]
            found = None
            for grasp in self.pickable(name, frozenset(order[:i])):
                if name == reference.name:
                    prefer, area = (
                        reference.position[:2],
                        np.array([*reference.position[:2], 0.0, 0.002, 0.002]),
                    )
                else:
                    prefer, area = box.position[:2], self._table()
                pose = self._find(
                    area, prefer, 0.0, box, grasp, [*standing, *landed, *reserved, *later]
                )
                if pose is not None:
                    found = Placement(grasp=grasp, pose=pose)
                    break
            if found is None:
                return None
            placed.append(found)
            landed.append(placement.obstacle(_moved_box(box, found.grasp, found.pose, 0.0, None)))
        return placed

    def _later_picks(self, names: tuple[str, ...]) -> list[np.ndarray]:
        """Where the gripper will be when it takes these boxes."""
        rows = []
        for name in names:
            box = self.boxes[name]
            grasp = self.grasps[name][0]
            angle = box.yaw + grasp.axis * math.pi / 2
            pose = (box.position[0], box.position[1], angle)
            rows += _volumes(box, grasp, pose, box.bottom)[1:]
        return rows

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
        names = list(self.boxes)
        obstacles = np.array([placement.obstacle(b) for b in self.boxes.values()] + self.fixtures())
        moved = np.array([order.index(n) if n in order else -1 for n in names] + [-1, -1])
        stands = np.ones((2 * m, len(obstacles)), np.bool_)
        supports = np.full(m, len(names))
        widest = len(arm.arm) + 2 * len(arm.finger) + 1
        link = np.zeros((2 * m, widest), np.int64)
        centre, half = np.zeros((2 * m, widest, 3)), np.zeros((2 * m, widest, 3))
        n_bodies = np.zeros(2 * m, np.int64)
        pick_target, place_z, turn = np.zeros((m, 4)), np.zeros(m), np.zeros((m, 2))
        bounds = np.zeros((m, 2))
        x = np.zeros(17 * m)
        p0, weight = np.zeros(3 * m), np.zeros(3 * m)
        for j, (name, place) in enumerate(zip(order, placements, strict=True)):
            box, grasp = self.boxes[name], place.grasp
            bottom = 0.0
            if name == self.goal.subject and self.goal.predicate is Predicate.ON:
                supports[j] = names.index(self.goal.reference)
                bottom = self.boxes[self.goal.reference].top
            pick_target[j] = self.pick_target(box, grasp)
            place_z[j] = bottom + box.size[2] / 2 + grasp.above
            turn[j] = grasp.axis * math.pi / 2, bottom + box.size[2] / 2
            p0[3 * j : 3 * j + 3] = place.pose
            for k, carried in ((2 * j, None), (2 * j + 1, _carried(box, grasp))):
                body = keyframes.bodies(arm, grasp.opening, carried)
                n_bodies[k] = len(body.link)
                link[k, : n_bodies[k]] = body.link
                centre[k, : n_bodies[k]], half[k, : n_bodies[k]] = body.centre, body.half
                stands[k, names.index(name)] = False
            c, s = abs(math.cos(place.pose[2])), abs(math.sin(place.pose[2]))
            along, across = grasp.parts[0, 1], grasp.parts[0, 2]
            bounds[j] = np.array(self.scene.table.size) / 2
            bounds[j] -= c * along + s * across, s * along + c * across
            target = np.array([*place.pose[:2], place_z[j], place.pose[2]])
            for k, t in ((2 * j, pick_target[j]), (2 * j + 1, target)):
                q = np.zeros(ARM)
                if not hand_down(t, self.base, arm.lower, arm.upper, q):
                    return None
                x[k * ARM : (k + 1) * ARM] = q
        x[14 * m :] = p0
        reference = self.boxes[self.goal.reference]
        if reference.name in order:
            j = order.index(reference.name)
            reference = _moved_box(reference, placements[j].grasp, placements[j].pose, 0.0, None)
        start = x.copy()
        for stay in keyframes.STAY:
            weight[:] = stay
            if reference.name in order:  # the subject's region was laid out around it
                j = order.index(reference.name)
                weight[3 * j : 3 * j + 3] = 1e6
            x[:] = start
            violation = keyframes.solve(
                x, m, HOME, p0, weight, pick_target, place_z, turn, self.base, arm.lower,
                arm.upper, link, centre, half, n_bodies, obstacles, stands, moved, supports,
                self.goal_region(reference), bounds, arm.frames.x, arm.frames.y,
                arm.frames.handle, arm.grasp.x, arm.grasp.y, arm.grasp.handle,
            )  # fmt: skip
            if violation <= keyframes.TOLERANCE:
                return x[: 14 * m].reshape(2 * m, ARM), x[14 * m :].reshape(m, 3)
        return None

    def fixtures(self) -> list[np.ndarray]:
        """What always stands there, as obstacles: the table (first) and the robot's foot."""
        table = np.array([0, 0, -0.05, 0, *(edge / 2 for edge in self.scene.table.size), 0.05])
        centre, half = panda().foot
        c, s = math.cos(self.base[3]), math.sin(self.base[3])
        x = self.base[0] + c * centre[0] - s * centre[1]
        y = self.base[1] + s * centre[0] + c * centre[1]
        return [table, np.array([x, y, self.base[2] + centre[2], self.base[3], *half])]

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
        arm = panda()
        standing = dict(self.boxes)
        phases: list[Phase] = []
        final: dict[str, Pose] = {}
        cost, worst = 0.0, 0.0
        at, leave = HOME, None
        sequence = logic.actions(self.goal, order)
        for j, (name, place) in enumerate(zip(order, placements, strict=True)):
            box, grasp = self.boxes[name], place.grasp
            last = name == self.goal.subject
            on = self.goal.reference if last and self.goal.predicate is Predicate.ON else None
            bottom = standing[on].top if on else 0.0
            take = self.pick_target(box, grasp)
            put = np.array(
                [poses[j, 0], poses[j, 1], bottom + box.size[2] / 2 + grasp.above, poses[j, 2]]
            )
            for k, (leaving, arriving, carried) in enumerate(
                ((leave, take, None), (take, put, _carried(box, grasp)))
            ):
                self.counts.path += 1
                if carried is not None:
                    del standing[name]
                obstacles = np.array(
                    [placement.obstacle(b) for b in standing.values()] + self.fixtures()
                )
                opening = grasp.closed if carried is not None else grasp.opening
                body = keyframes.bodies(arm, opening, carried)
                found = path.motion(
                    arm, self.base, at, q[2 * j + k], leaving, arriving, body, obstacles
                )
                if found is None:
                    return None
                X, depth = found
                cost, worst = cost + path.acceleration_cost(X), max(worst, depth)
                phases.append(
                    Phase(
                        action=sequence[2 * j + k],
                        q=X,
                        dt=path.time_step(arm, X),
                        opening=opening,
                        carried=name if carried is not None else None,
                    )
                )
                at = X[-1]
            landed = self._land(box, grasp, q[2 * j], q[2 * j + 1], poses[j], bottom, on)
            standing[name] = landed
            final[name] = Pose(position=landed.position, yaw=landed.yaw, on=on)
            X = path.retreat(arm, self.base, at, put)
            if X is None:
                return None
            depth = self._check(X, keyframes.bodies(arm, grasp.opening), standing)
            if depth > path.ALLOWED:
                return None
            worst, cost = max(worst, depth), cost + path.acceleration_cost(X)
            phases.append(
                Phase(
                    action=None,
                    q=X,
                    dt=path.time_step(arm, X),
                    opening=grasp.opening,
                    carried=None,
                )
            )
            at, leave = X[-1], None
        return Motion(
            order=order, phases=tuple(phases), final=final, cost=cost, max_penetration=worst
        )

    def _check(self, X: np.ndarray, body: keyframes.Bodies, standing: dict[str, Box]) -> float:
        arm = panda()
        obstacles = np.array([placement.obstacle(b) for b in standing.values()] + self.fixtures())
        margin = np.zeros((len(body.link), len(obstacles)))
        return path.dense_check(
            X, self.base, body.link, body.centre, body.half, obstacles, margin, arm.frames.x,
            arm.frames.y, arm.frames.handle, np.zeros((len(X) - 1, 2)),
        )  # fmt: skip

    def _land(self, box, grasp, q_pick, q_place, pose, bottom, on) -> Box:
        """The box after the release; its yaw follows the hand, which may have turned over."""
        angles = []
        for q in (q_pick, q_place):
            frames = panda().frames
            frames.x[:ARM], frames.x[ARM:] = q, self.base
            call(frames.handle)
            R = frames.y[HAND * FRAME + 3 : HAND * FRAME + 12].reshape(3, 3)
            angles.append(math.atan2(R[1, 1], R[0, 1]))
        yaw = box.yaw + angles[1] - angles[0]
        yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
        return replace(
            box,
            position=(float(pose[0]), float(pose[1]), bottom + box.size[2] / 2),
            yaw=yaw,
            on=on,
        )


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


def _volumes(box: Box, grasp: Grasp, pose, bottom: float) -> list[np.ndarray]:
    """The box at a pose and the gripper that puts it there, as obstacles up to the sky."""
    rows = []
    for i, (offset, along, across, under) in enumerate(grasp.parts):
        low = bottom + under
        high = bottom + box.size[2] if i == 0 else 2.0
        x, y = pose[0] + math.cos(pose[2]) * offset, pose[1] + math.sin(pose[2]) * offset
        rows.append(np.array([x, y, (low + high) / 2, pose[2], along, across, (high - low) / 2]))
    return rows
