"""The referee of plans: executes them again with pybullet's own kinematics and meshes.

It shares nothing with the planner but the URDF, and it is strict: whatever it cannot confirm,
it refuses with a reason. Motion is kinematic (no dynamics): the arm is posed at every row and
between rows, and a carried box is rigid to the hand.

Frames are named `T_a_b` (maps b's coordinates to a's); a pose is a position (m) and a
quaternion (x, y, z, w).

Measured of pybullet 3.2.7: every link of the Panda is one convex hull, and `getClosestPoints`
sees it grown by exactly 1 mm whatever `changeDynamics` says, which is taken back here; boxes
are exact on faces, and on edges too once their collision margin is set to almost nothing.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from relevance.errors import RelevanceError
from relevance.robot import panda_urdf
from relevance.scene import CONTACT_TOLERANCE, Goal, Phase, Scene, goal_holds
from relevance.simulation.bullet import Client, pybullet

MAX_PENETRATION = 1e-3
"""Deepest overlap that a replayed plan may have, m."""

_ARM = tuple(range(7))
_HAND = 8
_FINGERS = (9, 10)
_BASE = -1
_HULL_MARGIN = 1e-3  # getClosestPoints sees every link's hull grown by this much; taken back
_GRASP_POINT = (0.0, 0.0, 0.109)  # between the pads, 3 mm from the tips, hand frame, m
_GRASP_TOLERANCE = 2e-3  # how far a finger may be off the face of the box that it holds, m
_FLAT = 0.01  # tilt of a box that rests, rad
_EPSILON = 1e-6
# Links that can meet without being neighbours: the wrist and hand against the lower arm.
_SELF_PAIRS = {(a, b) for a in (6, _HAND, *_FINGERS) for b in (_BASE, 0, 1, 2, 3)}
_Bounds = tuple[Sequence[float], Sequence[float]]  # lowest and highest corner, m
_RENEW_AFTER = 200  # removed bodies leak; a fresh world now and then bounds it


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """The referee's verdict on a plan."""

    ok: bool
    """Whether everything held and nothing overlapped by more than 1 mm."""
    max_penetration: float
    """Deepest overlap of anything with anything, intended contacts aside, m, at least 0."""
    reason: str
    """The first thing that did not hold; empty when ok."""


def replay(scene: Scene, goal: Goal, phases: Sequence[Phase], *, substeps: int = 8) -> Replay:
    """Execute a plan again in pybullet, kinematically, and check everything about it.

    Every row of every phase and `substeps` equal steps between rows are posed with pybullet's
    kinematics. A carried box is rigid to the hand. Checked: joint limits and speeds, phases
    that continue each other, grasps (the fingers touch the box on both sides), rest (placed
    boxes stand flat on what the action says), the goal at the end, and the overlap of robot,
    boxes and table with each other. Not counted as overlap: fingers with the box between
    them, the robot's base with the table, neighbouring links of the robot.

    Raises SceneError when the goal names no object of the scene.
    """
    if substeps < 1:
        raise RelevanceError(f"substeps = {substeps}: expected at least 1")
    return _Run(_arena(os.getpid()), scene).judge(scene.goal(goal), phases, substeps)


class _Refused(Exception):
    """A plan does not hold; the message is the reason."""


