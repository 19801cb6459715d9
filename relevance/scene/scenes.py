"""Scenes: what is physically possible, and how they are read and written as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from relevance.hashing import content_hash
from relevance.scene.boxes import (
    CHECKED,
    Box,
    Camera,
    Light,
    Robot,
    SceneError,
    Table,
    footprint_gap,
)
from relevance.scene.plans import Pose
from relevance.scene.predicates import Goal

CONTACT_TOLERANCE = 0.001
"""How far a box may sink into or float over what it touches, m."""


@dataclass(frozen=True, slots=True, kw_only=True, config=CHECKED)
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
