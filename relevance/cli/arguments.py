"""Arguments that several subcommands take, and what all commands are described by."""

import dataclasses
import math
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from relevance.cli.terminal import UsageError

Preset = Literal["smoke", "demo", "laptop", "paper"]
DatasetPreset = Literal["smoke", "demo", "laptop", "crowd", "randomised", "paper"]
"""Sizes of datasets alone; the others are sizes of everything."""
DatasetArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATASET")]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
OptionalName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="N")]
Workers = Annotated[int, tyro.conf.arg(metavar="N")]
Repeated = tyro.conf.UseAppendAction[tuple[str, ...]]
"""A flag that may be given again, one word each time."""

CORES = len(os.sched_getaffinity(0))
MOST_WORKERS = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A subcommand: what makes its function, what it does in a few words, examples."""

    make: Callable[..., Callable[..., int]]
    about: str
    examples: tuple[str, ...]
    preset: str = "demo"
    presets: tuple[str, ...] = get_args(Preset)
    decides: tuple[str, ...] = ()
    """Flags whose values `make` takes after the preset: other flags depend on them."""


def at_least(flag: str, value: float | None, least: float, most: float = math.inf) -> None:
    """UsageError that names the flag, unless it is not given, or a number within the bounds."""
    if value is not None and not (least <= value <= most and math.isfinite(value)):
        expected = f"{least:g} to {most:g}" if math.isfinite(most) else f"at least {least:g}"
        if not math.isfinite(least):
            expected = "a finite number"
        raise UsageError(f"{flag} {value}: expected {expected}")


def over_zero(flag: str, value: float | None) -> None:
    """UsageError that names the flag, unless it is not given, or a finite number over 0."""
    if value is not None and not 0 < value < math.inf:
        raise UsageError(f"{flag} {value}: expected a number over 0")


def check_file(flag: str, file: Path | None, ending: str) -> None:
    """UsageError that names the flag, unless it is not given, or such a file can be written."""
    if file is None:
        return
    if file.suffix.lower() != ending:
        raise UsageError(f"{flag} {file}: expected a file that ends in {ending}")
    if not file.parent.is_dir() or not os.access(file.parent, os.W_OK):
        raise UsageError(f"{flag} {file}: {file.parent} is no folder that can be written")
    if file.is_dir():
        raise UsageError(f"{flag} {file}: is a folder, expected a file")


def check_workers(workers: int) -> None:
    """UsageError unless that many processes can be had."""
    at_least("--workers", workers, 1, MOST_WORKERS)


def settings_of(kind: type[Any], **given: Any) -> Any:
    """A config of those of the given settings that its class has."""
    known = {field.name for field in dataclasses.fields(kind)}
    return kind(**{name: value for name, value in given.items() if name in known})


def one_of(flag: str, value: str | None, known: Iterable[str]) -> None:
    """UsageError that names the flag and what there is, unless the value is not given or known."""
    names = list(known)
    if value is not None and value not in names:
        raise UsageError(f"{flag} {value}: expected one of {', '.join(names)}")
