"""Flow parameters: a preset's name plus overrides become a checked config.

A flow takes `preset="demo", overrides={"goals_per_scene": 2, "planner.max_actions": 4}`, so that
its parameters stay short, plain JSON in Prefect's page and command line while the configs
themselves stay beside the stages that own them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field

from relevance.configs import override
from relevance.errors import RelevanceError

Preset = Literal["smoke", "demo", "laptop", "paper"]
DatasetPreset = Literal["smoke", "demo", "laptop", "crowd", "randomised", "paper"]
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
    """A parameter of a flow that cannot be; says which and what is expected."""


def configured(kind: type[C], preset: str, overrides: Mapping[str, Any] | None = None) -> C:
    """The config dataclass `kind` of that preset, with the overridden settings replaced.

    Keys may be dotted (`planner.max_actions`) or values nested mappings. Raises RelevanceError
    for an unknown preset, an unknown setting or a value that cannot be.
    """
    make = getattr(kind, preset, None)
    if not callable(make) or preset.startswith("_"):
        raise ParameterError(f"preset {preset!r}: {kind.__name__} has no preset of that name")
    start: Any = make()
    if body := (overrides or {}).get("model.body"):
        start = start.with_body(body)  # which settings a model has depends on its body
    return override(start, overrides or {})


def absolute(path: str | Path) -> Path:
    """The path as tasks get it: absolute, since a worker may run in another folder.

    `s3://bucket/prefix` stays what it is.
    """
    from relevance.store import absolute as located

    return located(path)
