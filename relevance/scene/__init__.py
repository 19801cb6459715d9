"""What a tabletop is: boxes, table, camera, light, robot, and the goals asked of it.

World frame: origin at the centre of the table's top face, x forward (away from the
robot), y to the robot's left, z up. SI units (m, rad) throughout. The types here are
pydantic dataclasses, so a scene that exists is a scene that was checked: unknown fields,
NaN, overlapping, floating and off-table boxes are refused with the field's name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from relevance.hashing import content_hash

GAP = 0.05
"""Depth of a same-plane goal region, m (DESIGN section 2)."""
CONTACT_TOLERANCE = 0.001
"""How far a box may sink into or float over what it touches, m."""

_CHECKED = ConfigDict(extra="forbid", allow_inf_nan=False)

Length = Annotated[float, Field(gt=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[float, float, float]
Color = tuple[Unit, Unit, Unit]


class SceneError(ValueError):
    """A scene or goal that cannot be: says which field, what it holds, what was expected."""


class Predicate(StrEnum):
    """The spatial relations that a goal can ask for."""

    ON_THE_LEFT = "on-the-left"
    ON_THE_RIGHT = "on-the-right"
    IN_FRONT = "in-front"
    BEHIND = "behind"
    ON = "on"

    @property
    def direction(self) -> tuple[float, float] | None:
        """Unit vector u (x, y) from reference to subject, robot's axes; None for `on`."""
        return _DIRECTIONS.get(self)

    @property
    def family(self) -> str:
        """The scene family that its datasets are made of: `same-plane` or `on`."""
        return "on" if self is Predicate.ON else "same-plane"


