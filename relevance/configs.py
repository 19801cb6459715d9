"""Settings: frozen, checked where they are made, and known by what differs from the defaults.

Every stage has one config class beside its owner, made by `config`. Its identity leaves out
settings that have their default, so that a setting added later renames nothing old; a stage
whose behaviour or defaults change raises its version instead.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, dataclass_transform, get_type_hints

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
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
    return checked(cls, lambda error: ConfigError(f"{cls.__name__}{first_error(error)}"))


def checked(cls: C, refuse: Callable[[ValidationError], RelevanceError]) -> C:
    """A frozen dataclass of a class whose fields pydantic checks; `refuse` words what it found."""
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
            raise refuse(error) from None

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
    if first["type"].startswith("missing"):
        return f"{where}: expected there, found no such field"
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


def override(config: Any, changes: Mapping[str, Any], where: str = "") -> Any:
    """A copy of a config with some settings replaced, by dotted name or nested mapping.

    Raises ConfigError for an unknown setting or a value of the wrong type.
    """
    names = [field.name for field in dataclasses.fields(config) if field.init]
    hints = get_type_hints(type(config), include_extras=True)
    made: dict[str, Any] = {}
    for key, value in changes.items():
        name, dot, rest = key.partition(".")
        if name not in names:
            known = ", ".join(sorted(names))
            raise ConfigError(f"{where}{name}: unknown setting, expected one of {known}")
        current = made.get(name, getattr(config, name))
        if dot:
            value = {rest: value}
        if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
            made[name] = override(current, value, f"{where}{name}.")
        elif isinstance(current, Mapping) and dot:
            made[name] = _checked(hints[name], {**current, **value}, f"{where}{name}")
        elif dot:
            raise ConfigError(f"{where}{key}: {where}{name} has no settings of its own")
        else:
            made[name] = _checked(hints[name], value, f"{where}{name}")
    return dataclasses.replace(config, **made)


def dotted(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Nested values as one mapping with dotted names, as `override` takes them."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        inner = isinstance(value, Mapping)
        flat |= dotted(value, f"{before}{name}.") if inner else {f"{before}{name}": value}
    return flat


def _checked(hint: Any, value: Any, where: str) -> Any:
    try:
        return TypeAdapter(hint).validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        inner = "".join(f".{part}" for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{where}{inner}: {message} (found {first['input']!r})") from None
