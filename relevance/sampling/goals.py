"""Which goals a scene is asked."""

from __future__ import annotations

import numpy as np

from relevance.counters import generator
from relevance.robot import GRASPABLE_EDGE
from relevance.sampling.settings import GoalConfig
from relevance.scene import Goal, Predicate, Scene, goal_holds

_DEFAULT = GoalConfig()


def sample_goals(
    scene: Scene,
    predicate: Predicate,
    count: int,
    *,
    seed: int,
    config: GoalConfig = _DEFAULT,
) -> tuple[Goal, ...]:
    """Draw up to `count` distinct goals that are not true yet and whose subject can be grasped.

    Depends on (seed, scene.id, predicate, config) and the scene's boxes alone; asking for more
    goals keeps the earlier ones. Fewer than `count` come back when the scene has no more.
    """
    carrying = {name for box in scene.objects for name in box.supports}
    alone = predicate.stacked and sum(bool(box.supports) for box in scene.objects) == 1
    goals: list[Goal] = []
    weights: list[float] = []
    on_carrier: list[bool] = []
    for subject in scene.objects:
        if min(subject.size[:2]) > GRASPABLE_EDGE:
            continue
        for reference in scene.objects:
            # A reference that stands on its own subject would be lifted away with it.
            if reference.name == subject.name or subject.name in reference.supports:
                continue
            # One box stacked on a target: the question is whether it has to go (the paper's).
            if alone and reference.name not in carrying:
                continue
            goal = Goal(predicate=predicate, subject=subject.name, reference=reference.name)
            if goal_holds(scene.objects, goal, scene.robot):
                continue
            goals.append(goal)
            weights.append(config.carrying_subject if subject.name in carrying else 1.0)
            on_carrier.append(predicate.stacked and reference.name in carrying)
    weight = np.array(weights)
    chosen = np.array(on_carrier, dtype=bool)
    inside, outside = weight[chosen].sum(), weight[~chosen].sum()
    if inside > 0 and outside > 0:
        odds = config.carrying_reference / (1 - config.carrying_reference)
        weight[chosen] *= odds * outside / inside
    # Exponential keys: the order of a weighted draw without replacement.
    keys = generator(seed, f"{scene.id}/{predicate.name}").exponential(size=len(goals)) / weight
    return tuple(goals[i] for i in np.argsort(keys, kind="stable")[:count])
