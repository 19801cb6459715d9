"""Settings: frozen, checked where they are made, and known by what differs from the defaults.

Every stage has one config class beside its owner, made by `config`. Its identity leaves out
settings that have their default, so that a setting added later renames nothing old; a stage
whose behaviour or defaults change raises its version instead.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from relevance.errors import RelevanceError
from relevance.hashing import content_hash

C = TypeVar("C", bound=type)


class ConfigError(RelevanceError):
    """A setting that cannot be: says which, its value and what was expected."""


@dataclass_transform(
    kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field, Field)
)
def config(cls: C) -> C:
    """Make a class of annotated fields a frozen config; ConfigError names a field that is wrong.

    A rule about several fields is a `model_validator(mode="after")` that raises ValueError.
    """
    made: Any = dataclass(
        cls,
        frozen=True,
        slots=True,
        kw_only=True,
        config=ConfigDict(extra="forbid", allow_inf_nan=False),
    )
    check = made.__init__

    @functools.wraps(check)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            check(self, *args, **kwargs)
        except ValidationError as error:
            raise ConfigError(f"{cls.__name__}{first_error(error)}") from None

    made.__init__ = __init__
    return made


def first_error(error: ValidationError) -> str:
    """`.field = value: what was expected`, of the first thing that pydantic found."""
    found = error.errors(include_url=False)
    # A misspelt field is missing and unknown at once: the unknown one says more.
    first = next((e for e in found if e["type"] == "unexpected_keyword_argument"), found[0])
    where = "".join(f".{part}" for part in first["loc"])
    if first["type"] == "unexpected_keyword_argument":
        return f"{where}: unknown field"
    message = first["msg"].removeprefix("Value error, ")
    message = message.removeprefix("Input should be ").removeprefix("a ")
    if not where:
        return f": {message}"
    return f"{where} = {first['input']!r}: expected {message}"


def execution(default: Any, **more: Any) -> Any:
    """A field that says how something is run, not what comes of it: in no identity."""
    return dataclasses.field(default=default, metadata={"identity": False}, **more)


def identity(value: Any) -> Any:
    """What tells a config from the defaults: its settings that differ, nested ones likewise."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: identity(now)
            for field in dataclasses.fields(value)
            if field.metadata.get("identity", True)
            for now in [getattr(value, field.name)]
            if now != _default(field)
        }
    if isinstance(value, Mapping):
        return {key: identity(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [identity(item) for item in value]
    return value


def identity_hash(value: Any, **versions: str) -> str:
    """16 hex digits of a config's identity and of the versions of the stages that it sets."""
    return content_hash([versions, identity(value)])


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return dataclasses.MISSING
