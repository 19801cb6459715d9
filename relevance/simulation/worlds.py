"""Other people's pybullet worlds: what stands on a table there as a scene, and scenes put there.

A scene's frame has its origin at the centre of the table's top and x away from the robot; a
world's may lie anywhere, so a `World` keeps both, and turns poses of a plan into poses of bodies.
Bodies touch with gaps of a fraction of a millimetre there, and tilts to match: those are closed.
Poses are a position (m) and a quaternion (x, y, z, w), as pybullet has them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from relevance.errors import RelevanceError, RelevanceWarning
from relevance.robot import panda_urdf
from relevance.scene import (
    CONTACT_TOLERANCE,
    THINNEST,
    Box,
    Camera,
    Color,
    Light,
    Pose,
    Robot,
    Scene,
    Table,
    footprint_gap,
)
from relevance.simulation.bullet import pybullet

UPRIGHT = 0.02
"""Tilt up to which a box counts as upright, rad."""
SETTLED = 0.005
"""Gap or overlap with what carries it up to which a body counts as standing there, m."""
_NAME = "relevance-name"  # user data of bodies that a scene was written to
_TABLE_THICKNESS = 0.05
_DIGITS = 6  # pybullet keeps places as single floats; what is written comes back the same
_PLANE = "a plane"
_KINDS = {
    pybullet.GEOM_SPHERE: "a sphere",
    pybullet.GEOM_BOX: "a box",
    pybullet.GEOM_CYLINDER: "a cylinder",
    pybullet.GEOM_MESH: "a mesh",
    pybullet.GEOM_PLANE: _PLANE,
    pybullet.GEOM_CAPSULE: "a capsule",
}

BodyPose = tuple[Sequence[float], Sequence[float]]
_Stance = tuple[Sequence[float], Sequence[float], float]  # size, position, yaw
_AT_ORIGIN: BodyPose = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class WorldError(RelevanceError):
    """A pybullet world that cannot be read: says which body, what was found and expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """A body that is not a box of the scene: what it is, and what was done with it."""

    body: int
    name: str
    what: str
    done: str

    def __str__(self) -> str:
        return f"body {self.body} ({self.name}): {self.what}, {self.done}"


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """A scene and the bodies of a pybullet client that it is of."""

    scene: Scene
    client: int
    bodies: Mapping[str, int]
    """By the names of the scene's objects."""
    boxes: tuple[str, ...]
    """Objects that are boxes; the others are boxes around bodies of another shape, which a hand
    may not be able to take: `plan(world.scene, goal, movable=world.boxes)` leaves them there."""
    notes: tuple[Note, ...]
    """Every other body, and those that a box was put around."""
    origin: BodyPose
    """Where the scene's frame is in the world."""
    frames: Mapping[str, BodyPose] = field(repr=False)
    """Where each body's centre of mass is in the frame of its box."""

    def pose(self, name: str, pose: Pose) -> BodyPose:
        """Where a body is when its box is at a pose of the scene (`result.final[name]`), as
        `resetBasePositionAndOrientation` takes it."""
        there = _times(self.origin, _upright(pose.position, pose.yaw))
        return _times(there, self.frames[self.scene[name].name])


