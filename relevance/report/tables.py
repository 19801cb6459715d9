"""How much a dataset holds, in small tables: one a view of `schemas/`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relevance.pipeline import shards_of
from relevance.store import Dataset


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A small table to print: one view of the dataset."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics:
    """How much a dataset holds, and its tables."""

    path: str
    scenes: int
    goals: int
    plans: int
    """Goals with a plan that holds."""
    queries: int
    relevant: int
    shards: tuple[int, int]
    """Finished shards of scenes, and all of them."""
    labelled: tuple[int, int]
    """Finished shards of labels (one a predicate), and all of them."""
    tables: tuple[Table, ...]

    def __getitem__(self, name: str) -> Table:
        """The table made from the view `name`."""
        return next(table for table in self.tables if table.name == name)


VIEWS = {
    "paper_label_distribution": "Label distribution (the paper's table)",
    "label_balance": "Label balance of the queries",
    "plan_lengths": "Plan lengths",
    "plan_blockers": "Objects in the way: moved besides subject and reference",
    "plan_failures": "Goals without a plan, by reason",
    "plan_verdicts": "Do the plans hold?",
    "plan_ambiguity": "Ambiguous plans",
    "by_size": "What the number of boxes does",
    "plan_seconds": "Planning time, s",
    "bound_seconds": "Planning time by bound, s",
    "stage_seconds": "Time by stage, s of one process",
    "visibility": "Visibility of the objects",
    "visibility_tenths": "Objects by how much of them shows, in tenths",
    "scene_sizes": "Scenes by number of boxes",
    "scene_draws": "Draws that were rejected",
    "origins": "What made the rows",
}
"""The views that `statistics` shows, with their titles."""


def statistics(root: str | Path) -> Statistics:
    """Count and tabulate a dataset through its DuckDB views."""
    dataset = Dataset.open(root)
    specs = shards_of(dataset)
    with dataset.connect() as connection:
        tables = []
        for view, title in VIEWS.items():
            found = connection.execute(f"FROM {view}")
            columns = tuple(column[0] for column in found.description or ())
            rows = tuple(tuple(row) for row in found.fetchall())
            tables.append(Table(name=view, title=title, columns=columns, rows=rows))
        totals = connection.execute(
            "SELECT (SELECT count(*) FROM scenes), (SELECT count(*) FROM plans),"
            " (SELECT count(*) FROM plans WHERE holds),"
            " (SELECT count(*) FROM labels WHERE NOT is_goal_object),"
            " (SELECT count(*) FROM labels WHERE NOT is_goal_object AND relevant)"
        ).fetchone()
    assert totals is not None, "a query of counts has one row"
    scenes, goals, plans, queries, relevant = totals
    return Statistics(
        path=str(root),
        scenes=scenes,
        goals=goals,
        plans=plans,
        queries=queries,
        relevant=relevant,
        shards=(len(dataset.files("scenes")), len(specs)),
        labelled=(len(dataset.files("labels")), sum(len(spec.predicates) for spec in specs)),
        tables=tuple(tables),
    )


def cell(value: Any) -> str:
    """A value as a table shows it: three significant digits, a dash for null."""
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
