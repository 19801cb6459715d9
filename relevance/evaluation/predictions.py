"""What a checkpoint says of every labelled object, as rows, and whether they are up to date."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from relevance.evaluation.scorer import EvaluationError, enter, open_checkpoint, policy_of
from relevance.scene import PREDICATES, Goal
from relevance.store import Dataset, Labelling

Progress = Callable[[int, int], None]

_PREDICTED = (
    "scene_id",
    "split",
    "predicate",
    "subject",
    "reference",
    "query",
    "is_goal_object",
    "relevant",
)


def predict(
    root: str | Path,
    checkpoint: str | Path,
    *,
    split: str = "test",
    shards: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> int:
    """Score every labelled object of a split's shards into `predictions`; returns the row count.

    Labels are those of the checkpoint's policy, of the predicates that it has a head for;
    EvaluationError when the split has none.
    """
    dataset = Dataset.open(root)
    scorer, meta = open_checkpoint(checkpoint)
    of, heads = labelled_by(dataset, scorer.policy), scorer.model.predicates
    if not any(dataset.files("labels", of=of, split=split, predicate=name) for name in heads):
        raise EvaluationError(
            f"{dataset.path}: no labels of split {split} by policy {scorer.policy}, which the "
            f"checkpoint learned ({', '.join(heads)}); `relevance label {dataset.path} --policy "
            f"{scorer.policy}` makes them"
        )
    enter(dataset, checkpoint, meta)
    shards, count = dataset.shards(split) if shards is None else shards, 0
    for number, shard in enumerate(shards, 1):
        labels: dict[str, dict[Goal, dict[str, dict[str, Any]]]] = defaultdict(dict)
        for row in dataset.read_rows("labels", of=of, split=split, shard=shard):
            if row["predicate"] in heads:
                labels[row["scene_id"]].setdefault(_goal(row), {})[row["query"]] = row
        rows: list[dict[str, Any]] = []
        for sample in dataset.samples(split, [shard]) if labels else ():
            goals = labels.get(sample.scene.id, {})
            if not goals:
                continue
            scorer.observe(sample.scene, sample.image, sample.views)
            scores = scorer.score_goals(sample.scene, list(goals))
            for queries, values in zip(goals.values(), scores.tolist(), strict=True):
                scored = dict(zip(sample.scene.names, values, strict=True))
                rows += [
                    {name: label[name] for name in _PREDICTED}
                    | {
                        "checkpoint_id": scorer.checkpoint_id,
                        "score": scored[query],
                        "offset": scorer.offset(label["predicate"]),
                    }
                    for query, label in queries.items()
                ]
        dataset.write_rows("predictions", rows, name=scorer.checkpoint_id, split=split, shard=shard)
        count += len(rows)
        if progress:
            progress(number, len(shards))
    return count


def labelled_by(dataset: Dataset, policy: str) -> Labelling | None:
    """The labelling of a policy by the dataset's present planner; None: the current labels."""
    current = dataset.labelling
    if current is None or current.policy == policy:
        return None
    return replace(current, policy=policy)


def policy_of_checkpoint(dataset: Dataset, checkpoint_id: str) -> str:
    """The policy that a checkpoint of the dataset learned, by its row."""
    for row in dataset.read_rows("checkpoints", checkpoint_id=checkpoint_id):
        return policy_of(json.loads(row["config"] or "{}"))
    return policy_of(None)


def _goal(row: dict[str, Any]) -> Goal:
    return Goal(
        predicate=PREDICATES[row["predicate"]], subject=row["subject"], reference=row["reference"]
    )


def unjudged(dataset: Dataset, checkpoint_id: str, *, split: str = "test") -> list[str]:
    """What keeps the predictions of a checkpoint from being those of the present labels, in words.

    Labels are younger than predictions after another planner or policy made them. Those of
    predicates of which it says nothing are none of its own.
    """
    policy = policy_of_checkpoint(dataset, checkpoint_id)
    with dataset.connect(policy=policy, names=("predictions", "labels")) as connection:
        ((scores, labels, both, changed),) = connection.execute(
            """
            with p as (from predictions where checkpoint_id = $1 and split = $2),
                l as (from labels where policy = $3 and split = $2
                    and predicate in (select predicate from p))
            select (select count(*) from p), (select count(*) from l), count(*),
                count_if(p.relevant <> l.relevant)
            from p join l using (scene_id, predicate, subject, reference, query)
            """,
            [checkpoint_id, split, policy],
        ).fetchall()
    if not scores:
        return []
    again = "`relevance evaluate` scores them anew"
    found = [
        (scores - both, f"predictions have no label of policy {policy} any more and are left out"),
        (labels - both, f"labels of policy {policy} have no prediction yet; {again}"),
        (changed, f"labels changed since they were predicted; the present ones count; {again}"),
    ]
    return [f"{count} {what}" for count, what in found if count]
