"""What a finished run adds to its checkpoint: the decision that validation chose, and whose
directions it learned."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from relevance.scene import PREDICATES
from relevance.store import Dataset


def offsets(metrics: Mapping[str, Any], before: Mapping[str, float] = {}) -> dict[str, float]:
    """By predicate, what to add to a score so that beta = 0 is the decision with the highest
    total on the validation queries of `metrics`.

    eta in the loss shifts that optimum: a network that learned it well has it at
    -log(eta / (1 - eta)), for 0.86 at about -2. A predicate's own family of scenes says it where
    it has labels, else the first that borrows the predicate. Predicates of `before` keep theirs;
    those without validation labels get none.
    """
    found = {}
    for name, predicate in PREDICATES.items():
        group = next((g for g in (name, *predicate.also) if g in metrics), None)
        if group is not None:
            found[name] = metrics[group]["queries"]["best_beta"]
    return {name: beta for name, beta in found.items() if beta is not None} | dict(before)


def yaws(dataset: Dataset) -> list[float]:
    """How the robots of the training scenes are turned, rad: directions are the robot's, and no
    network is told which."""
    query = "select distinct round(robot.yaw, 3) from scenes where split = 'train' order by all"
    with dataset.connect(names=["scenes"]) as connection:
        return [yaw for (yaw,) in connection.execute(query).fetchall()]
