"""What scenes and goals are drawn: settings, checked where they are made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from relevance.configs import config
from relevance.hashing import content_hash
from relevance.robot import GRASPABLE_EDGE
from relevance.sampling.colors import MOST
from relevance.scene import FAMILIES, Camera, Light, Robot, Table, pinhole
from relevance.scene.contacts import check_robot

SAMPLER_VERSION = "3"
"""Raised when equal settings and counters come to give another scene or other goals: a default,
a draw or its order changed. Stored scenes keep the version that drew them."""

Span = tuple[float, float]
Share = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]


def _expect(good: Callable[[Any], bool], expected: str) -> AfterValidator:
    def check(value: Any) -> Any:
        if not good(value):
            raise ValueError(expected)
        return value

    return AfterValidator(check)


def _span(low: float, high: float) -> AfterValidator:
    return _expect(
        lambda span: low <= span[0] <= span[1] <= high, f"{low:g} <= from <= to <= {high:g}"
    )


@config
class Randomisation:
    """From what ranges each scene draws its looks; every draw is uniform."""

    light_elevation: Annotated[Span, _span(20, 90)] = (35.0, 80.0)
    """Height of the light over the table's plane, from and to, degrees; any compass direction."""
    light_tint: Annotated[float, Field(ge=0, le=0.5)] = 0.15
    """How far each channel of the light's colour may fall short of 1."""
    light_ambient: Annotated[Span, _span(0.2, 1)] = (0.45, 0.7)
    """Strength of the light that comes from everywhere, from and to."""
    light_diffuse: Annotated[Span, _span(0, 1)] = (0.25, 0.5)
    """Strength of the light that comes from its direction, from and to."""
    table_saturation: Annotated[float, Field(ge=0, le=0.5)] = 0.35
    """Most saturation of the table's colour, any hue."""
    table_value: Annotated[Span, _span(0, 1)] = (0.4, 0.95)
    """Brightness of the table's colour, from and to."""
    texture_share: Share = 0.75
    """Share of the tables with a texture (checks, stripes or noise)."""
    texture_contrast: Annotated[float, Field(ge=0, le=0.5)] = 0.25
    """How far each channel of the texture's second colour may differ from the first."""
    texture_scale: Annotated[Span, _span(0.01, 1)] = (0.02, 0.12)
    """Size of its pattern, from and to, m."""
    camera_shift: Annotated[float, Field(ge=0, le=0.03)] = 0.01
    """How far the eye, and the point that it looks at, may be off along each axis, m. The
    models place what they see with the nominal camera: with 1 cm and 0.5 degrees that is off by
    less than 2 cm on the table, which a network can still learn to forgive."""
    camera_fov: Annotated[float, Field(ge=0, le=2)] = 0.5
    """How far the horizontal field of view may be off, degrees."""
    color_delta_e: Annotated[float, Field(gt=0, le=30)] = 22.0
    """Least CIE 1976 Delta E of two boxes, and of a box and the table's colours; with n > 11
    boxes it shrinks by (11 / n)^(1/2). It takes the place of `SceneConfig.color_distance`."""


