"""Random scenes and goals, each a pure function of its counters.

Every draw comes from a Philox generator whose counter is (split, family, index, attempt), so
scene 17 is the same scene whoever makes it, in whatever order, with whatever number of
workers. Nothing here knows the renderer or the planner: a scene is drawn so that the camera
sees every box and the arm can reach it from above, and whether it is *useful* is decided later.

Goal regions that are free need no extra action, so uniformly scattered boxes give almost no
relevant objects (2 to 4% of the queries). `crowding` therefore draws a share of the boxes into
the goal regions of boxes that stand already; it is part of the configuration, hence of its
hash, hence of every row.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from relevance.scene import (
    FAMILIES,
    GAP,
    Box,
    Camera,
    Goal,
    Light,
    Predicate,
    Robot,
    Scene,
    Table,
    content_hash,
    footprint_gap,
    goal_holds,
)

GRASPABLE_EDGE = 0.07
"""Longest footprint edge that the hand (opening 8 cm) takes with room to spare, m."""
FINGER_ROOM = 0.03
"""Room that a finger (26 mm thick) needs beside a box to take it, m."""
CARRYING_REFERENCE_SHARE = 0.75
"""Share of `on` goals whose reference carries a box already, where the scene has one."""
CARRYING_SUBJECT_WEIGHT = 0.1
"""How likely a box that carries another is drawn as subject, relative to one that does not."""

_COLOR_NAMES: dict[str, tuple[float, float, float]] = {
    "red": (0.85, 0.1, 0.1),
    "maroon": (0.45, 0.1, 0.12),
    "orange": (0.95, 0.5, 0.1),
    "brown": (0.5, 0.3, 0.12),
    "yellow": (0.95, 0.9, 0.15),
    "olive": (0.5, 0.5, 0.12),
    "lime": (0.6, 0.95, 0.2),
    "green": (0.15, 0.75, 0.2),
    "forest": (0.12, 0.42, 0.15),
    "mint": (0.35, 0.95, 0.65),
    "cyan": (0.2, 0.9, 0.95),
    "teal": (0.1, 0.5, 0.5),
    "azure": (0.25, 0.6, 0.95),
    "blue": (0.12, 0.2, 0.9),
    "navy": (0.1, 0.12, 0.45),
    "violet": (0.5, 0.35, 0.95),
    "purple": (0.5, 0.1, 0.75),
    "plum": (0.42, 0.12, 0.42),
    "magenta": (0.95, 0.15, 0.85),
    "pink": (0.95, 0.5, 0.75),
    "crimson": (0.85, 0.1, 0.45),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """What scenes are drawn; raises ValueError that names the field on impossible settings."""

    family: str = "same-plane"
    """`same-plane`: all boxes on the table. `on`: the same, and one more box on one of them."""
    min_objects: int = 3
    """Fewest boxes on the table."""
    max_objects: int = 10
    """Most boxes on the table (the `on` family adds one)."""
    crowding: float = 0.9
    """Probability that a box is drawn into a goal region of an earlier one."""
    obstacle_share: float = 0.0
    """Share of boxes with both footprint edges over 7 cm, which the hand cannot take."""
    min_edge: float = 0.04
    """Shortest edge, m."""
    max_edge: float = 0.12
    """Longest edge, m."""
    spacing: float = 0.005
    """Least distance between boxes, m."""
    reach: tuple[float, float] = (0.30, 0.72)
    """Distance of a box's centre from the robot's base, from and to, m."""
    table_margin: float = 0.02
    """Least distance of a footprint from the table's edge, m."""
    image_margin: float = 2.0
    """Least distance of a box's projection from the image border, pixels."""
    color_distance: float = 0.3
    """Least RGB distance of two boxes, and of a box and the table."""
    tries: int = 100
    """Positions tried for one box before the draw counts as failed."""
    table: Table = field(default_factory=Table)
    camera: Camera = field(default_factory=Camera)
    light: Light = field(default_factory=Light)
    robot: Robot = field(default_factory=Robot)

    def __post_init__(self) -> None:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                value = getattr(self, name)
                raise ValueError(f"SceneConfig.{name} = {value!r}: expected {expected}")

        require("family", self.family in FAMILIES, f"one of {', '.join(FAMILIES)}")
        require("min_objects", self.min_objects >= 2, "at least 2")
        require("max_objects", self.min_objects <= self.max_objects, "at least min_objects")
        require("max_objects", self.max_objects <= 14, "at most 14 (distinct colours)")
        require("crowding", 0 <= self.crowding <= 1, "a probability")
        require("obstacle_share", 0 <= self.obstacle_share <= 1, "a probability")
        require("min_edge", 0 < self.min_edge <= GRASPABLE_EDGE, f"in (0, {GRASPABLE_EDGE}]")
        require("max_edge", self.max_edge > GRASPABLE_EDGE, f"over {GRASPABLE_EDGE}")
        require("spacing", self.spacing >= 0, "at least 0")
        require("reach", 0 <= self.reach[0] < self.reach[1], "0 <= from < to")
        require("table_margin", self.table_margin >= 0, "at least 0")
        require("color_distance", 0 < self.color_distance <= 0.35, "in (0, 0.35]")
        require("tries", self.tries >= 1, "at least 1")

    @property
    def content_hash(self) -> str:
        """16 hex digits that depend on the settings alone."""
        return content_hash(self)


