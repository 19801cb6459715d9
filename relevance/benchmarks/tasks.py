"""The tasks that the planner is measured on: random and fresh, ours or as other people make them.

`ours`: the sampler that datasets are made with, every predicate and number of boxes in equal
shares. `foreign`: boxes of any size thrown anywhere within reach, some onto others, with nothing
looked at but overlap: no crowding, no colours, no camera. Three of five of its goals are beside
a reference, two on one.
"""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from relevance.counters import generator
from relevance.errors import RelevanceError
from relevance.sampling import ATTEMPTS, SceneConfig, sample_task
from relevance.scene import (
    PREDICATES,
    Box,
    Goal,
    Predicate,
    Robot,
    Scene,
    SceneError,
    Table,
    footprint_gap,
    goal_holds,
)

Scenes = Literal["ours", "foreign"]

BOXES = (3, 10)
"""Fewest and most boxes of a task, stacked ones included."""
_STREAM = "bench"  # a split of its own: never a scene of a dataset
EDGES = (0.04, 0.12)
"""Shortest and longest edge of a foreign box, m."""
TAKEN = 0.07
"""Longest shorter edge of a foreign subject, m: others are obstacles (CONTRIBUTING, The words)."""
WITHIN = (0.30, 0.72)
"""Distance of a foreign box from the robot's base, m."""
APART = 0.001
"""Least gap between foreign boxes, m."""
ON_TOP = 0.3
"""How often a foreign box is thrown onto another one."""
THROWS = 50
"""Throws of one foreign box before its scene is given up."""


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
    scenes: Scenes = "ours",
    first: int = 0,
) -> list[Task]:
    """Draw `count` tasks from `first` on, numbers of boxes in equal shares, infeasible ones too.

    Our scenes have the default SceneConfig but for their number of boxes and `max_edge` (m).
    Depends on the arguments alone; a larger `count` keeps the earlier tasks. Raises
    BenchmarkError for settings that no scene meets.
    """
    if count < 1:
        raise BenchmarkError(f"tasks = {count}: expected at least 1")
    if not 0 <= seed < 2**63:
        raise BenchmarkError(f"seed = {seed}: expected 0 to 2**63 - 1")
    if not 3 <= boxes[0] <= boxes[1]:
        raise BenchmarkError(f"boxes = {boxes}: expected 3 <= fewest <= most")
    sizes = range(boxes[0], boxes[1] + 1)
    predicates = _predicates(scenes)
    make = _foreign_task if scenes == "foreign" else _task
    return [
        make(
            index,
            predicates[index % len(predicates)],
            sizes[index // len(predicates) % len(sizes)],
            seed,
            max_edge,
            stream,
        )
        for index in range(first, first + count)
    ]


def _predicates(scenes: Scenes) -> tuple[Predicate, ...]:
    """The predicates in the order in which tasks take turns at them."""
    every = tuple(PREDICATES.values())
    if scenes == "ours":
        return every
    beside = [predicate for predicate in every if not predicate.stacked]
    stacked = [predicate for predicate in every if predicate.stacked]
    turns = [[beside[(3 * k + i) % len(beside)] for i in range(3)] for k in range(len(beside))]
    return tuple(
        one
        for k, three in enumerate(turns)
        for one in (*three, *(stacked[(2 * k + i) % len(stacked)] for i in range(2)))
    )


def _task(
    index: int, predicate: Predicate, boxes: int, seed: int, max_edge: float, stream: str
) -> Task:
    start = SceneConfig(min_objects=2, max_edge=max_edge)
    found = sample_task(start, predicate, boxes, seed=seed, index=index, split=stream)
    if found is None:
        raise BenchmarkError(f"{boxes} boxes: no scene in {ATTEMPTS} draws, expected fewer boxes")
    scene, goal = found
    return Task(index=index, scene=scene, goal=goal)


def _foreign_task(
    index: int, predicate: Predicate, boxes: int, seed: int, max_edge: float, stream: str
) -> Task:
    for attempt in range(ATTEMPTS):
        rng = generator(seed, f"foreign/{stream}", index, attempt)
        objects = _thrown(rng, boxes, max_edge)
        if objects is None:
            continue
        try:
            scene = Scene(objects=objects)
        except (SceneError, ValueError):  # what a scene refuses and we did not look at
            continue
        able = [box.name for box in objects if min(box.size[:2]) <= TAKEN]
        pairs = [(a, b.name) for a in able for b in objects if b.name != a and a not in b.supports]
        if not pairs:
            continue
        subject, reference = pairs[int(rng.integers(len(pairs)))]
        goal = Goal(predicate=predicate, subject=subject, reference=reference)
        if not goal_holds(objects, goal, scene.robot):
            return Task(index=index, scene=scene, goal=goal)
    raise BenchmarkError(f"{boxes} boxes: no scene in {ATTEMPTS} draws, expected fewer boxes")


def _thrown(rng: np.random.Generator, count: int, max_edge: float) -> tuple[Box, ...] | None:
    """Boxes thrown one after the other, each until it overlaps none; None when one never does."""
    boxes: list[Box] = []
    for i in range(count):
        size = tuple(rng.uniform(EDGES[0], min(EDGES[1], max_edge), 3).round(4).tolist())
        color = colorsys.hsv_to_rgb(i / count, 0.8, 0.9)
        for _ in range(THROWS):
            box = _throw(rng, f"b{i}", size, color, boxes)
            if box is not None:
                boxes.append(box)
                break
        else:
            return None
    return tuple(boxes)


def _throw(
    rng: np.random.Generator,
    name: str,
    size: tuple[float, ...],
    color: tuple[float, ...],
    boxes: list[Box],
) -> Box | None:
    below = boxes[int(rng.integers(len(boxes)))] if boxes and rng.random() < ON_TOP else None
    if below is None:
        half = np.array(Table().size) / 2
        x, y = rng.uniform(-half, half)
        floor = 0.0
    else:
        a, b = rng.uniform(-0.5, 0.5, 2) * below.size[:2]
        c, s = math.cos(below.yaw), math.sin(below.yaw)
        x, y = below.position[0] + c * a - s * b, below.position[1] + s * a + c * b
        floor = below.top
    base = Robot().base
    if not WITHIN[0] <= math.hypot(x - base[0], y - base[1]) <= WITHIN[1]:
        return None
    box = Box(
        name=name,
        size=size,  # pyright: ignore[reportArgumentType]
        position=(round(float(x), 4), round(float(y), 4), floor + size[2] / 2),
        yaw=round(float(rng.uniform(-math.pi, math.pi)), 4),
        color=color,  # pyright: ignore[reportArgumentType]
        on=None if below is None else below.name,
    )
    for other in boxes:
        level = box.bottom < other.top - APART and other.bottom < box.top - APART
        if level and footprint_gap(box, other) < APART:
            return None
    if below is not None and not below.covers(*box.position[:2]):
        return None
    half = np.array(Table().size) / 2
    return box if (np.abs(box.corners()) <= half).all() else None
