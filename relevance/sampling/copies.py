"""Near copies of scenes: each box moved, turned, resized and recoloured a little, supports kept."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relevance.counters import generator
from relevance.robot import GRASPABLE_EDGE
from relevance.sampling.looks import nudged_color, nudged_light
from relevance.sampling.settings import Jitter, SceneConfig
from relevance.sampling.standing import Standing
from relevance.scene import Box, Scene
from relevance.scene.geometry import packed


def near_copy(
    scene: Scene,
    config: SceneConfig,
    jitter: Jitter,
    *,
    seed: int,
    number: int,
    attempt: int = 0,
) -> Scene | None:
    """Draw near copy `number` of a scene; None when this attempt failed (try the next).

    Names, order, supports, table, camera and robot are the scene's. Boxes keep to what `config`
    asks of drawn ones: reach, distances, the picture's border, how much shows. Pure: the result
    depends on the arguments alone, of the scene's id on nothing but the random numbers.
    """
    rng = generator(seed, f"copy/{scene.id}", number, attempt)
    config = replace(config, table=scene.table, camera=scene.camera, robot=scene.robot)
    light = nudged_light(rng, scene.light, jitter.light)
    colors = {
        color: nudged_color(rng, color, jitter.color)
        for color in dict.fromkeys(box.color for box in scene.objects)
    }
    standing = Standing(config, most=len(scene.objects))
    made: dict[str, Box] = {}
    for box in _from_below(scene):
        moved = _moved(rng, replace(box, color=colors[box.color]), scene, made, standing, jitter)
        if moved is None:
            return None
        made[box.name] = moved
        standing.add(moved)
    objects = tuple(made[name] for name in scene.names)
    return replace(scene, id="", goals=(), objects=objects, light=light)


def _from_below(scene: Scene) -> list[Box]:
    """The boxes, each after what it stands on."""
    waiting, found = list(scene.objects), list[Box]()
    while waiting:
        there = {box.name for box in found}
        ready = [box for box in waiting if there.issuperset(box.supports)]
        found += ready
        waiting = [box for box in waiting if box not in ready]
    return found


def _moved(
    rng: np.random.Generator,
    box: Box,
    scene: Scene,
    made: dict[str, Box],
    standing: Standing,
    jitter: Jitter,
) -> Box | None:
    """The box nearby, on what it stood on; None where it finds no place there."""
    config = standing.config
    carrier = made[box.supports[0]] if box.supports else None
    under, shift = -1, np.zeros(2)
    if carrier is not None:
        under = list(made).index(carrier.name)
        shift = np.subtract(carrier.position, scene[carrier.name].position)[:2]
    for _ in range(config.tries):
        size = _resized(rng, box.size, config, jitter.size)
        x, y = np.array(box.position[:2]) + shift + rng.uniform(-1, 1, 2) * jitter.position
        floor = carrier.top if carrier else 0.0
        position = round(float(x), 4), round(float(y), 4), floor + size[2] / 2
        yaw = round(box.yaw + float(rng.uniform(-jitter.yaw, jitter.yaw)), 4)
        over = carrier is None or carrier.covers(*position[:2])
        if over and standing.admits(packed(size, position, yaw), under):
            return replace(box, size=size, position=position, yaw=yaw)
    return None


def _resized(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    config: SceneConfig,
    most: float,
) -> tuple[float, float, float]:
    """Edges nearby, within the limits of drawn boxes where they were; see `_size` of `scenes`."""
    longest = config.max_edge, config.max_edge, config.max_height
    edges = []
    for edge, limit in zip(size, longest, strict=True):
        low, high = config.min_edge, limit
        if len(edges) < 2 and edge <= GRASPABLE_EDGE:
            high = min(high, GRASPABLE_EDGE)
        elif len(edges) < 2:
            low = GRASPABLE_EDGE + 1e-4
        edge = min(max(edge + rng.uniform(-most, most), min(low, edge)), max(high, edge))
        edges.append(math.floor(edge * 1e4 + 1e-6) / 1e4)
    return edges[0], edges[1], edges[2]
