"""How the parts of a scene are checked: pydantic dataclasses whose error is one line."""

from __future__ import annotations

import dataclasses
import re
from typing import TypeVar, dataclass_transform

from pydantic import Field, ValidationError

from relevance import configs
from relevance.errors import RelevanceError
from relevance.scene.words import shown

C = TypeVar("C", bound=type)


class SceneError(RelevanceError):
    """A scene or goal that cannot be: says which field, what it holds, what was expected."""


@dataclass_transform(
    kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field, Field)
)
def checked(cls: C) -> C:
    """Make a class of annotated fields a frozen dataclass.

    Fields that are unknown, of another type, NaN or infinite are refused with a SceneError.
    """
    return configs.checked(cls, lambda error: SceneError(f"{cls.__name__}: {first_error(error)}"))


_SAID_BETTER = {
    "unexpected_keyword_argument": "unknown field",
    "dataclass_type": "expected an object",
    "tuple_type": "expected a list",
}
_TRIED = re.compile(r"(function-after|tuple)\[.*|str")


def first_error(error: ValidationError) -> str:
    """`field: what was expected (found what)`, of the first thing that is wrong."""
    errors = error.errors(include_url=False)
    # A misspelt field is missing and unknown at once: the unknown one says more.
    first = next((e for e in errors if e["type"] == "unexpected_keyword_argument"), errors[0])
    # Where a name or a list of names is expected, the path says which was tried.
    *parents, last = map(str, first["loc"]) if first["loc"] else [""]
    parts = [part for part in parents if not _TRIED.fullmatch(part)]
    if first["type"] == "unexpected_keyword_argument" or not _TRIED.fullmatch(last):
        parts.append(last)
    field = shown(".".join(parts), 200)[1:-1]
    message = _SAID_BETTER.get(first["type"], first["msg"].removeprefix("Value error, "))
    text = ": ".join(part for part in (field, message) if part)
    found = first["input"]
    if not isinstance(found, str | int | float) or shown(found) in text:
        return text
    return text if message == "unknown field" else f"{text} (found {shown(found)})"
