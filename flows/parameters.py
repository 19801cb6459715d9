"""Flow parameters: a preset's name plus overrides become a checked config.

A flow takes `preset="demo", overrides={"goals_per_scene": 2, "planner.max_actions": 4}`, so that
its parameters stay short, plain JSON in Prefect's page and command line while the configs
themselves stay beside the stages that own them.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from relevance.errors import RelevanceError

Preset = Literal["smoke", "demo", "laptop", "paper"]
Overrides = dict[str, Any]


def _folder(text: str) -> str:
    if "\x00" in text or not text.strip():
        raise ValueError("expected the path of a dataset folder")
    if os.path.exists(text) and not os.path.isdir(text):
        raise ValueError(f"{text} is a file, expected the path of a dataset folder")
    return text


def _cluster(text: str) -> str:
    if not re.fullmatch(r"[a-z]+://[^\s/]+:\d+", text):
        raise ValueError("expected the address of a Dask scheduler, like tcp://10.0.0.1:8786")
    return text


DatasetPath = Annotated[str, AfterValidator(_folder)]
Workers = Annotated[int, Field(ge=1, le=1024)]
Cluster = Annotated[str, AfterValidator(_cluster)]

C = TypeVar("C")


class ParameterError(RelevanceError):
    """A preset or setting that is not known or not allowed; says which and what is expected."""


def configured(kind: type[C], preset: str, overrides: Mapping[str, Any] | None = None) -> C:
    """The config dataclass `kind` of that preset, with the overridden settings replaced.

    Keys may be dotted (`planner.max_actions`) or values nested mappings. Raises ParameterError
    for an unknown preset, an unknown setting or a value of the wrong type; the config's own
    checks raise their ValueError.
    """
    make = getattr(kind, preset, None)
    if not callable(make) or preset.startswith("_"):
        raise ParameterError(f"preset {preset!r}: {kind.__name__} has no preset of that name")
    start: Any = make()
    if body := (overrides or {}).get("model.body"):
        start = start.with_body(body)  # which settings a model has depends on its body
    return override(start, overrides or {})


def override(config: Any, overrides: Mapping[str, Any], where: str = "") -> Any:
    """A copy of the config with some settings replaced (see `configured`)."""
    names = [field.name for field in dataclasses.fields(config) if field.init]
    hints = get_type_hints(type(config), include_extras=True)
    changes: dict[str, Any] = {}
    for key, value in overrides.items():
        name, dot, rest = key.partition(".")
        if name not in names:
            known = ", ".join(sorted(names))
            raise ParameterError(f"{where}{name}: unknown setting, expected one of {known}")
        current = changes.get(name, getattr(config, name))
        if dot:
            value = {rest: value}
        if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
            changes[name] = override(current, value, f"{where}{name}.")
        elif isinstance(current, Mapping) and dot:
            changes[name] = _checked(hints[name], {**current, **value}, f"{where}{name}")
        elif dot:
            raise ParameterError(f"{where}{key}: {where}{name} has no settings of its own")
        else:
            changes[name] = _checked(hints[name], value, f"{where}{name}")
    return dataclasses.replace(config, **changes)


def _checked(hint: Any, value: Any, where: str) -> Any:
    try:
        return TypeAdapter(hint).validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        inner = "".join(f".{part}" for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise ParameterError(f"{where}{inner}: {message} (found {first['input']!r})") from None


def absolute(path: str | Path) -> Path:
    """The path as tasks get it: absolute, since a worker may run in another folder.

    `s3://bucket/prefix` stays what it is.
    """
    from relevance.store import absolute as located

    return located(path)