def read_bullet(
    client: Any = 0,
    *,
    robot: int | None = None,
    table: int | None = None,
    names: Mapping[int, str] = {},
    ignore: Collection[int] = (),
    camera: Camera = Camera(),  # noqa: B008  (frozen)
    light: Light = Light(),  # noqa: B008
) -> World:
    """The boxes on the table of a running pybullet world as a scene; nothing there is changed.

    Boxes are read from collision shapes, where a body has none from visual ones; one that lies on
    its side is a box of other edges. Any other body that stands on the table, a tilted box too, is
    taken as the upright box around it. Left out are bodies under or beside the table, planes as the
    ground mostly is one, and with a RelevanceWarning those that float, reach over the table's edge,
    or have joints, and planes that rise over its top. `World.notes` says so of every body. A
    SceneError names a box that cannot stand where it does.

    client: its number, or a BulletClient.
    robot, table: their bodies; by default those that are called so (`panda`, `table`). Without a
        table the top is z = 0, its centre the origin; without a robot it stands where it does in
        a scene.
    names: of bodies, for goals; by default those of their URDF, else `body-3`.
    ignore: bodies that are no part of it.
    camera, light: of the scene, in its frame.
    """
    number = _number(client)
    bodies = [
        pybullet.getBodyUniqueId(place, physicsClientId=number)
        for place in range(pybullet.getNumBodies(physicsClientId=number))
    ]
    left_out = [("ignore", body) for body in ignore]
    for what, given in (("robot", robot), ("table", table), *left_out):
        if given is not None and given not in bodies:
            known = ", ".join(map(str, bodies)) or "none: the world is empty"
            raise WorldError(f"{what} {given}: no such body, expected one of {known}")
    called = {body: _name(number, body) for body in bodies}
    written = {body: name for body in bodies if (name := _written(number, body)) is not None}
    foreign = {body: name for body, name in called.items() if body not in written}
    robot = robot if robot is not None else _called(foreign, "panda")
    table = table if table is not None else _called(called, "table")
    origin, top = _table(number, table, robot)
    reader = _Reader(number, origin, top, names=_distinct(called, written | {**names}))
    for body in bodies:
        if body == robot:
            reader.note(body, "the robot", "planned with as a Panda")
        elif body == table:
            reader.note(body, "the table", "its top is the scene's")
        elif body in ignore:
            reader.note(body, "a body", "left out as it was asked for")
        else:
            reader.take(body)
    standing = reader.settled()
    if not standing:
        raise WorldError(f"client {number}: nothing stands on the table, expected a box there")
    scene = Scene(
        objects=tuple(standing),
        table=top,
        camera=camera,
        light=light,
        robot=Robot() if robot is None else _robot(number, robot, origin),
    )
    for note in reader.warned:
        warnings.warn(str(note), RelevanceWarning, stacklevel=2)
    kept = set(scene.names)
    return World(
        scene=scene,
        client=number,
        bodies={name: body for name, body in reader.bodies.items() if name in kept},
        boxes=tuple(name for name in scene.names if name in reader.exact),
        notes=tuple(sorted(reader.notes, key=lambda note: note.body)),
        origin=origin,
        frames={name: frame for name, frame in reader.frames.items() if name in kept},
    )


def write_bullet(
    scene: Scene,
    client: Any = 0,
    *,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    robot: bool = True,
    mass: float = 0.1,
) -> World:
    """Put a scene's boxes, table and robot into a pybullet world; `read_bullet` gets them back.

    origin, yaw: where the centre of the table's top comes to be, m, and its turn, rad.
    robot: whether the Panda is loaded, too.
    mass: of each box, kg; 0 makes them immovable.
    """
    number, there = _number(client), _upright(origin, yaw)
    below = (0.0, 0.0, -_TABLE_THICKNESS / 2)
    size = (*scene.table.size, _TABLE_THICKNESS)
    table = _create(number, size, scene.table.color, 0.0, _times(there, _upright(below, 0.0)))
    _call(number, table, "table")
    notes = [Note(body=table, name="table", what="the table", done="its top is the scene's")]
    if robot:
        stands = _times(there, _upright(scene.robot.base, scene.robot.yaw))
        arm = pybullet.loadURDF(
            str(panda_urdf()), *stands, useFixedBase=True, physicsClientId=number
        )
        note = Note(body=arm, name="panda", what="the robot", done="planned with as a Panda")
        notes.append(note)
    bodies = {}
    for box in scene.objects:
        pose = _times(there, _upright(box.position, box.yaw))
        bodies[box.name] = _create(number, box.size, box.color, mass, pose)
        _call(number, bodies[box.name], box.name)
    return World(
        scene=scene,
        client=number,
        bodies=bodies,
        boxes=scene.names,
        notes=tuple(notes),
        origin=there,
        frames=dict.fromkeys(scene.names, _AT_ORIGIN),
    )


