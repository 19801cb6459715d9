"""Rows of `evaluations` to the figures that pages and tables show: the one speed-up.

Times are CPU seconds a task with bootstrap intervals. A task that a guide misses stays in the
figures: its cost is the guided attempt and then the unguided run that a user would need. The
paper's way, misses left out, stands beside it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from relevance.evaluation.accuracies import in_group
from relevance.metrics import Interval, mean, mean_interval, ratio_interval
from relevance.planner import PLANNER_VERSION
from relevance.scene import FAMILIES, group_of
from relevance.store import Dataset


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A guide against no guide on the same tasks; seconds are CPU seconds a task."""

    guide: str
    search: str
    beta: float
    group: str
    n_tasks: int
    n_solvable: int
    """Tasks that the unguided planner solves."""
    n_both: int
    """Tasks that both solve: what the paper's times rest on."""
    misses: int
    """Tasks that only the unguided planner solves."""
    gains: int
    """Tasks that only the guided planner solves (within the limits)."""
    unguided: Interval
    """Over the solvable tasks."""
    guided: Interval
    """The same, misses counted (see the top of this file)."""
    inference: Interval
    speedup: Interval
    """Sum of unguided over sum of guided seconds, solvable tasks, misses counted."""
    speedup_both: Interval
    """The same over the tasks that both solve (misses left out, as in the paper)."""
    speedup_all: Interval
    """The same over all tasks, those without a plan too."""
    nodes_unguided: float
    nodes_guided: float
    nlps_unguided: float
    nlps_guided: float
    actions_unguided: float
    """Mean plan length over the tasks that both solve."""
    actions_guided: float
    kept: float
    """Share of the objects that the guide kept."""

    @property
    def reduction(self) -> float:
        """Share of the time saved, misses left out: the paper's figure."""
        return 1 - 1 / self.speedup_both.value


def read_evaluations(dataset: Dataset, checkpoint_id: str) -> list[dict[str, Any]]:
    """Evaluation rows of a checkpoint, in a fixed order, of one planner and one set of settings.

    What another planner version or other settings made is left out, see `left_out`.
    """
    rows = _all_rows(dataset, checkpoint_id)
    kind = _kind(rows)
    return [row for row in rows if _made_by(row) == kind]


def left_out(dataset: Dataset, checkpoint_id: str) -> list[str]:
    """What a reader of `read_evaluations` should know of its rows and the ones left out."""
    rows = _all_rows(dataset, checkpoint_id)
    kind = _kind(rows)
    if kind is None:
        return []
    said = []
    for made_by, count in sorted(Counter(map(_made_by, rows)).items(), key=str):
        if made_by != kind:
            what = "other settings" if made_by[0] == kind[0] else f"planner {made_by[0]}"
            said.append(
                f"{count} rows of {what} are left out; `relevance evaluate` makes them anew"
            )
    planner = dataset.labelling.planner if dataset.labelling else kind[0]
    if kind[0] != planner:
        said.append(f"these reruns are of planner {kind[0]}, the labels of planner {planner}")
    return said


