"""How right a checkpoint is: its predictions as columns, judged beside two rules, in tables.

Judged by the labels of the policy that the checkpoint learned, as they are when they are read.

Shape suffixes: R rows of predictions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np

from relevance.evaluation.predictions import policy_of_checkpoint
from relevance.metrics import Accuracy, average_precision, calibration_error
from relevance.scene import FAMILIES, PREDICATES
from relevance.store import Dataset, arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Predictions:
    """Predictions of one checkpoint as columns, (R,) each."""

    predicate: np.ndarray
    family: np.ndarray
    """Of the scene."""
    scene: np.ndarray
    """Number of the scene that the row belongs to."""
    task: np.ndarray
    """Number of the task that the row belongs to."""
    relevant: np.ndarray
    score: np.ndarray
    """What the checkpoint decides by, its offset included."""
    raw_score: np.ndarray
    """What its network says."""
    is_goal_object: np.ndarray
    is_subject: np.ndarray
    stands: np.ndarray
    """`on the subject`, `on the reference` (over other boxes too) or `elsewhere`."""
    n_objects: np.ndarray
    """Boxes in the scene."""
    visible_fraction: np.ndarray
    ambiguous: np.ndarray
    """Whether the label could be another, see plans."""

    def __len__(self) -> int:
        return len(self.score)

    def where(self, mask: np.ndarray) -> Predictions:
        """The rows that a boolean mask (R,) selects."""
        return replace(self, **{f.name: getattr(self, f.name)[mask] for f in fields(self)})

    def of(self, group: str) -> Predictions:
        """Rows of one predicate or of a family of scenes, see `in_group`."""
        mask = np.zeros(len(self), bool)
        for predicate, family in product(np.unique(self.predicate), np.unique(self.family)):
            if in_group(predicate, group, family):
                mask |= (self.predicate == predicate) & (self.family == family)
        return self.where(mask)

    def queries(self) -> Predictions:
        """Rows other than those of subject and reference."""
        return self.where(~self.is_goal_object)

    def accuracy(self, beta: float = 0.0) -> Accuracy:
        """Shares judged rightly when an object is kept iff score > -beta."""
        return Accuracy.of(self.score, self.relevant, beta=beta, task=self.task)


def in_group(predicate: str, group: str, family: str | None = None) -> bool:
    """Whether a row belongs to `all`, to a family of scenes (by default the predicate's own) or
    is of the predicate that the group names, in the predicate's own family."""
    own = PREDICATES[predicate].family if predicate in PREDICATES else None
    family = family or own
    return group in ("all", family) or (group == predicate and family in (own, None))


def read_predictions(dataset: Dataset, checkpoint_id: str, *, split: str = "test") -> Predictions:
    """Predictions of a checkpoint on a split, in a fixed order: the view `judged`.

    Each is judged by the present label of the checkpoint's policy; a score without such a label
    is left out, see `unjudged`.
    """
    policy = policy_of_checkpoint(dataset, checkpoint_id)
    names = ("judged", "predictions", "labels", "scenes", "objects", "carried")
    with dataset.connect(policy=policy, names=names) as connection:
        found = arrays(
            connection,
            """
            select scene_id, subject, reference, query,
                predicate, family, relevant, score, raw_score, is_goal_object, stands,
                n_objects, visible_fraction, ambiguous, query = subject as is_subject
            from judged
            where checkpoint_id = $1 and split = $2 and policy = $3
            """,
            [checkpoint_id, split, policy],
        )
    # sorted here: the database would sort the texts, with all that stands in their rows
    names = ("scene_id", "predicate", "subject", "reference", "query")
    key = np.array([np.unique(found[name], return_inverse=True)[1] for name in names])
    order = np.lexsort(key[::-1])
    goal = key[:-1, order]
    another = (goal[:, 1:] != goal[:, :-1]).any(axis=0)
    task = np.concatenate([[0], np.cumsum(another)])[: len(order)]
    own = {field.name for field in fields(Predictions)} & {*found}
    return Predictions(scene=goal[0], task=task, **{name: found[name][order] for name in own})


# --- tables -----------------------------------------------------------------------------------

NETWORK, AS_TRAINED = "network", "network, offset left out"
RULE, NEVER = "rule: on subject or reference", "always irrelevant"

JUDGES: dict[str, Callable[[Predictions], np.ndarray]] = {
    NETWORK: lambda p: p.score,
    AS_TRAINED: lambda p: p.raw_score,
    RULE: lambda p: np.where((p.stands != "elsewhere") | p.is_subject, np.inf, -np.inf),
    NEVER: lambda p: np.full(len(p), -np.inf),
}
"""Who judges, and its scores. The rule takes the subject for relevant, too: it always moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakdown:
    """A question that divides the rows."""

    title: str
    of: Callable[[Predictions], np.ndarray]
    """The part that a row belongs to; parts are shown in their order."""


_QUARTERS = np.array(["0 to 25%", "25 to 50%", "50 to 75%", "75 to 100%"])

BREAKDOWNS = {
    "predicate": Breakdown(title="By predicate", of=lambda p: p.predicate),
    "stands": Breakdown(title="By where the query stands", of=lambda p: p.stands),
    "n_objects": Breakdown(title="By number of objects", of=lambda p: p.n_objects),
    "visible": Breakdown(
        title="By how much of the query shows",
        of=lambda p: _QUARTERS[np.clip(4 * p.visible_fraction, 0, 3).astype(int)],
    ),
    "ambiguous": Breakdown(
        title="By whether another answer would do",
        of=lambda p: np.where(p.ambiguous, "ambiguous", "one answer"),
    ),
}
"""What a network's accuracy is broken down by, besides the family of scenes."""


def accuracy_table(predictions: Predictions, *, beta: float = 0.0) -> list[dict[str, Any]]:
    """The network beside the rules: a row a family and judge. beta is the network's alone."""
    table = []
    for family, part in _families(predictions):
        for judge, scored in JUDGES.items():
            if judge == AS_TRAINED and (part.raw_score == part.score).all():
                continue
            table.append({"family": family, "judge": judge, **_figures(part, scored(part), beta)})
    return table


def breakdown_table(
    predictions: Predictions, by: str, *, beta: float = 0.0
) -> list[dict[str, Any]]:
    """The network's figures, a row a family and part of a breakdown; `rule` is the rule's total.

    (What `always irrelevant` scores in total is the base rate.)
    """
    table = []
    for family, part in _families(predictions):
        parts = BREAKDOWNS[by].of(part)
        for value in np.unique(parts):
            rows = part.where(parts == value)
            rule = Accuracy.of(JUDGES[RULE](rows), rows.relevant).total
            figures = _figures(rows, rows.score, beta)
            table.append({"family": family, by: value.item(), **figures, "rule": rule})
    return table


def _families(predictions: Predictions) -> list[tuple[str, Predictions]]:
    parts = [(family, predictions.of(family)) for family in FAMILIES]
    return [(family, part) for family, part in parts if len(part)]


def _figures(rows: Predictions, score: np.ndarray, beta: float) -> dict[str, Any]:
    found = Accuracy.of(score, rows.relevant, beta=beta, task=rows.task)
    return {
        "objects": found.n_rows,
        "relevant": found.share_relevant,
        "true_relevant": found.true_relevant,
        "true_irrelevant": found.true_irrelevant,
        "total": found.total,
        "base_rate": found.base_rate,
        "balanced": found.balanced,
        "average_precision": average_precision(score, rows.relevant),
        "calibration_error": calibration_error(score, rows.relevant),
        "tasks": found.n_tasks,
        "set_recall": found.set_recall,
        "tasks_whole": found.tasks_whole,
        "tasks_right": found.tasks_right,
    }
