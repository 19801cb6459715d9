"""What the pages share: the choice of the side bar, and the cached answers to their questions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import streamlit as st

from relevance.evaluation import (
    Comparison,
    Predictions,
    left_out,
    read_evaluations,
    read_predictions,
    settings,
    speed_table,
    summarise,
    unjudged,
)
from relevance.report.style import percent
from relevance.store import Dataset, DatasetError, Sample

__all__ = ["Choice", "ask", "chosen", "figures", "percent", "stamp"]

SQL = Path(__file__).parent / "sql"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What the side bar says."""

    path: str
    version: tuple[int, int]
    """Changes whenever a file of the dataset does, so that cached answers are asked again."""
    own_policy: str | None = None
    policy: str | None = None
    """Of the labels: the checkpoint's, or the dataset's own without a checkpoint."""
    split: str = "test"
    checkpoint: str | None = None
    beta: float = 0.0


def chosen() -> Choice:
    """What the side bar says now."""
    return st.session_state["choice"]


def stamp(dataset: Dataset) -> tuple[int, int]:
    """Changes whenever a table of the dataset does: number of files and newest change."""
    files = list(dataset.path.rglob("*.parquet"))
    return len(files), max((file.stat().st_mtime_ns for file in files), default=0)


def ask(choice: Choice, query: str, **given: Any) -> list[dict[str, Any]]:
    """Rows of `sql/QUERY.sql`; raises DatasetError when the dataset cannot answer."""
    other = choice.policy if choice.policy != choice.own_policy else None
    return _ask(choice.path, choice.version, other, query, given)


@st.cache_data(show_spinner=False, max_entries=200)
def _ask(
    path: str,
    version: tuple[int, int],
    policy: str | None,
    query: str,
    given: Mapping[str, Any],
) -> list[dict[str, Any]]:
    with Dataset.open(path).connect(policy=policy) as connection:
        try:
            found = connection.execute((SQL / f"{query}.sql").read_text(), dict(given))
            names = [column[0] for column in found.description or ()]
            return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
        except Exception as error:  # the queries are ours and tested: what fails is the data
            raise DatasetError(f"{path}: {str(error).splitlines()[0]}") from error


@st.cache_data(show_spinner=False, max_entries=8)
def predictions(choice: Choice) -> tuple[Predictions, list[str]]:
    """The checkpoint's predictions on the split, and what to know of them."""
    dataset, name = Dataset.open(choice.path), choice.checkpoint or ""
    found = read_predictions(dataset, name, split=choice.split)
    return found, unjudged(dataset, name, split=choice.split)


@st.cache_data(show_spinner=False, max_entries=8)
def comparisons(choice: Choice) -> tuple[list[dict[str, Any]], list[Comparison], list[str]]:
    """Speed-ups of the checkpoint: the table, those over all predicates, what to know of them."""
    dataset, name = Dataset.open(choice.path), choice.checkpoint or ""
    whole = [summarise(rows) for rows in settings(read_evaluations(dataset, name)).values()]
    return speed_table(dataset, name), whole, left_out(dataset, name)


@st.cache_data(show_spinner=False, max_entries=20)
def samples(
    path: str, version: tuple[int, int], split: str, wanted: Mapping[str, int]
) -> dict[str, Sample]:
    """Scenes with their images, by id; `wanted` gives each one's shard."""
    shards = sorted(set(wanted.values()))
    found = Dataset.open(path).samples(split, shards) if shards else ()
    return {sample.key: sample for sample in found if sample.key in wanted}


def figures(*shown: tuple[str, str, str], columns: int = 0) -> None:
    """Headline figures side by side: label, value, and what it rests on."""
    for column, (label, value, note) in zip(
        st.columns(max(len(shown), columns)), shown, strict=False
    ):
        column.metric(label, value)
        column.caption(note)


percent_column = partial(st.column_config.NumberColumn, format="percent")
"""A column of shares."""