class _Reader:
    """Takes in one body after the other."""

    def __init__(
        self, client: int, origin: BodyPose, table: Table, *, names: Mapping[int, str]
    ) -> None:
        self.client, self.origin, self.table, self.names = client, origin, table, names
        self.inverse = pybullet.invertTransform(*origin)
        self.boxes: list[Box] = []
        self.bodies: dict[str, int] = {}
        self.frames: dict[str, BodyPose] = {}
        self.exact: set[str] = set()
        self.notes: list[Note] = []
        self.warned: list[Note] = []

    def note(self, body: int, what: str, done: str, *, warn: bool = False) -> None:
        """What was done with a body."""
        self.notes.append(Note(body=body, name=self.names[body], what=what, done=done))
        if warn:
            self.warned.append(self.notes[-1])

    def take(self, body: int) -> None:
        """A box, or the box around it, if it is over the table."""
        if _moving_joints(self.client, body):
            return self.note(body, "a body with joints", "left out", warn=True)
        shapes = _shapes(self.client, body)
        if not shapes:
            return self.note(body, "a body without a shape to touch", "left out")
        shapes = [replace(shape, pose=_times(self.inverse, shape.pose)) for shape in shapes]
        if any(shape.kind == _PLANE for shape in shapes):
            return self._ground(body, shapes)
        alone = shapes[0] if len(shapes) == 1 else None
        what = alone.kind if alone else f"a body of {len(shapes)} shapes"
        exact = alone.upright() if alone else None
        size, position, yaw = exact or _around(shapes)
        if alone and alone.kind == "a box" and exact is None:
            what = f"a box tilted by {math.degrees(alone.tilt):.0f} degrees"
        # by its middle, too: a thin sheet on the table rises over it by no more than that
        if position[2] <= 0 and position[2] + size[2] / 2 <= CONTACT_TOLERANCE:
            return self.note(body, what, "left out: it is under the table's top")
        if min(_rounded(size)) < THINNEST:
            thin = f"left out: it is thinner than {1000 * THINNEST:g} mm"
            return self.note(body, what, thin, warn=True)
        box = Box(
            name=self.names[body],
            size=_rounded(size),
            position=_rounded(position),
            yaw=round(yaw, _DIGITS),
            color=_color(self.client, body),
        )
        half = np.array(self.table.size) / 2
        over = np.abs(box.corners()) <= half + CONTACT_TOLERANCE
        if not over.all(axis=1).any() and not (np.abs(position[:2]) <= half).all():
            return self.note(body, what, "left out: it is beside the table")
        if not over.all():
            return self.note(body, what, "left out: it reaches over the table's edge", warn=True)
        if exact is None:
            self.note(body, what, "taken as the upright box around it", warn=True)
        else:
            self.exact.add(box.name)
        self.boxes.append(box)
        self.bodies[box.name] = body
        there = pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)
        frame = pybullet.invertTransform(*_upright(position, yaw))
        self.frames[box.name] = _times(frame, _times(self.inverse, there))
        return None

    def _ground(self, body: int, shapes: Sequence[_Shape]) -> None:
        """A plane has no edges: nothing stands on it but what stands on the table, too."""
        over = max(shape.rise for shape in shapes if shape.kind == _PLANE)
        if math.isinf(over):
            why = "it is not level, expected ground"
        elif over > CONTACT_TOLERANCE:
            why = f"it lies {1000 * over:.0f} mm over the table's top, expected it no higher"
        else:
            why = "it is not over the table's top"
        self.note(body, _PLANE, f"left out: {why}", warn=over > CONTACT_TOLERANCE)

    def settled(self) -> list[Box]:
        """The boxes, each right on what it stands on, in the order of the bodies; those that
        stand on nothing are left out."""
        placed: dict[str, Box] = {}
        for box in sorted(self.boxes, key=lambda box: (box.bottom, box.name)):
            found = _settle(box, placed.values())
            if isinstance(found, Box):
                placed[box.name] = found
                continue
            body = self.bodies[box.name]
            self.notes = [note for note in self.notes if note.body != body]
            self.warned = [note for note in self.warned if note.body != body]
            self.note(body, "a body", f"left out: {found}", warn=True)
        return [placed[box.name] for box in self.boxes if box.name in placed]


def _settle(box: Box, placed: Collection[Box]) -> Box | str:
    """The box on what it stands on, or why it stands on nothing."""
    below = [
        other
        for other in placed
        if abs(other.top - box.bottom) <= min(SETTLED, abs(box.bottom))
        and footprint_gap(box, other) < 0
    ]
    if not below and abs(box.bottom) > SETTLED:
        return f"it floats {1000 * box.bottom:.0f} mm over the table"
    floor = max((other.top for other in below), default=0.0)
    carriers = [other for other in below if floor - other.top <= CONTACT_TOLERANCE]
    if len(carriers) == 1 and not carriers[0].covers(*box.position[:2]):
        return f"its centre is not over {carriers[0].name}, on which it would stand"
    names = tuple(other.name for other in carriers)
    x, y, _ = box.position
    return replace(box, position=(x, y, floor + box.size[2] / 2), on=names or None)


