"""Tables for a page and for files: rows are plain values, columns say how a page shows them."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from relevance.report.style import DASH, number, percent, seconds
from relevance.store import replacing

Row = Mapping[str, Any]

TRIPLE = ("true_relevant", "true_irrelevant", "total")
"""The shares that the paper reports of a network."""
PAPER, OURS, RULE, MISSING = "paper", "ours", "rule", "missing"
"""Whose row it is (`whose`); `missing` says in `why` what it would take."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column as a page shows it."""

    title: str
    cell: Callable[[Row], str]
    left: bool = False
    """Text, not figures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A table with what has to be known of it."""

    name: str
    """What its files are called."""
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def write(self, folder: Path) -> None:
        """NAME.csv, and NAME.json with title and notes; None and what is no number stay empty."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in row.items()} for row in self.rows)
        rows = [{name: _plain(row.get(name)) for name in names} for row in self.rows]
        whole = {"title": self.title, "notes": list(self.notes), "rows": rows}
        for kind, content in (
            ("csv", text.getvalue()),
            ("json", json.dumps(whole, indent=1, allow_nan=False) + "\n"),
        ):
            with replacing(folder / f"{self.name}.{kind}") as temporary:
                temporary.write_text(content, encoding="utf-8")

    def shown(self) -> Iterator[tuple[Row, list[str]]]:
        """Rows with their cells: what repeats the first cell above is left blank; a missing row has
        only its words, and then what it would take."""
        above = ""
        for row in self.rows:
            cells = [c.cell(row) for c in self.columns if c.left or row["whose"] != MISSING]
            first, *others = cells
            yield row, ["" if first == above else first, *others]
            above = first


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- columns ----------------------------------------------------------------------------------


def words(title: str, name: str) -> Column:
    """What a row is called."""
    return Column(title=title, cell=lambda row: str(row.get(name) or ""), left=True)


def shares(title: str, name: str, *, decimals: int = 1, theirs: int = 0) -> Column:
    """A share in 0..1; those of the paper's rows have as few decimals as it gives."""

    def cell(row: Row) -> str:
        return percent(row.get(name), theirs if row["whose"] == PAPER else decimals)

    return Column(title=title, cell=cell)


def triple(title: str, prefix: str) -> Column:
    """True relevant, true irrelevant and total in one cell."""

    def cell(row: Row) -> str:
        values = [row.get(prefix + name) for name in TRIPLE]
        if any(value is None for value in values):
            return DASH
        return " / ".join(f"{100 * value:.1f}" for value in values if value is not None)

    return Column(title=f"{title}: relevant / irrelevant / total, %", cell=cell)


def counts(title: str, name: str) -> Column:
    """How many."""
    return Column(title=title, cell=lambda row: number(row.get(name)))


def times(title: str, name: str) -> Column:
    """Seconds, with their 67% interval below."""
    return Column(title=title, cell=lambda row: _with_ends(row, name, _hundredths, _NARROW))


def saved(title: str, name: str, *, ends: bool = True) -> Column:
    """A share of time, with both of its intervals below unless they are for the files alone."""
    below = {**_NARROW, **_WIDE} if ends else {}
    return Column(title=title, cell=lambda row: _with_ends(row, name, _rounded, below))


_NARROW, _WIDE = {"": ""}, {"_95": "95%: "}
"""What the names of an interval's ends have behind them, and what is written before it."""


def _hundredths(value: float | None) -> str:
    return f"{value:.2f} s" if value is not None and 1 <= value < 100 else seconds(value)


def _rounded(value: float | None) -> str:
    return percent(value, 1).replace("-", "\N{MINUS SIGN}")


def _with_ends(
    row: Row, name: str, shown: Callable[[float | None], str], below: Mapping[str, str]
) -> Markup:
    text = Markup("{}").format(shown(row.get(name)))
    if text == DASH:
        return text
    for suffix, before in below.items():
        low, high = row.get(f"{name}_low{suffix}"), row.get(f"{name}_high{suffix}")
        if low is not None and high is not None:
            ends = _without_repeated_unit(shown(low), shown(high))
            text += Markup("<small>{}{}</small>").format(before, ends)
    return text


def _without_repeated_unit(low: str, high: str) -> str:
    for unit in ("%", " ms", " s"):
        if low.endswith(unit) and high.endswith(unit):
            low = low.removesuffix(unit)
            break
    return f"{low} to {high}"


def spread(name: str, narrow: Any, wide: Any) -> dict[str, float]:
    """The cells of an estimate with its 67% and its 95% interval."""
    return {
        name: narrow.value,
        f"{name}_low": narrow.low,
        f"{name}_high": narrow.high,
        f"{name}_low_95": wide.low,
        f"{name}_high_95": wide.high,
    }


def share_cells(names: Sequence[str], of: Any, prefix: str = "") -> dict[str, float]:
    """Cells from the attributes of an object."""
    return {prefix + name: getattr(of, name) for name in names}
