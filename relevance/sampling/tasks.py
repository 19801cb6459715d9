"""Tasks of a stated number of boxes: a scene, and one goal of a predicate for it."""

from __future__ import annotations

from dataclasses import replace

from relevance.sampling.goals import sample_goals
from relevance.sampling.scenes import sample_scene
from relevance.sampling.settings import SceneConfig
from relevance.scene import Goal, Predicate, Scene

ATTEMPTS = 2000
"""Draws of one scene before its size counts as impossible."""


def sample_task(
    config: SceneConfig, predicate: Predicate, boxes: int, *, seed: int, index: int, split: str
) -> tuple[Scene, Goal] | None:
    """Draw task `index` of a split with that many boxes; None when no draw has one.

    Pure: the result depends on the arguments alone. Goals without a plan are drawn too.
    """
    # Of any number of boxes are those with stacks, which have one more than their config says.
    count = boxes - predicate.stacked
    family = "stacks" if predicate.stacked else predicate.family
    config = replace(config, family=family, min_objects=count, max_objects=count)
    for attempt in range(ATTEMPTS):
        scene = sample_scene(config, seed=seed, index=index, split=split, attempt=attempt)
        if scene is None:
            continue
        goals = sample_goals(scene, predicate, 1, seed=seed)
        if goals:
            return scene, goals[0]
    return None
