"""The tasks that the planner is measured on: random, fresh, in equal shares of every kind."""

from __future__ import annotations

from dataclasses import dataclass, replace

from relevance.errors import RelevanceError
from relevance.sampling import SceneConfig, sample_goals, sample_scene
from relevance.scene import PREDICATES, Goal, Predicate, Scene

BOXES = (3, 10)
"""Fewest and most boxes of a task, stacked ones included."""
ATTEMPTS = 2000
"""Draws of one scene before its size counts as impossible."""
_STREAM = "bench"  # a split of its own: never a scene of a dataset


class BenchmarkError(RelevanceError):
    """A measurement that cannot be made: says which setting, its value and what was expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One scene and one goal for it."""

    index: int
    scene: Scene
    goal: Goal

    @property
    def n_objects(self) -> int:
        """Boxes of the scene."""
        return len(self.scene.objects)


def draw(
    count: int,
    seed: int,
    *,
    boxes: tuple[int, int] = BOXES,
    max_edge: float = SceneConfig().max_edge,
    stream: str = _STREAM,
) -> list[Task]:
    """Draw `count` tasks, predicates and numbers of boxes in equal shares, infeasible ones too.

    Scenes have the default SceneConfig but for their number of boxes and `max_edge` (m).
    Depends on the arguments alone; a larger `count` keeps the earlier tasks. Raises
    BenchmarkError for settings that no scene meets.
    """
    if count < 1:
        raise BenchmarkError(f"tasks = {count}: expected at least 1")
    if not 0 <= seed < 2**63:
        raise BenchmarkError(f"seed = {seed}: expected 0 to 2**63 - 1")
    if not 3 <= boxes[0] <= boxes[1]:
        raise BenchmarkError(f"boxes = {boxes}: expected 3 <= fewest <= most")
    predicates = tuple(PREDICATES.values())
    sizes = range(boxes[0], boxes[1] + 1)
    return [
        _task(
            index,
            predicates[index % len(predicates)],
            sizes[index // len(predicates) % len(sizes)],
            seed,
            max_edge,
            stream,
        )
        for index in range(count)
    ]


def _task(
    index: int, predicate: Predicate, boxes: int, seed: int, max_edge: float, stream: str
) -> Task:
    # The `on` family has one box more than its config says.
    count = boxes - (predicate.stacked)
    start = SceneConfig(family=predicate.family, min_objects=2, max_edge=max_edge)
    config = replace(start, min_objects=count, max_objects=count)
    for attempt in range(ATTEMPTS):
        scene = sample_scene(config, seed=seed, index=index, split=stream, attempt=attempt)
        if scene is None:
            continue
        goals = sample_goals(scene, predicate, 1, seed=seed)
        if goals:
            return Task(index=index, scene=scene, goal=goals[0])
    raise BenchmarkError(f"{boxes} boxes: no scene in {ATTEMPTS} draws, expected fewer boxes")
