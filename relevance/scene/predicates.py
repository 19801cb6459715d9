"""What a goal asks for: spatial relations, one object each, and the goals made of them.

Directions are the robot's: left is +y of its base frame, in front is nearer to it, wherever it
stands and however it is turned. A new
relation is one more object here; one whose region is of another shape brings a class of `Region`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any, Protocol

from pydantic import (
    AfterValidator,
    BeforeValidator,
    InstanceOf,
    PlainSerializer,
    model_validator,
)

from relevance.registry import Registry
from relevance.scene.boxes import Box, Robot
from relevance.scene.checks import SceneError, checked
from relevance.scene.words import normal, shown

GAP = 0.05
"""Depth of a same-plane goal region, m (CONTRIBUTING, The words)."""


class Region(Protocol):
    """Where the subject's centre may be, on the plane that it stands on."""

    @property
    def rectangles(self) -> tuple[Rectangle, ...]:
        """Rectangles within it that together are all of it: planners look nowhere else, so what
        they leave out is a plan that may be missed."""
        ...

    def contains(self, x: float, y: float, tolerance: float = 0.0) -> bool:
        """Whether a point lies in it, or at most `tolerance` (m) outside: the definition."""
        ...


@plain_dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """A region that is a rectangle."""

    x: float
    y: float
    """Centre in the world frame, m."""
    angle: float
    """Turn of its own axes about z, rad."""
    half: tuple[float, float]
    """Half extents along its own axes, m."""

    @property
    def rectangles(self) -> tuple[Rectangle, ...]:
        """Itself."""
        return (self,)

    def contains(self, x: float, y: float, tolerance: float = 0.0) -> bool:
        """Whether a point lies in it, or at most `tolerance` (m) outside along its axes."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        dx, dy = x - self.x, y - self.y
        a, b = abs(c * dx + s * dy), abs(c * dy - s * dx)
        return a <= self.half[0] + tolerance and b <= self.half[1] + tolerance


@plain_dataclass(frozen=True, slots=True, kw_only=True)
class Predicate(ABC):
    """A spatial relation of subject and reference."""

    name: str
    """As goals are written: `on-the-left`."""
    family: str
    """The scene family that its datasets are made of."""
    also: tuple[str, ...] = ()
    """Other families that are asked it; figures of those are kept apart, see `group_of`."""
    mirror: str
    """The name of what it becomes when y changes sign; its own where that changes nothing."""

    def __str__(self) -> str:
        return self.name

    @property
    def stacked(self) -> bool:
        """Whether the subject ends on the reference, not on the table."""
        return False

    def direction(self, robot: Robot) -> tuple[float, float] | None:
        """Unit vector (x, y) in the world from reference to subject; None where any will do."""
        return None

    @abstractmethod
    def region(self, subject: Box, reference: Box, robot: Robot) -> Region:
        """Where the subject's centre may be."""

    def holds(self, subject: Box, reference: Box, robot: Robot, tolerance: float = 1e-3) -> bool:
        """Whether the relation is true of two boxes, up to `tolerance` (m)."""
        if self.stacked:
            stands = reference.name in subject.supports
            stands = stands and abs(subject.bottom - reference.top) <= tolerance
        else:
            stands = not subject.supports and abs(subject.bottom) <= tolerance
        there = self.region(subject, reference, robot)
        # a centre that is not over the face falls down: no tolerance on top of a box
        return stands and there.contains(*subject.position[:2], 0.0 if self.stacked else tolerance)


@plain_dataclass(frozen=True, slots=True, kw_only=True)
class Beside(Predicate):
    """On the table, in a region GAP deep on one side of the reference (CONTRIBUTING, The words)."""

    toward: tuple[float, float]
    """Unit vector (x, y) in the robot's axes from reference to subject."""

    def direction(self, robot: Robot) -> tuple[float, float]:
        """The side in the world frame."""
        c, s = math.cos(robot.yaw), math.sin(robot.yaw)
        x, y = self.toward
        return c * x - s * y, s * x + c * y

    def region(self, subject: Box, reference: Box, robot: Robot) -> Rectangle:
        """H + r to H + r + GAP along the side, W to both sides across it."""
        u = self.direction(robot)
        ex, ey = reference.extents_at(robot.yaw)
        along, across = (ex, ey) if self.toward[0] else (ey, ex)
        low = along + min(subject.size[0], subject.size[1]) / 2
        high = low + GAP
        middle, depth = (low + high) / 2, (high - low) / 2
        return Rectangle(
            x=reference.position[0] + middle * u[0],
            y=reference.position[1] + middle * u[1],
            angle=robot.yaw,
            half=(depth, across) if self.toward[0] else (across, depth),
        )