# --- shapes -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shape:
    """One shape of a body."""

    kind: str
    dimensions: tuple[float, float, float]
    """Edges of a box; length and radius of a cylinder and a capsule; radius of a sphere; edges of
    the upright box around a mesh; the normal of a plane."""
    pose: BodyPose

    @property
    def axes(self) -> np.ndarray:
        """Its own axes as columns (3, 3)."""
        return np.reshape(pybullet.getMatrixFromQuaternion(self.pose[1]), (3, 3))

    @property
    def tilt(self) -> float:
        """Turn from the upright pose that is nearest, rad."""
        return math.acos(min(1.0, float(np.abs(self.axes[2]).max())))

    def upright(self) -> _Stance | None:
        """Size, position and yaw of a box that stands on one of its faces; None for others."""
        if self.kind != "a box" or self.tilt > UPRIGHT:
            return None
        axes = self.axes
        up = int(np.abs(axes[2]).argmax())
        x, y = (up + 1) % 3, (up + 2) % 3
        if axes[2, up] < 0:  # upside down: the other way round, seen from above
            x, y = y, x
        size = [self.dimensions[axis] for axis in (x, y, up)]
        return size, self.pose[0], math.atan2(axes[1, x], axes[0, x])

    @property
    def rise(self) -> float:
        """Height of a plane, m; infinite where it is not level."""
        normal = self.axes @ np.array(self.dimensions)
        return self.pose[0][2] if normal[2] >= math.cos(UPRIGHT) else math.inf

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of what is around it, no plane, (3,) each, m."""
        axes, (a, b, _) = self.axes, self.dimensions
        if self.kind == "a sphere":
            half = np.full(3, a)
        elif self.kind in ("a cylinder", "a capsule"):
            # A disc reaches less far along its axis than a ball.
            flat = 1 - np.minimum(axes[:, 2] ** 2, 1) if self.kind == "a cylinder" else 1.0
            half = np.abs(axes[:, 2]) * a / 2 + b * np.sqrt(flat)
        else:
            half = np.abs(axes) @ np.array(self.dimensions) / 2
        return np.array(self.pose[0]) - half, np.array(self.pose[0]) + half


def _around(shapes: Sequence[_Shape]) -> _Stance:
    """Size, position and yaw of the box around shapes."""
    low, high = zip(*(shape.bounds() for shape in shapes), strict=True)
    lowest, highest = np.min(low, axis=0), np.max(high, axis=0)
    return (highest - lowest).tolist(), ((lowest + highest) / 2).tolist(), 0.0


def _shapes(client: int, body: int) -> list[_Shape]:
    """What a body is made of, in the world: what it collides with, else what is seen of it."""
    found = []
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        centre, _ = _frames(client, body, link)
        for part in pybullet.getCollisionShapeData(body, link, physicsClientId=client):
            kind, dimensions, at = part[2], part[3], _times(centre, (part[5], part[6]))
            if kind == pybullet.GEOM_MESH:  # its dimensions are scales
                low, high = np.array(pybullet.getAABB(body, link, physicsClientId=client))
                dimensions, at = tuple(high - low), (tuple((low + high) / 2), _AT_ORIGIN[1])
            found.append(_Shape(kind=_KINDS.get(kind, "a body"), dimensions=dimensions, pose=at))
    if found:
        return found
    for part in pybullet.getVisualShapeData(body, physicsClientId=client):
        if part[2] != pybullet.GEOM_MESH:
            _, frame = _frames(client, body, part[1])
            at = _times(frame, (part[5], part[6]))
            kind = _KINDS.get(part[2], "a body")
            found.append(_Shape(kind=kind, dimensions=part[3], pose=at))
    return found


def _frames(client: int, body: int, link: int) -> tuple[BodyPose, BodyPose]:
    """A link's centre of mass, and its frame as its URDF has it, in the world."""
    if link >= 0:
        state = pybullet.getLinkState(
            body, link, computeForwardKinematics=True, physicsClientId=client
        )
        return state[:2], state[4:6]
    centre = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    local = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
    return centre, _times(centre, pybullet.invertTransform(*local))


def _moving_joints(client: int, body: int) -> bool:
    joints = range(pybullet.getNumJoints(body, physicsClientId=client))
    return any(
        pybullet.getJointInfo(body, joint, physicsClientId=client)[2] != pybullet.JOINT_FIXED
        for joint in joints
    )


def _color(client: int, body: int) -> Color:
    """Of the first shape that is seen; white where none is."""
    seen = pybullet.getVisualShapeData(body, physicsClientId=client)
    red, green, blue = (
        min(1.0, max(0.0, round(channel, 6))) for channel in (seen[0][7] if seen else (1, 1, 1))[:3]
    )
    return red, green, blue


# --- table, robot and names ---------------------------------------------------------------------


