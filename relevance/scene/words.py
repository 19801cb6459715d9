"""Words that people choose, names and ids: in one normal form, and safe to print."""

from __future__ import annotations

import unicodedata
from typing import Annotated, Any

from pydantic import AfterValidator

LONGEST = 200
"""Most characters of a name or an id."""
_LINES = "\u2028\u2029"  # line and paragraph separators: they end no line of a file
_APART = "(),"  # what takes a goal apart


def normal(text: str) -> str:
    """The one form in which words are compared (NFC)."""
    return text if text.isascii() else unicodedata.normalize("NFC", text)


def shown(value: Any, most: int = 60) -> str:
    """A value as it may stand in an error: on one line, printable, no longer than `most`."""
    text = repr(value)
    return text if len(text) <= most else f"{text[: most - 1]}…"


def printable(text: str) -> str:
    """A text as it is where it can be printed on one line, else with escapes."""
    return text if text.isprintable() else repr(text)[1:-1]


def _word(text: str, also: str = "") -> str:
    text = normal(text)
    if len(text) > LONGEST:
        raise ValueError(f"expected at most {LONGEST} characters, found {len(text)}")
    if text != text.strip():
        raise ValueError("expected no blanks at its ends")
    for character in text if not text.isprintable() else "":
        if not (character.isprintable() or character in also):
            raise ValueError(f"expected printable characters, found U+{ord(character):04X}")
    return text


def named(text: str) -> str:
    """A name in its normal form; ValueError says why it can be none."""
    text = _word(text)
    if not text:
        raise ValueError("expected at least 1 character")
    if any(character in text for character in _APART):
        raise ValueError("expected none of '(', ')' and ','")
    return text


def _id(text: str) -> str:
    return _word(text, _LINES)


Name = Annotated[str, AfterValidator(named)]
"""A name of a box: goals are written with it."""
Id = Annotated[str, AfterValidator(_id)]
"""An id of a scene; empty: not given."""