_DIRECTIONS = {
    Predicate.ON_THE_LEFT: (0.0, 1.0),
    Predicate.ON_THE_RIGHT: (0.0, -1.0),
    Predicate.IN_FRONT: (-1.0, 0.0),
    Predicate.BEHIND: (1.0, 0.0),
}
FAMILIES = ("same-plane", "on")


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Goal:
    """`predicate(subject, reference)`, e.g. `on-the-left(red, blue)`."""

    predicate: Predicate
    subject: str
    reference: str

    def __str__(self) -> str:
        return f"{self.predicate.value}({self.subject}, {self.reference})"

    @classmethod
    def parse(cls, text: str) -> Goal:
        """Read `predicate(subject, reference)`; raises SceneError on anything else."""
        name, bracket, rest = text.partition("(")
        names = [part.strip() for part in rest.strip().removesuffix(")").split(",")]
        if not bracket or not rest.strip().endswith(")") or len(names) != 2 or not all(names):
            raise SceneError(f"goal {text!r}: expected predicate(subject, reference)")
        try:
            predicate = Predicate(name.strip())
        except ValueError:
            allowed = ", ".join(p.value for p in Predicate)
            raise SceneError(
                f"goal {text!r}: unknown predicate {name.strip()!r}, expected one of {allowed}"
            ) from None
        if names[0] == names[1]:
            raise SceneError(f"goal {text!r}: subject and reference are the same object")
        return cls(predicate=predicate, subject=names[0], reference=names[1])


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Box:
    """One box, standing upright."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[^(),\s][^(),]*$")]
    size: tuple[Length, Length, Length]
    """Full edge lengths along its own x, y, z, m."""
    position: Vector
    """Centre in the world frame, m."""
    yaw: float = 0.0
    """Rotation about z, rad."""
    color: Color
    """RGB in 0..1, as in an image file."""
    on: str | None = None
    """Name of the box that it stands on; None for the table."""

    @property
    def bottom(self) -> float:
        """Height of its lower face, m."""
        return self.position[2] - self.size[2] / 2

    @property
    def top(self) -> float:
        """Height of its upper face, m."""
        return self.position[2] + self.size[2] / 2

    @property
    def extents(self) -> tuple[float, float]:
        """Half extents of the footprint along world x and y, m."""
        c, s = abs(math.cos(self.yaw)), abs(math.sin(self.yaw))
        hx, hy = self.size[0] / 2, self.size[1] / 2
        return c * hx + s * hy, s * hx + c * hy

    def corners(self) -> np.ndarray:
        """Footprint corners in the world frame, (4, 2), m."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        (hx, hy), (x, y) = (edge / 2 for edge in self.size[:2]), self.position[:2]
        a, b, d, e = c * hx, s * hy, s * hx, c * hy
        return np.array(
            [
                [x + a - b, y + d + e],
                [x - a - b, y - d + e],
                [x - a + b, y - d - e],
                [x + a + b, y + d - e],
            ]
        )

    def covers(self, x: float, y: float) -> bool:
        """Whether the point (x, y) lies over its footprint."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        dx, dy = x - self.position[0], y - self.position[1]
        return abs(c * dx + s * dy) <= self.size[0] / 2 and abs(c * dy - s * dx) <= self.size[1] / 2


TEXTURES = ("checks", "stripes", "noise")
"""Patterns that a table can have: squares, bands across its angle, cloudy spots."""


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Texture:
    """A pattern on the table: parameters, not pixels, so that it can be drawn again exactly."""

    kind: Literal["checks", "stripes", "noise"]
    color: Color
    """The second colour; the first is the table's own."""
    scale: Length
    """Edge of a square, width of a band or size of a spot, m."""
    angle: float = 0.0
    """Turn of the pattern about z, rad."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Where the pattern lies; which one it is, for `noise`."""


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Table:
    """The table, its top face at z = 0."""

    size: tuple[Length, Length] = (0.8, 1.2)
    """Full edge lengths along x and y, m."""
    color: Color = (0.93, 0.92, 0.89)
    texture: Texture | None = None
    """None: of one colour."""


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Camera:
    """Pinhole camera; image-left is robot-left."""

    eye: Vector = (-0.66, 0.0, 0.66)
    target: Vector = (0.0, 0.0, 0.0)
    width: Annotated[int, Field(gt=0)] = 320
    height: Annotated[int, Field(gt=0)] = 192
    fov: Annotated[float, Field(gt=0, lt=180)] = 47.0
    """Horizontal field of view, degrees."""
    near: Length = 0.038
    far: Length = 100.0


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Light:
    """One distant light, as pybullet's TinyRenderer takes it."""

    direction: Vector = (-0.4, 0.5, 1.0)
    """From the scene towards the light."""
    color: Color = (1.0, 1.0, 1.0)
    distance: Length = 2.0
    """How far the light is from the world's origin, m; shadows spread from there, while the
    shade of a face depends on the direction alone."""
    ambient: Unit = 0.6
    diffuse: Unit = 0.4
    specular: Unit = 0.05
    shadow: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Robot:
    """Where the Franka Panda stands."""

    base: Vector = (-0.48, 0.0, 0.0)
    yaw: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Scene:
    """A tabletop; raises SceneError (through pydantic) unless it is physically possible."""

    id: str = ""
    """Content hash when left empty."""
    objects: Annotated[tuple[Box, ...], Field(min_length=1)]
    goals: tuple[str, ...] = ()
    """Goals asked of it, as text."""
    table: Table = Table()
    camera: Camera = Camera()
    light: Light = Light()
    robot: Robot = Robot()

    @model_validator(mode="after")
    def _possible(self) -> Scene:
        _check_boxes(self.objects, self.table)
        for text in self.goals:
            self.goal(text)
        if not self.id:
            body = TypeAdapter(Scene).dump_python(self, mode="json", exclude={"id", "goals"})
            if self.table.texture is None:  # a plain table hashes as it did before there were any
                del body["table"]["texture"]
            object.__setattr__(self, "id", content_hash(body))
        return self

    def __getitem__(self, name: str) -> Box:
        for box in self.objects:
            if box.name == name:
                return box
        known = ", ".join(box.name for box in self.objects)
        raise SceneError(f"unknown object {name!r}, expected one of {known}")

    @property
    def names(self) -> tuple[str, ...]:
        """Object names, in order."""
        return tuple(box.name for box in self.objects)

    def goal(self, text: str | Goal) -> Goal:
        """Read a goal and check that its objects are in the scene."""
        goal = text if isinstance(text, Goal) else Goal.parse(text)
        for name in (goal.subject, goal.reference):
            if name not in self.names:
                known = ", ".join(self.names)
                raise SceneError(f"goal {str(goal)!r}: unknown object {name!r}, have {known}")
        return goal

    def moved(self, final: Mapping[str, Pose]) -> tuple[Box, ...]:
        """The boxes after some of them were put elsewhere (not checked: plans are)."""
        return tuple(
            replace(
                box,
                position=final[box.name].position,
                yaw=final[box.name].yaw,
                on=final[box.name].on,
            )
            if box.name in final
            else box
            for box in self.objects
        )