def _table(client: int, body: int | None, robot: int | None) -> tuple[BodyPose, Table]:
    """The scene's frame in the world, and the table's top.

    The top is the highest of its boxes. Of the four ways to lay axes along its edges it is the one
    in which the robot is turned least, so that left is where a model learned it.
    """
    if body is None:
        return _AT_ORIGIN, Table()
    shapes = _shapes(client, body)
    slabs = [found for shape in shapes if (found := shape.upright())]
    if not shapes:
        raise WorldError(f"table {body}: has no shape to stand on, expected one")
    if any(shape.kind == _PLANE for shape in shapes):
        raise WorldError(f"table {body}: is a plane without edges, expected a body with some")
    if not slabs and any(shape.kind == "a box" for shape in shapes):
        raise WorldError(f"table {body}: is tilted, expected its top level")
    size, (x, y, z), yaw = max(
        slabs or [_around(shapes)], key=lambda slab: slab[1][2] + slab[0][2] / 2
    )
    length, width = size[:2]
    if robot is not None and _written(client, body) is None:
        quarters = round((_heading(client, robot) - yaw) / (math.pi / 2))
        yaw += quarters * math.pi / 2
        length, width = (width, length) if quarters % 2 else (length, width)
    top = Table(size=_rounded((length, width)), color=_color(client, body))
    return _upright((x, y, z + size[2] / 2), yaw), top


def _robot(client: int, body: int, origin: BodyPose) -> Robot:
    """Where the robot stands in the scene."""
    _, frame = _frames(client, body, -1)
    (x, y, z), turn = _times(pybullet.invertTransform(*origin), frame)
    axes = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))
    if axes[2, 2] < math.cos(UPRIGHT):
        tilt = math.degrees(math.acos(max(-1.0, float(axes[2, 2]))))
        raise WorldError(f"robot {body}: is tilted by {tilt:.0f} degrees, expected it upright")
    return Robot(base=_rounded((x, y, z)), yaw=round(math.atan2(axes[1, 0], axes[0, 0]), _DIGITS))


def _heading(client: int, body: int) -> float:
    axes = pybullet.getMatrixFromQuaternion(_frames(client, body, -1)[1][1])
    return math.atan2(axes[3], axes[0])


def _written(client: int, body: int) -> str | None:
    """The name that `write_bullet` gave a body."""
    key = pybullet.getUserDataId(body, _NAME, physicsClientId=client)
    return None if key < 0 else pybullet.getUserData(key, physicsClientId=client).decode()


def _name(client: int, body: int) -> str:
    """What a body is called: by `write_bullet`, by its URDF, or not at all."""
    written = _written(client, body)
    if written is not None:
        return written
    name = pybullet.getBodyInfo(body, physicsClientId=client)[1].decode(errors="replace")
    plain = "".join(c for c in name.removesuffix(".urdf") if c.isprintable() and c not in "(),")
    return plain.strip()[:100]


def _called(names: Mapping[int, str], word: str) -> int | None:
    """The body that is called so; WorldError where several are."""
    found = [body for body, name in names.items() if name.lower() == word]
    if len(found) > 1:
        raise WorldError(f"bodies {found}: each is called {word}, expected {word}=... to say which")
    return found[0] if found else None


def _distinct(called: Mapping[int, str], given: Mapping[int, str]) -> dict[int, str]:
    """A name for every body; what is given counts first, and equal ones are numbered."""
    for body in given:
        if body not in called:
            raise WorldError(f"names: no body {body}, expected some of {list(called)}")
    names = dict(given)
    taken = set(given.values())
    for body, name in called.items():
        if body in names:
            continue
        plain, count = name or f"body-{body}", 1
        name = plain
        while name in taken:
            count += 1
            name = f"{plain}-{count}"
        names[body] = name
        taken.add(name)
    return names


def _number(client: Any) -> int:
    """A client's number; WorldError where it is not connected."""
    number = getattr(client, "_client", client)
    if not isinstance(number, int) or number < 0 or not pybullet.isConnected(number):
        raise WorldError(f"client {number!r}: not connected, expected what pybullet.connect gave")
    return number


def _create(client: int, size: Sequence[float], color: Color, mass: float, pose: BodyPose) -> int:
    half = [edge / 2 for edge in size]
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client
    )
    seen = pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=half, rgbaColor=[*color, 1.0], physicsClientId=client
    )
    return pybullet.createMultiBody(mass, shape, seen, *pose, physicsClientId=client)


def _call(client: int, body: int, name: str) -> None:
    pybullet.addUserData(body, _NAME, name, physicsClientId=client)


def _upright(position: Sequence[float], yaw: float) -> BodyPose:
    return tuple(map(float, position)), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def _times(a: BodyPose, b: BodyPose) -> BodyPose:
    return pybullet.multiplyTransforms(*a, *b)


def _rounded(values: Sequence[float]) -> tuple[Any, ...]:
    return tuple(round(float(value), _DIGITS) for value in values)