def sample_scene(
    config: SceneConfig, *, seed: int, index: int, split: str = "train", attempt: int = 0
) -> Scene | None:
    """Draw scene `index` of a split; None when this attempt failed (try the next `attempt`).

    Pure: the result depends on the arguments alone.
    """
    rng = _generator(seed, f"{config.family}/{split}", index, attempt)
    count = int(rng.integers(config.min_objects, config.max_objects + 1))
    total = count + (config.family == "on")
    colors = _colors(rng, total, config)
    if colors is None:
        return None
    boxes: list[Box] = []
    for name, color in colors[:count]:
        box = _table_box(rng, name, color, boxes, config)
        if box is None:
            return None
        boxes.append(box)
    if config.family == "on":
        box = _stacked_box(rng, *colors[count], boxes, config)
        if box is None:
            return None
        boxes.append(box)
    # Crowded boxes come after their neighbours and the stacked one comes last: shuffled, so
    # that the order of objects tells nothing.
    objects = tuple(boxes[i] for i in rng.permutation(len(boxes)))
    return Scene(
        objects=objects,
        table=config.table,
        camera=config.camera,
        light=config.light,
        robot=config.robot,
    )


def sample_goals(scene: Scene, predicate: Predicate, count: int, *, seed: int) -> tuple[Goal, ...]:
    """Draw up to `count` distinct goals that are not true yet and whose subject can be grasped.

    Depends on (seed, scene.id, predicate) and the scene's boxes alone; asking for more goals
    keeps the earlier ones. Fewer than `count` come back when the scene has no more.
    """
    carrying = {box.on for box in scene.objects if box.on is not None}
    goals: list[Goal] = []
    weights: list[float] = []
    on_carrier: list[bool] = []
    for subject in scene.objects:
        if min(subject.size[:2]) > GRASPABLE_EDGE:
            continue
        for reference in scene.objects:
            # A reference that stands on its own subject would be lifted away with it.
            if reference.name == subject.name or reference.on == subject.name:
                continue
            goal = Goal(predicate=predicate, subject=subject.name, reference=reference.name)
            if goal_holds(scene.objects, goal):
                continue
            goals.append(goal)
            weights.append(CARRYING_SUBJECT_WEIGHT if subject.name in carrying else 1.0)
            on_carrier.append(predicate is Predicate.ON and reference.name in carrying)
    weight = np.array(weights)
    chosen = np.array(on_carrier, dtype=bool)
    inside, outside = weight[chosen].sum(), weight[~chosen].sum()
    if inside > 0 and outside > 0:
        ratio = CARRYING_REFERENCE_SHARE / (1 - CARRYING_REFERENCE_SHARE)
        weight[chosen] *= ratio * outside / inside
    # Exponential keys: the order of a weighted draw without replacement.
    keys = _generator(seed, f"{scene.id}/{predicate.value}").exponential(size=len(goals)) / weight
    return tuple(goals[i] for i in np.argsort(keys, kind="stable")[:count])


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pinhole projection of world points (..., 3), m: pixels (..., 2) x, y and depths (...), m.

    Pixel (0, 0) is the outer corner of the top-left pixel; depth is along the optical axis.
    """
    eye, axes, focal = _pinhole(camera)
    relative = (points - eye) @ axes
    depth = relative[..., 2]
    pixels = relative[..., :2] / depth[..., None] * focal
    return pixels + np.array([camera.width / 2, camera.height / 2]), depth


def camera_up(camera: Camera) -> tuple[float, float, float]:
    """The world direction that is up in the image: +z, or +x for a camera looking straight down."""
    dx, dy = camera.target[0] - camera.eye[0], camera.target[1] - camera.eye[1]
    return (0.0, 0.0, 1.0) if math.hypot(dx, dy) > 1e-9 else (1.0, 0.0, 0.0)


@lru_cache(maxsize=16)
def _pinhole(camera: Camera) -> tuple[np.ndarray, np.ndarray, float]:
    """Eye (3,), image axes right, down and forward as columns (3, 3), focal length in pixels."""
    eye, target = np.array(camera.eye), np.array(camera.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, camera_up(camera))
    right /= np.linalg.norm(right)
    focal = camera.width / 2 / math.tan(math.radians(camera.fov) / 2)
    return eye, np.stack([right, np.cross(forward, right), forward], axis=1), focal


def vertices(box: Box) -> np.ndarray:
    """The eight corners of a box in the world frame, (8, 3), m: the lower four first."""
    footprint = box.corners()
    heights = np.repeat([box.bottom, box.top], 4)[:, None]
    return np.hstack([np.vstack([footprint, footprint]), heights])


def _generator(seed: int, stream: str, index: int = 0, attempt: int = 0) -> np.random.Generator:
    """A generator of its own for each counter; Philox counts up in the first word."""
    word = int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8], "little")
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, attempt, index, word]))


def _size(rng: np.random.Generator, config: SceneConfig) -> tuple[float, float, float]:
    """Edges of a box: one footprint edge fits the hand, unless it is drawn as an obstacle."""
    obstacle = rng.random() < config.obstacle_share
    if obstacle:
        low = min(GRASPABLE_EDGE + 0.015, config.max_edge)
        a, b = rng.uniform(low, config.max_edge, 2)
    else:
        a = rng.uniform(config.min_edge, GRASPABLE_EDGE)
        b = rng.uniform(config.min_edge, config.max_edge)
    if rng.random() < 0.5:
        a, b = b, a
    height = rng.uniform(config.min_edge, config.max_edge)
    # Floored to 0.1 mm, so that a limit stays kept and files stay readable.
    x, y, z = (math.floor(edge * 1e4 + 1e-6) / 1e4 for edge in (a, b, height))
    return x, y, z


def _table_box(
    rng: np.random.Generator,
    name: str,
    color: tuple[float, float, float],
    boxes: list[Box],
    config: SceneConfig,
) -> Box | None:
    size = _size(rng, config)
    crowd = bool(boxes) and rng.random() < config.crowding
    for _ in range(config.tries):
        if crowd:
            x, y, yaw = _beside(rng, size, boxes[int(rng.integers(len(boxes)))], config)
        else:
            x, y, yaw = _anywhere(rng, config)
        box = Box(
            name=name,
            size=size,
            position=(round(x, 4), round(y, 4), size[2] / 2),
            yaw=round(yaw, 4),
            color=color,
        )
        if _fits(box, boxes, config):
            return box
    return None


def _anywhere(rng: np.random.Generator, config: SceneConfig) -> tuple[float, float, float]:
    """A pose that is uniform over the table's part in front of the robot."""
    half_x, half_y = config.table.size[0] / 2, config.table.size[1] / 2
    return (
        float(rng.uniform(-half_x, half_x)),
        float(rng.uniform(-half_y, half_y)),
        float(rng.uniform(-math.pi / 2, math.pi / 2)),
    )