@dataclass(frozen=True, slots=True, kw_only=True, config=_CHECKED)
class Pose:
    """Where a box stands: centre (m), yaw (rad), and on which box (None: table)."""

    position: Vector
    yaw: float
    on: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """`pick(object)` or `place(object, support)`; exactly one object each."""

    name: str
    """`pick` or `place`."""
    object: str
    support: str | None = None
    """For `place`: a box's name or `table`."""

    def to_list(self) -> list[str]:
        """As it stands in plan rows and JSON: `["place", "red", "table"]`."""
        return [part for part in (self.name, self.object, self.support) if part is not None]


@dataclass(
    frozen=True, slots=True, kw_only=True, eq=False, config={"arbitrary_types_allowed": True}
)
class Phase:
    """One motion of the arm, ending at a switch (grasp or release) or in the final retreat.

    Joint angles are linear between rows. During the motion the fingers keep `opening`; a
    carried box is rigid to the hand with the offset that it had when it was grasped.
    """

    action: Action | None
    """What happens at the last row; None for the final retreat."""
    q: np.ndarray
    """(T + 1, 7), rad; the first row equals the last row of the phase before."""
    dt: float
    """Seconds between rows."""
    opening: float
    """Value of each of the two finger joints during the motion, m."""
    carried: str | None
    """Name of the box in the hand, if any."""


def goal_holds(objects: Iterable[Box], goal: Goal, tolerance: float = 1e-3) -> bool:
    """Whether the goal is true of these boxes (DESIGN section 2), up to `tolerance` metres."""
    boxes = {box.name: box for box in objects}
    subject, reference = boxes[goal.subject], boxes[goal.reference]
    u = goal.predicate.direction
    if u is None:
        return (
            subject.on == reference.name
            and abs(subject.bottom - reference.top) <= tolerance
            and reference.covers(*subject.position[:2])
        )
    if subject.on is not None or abs(subject.bottom) > tolerance:
        return False
    low, high, half_width = region(subject, reference, goal.predicate)
    dx = subject.position[0] - reference.position[0]
    dy = subject.position[1] - reference.position[1]
    along, across = dx * u[0] + dy * u[1], abs(dx * u[1]) + abs(dy * u[0])
    return low - tolerance <= along <= high + tolerance and across <= half_width + tolerance


def region(subject: Box, reference: Box, predicate: Predicate) -> tuple[float, float, float]:
    """Bounds of a same-plane goal region: (H + r, H + r + GAP, W), m (DESIGN section 2)."""
    u = predicate.direction
    assert u is not None, "`on` has no region beside the reference"
    ex, ey = reference.extents
    along, across = (ex, ey) if u[0] else (ey, ex)
    r = min(subject.size[0], subject.size[1]) / 2
    return along + r, along + r + GAP, across


