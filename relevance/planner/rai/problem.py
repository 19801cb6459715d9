"""A goal in rai's formats: its configuration, rules and search, as text."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relevance.robot import ARM, HOME, LINKS, panda
from relevance.scene import Box, Goal, Rectangle, Region, Scene, footprint_gap

ROUND = 0.01
"""Corner radius of boxes against the hand, m; rai's solver needs it to slide along edges."""
ROUND_BOX = 0.004
"""Corner radius of boxes against each other, m."""
ROOM = 0.0008
"""How far a box's footprint is grown against others beyond its rounded corners, m."""
SKIN = 0.001
"""How far the parts of the hand are grown, m."""
REGION_MARGIN = 0.002
"""How far inside the goal region rai places a subject, m."""
_FRAMES = dict(zip(LINKS, ("l_panda_joint5", "l_panda_joint6", "l_panda_hand_joint"), strict=True))
_FINGERS = {1.0: "l_panda_finger_joint1", -1.0: "l_panda_finger_joint2"}
_FINGER_ROOT = 0.0584  # of both finger frames, along the hand's z, m
_RULES = """\
is_gripper
is_object
is_box
is_sphere
is_capsule
is_blocker
is_subject
is_table
is_target
is_base
partOf
on
busy
clear
done

START_STATE {}

DecisionRule pick_box {
  Obj, From, Hand,
  pre: { (is_gripper Hand) (is_object Obj) (on From Obj) (clear Obj) (busy Hand)! (done Obj)! }
  eff: { (on From Obj)! #deletes
    (on Hand Obj) (busy Hand) (clear From) (done Obj) }
}

DecisionRule place_straightOn {
  Obj, Hand, To,
  pre: { (is_gripper Hand) (is_blocker Obj) (is_table To) (on Hand Obj) }
  eff: { (busy Hand)! (on Hand Obj)! #deletes
    (on To Obj) }
}

DecisionRule place_straightOn {
  Obj, Hand, To, Under,
  pre: { (is_gripper Hand) (is_subject Obj) (is_target To) (on Hand Obj)
    (is_base Under) (clear Under) }
  eff: { (busy Hand)! (on Hand Obj)! #deletes
    (on To Obj) }
}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class RaiProblem:
    """One goal as rai reads it: the text of its files, and what the answer is read with."""

    configuration: str
    rules: str
    search: str
    pairs: Mapping[str, list[list[str]]]
    """Collision pairs: [part of the hand, box] under `hand`, [shape, shape, box, box] under
    `boxes`, [part, shape] under `fixed`."""
    names: Mapping[str, str]
    """From rai's names of boxes and places to ours."""
    turn: Mapping[str, float]
    """By our name: how far rai's box is turned about z, since rai takes boxes across their y."""


def rai_problem(
    scene: Scene, goal: Goal, *, movable: Collection[str], there: Rectangle | None = None
) -> RaiProblem:
    """Write a goal in rai's formats; boxes outside `movable` stay where they are.

    there: the part of the goal region that is meant (None: its first rectangle).
    """
    ids = {box.name: f"box{i}" for i, box in enumerate(scene.objects)}
    on = goal.predicate.stacked
    # Nothing keeps a subject apart from what carries it: where that stands on the reference, the
    # reference has to be cleared.
    carriers = scene[goal.subject].supports
    beneath = on and any(goal.reference in scene[name].supports for name in carriers)
    parts, lines = _hand()
    lines = [*_world(scene, "is_table, clear" if beneath else "is_table, clear, is_base"), *lines]
    turn = {box.name: math.pi / 2 if box.size[0] < box.size[1] else 0.0 for box in scene.objects}
    places = {"target": goal.reference if on else "table", "table": "table"}
    carrying = {name for box in scene.objects for name in box.supports}
    moves: set[str] = set()
    for box in scene.objects:
        facts = [] if box.name in carrying else ["clear"]
        stays = box.name not in movable or (box.name == goal.reference and not on)
        if not stays and min(box.size[:2]) <= 2 * panda().max_opening:
            facts += ["is_object", "is_subject" if box.name == goal.subject else "is_blocker"]
        if beneath and box.name == goal.reference:
            facts.append("is_base")
        if "is_object" in facts:
            moves.add(box.name)
        lines += _box(box, scene, ids, turn, facts)
    there = there or goal_region(scene, goal).rectangles[0]
    lines.append(_target(scene, goal, there, ids[goal.reference], turn))
    pairs: dict[str, list[list[str]]] = {"hand": [], "boxes": [], "fixed": []}
    pairs["hand"] = [[part, rai_name] for rai_name in ids.values() for part in parts]
    pairs["fixed"] = [[part, "slab"] for part in parts]
    for i, a in enumerate(scene.objects):
        if a.name in moves:
            pairs["boxes"].append([ids[a.name], "foot", ids[a.name], ids[a.name]])
        for b in scene.objects[:i]:
            if not moves & {a.name, b.name}:
                continue
            if b.name in a.supports or a.name in b.supports:
                continue
            # Boxes that stand closer than their grown shapes allow are kept apart as they are.
            close = footprint_gap(a, b) < 2 * _growth() + 2e-4
            prefix = "" if close else "wide_"
            pair = [ids[a.name], ids[b.name]]
            pairs["boxes"].append([*(f"{prefix}{rai_name}" for rai_name in pair), *pair])
    listed = [pair[:2] for kind in ("hand", "boxes", "fixed") for pair in pairs[kind]]
    search = "\n".join(
        [
            "fol: <task.fol>",
            f'terminal: "(on target {ids[goal.subject]})"',
            "genericCollisions: false",
            f"coll: [{' '.join(name for pair in listed for name in pair)}]",
            "",
        ]
    )
    return RaiProblem(
        configuration="\n".join(lines) + "\n",
        rules=_RULES,
        search=search,
        pairs=pairs,
        names={**{rai_name: name for name, rai_name in ids.items()}, **places},
        turn=turn,
    )