def _beside(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    neighbour: Box,
    config: SceneConfig,
) -> tuple[float, float, float]:
    """A pose in one of the neighbour's four goal regions, its long edge across the way in.

    Near the region's middle and broadside on, it leaves no room beside it more often. The gap
    is too narrow for another box, yet wide enough for a finger, so that it can be taken away.
    """
    quarter = int(rng.integers(4))
    axis = quarter % 2
    broadside = 0.0 if (size[0] < size[1]) == (axis == 0) else math.pi / 2
    yaw = broadside + float(rng.uniform(-0.3, 0.3))
    probe = Box(name="probe", size=size, position=(0.0, 0.0, 0.0), yaw=yaw, color=(0, 0, 0))
    gap = max(config.spacing, float(rng.uniform(FINGER_ROOM, GAP)))
    along = neighbour.extents[axis] + probe.extents[axis] + gap
    across = float(rng.uniform(-0.5, 0.5)) * neighbour.extents[1 - axis]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    x = neighbour.position[0] + along * c - across * s
    y = neighbour.position[1] + along * s + across * c
    return x, y, yaw


def _stacked_box(
    rng: np.random.Generator,
    name: str,
    color: tuple[float, float, float],
    boxes: list[Box],
    config: SceneConfig,
) -> Box | None:
    """A box on one of the others, its centre over the middle half of that box's top face."""
    for _ in range(config.tries):
        carrier = boxes[int(rng.integers(len(boxes)))]
        size = _size(rng, replace(config, obstacle_share=0.0))
        yaw = float(rng.uniform(-math.pi / 2, math.pi / 2))
        c, s = math.cos(carrier.yaw), math.sin(carrier.yaw)
        dx, dy = rng.uniform(-0.25, 0.25, 2) * carrier.size[:2]
        box = Box(
            name=name,
            size=size,
            position=(
                round(carrier.position[0] + float(c * dx - s * dy), 4),
                round(carrier.position[1] + float(s * dx + c * dy), 4),
                carrier.top + size[2] / 2,
            ),
            yaw=round(yaw, 4),
            color=color,
            on=carrier.name,
        )
        if _fits(box, boxes, config):
            return box
    return None


