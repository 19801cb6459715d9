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
    -log(eta / (1 - eta)), for 0.86 at about -2. Predicates of `before` keep theirs; those without
    validation labels get none.
    """
    found = {}
    for name in PREDICATES:
        group = group_that_decides(name, metrics)
        if group is not None:
            found[name] = metrics[group]["queries"]["best_beta"]
    return {name: beta for name, beta in found.items() if beta is not None} | dict(before)


def group_that_decides(predicate: str, metrics: Mapping[str, Any]) -> str | None:
    """Whose queries choose a predicate's offset: its own family's where it has labels, else those
    of the first family that borrows it."""
    groups = predicate, *PREDICATES[predicate].also
    return next((group for group in groups if group in metrics), None)


def yaws(dataset: Dataset) -> list[float]:
    """How the robots of the training scenes are turned, rad: directions are the robot's, and no
    network is told which."""
    query = "select distinct round(robot.yaw, 3) from scenes where split = 'train' order by all"
    with dataset.connect(names=["scenes"]) as connection:
        return [yaw for (yaw,) in connection.execute(query).fetchall()]