def _all_rows(dataset: Dataset, checkpoint_id: str) -> list[dict[str, Any]]:
    with dataset.connect() as connection:
        found = connection.execute(
            """
            select e.*, family from evaluations e
            left join (select scene_id, any_value(family) as family from scenes group by scene_id)
                using (scene_id)
            where checkpoint_id = ?
            order by guide, search, beta, predicate, scene_id, subject, reference
            """,
            [checkpoint_id],
        )
        names = [column[0] for column in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def _made_by(row: dict[str, Any]) -> tuple[str | None, str | None]:
    return row["planner_version"], row["config_hash"]


def _kind(rows: Sequence[dict[str, Any]]) -> tuple[str | None, str | None] | None:
    """The planner version and settings that count: ours before others, then what made most."""
    counts = Counter(map(_made_by, rows))
    return max(
        counts, key=lambda made: (made[0] == PLANNER_VERSION, counts[made], str(made)), default=None
    )


def summarise(rows: Sequence[dict[str, Any]], group: str = "all") -> Comparison:
    """Sum up rows of one guide, search and beta; `group` is a predicate, a family or `all`."""
    chosen = [row for row in rows if in_group(shown_as(row), group)]
    setting = {(row["guide"], row["search"], row["beta"]) for row in rows}
    assert len(setting) == 1, f"rows of one guide, search and beta, got {setting}"
    guide, search, beta = setting.pop()
    solvable = [row for row in chosen if row["solved_unguided"]]
    both = [row for row in solvable if row["solved_guided"]]

    def column(name: str, of: Sequence[dict[str, Any]]) -> list[float]:
        return [row[name] for row in of]

    def cost(of: Sequence[dict[str, Any]]) -> list[float]:
        return [guided_cost(row) for row in of]

    def speedup(of: Sequence[dict[str, Any]]) -> Interval:
        return ratio_interval(column("seconds_unguided", of), cost(of))

    return Comparison(
        guide=guide,
        search=search,
        beta=beta,
        group=group,
        n_tasks=len(chosen),
        n_solvable=len(solvable),
        n_both=len(both),
        misses=len(solvable) - len(both),
        gains=sum(row["solved_guided"] and not row["solved_unguided"] for row in chosen),
        unguided=mean_interval(column("seconds_unguided", solvable)),
        guided=mean_interval(cost(solvable)),
        inference=mean_interval(column("seconds_inference", solvable)),
        speedup=speedup(solvable),
        speedup_both=speedup(both),
        speedup_all=speedup(chosen),
        nodes_unguided=mean(column("nodes_unguided", solvable)),
        nodes_guided=mean(column("nodes_guided", solvable)),
        nlps_unguided=mean(column("nlps_unguided", solvable)),
        nlps_guided=mean(column("nlps_guided", solvable)),
        actions_unguided=mean(column("n_actions_unguided", both)),
        actions_guided=mean(column("n_actions_guided", both)),
        kept=mean([row["n_kept"] / row["n_objects"] for row in chosen if row["n_kept"]]),
    )


def shown_as(row: Mapping[str, Any]) -> str:
    """The name that figures give the predicate of a row, see `scene.group_of`."""
    return group_of(row["predicate"], row.get("family"))


def guided_cost(row: dict[str, Any]) -> float:
    """Seconds that a user of the guide pays: after a miss the task is planned again unguided."""
    missed = row["solved_unguided"] and not row["solved_guided"]
    return row["seconds_guided"] + (row["seconds_unguided"] if missed else 0.0)


def settings(
    rows: Iterable[dict[str, Any]],
) -> dict[tuple[str, str, float], list[dict[str, Any]]]:
    """Rows by (search, guide, beta), in order."""
    found: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["search"], row["guide"], row["beta"]), []).append(row)
    return dict(sorted(found.items()))


def speed_table(dataset: Dataset, checkpoint_id: str) -> list[dict[str, Any]]:
    """What a checkpoint saves, a row a search, guide, beta and family, then of all predicates."""
    table = []
    for (search, guide, beta), rows in settings(read_evaluations(dataset, checkpoint_id)).items():
        for group in (*FAMILIES, "all"):
            found = summarise(rows, group)
            if not found.n_tasks:
                continue
            table.append(
                {
                    "search": search,
                    "guide": guide,
                    "beta": beta,
                    "family": group,
                    "tasks": found.n_tasks,
                    "solvable": found.n_solvable,
                    "missed": found.misses,
                    "seconds_unguided": found.unguided.value,
                    "seconds_guided": found.guided.value,
                    "seconds_network": found.inference.value,
                    "speedup": found.speedup.value,
                    "speedup_both": found.speedup_both.value,
                    "nlps_unguided": found.nlps_unguided,
                    "nlps_guided": found.nlps_guided,
                }
            )
    return table