class _Arena(Client):
    """A pybullet client that holds the Panda and takes in one scene after another."""

    def __init__(self) -> None:
        super().__init__()
        self.bodies: list[int] = []
        self._uses = 0
        self._load()

    def _load(self) -> None:
        pybullet.resetSimulation(physicsClientId=self.client)
        self.bodies = []
        self.robot = pybullet.loadURDF(
            str(panda_urdf()),
            useFixedBase=True,
            flags=pybullet.URDF_IGNORE_VISUAL_SHAPES,
            physicsClientId=self.client,
        )
        count = pybullet.getNumJoints(self.robot, physicsClientId=self.client)
        info = [
            pybullet.getJointInfo(self.robot, j, physicsClientId=self.client) for j in range(count)
        ]
        self.links = (_BASE, *range(count))
        self.names = {_BASE: "base", **{j: info[j][12].decode() for j in range(count)}}
        assert self.names[_HAND] == "panda_hand", "the URDF's link order changed"
        self.lower = np.array([info[j][8] for j in _ARM])
        self.upper = np.array([info[j][9] for j in _ARM])
        self.speed = np.array([info[j][11] for j in _ARM])
        self.finger_limits = (info[_FINGERS[0]][8], info[_FINGERS[0]][9])
        # The fixed flange (7) and the grasp target (11) have no shape.
        self.solid = tuple(
            link
            for link in self.links
            if pybullet.getCollisionShapeData(self.robot, link, physicsClientId=self.client)
        )
        self.may_meet = [(a, b) for a in self.solid for b in self.solid if (a, b) in _SELF_PAIRS]

    def enter(self, scene: Scene) -> int:
        """Put a scene's boxes and table around the robot; returns the table's body."""
        self._uses += 1
        if self._uses % _RENEW_AFTER == 0:
            self._load()
        for body in self.bodies:
            pybullet.removeBody(body, physicsClientId=self.client)
        half_yaw = scene.robot.yaw / 2
        self.place(self.robot, scene.robot.base, (0.0, 0.0, math.sin(half_yaw), math.cos(half_yaw)))
        self.bodies = [self._box(box.size) for box in scene.objects]
        thickness = 0.1
        table = self._box((*scene.table.size, thickness))
        self.place(table, (0.0, 0.0, -thickness / 2), (0.0, 0.0, 0.0, 1.0))
        self.bodies.append(table)
        return table

    def _box(self, size: Sequence[float]) -> int:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[edge / 2 for edge in size],
            physicsClientId=self.client,
        )
        body = pybullet.createMultiBody(
            baseMass=0.0, baseCollisionShapeIndex=shape, physicsClientId=self.client
        )
        # The margin rounds a box's edges (1 mm by default: 0.4 mm too far at an edge).
        pybullet.changeDynamics(body, -1, collisionMargin=1e-5, physicsClientId=self.client)
        return body

    def place(self, body: int, position: Sequence[float], orientation: Sequence[float]) -> None:
        # Bodies are posed by their centre of mass, and the robot's base has one of its own.
        if body == self.robot:
            local = pybullet.getDynamicsInfo(body, -1, physicsClientId=self.client)[3:5]
            position, orientation = pybullet.multiplyTransforms(position, orientation, *local)
        pybullet.resetBasePositionAndOrientation(
            body, position, orientation, physicsClientId=self.client
        )

    def pose_robot(self, q: np.ndarray, opening: float) -> None:
        values = [[value] for value in (*q.tolist(), opening, opening)]
        pybullet.resetJointStatesMultiDof(
            self.robot, (*_ARM, *_FINGERS), values, physicsClientId=self.client
        )

    def hand(self) -> tuple[Sequence[float], Sequence[float]]:
        """T_world_hand as position and quaternion."""
        state = pybullet.getLinkState(
            self.robot, _HAND, computeForwardKinematics=True, physicsClientId=self.client
        )
        return state[4], state[5]

    def bounds(self, body: int, link: int = -1) -> _Bounds:
        return pybullet.getAABB(body, link, physicsClientId=self.client)

    def distance(self, a: int, b: int, link_a: int = -1, link_b: int = -1) -> float:
        """Signed distance if under 2 mm, else infinity; hulls of the robot at true size, m."""
        points = pybullet.getClosestPoints(
            a, b, 2e-3, linkIndexA=link_a, linkIndexB=link_b, physicsClientId=self.client
        )
        margin = _HULL_MARGIN * ((a == self.robot) + (b == self.robot))
        return min((point[8] for point in points), default=math.inf) + margin