def _models() -> Path:
    """The folder of rai's robot models, found without importing rai."""
    found = importlib.util.find_spec("robotic")
    assert found, "require_rai comes first"
    return Path(found.origin or "").parent / "rai-robotModels"


def _growth() -> float:
    """How far a rounded box is grown to each side to hold the true one, and some room, m."""
    return ROUND_BOX * (1 - 1 / math.sqrt(2)) + ROOM


def _world(scene: Scene, facts: str) -> list[str]:
    """Table, robot base and the robot's foot."""
    x, y = scene.table.size
    # rai keeps a box's centre over its support: the edge is as far away as its widest corner.
    spare = max(math.hypot(*box.size[:2]) for box in scene.objects)
    inner = (max(x - spare, 0.02), max(y - spare, 0.02))
    base, yaw = scene.robot.base, scene.robot.yaw
    centre, half = panda().foot
    table = _shape((0, 0, -0.05), (*inner, 0.1), 0.001, logical=f"{{ {facts} }}")
    return [
        "world: {}",
        f"table (world): {table}",
        f"slab (world): {_shape((0, 0, -0.05), (x, y, 0.1), 0.001)}",
        'Prefix: "l_"',
        f"Include: <{_models() / 'panda' / 'panda.g'}>",
        "Prefix: False",
        f"Edit l_panda_base (world): {{ Q: [{_row((*base, *_turned(yaw)))}] }}",
        *(f"Edit l_panda_joint{i + 1}: {{ q: {HOME[i]:.9f} }}" for i in range(ARM)),
        "Edit l_panda_finger_joint1: { joint_active: True }",
        f"foot (l_panda_base): {_shape(centre, 2 * half, 0.005)}",
    ]


def _hand() -> tuple[list[str], list[str]]:
    """Names and lines of the boxes around wrist, hand and fingers."""
    arm = panda()
    boxes = [(_FRAMES[LINKS[link]], centre, half) for link, centre, half in arm.arm]
    low = np.min([low for low, _ in arm.finger], axis=0)
    high = np.max([high for _, high in arm.finger], axis=0)
    x, y, z = (low + high) / 2
    for side, frame in _FINGERS.items():
        boxes.append((frame, np.array([x, side * y, z - _FINGER_ROOT]), (high - low) / 2))
    names = [f"part{i}" for i in range(len(boxes))]
    return names, [
        f"{name} ({frame}): {_shape(centre, 2 * (half + SKIN), 0.005)}"
        for name, (frame, centre, half) in zip(names, boxes, strict=True)
    ]


def _box(
    box: Box, scene: Scene, ids: Mapping[str, str], turn: Mapping[str, float], facts: list[str]
) -> list[str]:
    x, y, z = box.size
    size = (y, x, z) if turn[box.name] else (x, y, z)
    yaw, position = box.yaw + turn[box.name], np.array(box.position)
    support = next(iter(box.supports), None)
    parent = "table" if support is None else ids[support]
    if support is None:
        position = position + np.array([0, 0, 0.05])
    else:
        below = scene[support]
        angle = below.yaw + turn[support]
        dx, dy, dz = position - np.array(below.position)
        c, s = math.cos(angle), math.sin(angle)
        position, yaw = np.array([c * dx + s * dy, c * dy - s * dx, dz]), yaw - angle
    logical = f"{{ {', '.join(facts)} }}"
    shape = _shape(position, size, ROUND, yaw=yaw, logical=logical)
    wide = (size[0] + 2 * _growth(), size[1] + 2 * _growth(), size[2])
    name = ids[box.name]
    return [
        f"{name} ({parent}): {shape[:-2]}, joint: rigid }}",
        f"wide_{name} ({name}): {_shape((0, 0, 0), wide, ROUND_BOX)}",
    ]


def goal_region(scene: Scene, goal: Goal) -> Region:
    """Where the subject may go."""
    return goal.predicate.region(scene[goal.subject], scene[goal.reference], scene.robot)


def _target(
    scene: Scene, goal: Goal, there: Rectangle, reference_id: str, turn: Mapping[str, float]
) -> str:
    """A part of the goal region as a thin plate in its support; the subject's centre must be over
    it."""
    thick = 0.002
    extent = 2 * np.array(there.half) - 2 * REGION_MARGIN
    if goal.predicate.stacked:
        reference = scene[goal.reference]
        yaw = reference.yaw + turn[reference.name]
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = there.x - reference.position[0], there.y - reference.position[1]
        parent, angle = reference_id, there.angle - yaw
        centre = (c * dx + s * dy, c * dy - s * dx, (reference.size[2] - thick) / 2)
    else:
        parent, centre, angle = "table", (there.x, there.y, 0.05 - thick / 2), there.angle
    size = (*np.maximum(extent, 2 * REGION_MARGIN), thick)
    return f"target ({parent}): {_shape(centre, size, 0.0005, yaw=angle, logical='{ is_target }')}"


def _shape(centre, size, radius: float, *, yaw: float = 0.0, logical: str = "") -> str:
    """A rounded box in rai's words."""
    radius = min(radius, 0.45 * float(min(size)))
    text = f"{{ Q: [{_row((*centre, *_turned(yaw)))}], shape: ssBox"
    text += f", size: [{_row((*size, radius))}]"
    return f"{text}, logical: {logical} }}" if logical else f"{text} }}"


def _turned(yaw: float) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of a turn about z."""
    return math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)


def _row(values) -> str:
    return ", ".join(f"{value:.9f}" for value in values)