@config
class SceneConfig:
    """What scenes are drawn."""

    family: Annotated[
        str, _expect(lambda name: name in FAMILIES, f"one of {', '.join(FAMILIES)}")
    ] = "same-plane"
    """`same-plane`: all boxes on the table. `on`: few boxes, one of them on another (the paper's).
    `stacks`: many boxes, up to half of them on others."""
    min_objects: Annotated[int, Field(ge=2)] = 3
    """Fewest boxes (`stacks` adds one)."""
    max_objects: Annotated[int, _expect(lambda n: n < MOST, f"under {MOST} (distinct colours)")] = (
        10
    )
    """Most boxes (`stacks` adds one)."""
    on_objects: Annotated[
        tuple[int, int], _expect(lambda n: 3 <= n[0] <= n[1] <= MOST, f"3 <= from <= to <= {MOST}")
    ] = (3, 5)
    """Fewest and most boxes of an `on` scene, the stacked one among them."""
    crowding: Share = 1.0
    """Probability that a box is drawn into a goal region of an earlier one (same-plane)."""
    crowding_on: Share = 0.0
    """The same for the boxes on the table of an `on` or `stacks` scene."""
    choices: Annotated[int, Field(ge=1)] = 8
    """Free places of which a crowded box takes the one that closes most goal regions."""
    stacking: Share = 0.7
    """Probability that a box of a `stacks` scene stands on another (one always does; stacks are
    two high, so at most every second box)."""
    stack_height: float = 0.15
    """Tallest stack, m; taller ones hide what is behind them."""
    obstacle_share: Share = 0.0
    """Share of boxes with both footprint edges over 7 cm, which the hand cannot take."""
    min_edge: Annotated[float, Field(gt=0, le=GRASPABLE_EDGE)] = 0.04
    """Shortest edge, m."""
    max_edge: Annotated[float, Field(gt=GRASPABLE_EDGE)] = 0.12
    """Longest edge, m."""
    max_height: float = 0.12
    """Tallest box, m."""
    spacing: NotNegative = 0.005
    """Least distance between boxes, m."""
    reach: Annotated[Span, _expect(lambda span: 0 <= span[0] < span[1], "0 <= from < to")] = (
        0.30,
        0.72,
    )
    """Distance of a box's centre from the robot's base, from and to, m."""
    table_margin: NotNegative = 0.02
    """Least distance of a footprint from the table's edge, m."""
    image_margin: float = 2.0
    """Least distance of a box's projection from the image border, pixels."""
    visible: Annotated[float, Field(ge=0, lt=1)] = 0.35
    """Least share of what the camera sees of a box alone that shows among the others, judged by
    rays to its faces; the rendering has the last word."""
    color_distance: Annotated[float, Field(gt=0, le=0.35)] = 0.3
    """Least RGB distance of two boxes, and of a box and the table; with n > 11 boxes it
    shrinks by (11 / n)^(1/2)."""
    saturation: Annotated[Span, _span(0, 1)] = (0.55, 1.0)
    """Saturation of the boxes' colours, from and to; any hue."""
    brightness: Annotated[Span, _span(0, 1)] = (0.4, 1.0)
    """Value of the boxes' colours (HSV), from and to."""
    twins: Share = 0.0
    """Share of the boxes that look like one before them, of its size and colour."""
    occlusion: Share = 0.0
    """Least share of the boxes that others hide, mean over boxes; a draw with less has failed."""
    tries: Annotated[int, Field(ge=1)] = 100
    """Positions tried for one box before the draw counts as failed."""
    randomisation: Randomisation | None = None
    """Light, table, camera and colours that differ from scene to scene; None: the paper's
    setting, all as below."""
    table: Table = Field(default_factory=Table)
    camera: Camera = Field(default_factory=Camera)
    light: Light = Field(default_factory=Light)
    robot: Robot = Field(default_factory=Robot)

    @model_validator(mode="after")
    def _agree(self) -> SceneConfig:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                raise ValueError(f"{name} = {getattr(self, name)!r}: expected {expected}")

        require("max_objects", self.min_objects <= self.max_objects, "at least min_objects")
        require("max_height", self.min_edge <= self.max_height, "at least min_edge")
        require("stack_height", 2 * self.min_edge < self.stack_height, "over twice min_edge")
        check_robot(self.table, self.robot)
        require("camera", self._in_sight(), "one that sees some of what the robot reaches")
        return self

    def _in_sight(self) -> bool:
        """Whether the camera sees any of the places where boxes may stand, 5 cm apart."""
        far, edges = self.reach[1], []
        for edge, base in zip(self.table.size, self.robot.base, strict=False):
            # a table may be vast: only its rows within reach
            rows = np.clip((np.array([base - far, base + far]) + edge / 2) / 0.05, 0, edge / 0.05)
            edges.append(np.arange(np.floor(rows[0]), np.ceil(rows[1])) * 0.05 - edge / 2 + 0.025)
        x, y = (places.ravel() for places in np.meshgrid(*edges))
        distance = np.hypot(x - self.robot.base[0], y - self.robot.base[1])
        within = (self.reach[0] <= distance) & (distance <= self.reach[1])
        points = np.stack([x, y, np.full(len(x), self.min_edge / 2)], axis=1)[within]
        eye, axes, focal = pinhole(self.camera)
        right, down, depth = ((points - eye) @ axes).T
        half = np.array([self.camera.width, self.camera.height]) / 2 / focal
        ahead = (depth > self.camera.near) & (depth < self.camera.far)
        return bool(
            (ahead & (abs(right) <= half[0] * depth) & (abs(down) <= half[1] * depth)).any()
        )

    @property
    def numbers(self) -> tuple[int, int]:
        """Fewest and most boxes of a scene of this family."""
        if self.family == "on":
            return self.on_objects
        more = self.family == "stacks"
        return self.min_objects + more, self.max_objects + more

    @property
    def content_hash(self) -> str:
        """16 hex digits that depend on the settings alone."""
        return content_hash(self)


@config
class Jitter:
    """How far a near copy of a scene may be from it; every draw is uniform, both ways."""

    position: NotNegative = 0.004
    """Of a box along x and y, m; of one that stands on another, relative to that."""
    yaw: NotNegative = 0.05
    """Of a box, rad."""
    size: NotNegative = 0.002
    """Of each edge, m; what the hand can take stays so, and what it cannot."""
    color: Annotated[float, Field(ge=0, le=0.1)] = 0.03
    """Of each channel of a box's colour (0..1); boxes of one colour stay of one colour."""
    light: Annotated[float, Field(ge=0, le=0.2)] = 0.05
    """Of the light's strengths and colour (0..1), and of its direction (1: as much as its
    length)."""


@config
class GoalConfig:
    """The odds of goals; they look at who carries whom, never at plans."""

    carrying_reference: Annotated[float, Field(gt=0, lt=1)] = 0.98
    """Share of `on` goals whose reference carries a box already, where several boxes carry one;
    where a single one does, it is always the reference."""
    carrying_subject: Annotated[float, Field(gt=0)] = 30.0
    """How likely a box that carries another is drawn as subject, relative to one that does not."""
