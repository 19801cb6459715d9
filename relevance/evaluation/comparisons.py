"""Rows of `evaluations` to the figures that pages and tables show: the one speed-up.

Times are CPU seconds a task with bootstrap intervals over scenes. A task that a guide misses stays
in the figures: its cost is the guided attempt and then the unguided run that a user would need. The
paper's way, misses left out, stands beside it. So does the oracle: the same guide with true labels
and a look that costs nothing.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from relevance.evaluation.accuracies import in_group
from relevance.evaluation.priors import TRUE
from relevance.evaluation.reruns import OWN
from relevance.metrics import (
    CONFIDENCE,
    WIDE,
    Interval,
    mean,
    over_groups,
    ratio_of_sums,
    saving_reached,
)
from relevance.planner import PLANNER_VERSION
from relevance.scene import FAMILIES, group_of
from relevance.store import Dataset


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A guide against no guide on the same tasks; seconds are CPU seconds a task."""

    prior: str
    """Who gives the scores: the checkpoint, or another."""
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
    speedup_wide: Interval
    """`speedup` with its 95% interval."""
    median_unguided: float
    median_guided: float
    """Of the solvable tasks, misses counted."""
    amortised: Interval
    """As `guided`, each scene encoded once for all of its goals that were rerun."""
    oracle: Interval
    """As `guided`, with true labels and no look; nan where it was not rerun."""
    reached: Interval
    """Of what the oracle saves, the share that the guide saves; nan where it saves nothing."""
    reached_free: Interval
    """The same before the look is paid."""
    looked: float
    """Share of all tasks in which the guide asked for scores."""
    sequences_unguided: float
    """Action sequences that were tried, solvable tasks; nan where they were not recorded."""
    sequences_guided: float
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


def read_evaluations(
    dataset: Dataset, checkpoint_id: str, prior: str = OWN
) -> list[dict[str, Any]]:
    """Evaluation rows of a checkpoint, in a fixed order, of one planner and one set of settings;
    of its own scores, or of another prior that was rerun beside it (`rerun_priors`).

    What another planner version or other settings made is left out, see `left_out`. Each row has
    what true labels cost in its place, see `with_oracle`.
    """
    rows = with_oracle(_current(dataset, checkpoint_id))
    return [row for row in rows if prior_of(row) == prior]


def rerun_priors(dataset: Dataset, checkpoint_id: str) -> list[str]:
    """The priors that were rerun beside a checkpoint."""
    return sorted({prior_of(row) for row in _current(dataset, checkpoint_id)} - {OWN})