@plain_dataclass(frozen=True, slots=True, kw_only=True)
class OnTop(Predicate):
    """On the reference's top face, the centre over that face."""

    @property
    def stacked(self) -> bool:
        """Yes."""
        return True

    def region(self, subject: Box, reference: Box, robot: Robot) -> Rectangle:
        """The reference's top face."""
        return Rectangle(
            x=reference.position[0],
            y=reference.position[1],
            angle=reference.yaw,
            half=(reference.size[0] / 2, reference.size[1] / 2),
        )


PREDICATES: Registry[Predicate] = Registry("predicate")
"""Every predicate by name."""

for _predicate in (
    Beside(name="on-the-left", family="same-plane", mirror="on-the-right", toward=(0.0, 1.0)),
    Beside(name="on-the-right", family="same-plane", mirror="on-the-left", toward=(0.0, -1.0)),
    Beside(name="in-front", family="same-plane", mirror="in-front", toward=(-1.0, 0.0)),
    Beside(name="behind", family="same-plane", mirror="behind", toward=(1.0, 0.0)),
    OnTop(name="on", family="on", also=("stacks",), mirror="on"),
):
    PREDICATES.register(_predicate.name, _predicate)

FAMILIES = ("same-plane", "on", "stacks")
"""The kinds of scenes that predicates are asked of."""


def asked_of(family: str) -> tuple[Predicate, ...]:
    """The predicates that scenes of a family are asked."""
    return tuple(p for p in PREDICATES.values() if family in (p.family, *p.also))


def group_of(predicate: str, family: str | None) -> str:
    """What figures of a predicate in a family are shown as: the predicate in its own family (or
    when the family is not known), else that other family, which only borrows it."""
    if family is None or predicate not in PREDICATES:
        return predicate
    return predicate if family == PREDICATES[predicate].family else family


def _named(value: Any) -> Any:
    return PREDICATES[value] if isinstance(value, str) else value


@checked
class Goal:
    """`predicate(subject, reference)`, e.g. `on-the-left(red, blue)`."""

    predicate: Annotated[
        InstanceOf[Predicate], BeforeValidator(_named), PlainSerializer(str, return_type=str)
    ]
    subject: Annotated[str, AfterValidator(normal)]
    reference: Annotated[str, AfterValidator(normal)]

    @model_validator(mode="after")
    def _of_two(self) -> Goal:
        if self.subject == self.reference:
            raise ValueError(f"{shown(str(self))}: subject and reference are the same object")
        return self

    def __str__(self) -> str:
        return f"{self.predicate}({self.subject}, {self.reference})"

    @classmethod
    def parse(cls, text: str) -> Goal:
        """Read `predicate(subject, reference)`; raises SceneError on anything else."""
        where = f"goal {shown(text)}"
        name, bracket, rest = normal(text).partition("(")
        names = [part.strip() for part in rest.strip().removesuffix(")").split(",")]
        if not bracket or not rest.strip().endswith(")") or len(names) != 2 or not all(names):
            raise SceneError(f"{where}: expected predicate(subject, reference)")
        if name.strip() not in PREDICATES:
            found, known = shown(name.strip()), ", ".join(PREDICATES)
            raise SceneError(f"{where}: unknown predicate {found}, expected one of {known}")
        predicate = PREDICATES[name.strip()]
        return cls(predicate=predicate, subject=names[0], reference=names[1])


def goal_holds(objects: Iterable[Box], goal: Goal, robot: Robot, tolerance: float = 1e-3) -> bool:
    """Whether the goal is true of these boxes, up to `tolerance` metres."""
    boxes = {box.name: box for box in objects}
    subject, reference = boxes[goal.subject], boxes[goal.reference]
    return goal.predicate.holds(subject, reference, robot, tolerance)
