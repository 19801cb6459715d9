"""Scenes: boxes, what surrounds them, and the goals asked of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, TypeAdapter, model_validator

from relevance.hashing import content_hash
from relevance.scene.boxes import Box, Camera, Light, Robot, Table, wrapped
from relevance.scene.checks import SceneError, checked
from relevance.scene.contacts import check_boxes, with_all_supports
from relevance.scene.plans import Pose
from relevance.scene.predicates import Goal
from relevance.scene.projection import pinhole, vertices
from relevance.scene.words import Id, normal, shown

MOST_BOXES = 254
"""Most boxes of a scene: a mask names each in a byte."""


@checked
class Scene:
    """A tabletop; raises SceneError unless it is physically possible.

    Scenes are equal, and have equal hashes, when all of their fields are: one can be the key of
    a cache, whatever ids people choose.
    """

    id: Id = ""
    """Content hash when left empty."""
    objects: Annotated[tuple[Box, ...], Field(min_length=1, max_length=MOST_BOXES)]
    goals: tuple[str, ...] = ()
    """Goals asked of it, as text: `predicate(subject, reference)`."""
    table: Table = Table()
    camera: Camera = Camera()
    light: Light = Light()
    robot: Robot = Robot()

    @model_validator(mode="after")
    def _possible(self) -> Scene:
        # However turns are written, equal scenes are one; planners would break ties differently.
        turns = [wrapped(box.yaw) for box in self.objects]
        if turns != [box.yaw for box in self.objects]:
            pairs = zip(self.objects, turns, strict=True)
            object.__setattr__(
                self, "objects", tuple(replace(box, yaw=turn) for box, turn in pairs)
            )
        objects = tuple(with_all_supports(box, self.objects) for box in self.objects)
        object.__setattr__(self, "objects", objects)
        check_boxes(self.objects, self.table, self.robot)
        _check_camera(self.camera, self.objects)
        object.__setattr__(self, "goals", tuple(str(self.goal(text)) for text in self.goals))
        if not self.id:
            body = TypeAdapter(Scene).dump_python(self, mode="json", exclude={"id", "goals"})
            if self.table.texture is None:  # a plain table hashes as it did before there were any
                del body["table"]["texture"]
            object.__setattr__(self, "id", content_hash(body))
        return self

    def __getitem__(self, name: str) -> Box:
        for box in self.objects:
            if box.name == normal(name):
                return box
        known = ", ".join(self.names)
        raise SceneError(f"unknown object {shown(name)}, expected one of {known}")

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
                raise SceneError(
                    f"goal {shown(str(goal))}: unknown object {shown(name)}, have {known}"
                )
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


_DEFAULT_CAMERA = Camera()


def _check_camera(camera: Camera, objects: tuple[Box, ...]) -> None:
    """Raise SceneError when near and far cut off all that is in front of the camera."""
    if camera == _DEFAULT_CAMERA:
        return
    eye, axes, _ = pinhole(camera)
    depth = (np.concatenate([vertices(box) for box in objects]) - eye) @ axes[:, 2]
    ahead = depth[depth > 0]
    if len(ahead) and not ((ahead > camera.near) & (ahead < camera.far)).any():
        raise SceneError(
            f"camera: sees nothing from near {camera.near:g} to far {camera.far:g} m, "
            f"expected some of {ahead.min():.3g} to {ahead.max():.3g} m between them"
        )