def _current(dataset: Dataset, checkpoint_id: str) -> list[dict[str, Any]]:
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
    with dataset.connect(names=("evaluations", "scenes")) as connection:
        found = connection.execute(
            """
            select e.*, family from evaluations e
            left join (select scene_id, any_value(family) as family from scenes group by scene_id)
                using (scene_id)
            where checkpoint_id = ?
            order by prior, guide, search, beta, predicate, scene_id, subject, reference
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
    """Sum up rows of one prior, guide, search and beta; `group` is a predicate, a family or `all`.

    What was not recorded (`seconds_oracle`, `sequences`, ...) gives nan.
    """
    chosen = [row for row in rows if in_group(shown_as(row), group)]
    setting = {(prior_of(row), row["guide"], row["search"], row["beta"]) for row in rows}
    assert len(setting) == 1, f"rows of one prior, guide, search and beta, got {setting}"
    prior, guide, search, beta = setting.pop()
    solvable = [row for row in chosen if row["solved_unguided"]]
    both = [row for row in solvable if row["solved_guided"]]
    known = [row for row in solvable if row.get("seconds_oracle") is not None]

    def column(name: str, of: Sequence[dict[str, Any]]) -> list[float]:
        return [row[name] for row in of]

    def recorded(name: str) -> float:
        return mean([row[name] for row in solvable if row.get(name) is not None])

    def cost(of: Sequence[dict[str, Any]]) -> list[float]:
        return [guided_cost(row) for row in of]

    def over_scenes(
        of: Sequence[dict[str, Any]], statistic: Any, *columns: Sequence[float], **more: Any
    ) -> Interval:
        return over_groups(column("scene_id", of), statistic, *columns, **more)

    def mean_of(of: Sequence[dict[str, Any]], values: Sequence[float]) -> Interval:
        return over_scenes(of, np.nanmean, values)

    def speedup(of: Sequence[dict[str, Any]], confidence: float = CONFIDENCE) -> Interval:
        unguided = column("seconds_unguided", of)
        return over_scenes(of, ratio_of_sums, unguided, cost(of), confidence=confidence)

    oracle = [oracle_cost(row) for row in known]
    reached = partial(
        saving_reached, column("scene_id", known), column("seconds_unguided", known), best=oracle
    )
    free = [guided_cost(row) - row["seconds_inference"] for row in known]
    return Comparison(
        prior=prior,
        guide=guide,
        search=search,
        beta=beta,
        group=group,
        n_tasks=len(chosen),
        n_solvable=len(solvable),
        n_both=len(both),
        misses=len(solvable) - len(both),
        gains=sum(row["solved_guided"] and not row["solved_unguided"] for row in chosen),
        unguided=mean_of(solvable, column("seconds_unguided", solvable)),
        guided=mean_of(solvable, cost(solvable)),
        inference=mean_of(solvable, column("seconds_inference", solvable)),
        speedup=speedup(solvable),
        speedup_both=speedup(both),
        speedup_all=speedup(chosen),
        speedup_wide=speedup(solvable, WIDE),
        median_unguided=median(column("seconds_unguided", solvable)),
        median_guided=median(cost(solvable)),
        amortised=mean_of(solvable, amortised_costs(solvable)),
        oracle=mean_of(known, oracle),
        reached=reached(cost(known)),
        reached_free=reached(free),
        looked=mean([row.get("looked") is not False for row in chosen]),
        sequences_unguided=recorded("sequences_unguided"),
        sequences_guided=recorded("sequences"),
        nodes_unguided=mean(column("nodes_unguided", solvable)),
        nodes_guided=mean(column("nodes_guided", solvable)),
        nlps_unguided=mean(column("nlps_unguided", solvable)),
        nlps_guided=mean(column("nlps_guided", solvable)),
        actions_unguided=mean(column("n_actions_unguided", both)),
        actions_guided=mean(column("n_actions_guided", both)),
        kept=mean([row["n_kept"] / row["n_objects"] for row in chosen if row["n_kept"]]),
    )


def median(values: Sequence[float]) -> float:
    """nan of nothing."""
    return float(np.median(values)) if len(values) else float("nan")


def prior_of(row: Mapping[str, Any]) -> str:
    """Who gave the scores of a row; older ones do not say, it was the checkpoint."""
    return row.get("prior") or OWN


def amortised_costs(rows: Sequence[Mapping[str, Any]]) -> list[float]:
    """What the guided runs of `rows` cost when a scene is encoded once: the goals of a scene that
    looked share one encoding, equally."""
    looked: dict[str, int] = defaultdict(int)
    for row in rows:
        looked[row["scene_id"]] += bool(row.get("seconds_encoding"))
    return [
        guided_cost(row)
        - (row.get("seconds_encoding") or 0.0) * (1 - 1 / max(looked[row["scene_id"]], 1))
        for row in rows
    ]


def shown_as(row: Mapping[str, Any]) -> str:
    """The name that figures give the predicate of a row, see `scene.group_of`."""
    return group_of(row["predicate"], row.get("family"))


def guided_cost(row: Mapping[str, Any]) -> float:
    """Seconds that a user of the guide pays: after a miss the task is planned again unguided."""
    missed = row["solved_unguided"] and not row["solved_guided"]
    return row["seconds_guided"] + (row["seconds_unguided"] if missed else 0.0)


def oracle_cost(row: Mapping[str, Any]) -> float:
    """The same for the guide with true labels."""
    missed = row["solved_unguided"] and not row["solved_oracle"]
    return row["seconds_oracle"] + (row["seconds_unguided"] if missed else 0.0)


def with_oracle(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each row with what true labels cost in its place: `seconds_oracle` and `solved_oracle`, None
    where they were not rerun."""

    def place(row: Mapping[str, Any]) -> tuple[Any, ...]:
        names = ("search", "guide", "scene_id", "predicate", "subject", "reference")
        return tuple(row[name] for name in names)

    true = {place(row): row for row in rows if prior_of(row) == TRUE}
    nothing = {"seconds_guided": None, "solved_guided": None}
    return [
        row | {"seconds_oracle": its["seconds_guided"], "solved_oracle": its["solved_guided"]}
        for row in rows
        for its in [true.get(place(row), nothing)]
    ]


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
                    "seconds_oracle": found.oracle.value,
                    "reached": found.reached.value,
                    "looked": found.looked,
                    "nlps_unguided": found.nlps_unguided,
                    "nlps_guided": found.nlps_guided,
                }
            )
    return table
