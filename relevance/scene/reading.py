"""Scenes as JSON: what is written comes back, and what cannot be read says where and why.

Text is UTF-8 whatever the locale, with or without a byte order mark; lines end at a line feed
alone. Numbers are numbers: neither text nor booleans. A key given twice is an error, and so is
an id: the lines of a plan carry nothing else of their scene.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from relevance.scene.checks import SceneError, first_error
from relevance.scene.scenes import Scene
from relevance.scene.words import printable, shown

STANDARD_INPUT = "-"
"""The path that means standard input."""
_AROUND = 30  # characters shown before and after the place of an error
_BYTE_ORDER_MARK = "\ufeff"
_SCENE = TypeAdapter(Scene)


def scene_to_json(scene: Scene) -> str:
    """One line of JSON; `scene_from_json` gives an equal scene back."""
    text = _SCENE.dump_json(scene).decode()
    # They end no line here, but they do for tools that split text as Unicode has it.
    return text.replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def scene_from_json(text: str | bytes, *, where: str = "scene") -> Scene:
    """Read one scene; raises SceneError that names `where`, the field and what was expected."""
    if isinstance(text, bytes):
        text = _decoded(text, where)
    try:
        value = _json(text)
    except _NotJsonError as error:
        raise SceneError(f"{where}: {error}") from None
    return _scene(value, where)


def read_scenes(path: str | Path) -> list[Scene]:
    """Read a JSON file (one scene or a list) or JSON lines (one scene a line); `-`: standard input.

    Raises SceneError naming file, line and field; a file that cannot be read becomes one too.
    """
    name, text = _text(path)
    if not text.strip():
        raise SceneError(f"{name}: is empty, expected at least one scene")
    items = _items(name, text)
    if not items:
        raise SceneError(f"{name}: has no scenes, expected at least one")
    scenes: list[Scene] = []
    places: dict[str, str] = {}
    for where, value in items:
        scene = _scene(value, where)
        if scene.id in places:
            raise SceneError(
                f"{where}: id {scene.id!r} is that of {places[scene.id]} already, "
                "expected distinct ids (a scene without one is named by its content)"
            )
        places[scene.id] = where
        scenes.append(scene)
    return scenes


class _NotJsonError(ValueError):
    """A text is no JSON value; the message says where and why."""


class _Repeated(dict[str, Any]):
    """A JSON object of which a key was given twice."""

    key = ""


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) == len(pairs):
        return made
    marked = _Repeated(made)
    seen: set[str] = set()
    marked.key = next(key for key, _ in pairs if key in seen or seen.add(key))
    return marked


def _json(text: str) -> Any:
    """The value of a JSON text."""
    text = text.removeprefix(_BYTE_ORDER_MARK)
    try:
        return json.loads(text, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        at = error.pos
        near = text[max(at - _AROUND, 0) : at + _AROUND]
        place = f"line {error.lineno} column {error.colno}"
        raise _NotJsonError(f"{error.msg} at {place}, near {shown(near, 80)}") from None
    except RecursionError:
        raise _NotJsonError("nested too deeply, expected a scene") from None
    except ValueError:  # the one other thing that the parser refuses
        raise _NotJsonError("a number has too many digits, expected a scene") from None


def _items(name: str, text: str) -> list[tuple[str, Any]]:
    """The values of a file, each with its place; they are scenes or should be."""
    try:
        whole = _json(text)
    except _NotJsonError as error:
        numbered = enumerate(text.split("\n"), 1)
        lines = [(f"{name}:{n}", line) for n, line in numbered if line.strip()]
        if len(lines) == 1:
            raise SceneError(f"{lines[0][0]}: {error}") from None
        return [(at, _line(name, i, at, line, error)) for i, (at, line) in enumerate(lines)]
    if isinstance(whole, list):
        return [(f"{name}[{n}]", item) for n, item in enumerate(whole)]
    return [(f"{name}:1", whole)]


def _line(name: str, i: int, where: str, line: str, whole: _NotJsonError) -> Any:
    try:
        return _json(line)
    except _NotJsonError as error:
        if i:
            raise SceneError(f"{where}: {error}") from None
        raise SceneError(
            f"{name}: neither one JSON value ({whole}) nor one a line ({where}: {error})"
        ) from None


def _scene(value: Any, where: str) -> Scene:
    if not isinstance(value, dict):
        raise SceneError(f"{where}: expected a scene (an object), found {_kind(value)}")
    _check_keys(value, where)
    try:
        return _SCENE.validate_python(value)
    except ValidationError as error:
        raise SceneError(f"{where}: {first_error(error)}") from None


def _check_keys(value: Any, where: str) -> None:
    """Raise SceneError at a key that is given twice, at whatever depth."""
    waiting: list[tuple[str, Any]] = [("", value)]
    while waiting:
        path, item = waiting.pop()
        if isinstance(item, _Repeated):
            key = printable(f"{path}{item.key}")
            raise SceneError(f"{where}: {key}: given twice, expected each key once")
        parts = item.items() if isinstance(item, dict) else enumerate(item)
        waiting += [(f"{path}{k}.", part) for k, part in parts if isinstance(part, dict | list)]


def _kind(value: Any) -> str:
    return {type(None): "null", list: "a list"}.get(type(value)) or shown(value)


def _text(path: str | Path) -> tuple[str, str]:
    """What a file is called in errors, and what it says."""
    name = "standard input" if str(path) == STANDARD_INPUT else printable(str(path))
    try:
        raw = sys.stdin.buffer.read() if str(path) == STANDARD_INPUT else Path(path).read_bytes()
    except OSError as error:
        raise SceneError(f"{name}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:  # a path that no file can have
        raise SceneError(f"{name}: cannot be read ({error})") from None
    return name, _decoded(raw, name)


def _decoded(raw: bytes, name: str) -> str:
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{name}: cannot be read as text, expected UTF-8 ({error.reason} at byte {error.start})"
        ) from None