def _fits(box: Box, boxes: list[Box], config: SceneConfig) -> bool:
    """Whether the arm can reach it, the camera sees all of it, and it keeps its distance."""
    base = config.robot.base
    distance = math.hypot(box.position[0] - base[0], box.position[1] - base[1])
    if not config.reach[0] <= distance <= config.reach[1]:
        return False
    limit = np.array(config.table.size) / 2 - config.table_margin
    if (np.abs(box.corners()) > limit).any():
        return False
    pixels, depth = project(config.camera, vertices(box))
    edge = np.array([config.camera.width, config.camera.height]) - config.image_margin
    if (depth <= config.camera.near).any():
        return False
    if (pixels < config.image_margin).any() or (pixels > edge).any():
        return False
    radius = math.hypot(*box.size[:2]) / 2
    for other in boxes:
        if other.name == box.on or box.bottom - other.top >= config.spacing:
            continue
        reach = radius + math.hypot(*other.size[:2]) / 2 + config.spacing
        dx, dy = box.position[0] - other.position[0], box.position[1] - other.position[1]
        # Disks that are apart settle most pairs; the separating axis costs 30 us.
        if dx * dx + dy * dy < reach * reach and footprint_gap(box, other) < config.spacing:
            return False
    return True


def _colors(
    rng: np.random.Generator, count: int, config: SceneConfig
) -> list[tuple[str, tuple[float, float, float]]] | None:
    """Distinct saturated colours, each named after the nearest colour word not yet taken."""
    words, anchors = list(_COLOR_NAMES), np.array(list(_COLOR_NAMES.values()))
    taken = np.array([config.table.color])
    named: dict[str, tuple[float, float, float]] = {}
    for _ in range(200 * count):
        color = _from_hsv(rng.uniform(0, 1), rng.uniform(0.55, 1), rng.uniform(0.4, 1))
        if ((taken - color) ** 2).sum(axis=1).min() < config.color_distance**2:
            continue
        nearest = np.argsort(((anchors - color) ** 2).sum(axis=1), kind="stable")
        name = next(words[i] for i in nearest if words[i] not in named)
        taken = np.vstack([taken, color])
        named[name] = (float(color[0]), float(color[1]), float(color[2]))
        if len(named) == count:
            return list(named.items())
    return None


def _from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """RGB (3,) of a hue, saturation and value in 0..1, rounded to 0.001."""
    k = (np.array([5.0, 3.0, 1.0]) + 6 * hue) % 6
    shade = np.clip(np.minimum(k, 4 - k), 0, 1)
    return np.round(value * (1 - saturation * shade), 3)
