"""What stands on the table and around it: boxes, table, camera, light, robot.

Pydantic dataclasses: fields that are unknown, of another type, NaN or infinite are refused.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, Strict, model_validator

from relevance.scene.checks import checked
from relevance.scene.words import Name, normal

_FAR = 1e6  # m; beyond, and for far more turns than this, digits are lost

Length = Annotated[float, Strict(), Field(gt=0, le=_FAR)]
THINNEST = 1e-4
"""Shortest edge, m."""
Edge = Annotated[Length, Field(ge=THINNEST)]
Unit = Annotated[float, Strict(), Field(ge=0, le=1)]
Metres = Annotated[float, Strict(), Field(ge=-_FAR, le=_FAR)]
Angle = Annotated[float, Strict(), Field(ge=-_FAR, le=_FAR)]
Whole = Annotated[int, Strict()]
Vector = tuple[Metres, Metres, Metres]
Color = tuple[Unit, Unit, Unit]


def wrapped(angle: float) -> float:
    """The same turn in (-pi, pi], rad; to 1e-12, so that all ways to write it are one."""
    turn = round(math.remainder(angle, math.tau), 12)
    return math.pi if abs(turn) > math.pi else turn


Turn = Annotated[Angle, AfterValidator(wrapped)]


def _supports(value: Any) -> Any:
    """One name instead of a list of one; what is no name is refused later, by its type."""
    if not isinstance(value, list | tuple):
        return value
    if not value or len({normal(str(name)) for name in value}) < len(value):
        raise ValueError("expected null, a name or a list of distinct names")
    alone = len(value) == 1 and isinstance(value[0], str)
    return value[0] if alone else tuple(value)


Support = Annotated[Name | tuple[Name, ...] | None, BeforeValidator(_supports)]


@checked
class Box:
    """One box, standing upright."""

    name: Name
    size: tuple[Edge, Edge, Edge]
    """Full edge lengths along its own x, y, z, m."""
    position: Vector
    """Centre in the world frame, m."""
    yaw: Angle = 0.0
    """Rotation about z, rad; a scene keeps it in (-pi, pi]."""
    color: Color
    """RGB in 0..1, as in an image file."""
    on: Support = None
    """Name of the box that it stands on, or names of several; None for the table."""

    @property
    def supports(self) -> tuple[str, ...]:
        """Names of the boxes that it stands on; none for the table."""
        if self.on is None:
            return ()
        return (self.on,) if isinstance(self.on, str) else self.on

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
        return self.extents_at(0.0)

    def extents_at(self, angle: float) -> tuple[float, float]:
        """Half extents of the footprint along axes that are turned by `angle` (rad), m."""
        c, s = abs(math.cos(self.yaw - angle)), abs(math.sin(self.yaw - angle))
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


_NOWHERE = 1e-6  # m; what is shorter has no direction
_MOST_PIXELS = 4096  # a side of a picture

TEXTURES = ("checks", "stripes", "noise")
"""Patterns that a table can have: squares, bands across its angle, cloudy spots."""


@checked
class Texture:
    """A pattern on the table: parameters, not pixels, so that it can be drawn again exactly."""

    kind: Literal["checks", "stripes", "noise"]
    color: Color
    """The second colour; the first is the table's own."""
    scale: Edge
    """Edge of a square, width of a band or size of a spot, m."""
    angle: Angle = 0.0
    """Turn of the pattern about z, rad."""
    seed: Annotated[Whole, Field(ge=0, lt=2**31)] = 0
    """Where the pattern lies; which one it is, for `noise`."""


@checked
class Table:
    """The table, its top face at z = 0."""

    size: tuple[Edge, Edge] = (0.8, 1.2)
    """Full edge lengths along x and y, m."""
    color: Color = (0.93, 0.92, 0.89)
    texture: Texture | None = None
    """None: of one colour."""


@checked
class Camera:
    """Pinhole camera; image-left is robot-left."""

    eye: Vector = (-0.66, 0.0, 0.66)
    target: Vector = (0.0, 0.0, 0.0)
    width: Annotated[Whole, Field(gt=0, le=_MOST_PIXELS)] = 320
    height: Annotated[Whole, Field(gt=0, le=_MOST_PIXELS)] = 192
    fov: Annotated[float, Strict(), Field(ge=0.1, lt=180)] = 47.0
    """Horizontal field of view, degrees."""
    near: Length = 0.038
    far: Length = 100.0

    @model_validator(mode="after")
    def _sees(self) -> Camera:
        if math.dist(self.eye, self.target) < _NOWHERE:
            raise ValueError(f"target {list(self.target)} is where the eye is, expected another")
        if self.near >= self.far:
            raise ValueError(f"near {self.near:g} m, expected less than far, {self.far:g} m")
        return self


@checked
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
    shadow: Annotated[bool, Strict()] = True

    @model_validator(mode="after")
    def _shines(self) -> Light:
        if math.hypot(*self.direction) < _NOWHERE:
            raise ValueError(f"direction {list(self.direction)}, expected one that leads somewhere")
        if self.ambient + self.diffuse <= 0 or max(self.color) <= 0:
            raise ValueError("it is dark, expected ambient or diffuse light of some colour")
        return self


@checked
class Robot:
    """Where the Franka Panda stands."""

    base: Vector = (-0.48, 0.0, 0.0)
    yaw: Turn = 0.0


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