@lru_cache(maxsize=1)
def _arena(process: int) -> _Arena:
    """The arena of this process: loading the URDF takes longer than most replays."""
    del process  # The key: a forked child must not share its parent's client.
    return _Arena()


class _Run:
    """One plan being judged."""

    def __init__(self, arena: _Arena, scene: Scene) -> None:
        self.arena, self.robot = arena, scene.robot
        self.table = arena.enter(scene)
        self.boxes = {box.name: box for box in scene.objects}
        self.names = tuple(self.boxes)
        self.body = dict(zip(self.boxes, arena.bodies[:-1], strict=True))
        self.table_half = np.array(scene.table.size) / 2
        self.bounds: dict[str, _Bounds] = {}
        self.poses: dict[str, tuple[Sequence[float], Sequence[float]]] = {}
        for box in scene.objects:
            half = box.yaw / 2
            self._put(box.name, box.position, (0.0, 0.0, math.sin(half), math.cos(half)))
        self.held: str | None = None
        self.T_hand_box: tuple[Sequence[float], Sequence[float]] = ((0, 0, 0), (0, 0, 0, 1))
        self.given: dict[str, float] = {}
        """How deep the held box was in others when it was taken, m, less once it left them: a
        scene may sink a box up to its tolerance, and no plan is to blame for that."""
        self.deepest = 0.0
        self.culprit = ""
        self.where = ""

    def judge(self, goal: Goal, phases: Sequence[Phase], substeps: int) -> Replay:
        try:
            self._limits(phases)
            for number, phase in enumerate(phases):
                self._motion(number, phase, substeps)
                following = phases[number + 1] if number + 1 < len(phases) else None
                self._switch(number, phase, following, substeps)
            self._end(goal)
        except _Refused as refusal:
            # An overlap came first, if there was one.
            reason = self.culprit or str(refusal)
            return Replay(ok=False, max_penetration=self.deepest, reason=reason)
        return Replay(ok=not self.culprit, max_penetration=self.deepest, reason=self.culprit)

    def _limits(self, phases: Sequence[Phase]) -> None:
        """Everything that can be said about the joint trajectories alone."""
        arena = self.arena
        previous: np.ndarray | None = None
        for number, phase in enumerate(phases):
            where = f"phase {number}"
            q = np.asarray(phase.q, dtype=float)
            if q.ndim != 2 or q.shape[1] != 7 or len(q) < 1 or not np.isfinite(q).all():
                raise _Refused(f"{where}: q has shape {q.shape}, expected (T + 1, 7), finite")
            if not (math.isfinite(phase.dt) and phase.dt > 0):
                raise _Refused(f"{where}: dt = {phase.dt}, expected more than 0")
            low, high = arena.finger_limits
            if not low - _EPSILON <= phase.opening <= high + _EPSILON:
                raise _Refused(
                    f"{where}: opening {phase.opening:g} m, expected {low:g} to {high:g}"
                )
            beyond = np.maximum(arena.lower - q, q - arena.upper).max(axis=0)
            if beyond.max() > _EPSILON:
                joint = int(beyond.argmax())
                raise _Refused(
                    f"{where}: joint {joint + 1} exceeds its limit by {beyond[joint]:.4f} rad"
                )
            speed = np.abs(np.diff(q, axis=0)) / phase.dt
            over = (speed / arena.speed).max(axis=0, initial=0.0)
            if over.max() > 1 + _EPSILON:
                joint = int(over.argmax())
                raise _Refused(
                    f"{where}: joint {joint + 1} moves at {over[joint]:.2f} times its speed limit"
                )
            if previous is not None and np.abs(q[0] - previous).max() > _EPSILON:
                raise _Refused(f"{where}: does not start where the phase before ended")
            previous = q[-1]

    def _motion(self, number: int, phase: Phase, substeps: int) -> None:
        if phase.carried != self.held:
            raise _Refused(
                f"phase {number}: carries {phase.carried!r}, but the hand holds {self.held!r}"
            )
        q = np.asarray(phase.q, dtype=float)
        for row in range(len(q)):
            for step in range(substeps if row + 1 < len(q) else 1):
                share = step / substeps
                at = q[row] if step == 0 else (1 - share) * q[row] + share * q[row + 1]
                self.where = f"phase {number}, row {row}" + (f" + {share:.2f}" if step else "")
                self._pose(at, phase.opening)
                self._overlaps(self.held)

    def _switch(self, number: int, phase: Phase, following: Phase | None, substeps: int) -> None:
        """What happens at a phase's last row, the arm standing still."""
        action = phase.action
        if action is None:
            return
        self.where = f"phase {number}, {action.name} {action.object}"
        if action.object not in self.boxes:
            raise _Refused(f"{self.where}: there is no such box")
        if following is None:
            raise _Refused(f"{self.where}: the plan ends with the hand at the box")
        if action.name == "pick":
            self._pick(action.object, following.opening)
        elif action.name == "place":
            self._place(action.object, action.support)
        else:
            raise _Refused(f"{self.where}: expected pick or place")
        # The fingers close or open in place; what they touch then is the box, nothing else.
        for step in range(1, substeps):
            share = step / substeps
            opening = (1 - share) * phase.opening + share * following.opening
            self._pose(np.asarray(phase.q[-1], dtype=float), opening)
            self._overlaps(action.object)

    def _pick(self, name: str, opening: float) -> None:
        if self.held is not None:
            raise _Refused(f"{self.where}: the hand holds {self.held!r} already")
        burden = [box.name for box in self.boxes.values() if name in box.supports]
        if burden:
            raise _Refused(f"{self.where}: {burden[0]!r} stands on it")
        inverse = pybullet.invertTransform(*self.arena.hand())
        self.T_hand_box = pybullet.multiplyTransforms(*inverse, *self.poses[name])
        near, far = self._between_fingers(name)
        if not near < far:
            raise _Refused(f"{self.where}: the box is not between the fingers")
        off = max(abs(near + opening), abs(far - opening))
        if off > _GRASP_TOLERANCE:
            raise _Refused(
                f"{self.where}: a closed finger is {1000 * off:.1f} mm off the box's face"
            )
        self.held = name
        self.given = {
            other: max(0.0, -self.arena.distance(self.body[name], body))
            for other, body in self._others(name)
        }

    def _others(self, name: str) -> list[tuple[str, int]]:
        """Every box but one, and the table, with their bodies."""
        return [(o, self.body[o]) for o in self.names if o != name] + [("table", self.table)]

    def _between_fingers(self, name: str) -> tuple[float, float]:
        """Where the line through both finger pads enters and leaves a box, y in hand frame."""
        position, orientation = self.T_hand_box
        rotation = np.array(pybullet.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        start = rotation.T @ (np.array(_GRASP_POINT) - np.array(position))
        along = rotation.T @ np.array([0.0, 1.0, 0.0])
        near, far = -math.inf, math.inf
        for x, d, edge in zip(start, along, self.boxes[name].size, strict=True):
            if abs(d) < 1e-12:
                if abs(x) > edge / 2:
                    return math.inf, -math.inf
                continue
            a, b = sorted(((-edge / 2 - x) / d, (edge / 2 - x) / d))
            near, far = max(near, a), min(far, b)
        return near, far

    def _place(self, name: str, support: str | None) -> None:
        if self.held != name:
            raise _Refused(f"{self.where}: the hand holds {self.held!r}")
        position, orientation = self.poses[name]
        rotation = np.array(pybullet.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        tilt = math.acos(min(1.0, rotation[2, 2]))
        if tilt > _FLAT:
            raise _Refused(f"{self.where}: the box is tilted by {tilt:.3f} rad")
        on = None if support in (None, "table") else support
        if on is not None and (on not in self.boxes or on == name):
            raise _Refused(f"{self.where}: there is no support {on!r}")
        box = replace(
            self.boxes[name],
            position=(position[0], position[1], position[2]),
            yaw=math.atan2(rotation[1, 0], rotation[0, 0]),
            on=on,
        )
        floor = 0.0 if on is None else self.boxes[on].top
        if abs(box.bottom - floor) > CONTACT_TOLERANCE:
            raise _Refused(
                f"{self.where}: released {1000 * (box.bottom - floor):+.1f} mm over its support"
            )
        if on is None:
            if (np.abs(box.corners()) > self.table_half + CONTACT_TOLERANCE).any():
                raise _Refused(f"{self.where}: the box is not on the table")
        elif not self.boxes[on].covers(*box.position[:2]):
            raise _Refused(f"{self.where}: its centre is not over {on!r}")
        self.boxes[name] = box
        self.held = None

    def _end(self, goal: Goal) -> None:
        if self.held is not None:
            raise _Refused(f"the plan ends with {self.held!r} in the hand")
        if not goal_holds(self.boxes.values(), goal, self.robot):
            raise _Refused(f"the goal {goal} is not true at the end")

    def _put(self, name: str, position: Sequence[float], orientation: Sequence[float]) -> None:
        self.poses[name] = (position, orientation)
        self.arena.place(self.body[name], position, orientation)
        self.bounds[name] = self.arena.bounds(self.body[name])

    def _pose(self, q: np.ndarray, opening: float) -> None:
        self.arena.pose_robot(q, opening)
        if self.held is not None:
            pose = pybullet.multiplyTransforms(*self.arena.hand(), *self.T_hand_box)
            self._put(self.held, *pose)

    def _overlaps(self, gripped: str | None) -> None:
        """Record the deepest overlap in the present pose; `gripped` may touch the fingers.

        Plain loops over tuples: with so few bounds, arrays cost three times as much.
        """
        arena, bounds, held = self.arena, self.bounds, self.held
        above = () if held is None else (held,)
        links = {link: arena.bounds(arena.robot, link) for link in arena.solid}
        tallest = max((bounds[name][1][2] for name in self.names if name != held), default=0.0)
        for link, its in links.items():
            for name in self.names if its[0][2] <= tallest else above:
                if _touch(its, bounds[name]) and (name != gripped or link not in _FINGERS):
                    depth = -arena.distance(arena.robot, self.body[name], link)
                    self._record(depth, arena.names[link], name)
        for a, b in arena.may_meet:
            if _touch(links[a], links[b]):
                depth = -arena.distance(arena.robot, arena.robot, a, b)
                self._record(depth, arena.names[a], arena.names[b])
        for link, (low, _) in links.items():
            if low[2] < 0 and link not in (_BASE, 0):
                depth = -arena.distance(arena.robot, self.table, link)
                self._record(depth, arena.names[link], "table")
        if held is None:
            return
        mine = bounds[held]
        for name, body in self._others(held):
            if mine[0][2] < 0 if name == "table" else _touch(mine, bounds[name]):
                depth = -arena.distance(self.body[held], body)
                given = self.given.get(name, 0.0)
                self._record(depth - given, held, name)
                self.given[name] = min(given, max(0.0, depth))
            else:
                self.given[name] = 0.0

    def _record(self, depth: float, a: str, b: str) -> None:
        self.deepest = max(self.deepest, depth)
        if depth > MAX_PENETRATION and not self.culprit:
            self.culprit = f"{self.where}: {a} penetrates {b} by {1000 * depth:.1f} mm"


def _touch(a: _Bounds, b: _Bounds) -> bool:
    """Whether two axis-aligned bounds overlap; heights first, which settle most pairs."""
    (ax, ay, az), (AX, AY, AZ) = a
    (bx, by, bz), (BX, BY, BZ) = b
    return az <= BZ and bz <= AZ and ax <= BX and bx <= AX and ay <= BY and by <= AY