def footprint_gap(a: Box, b: Box) -> float:
    """Separating-axis distance of two footprints, m; negative where they overlap.

    A lower bound of the true distance when positive, the exact depth when negative.
    """
    dx, dy = b.position[0] - a.position[0], b.position[1] - a.position[1]
    c, s = abs(math.cos(b.yaw - a.yaw)), abs(math.sin(b.yaw - a.yaw))
    best = -math.inf
    for one, other in ((a, b), (b, a)):
        along, across = math.cos(one.yaw), math.sin(one.yaw)
        hx, hy = other.size[0] / 2, other.size[1] / 2
        best = max(
            best,
            abs(along * dx + across * dy) - one.size[0] / 2 - c * hx - s * hy,
            abs(along * dy - across * dx) - one.size[1] / 2 - s * hx - c * hy,
        )
    return best


def _check_boxes(objects: tuple[Box, ...], table: Table) -> None:
    names = [box.name for box in objects]
    for i, box in enumerate(objects):
        where = f"objects.{i} ({box.name!r})"
        if box.name in names[:i] or box.name == "table":
            raise SceneError(f"{where}: name is taken, expected distinct names other than 'table'")
        reach = (abs(at) + extent for at, extent in zip(box.position, box.extents, strict=False))
        if any(
            far > edge / 2 + CONTACT_TOLERANCE for far, edge in zip(reach, table.size, strict=True)
        ):
            raise SceneError(
                f"{where}: position {list(box.position)} is off the table, "
                f"expected its footprint within +-{table.size[0] / 2:g}, +-{table.size[1] / 2:g} m"
            )
        if box.on is None:
            support, floor = "the table", 0.0
        elif box.on == box.name or box.on not in names:
            raise SceneError(f"{where}: on = {box.on!r}, expected null or another object's name")
        else:
            below = objects[names.index(box.on)]
            support, floor = repr(box.on), below.top
            if not below.covers(*box.position[:2]):
                raise SceneError(f"{where}: floating, expected its centre over {support}")
        if abs(box.bottom - floor) > CONTACT_TOLERANCE:
            state = "floating above" if box.bottom > floor else "sunk into"
            raise SceneError(
                f"{where}: {state} {support}, expected position z {floor + box.size[2] / 2:g}, "
                f"found {box.position[2]:g}"
            )
        for other in objects[:i]:
            depth = -max(box.bottom - other.top, other.bottom - box.top, footprint_gap(box, other))
            if depth > CONTACT_TOLERANCE:
                raise SceneError(
                    f"{where}: overlaps {other.name!r} by {1000 * depth:.1f} mm, "
                    "expected boxes apart or touching"
                )


_SCENE = TypeAdapter(Scene)


def scene_to_json(scene: Scene) -> str:
    """One line of JSON; `scene_from_json` gives an equal scene back."""
    return _SCENE.dump_json(scene).decode()


def scene_from_json(text: str | bytes, *, where: str = "scene") -> Scene:
    """Read one scene; raises SceneError that names `where`, the field and what was expected."""
    try:
        return _SCENE.validate_json(text)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        # A misspelt field is missing and unknown at once: the unknown one says more.
        first = next((e for e in errors if e["type"] == "unexpected_keyword_argument"), errors[0])
        field = ".".join(str(part) for part in first["loc"])
        found = first["input"] if isinstance(first["input"], str | int | float) else None
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "unexpected_keyword_argument":
            message = "unknown field"
        text = ": ".join(part for part in (where, field, message) if part)
        if found is not None and repr(found) not in text:
            text += f" (found {found!r})"
        raise SceneError(text) from None


def read_scenes(path: str | Path) -> list[Scene]:
    """Read a JSON file (one scene or a list) or JSON lines (one scene a line).

    Raises SceneError naming file, line and field; FileNotFoundError becomes one too.
    """
    path = Path(path)
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read as text ({error})") from None
    try:
        whole = json.loads(text)
    except json.JSONDecodeError:
        lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
        if not lines:
            raise SceneError(f"{path}: is empty, expected at least one scene") from None
        return [scene_from_json(line, where=f"{path}:{n}") for n, line in lines]
    if isinstance(whole, list):
        return [
            scene_from_json(json.dumps(item), where=f"{path}[{n}]") for n, item in enumerate(whole)
        ]
    return [scene_from_json(text, where=f"{path}:1")]
