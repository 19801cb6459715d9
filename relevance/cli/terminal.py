"""What people and programs see: tables, strict JSON, CSV and progress bars (rich)."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from relevance.errors import RelevanceError

Format = Literal["table", "json", "csv"]

console = Console(stderr=True)


class UsageError(RelevanceError):
    """A command line that asks for what cannot be."""


def to_json(value: Any) -> str:
    """One line of strict JSON; NaN and infinities, which JSON has not, become null."""

    def strict(value: Any) -> Any:
        if isinstance(value, Decimal):
            value = int(value) if value == value.to_integral_value() else float(value)
        if isinstance(value, float) and not math.isfinite(value):
            return None
        if isinstance(value, Mapping):
            return {str(key): strict(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [strict(item) for item in value]
        return value

    return json.dumps(strict(value), default=str, allow_nan=False)


def show(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], format: Format, title: str | None = None
) -> None:
    """Print rows: a table, one JSON list of objects, or CSV with a header."""
    if format == "json":
        print(to_json([dict(zip(columns, row, strict=True)) for row in rows]))
    elif format == "csv":
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(
            [to_json(cell) if isinstance(cell, list | dict) else cell for cell in row]
            for row in rows
        )
    else:
        table = Table(title=title, title_justify="left")
        for name in columns:
            table.add_column(escape(name), overflow="fold")
        for row in rows:
            cells = [f"{x:.6g}" if isinstance(x, float) else str(x) for x in row]
            table.add_row(*[escape(cell) for cell in cells])
        # A file or a pipe takes lines of any length.
        Console(width=None if sys.stdout.isatty() else 10_000).print(table)


def say(text: str) -> None:
    """A line for the person, on stderr; stdout is for results."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def bars() -> Progress:
    """Progress bars on stderr; nothing at all unless that is a terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )


@contextmanager
def bar(what: str, quiet: bool = False) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal; yields progress(done, total)."""
    with bars() as drawn:
        row = drawn.add_task(what, total=None, visible=not quiet)
        yield lambda done, total: drawn.update(row, completed=done, total=total)
