"""Random scenes and goals, each a pure function of its counters.

Every draw comes from a Philox generator whose counter is (split, family, index, attempt), so
scene 17 is the same scene whoever makes it, in whatever order, with whatever number of
workers. Nothing here knows the renderer or the planner: a scene is drawn so that the camera
sees every box and the arm can reach it from above, and whether it is *useful* is decided later.

Goal regions that are free need no extra action, so uniformly scattered boxes give almost no
relevant objects (2 to 4% of the queries). Scenes are therefore dense where it matters: boxes
stand squarely in the goal regions of others (`crowding`). An `on` scene is the paper's: a random
target that carries one other box, few more boxes, and every goal asks to stand on that target.
In `stacks`, which is ours, many boxes carry another (`stacking`); which of the valid goals are
asked follows stated odds (`GoalConfig`) that look at the stacks. Nothing looks at plans. With the
defaults about 14% (same-plane) and 30% (`on`) of the queries are relevant; in the paper 14% and
30%. All of it is configuration, hence in every row's hash.
"""

from relevance.sampling.copies import near_copy
from relevance.sampling.goals import sample_goals
from relevance.sampling.looks import same_view, view_of
from relevance.sampling.scenes import sample_scene
from relevance.sampling.settings import (
    SAMPLER_VERSION,
    GoalConfig,
    Jitter,
    Randomisation,
    SceneConfig,
)
from relevance.sampling.tasks import ATTEMPTS, sample_task

__all__ = [
    "ATTEMPTS",
    "SAMPLER_VERSION",
    "GoalConfig",
    "Jitter",
    "Randomisation",
    "SceneConfig",
    "near_copy",
    "same_view",
    "sample_goals",
    "sample_scene",
    "sample_task",
    "view_of",
]
