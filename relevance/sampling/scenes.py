"""Random scenes, each a pure function of its counters (see the package's docstring)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relevance.counters import generator
from relevance.robot import GRASPABLE_EDGE
from relevance.sampling.colors import draw_colors
from relevance.sampling.looks import draw_camera, draw_light, draw_table
from relevance.sampling.settings import SceneConfig
from relevance.sampling.standing import Standing
from relevance.scene import Box, Color, Scene
from relevance.scene.geometry import packed

GAPS = (0.005, 0.03)
"""Narrowest and widest gap of a crowded box to its neighbour, m. A finger beside a box takes 28 to
31 mm with its clearance, so most boxes must leave before their neighbour can be taken from that
side. From 10 to 50 mm 11% of the same-plane queries are relevant, from 5 to 40 mm 12.7%, so 14.3%
(the paper's 14)."""
CENTRED = 0.1
"""How far off a neighbour's middle a crowded box may stand, as a share of its half extent."""
OVER = {"on": 0.2, "stacks": 0.25}
"""How far off its carrier's middle the centre of a stacked box may be, as a share of each edge."""
BROADSIDE = 0.05
"""How far a crowded box may be turned out of line with its neighbour's sides, rad."""


def sample_scene(
    config: SceneConfig, *, seed: int, index: int, split: str = "train", attempt: int = 0
) -> Scene | None:
    """Draw scene `index` of a split; None when this attempt failed (try the next `attempt`).

    Pure: the result depends on the arguments alone.
    """
    rng = generator(seed, f"{config.family}/{split}", index, attempt)
    fewest, most = config.numbers
    total = int(rng.integers(fewest, most + 1))
    ranges = config.randomisation
    if ranges is not None:
        config = replace(
            config,
            light=draw_light(rng, config.light, ranges),
            table=draw_table(rng, config.table, ranges),
            camera=draw_camera(rng, config.camera, ranges),
        )
    texture = config.table.texture
    colors = draw_colors(
        rng,
        total,
        [config.table.color, *([texture.color] if texture else [])],
        distance=ranges.color_delta_e if ranges else config.color_distance,
        perceptual=ranges is not None,
        saturation=config.saturation,
        brightness=config.brightness,
    )
    if colors is None:
        return None
    on_top = int(config.family == "on")
    if config.family == "stacks":
        on_top = min(1 + int(rng.binomial(total - 1, config.stacking)), total // 2)
    standing = Standing(config)
    for i, (name, color) in enumerate(colors):
        box, twin = None, None
        if i and config.twins and rng.random() < config.twins:
            twin = standing.boxes[int(rng.integers(i))]
            color = twin.color
        if i >= total - on_top:
            box = _stacked_box(rng, name, color, standing, config, twin)
        # One box stands on another; a further one that finds no place there goes to the table.
        if box is None and i != total - on_top:
            box = _table_box(rng, name, color, standing, config, twin)
        if box is None:
            return None
        standing.add(box)
    if config.occlusion and _hidden(standing) < config.occlusion:
        return None
    # Crowded boxes come after their neighbours and the stacked ones come last: shuffled, so
    # that the order of objects tells nothing.
    objects = tuple(standing.boxes[i] for i in rng.permutation(total))
    return Scene(
        objects=objects,
        table=config.table,
        camera=config.camera,
        light=config.light,
        robot=config.robot,
    )


def _hidden(standing: Standing) -> float:
    """Share of the boxes that others hide, mean over boxes, judged by rays."""
    shown, n = standing._shown, len(standing.boxes)
    return float((shown.shares[:n] * shown.hidden[:n]).sum() / n)


def _size(
    rng: np.random.Generator, config: SceneConfig, obstacles: float, tallest: float
) -> tuple[float, float, float]:
    """Edges of a box: one footprint edge fits the hand, unless it is drawn as an obstacle."""
    obstacle = rng.random() < obstacles
    if obstacle:
        low = min(GRASPABLE_EDGE + 0.015, config.max_edge)
        a, b = rng.uniform(low, config.max_edge, 2)
    else:
        a = rng.uniform(config.min_edge, GRASPABLE_EDGE)
        b = rng.uniform(config.min_edge, config.max_edge)
    if rng.random() < 0.5:
        a, b = b, a
    height = rng.uniform(config.min_edge, tallest)
    # Floored to 0.1 mm, so that a limit stays kept and files stay readable.
    x, y, z = (math.floor(edge * 1e4 + 1e-6) / 1e4 for edge in (a, b, height))
    return x, y, z


def _table_box(
    rng: np.random.Generator,
    name: str,
    color: Color,
    standing: Standing,
    config: SceneConfig,
    twin: Box | None,
) -> Box | None:
    boxes = standing.boxes
    size = twin.size if twin else _size(rng, config, config.obstacle_share, config.max_height)
    crowding = config.crowding if config.family == "same-plane" else config.crowding_on
    crowd = bool(boxes) and rng.random() < crowding
    best, most, fitting = None, -1, 0
    for _ in range(config.tries):
        if crowd:
            x, y, yaw = _beside(rng, size, boxes[int(rng.integers(len(boxes)))], config)
        else:
            x, y, yaw = _anywhere(rng, config)
        position, yaw = (round(x, 4), round(y, 4), size[2] / 2), round(yaw, 4)
        candidate = packed(size, position, yaw)
        if standing.admits(candidate):
            closed = standing.closes(candidate)
            if closed > most:
                best, most = (position, yaw), closed
            fitting += 1
            if not crowd or fitting == config.choices:
                break
    if best is None:
        return None
    return Box(name=name, size=size, position=best[0], yaw=best[1], color=color)


def _anywhere(rng: np.random.Generator, config: SceneConfig) -> tuple[float, float, float]:
    """A pose that is uniform over the table's part in front of the robot."""
    half_x, half_y = config.table.size[0] / 2, config.table.size[1] / 2
    a, b, turn = rng.random(3).tolist()
    return (
        _within(-half_x, half_x, a),
        _within(-half_y, half_y, b),
        _within(-math.pi / 2, math.pi / 2, turn),
    )


def _within(low: float, high: float, share: float) -> float:
    """A draw from 0..1 stretched over a range as `Generator.uniform` does, in less time."""
    return low + (high - low) * share


def _beside(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    neighbour: Box,
    config: SceneConfig,
) -> tuple[float, float, float]:
    """A pose in one of the neighbour's four goal regions, its long edge across the way in.

    Near the region's middle and broadside on, it leaves no room beside it more often. The gap
    is too narrow for another box, and hardly ever wide enough for a finger.
    """
    quarter = int(rng.integers(4))
    axis = quarter % 2
    broadside = 0.0 if (size[0] < size[1]) == (axis == 0) else math.pi / 2
    turn, deep, off = rng.random(3).tolist()
    yaw = broadside + _within(-BROADSIDE, BROADSIDE, turn)  # to the robot's axes
    c, s = abs(math.cos(yaw)), abs(math.sin(yaw))
    extents = (c * size[0] + s * size[1]) / 2, (s * size[0] + c * size[1]) / 2
    gap = max(config.spacing, _within(*GAPS, deep))
    there = neighbour.extents_at(config.robot.yaw)
    along = there[axis] + extents[axis] + gap
    across = _within(-CENTRED, CENTRED, off) * there[1 - axis]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    dx, dy = along * c - across * s, along * s + across * c
    c, s = math.cos(config.robot.yaw), math.sin(config.robot.yaw)
    x = neighbour.position[0] + (c * dx - s * dy)
    y = neighbour.position[1] + (s * dx + c * dy)
    return x, y, yaw + config.robot.yaw


def _stacked_box(
    rng: np.random.Generator,
    name: str,
    color: Color,
    standing: Standing,
    config: SceneConfig,
    twin: Box | None,
) -> Box | None:
    """A box on one that carries none yet, its centre near the middle of the top face (`OVER`)."""
    taken = {box.on for box in standing.boxes}
    free = [
        i
        for i, box in enumerate(standing.boxes)
        if box.on is None
        and box.name not in taken
        and box.top + config.min_edge < config.stack_height
    ]
    if config.family == "on" and free:  # one target, whatever its size
        free = [free[int(rng.integers(len(free)))]]
    for _ in range(min(config.tries, 4 * len(free))):
        i = free[int(rng.integers(len(free)))]
        carrier = standing.boxes[i]
        tallest = min(config.stack_height - carrier.top, config.max_height)
        size = twin.size if twin else _size(rng, config, 0.0, tallest)
        if size[2] > tallest:
            continue
        yaw = float(rng.uniform(-math.pi / 2, math.pi / 2))
        c, s = math.cos(carrier.yaw), math.sin(carrier.yaw)
        over = OVER[config.family]
        dx, dy = rng.uniform(-over, over, 2) * carrier.size[:2]
        position = (
            round(carrier.position[0] + float(c * dx - s * dy), 4),
            round(carrier.position[1] + float(s * dx + c * dy), 4),
            carrier.top + size[2] / 2,
        )
        yaw = round(yaw, 4)
        if standing.admits(packed(size, position, yaw), i):
            return Box(
                name=name, size=size, position=position, yaw=yaw, color=color, on=carrier.name
            )
    return None
