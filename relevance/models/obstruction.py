"""Which objects are in the way, at each pick and at the goal: the planner's pose bound in tensors.

Who must have left is decided in millimetres, by the best of many holds and places: attention over
objects does not find it. So it is told: of each object what it costs to leave it where it is, and
what to take it away, in objects that must leave.

Shape suffixes: B scenes, N objects (padded), G goals, R rows that are asked about (N or G),
T places that are tried, W ways to hold a box, 2 the pairs of its edges, C choices of all three.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from relevance.holding import MARGIN, PICK_MARGIN, REGION_MARGIN
from relevance.models.hand import (
    BETWEEN_THEM,
    FAR,
    LEANING,
    UPRIGHT,
    Boxes,
    box_gaps,
    boxes_of,
    hand_gaps,
    hold,
    seen_from,
)
from relevance.models.layers import pick
from relevance.models.tracing import reshaped
from relevance.networks import ANGLES, DECIMETRE
from relevance.scene import GAP, Predicate, Robot

ROBOT = Robot()
"""Whose axes the directions of goals are: every picture was taken in front of this one."""
SOFTNESS = (0.0005, 0.003, 0.01)
"""Gaps over which a decision turns, m: as the planner has it, and as well as a box is seen."""
MOST = 4.0
"""No more objects than that are counted."""
OBSTRUCTION = 3 * len(SOFTNESS) + 1
"""How many numbers `obstruction` gives."""
STEPS = (-1.0, 0.0, 1.0)
"""Where in a goal's region a subject is tried, along both of its axes, in half extents."""
TRIED = 4
"""How many of these places, turned as the reference and as the nearest other, get a hand: those
where the fewest are in the way of the box alone."""
_FIRST = 1e-3
"""By how much an earlier place is preferred: of equal ones every runtime takes the same."""
_CHOICES = (0, 0, 0, -1)
"""From (B, R, N, ...) to (B, R, N, C)."""


@torch.no_grad()
def obstructed_picks(geometry: Tensor, present: Tensor) -> Tensor:
    """Of each object (column) what it is to a pick of each other (row), (B, N, N, OBSTRUCTION).

    geometry (B, N, GEOMETRY), decimetres; present (B, N) bool.
    """
    gap, sound = pick_gaps(geometry, present)
    return obstruction(reshaped(gap, _CHOICES), reshaped(sound[:, :, None], _CHOICES))


@torch.no_grad()
def obstructed_goals(
    geometry: Tensor, present: Tensor, predicate: Predicate, goals: Tensor
) -> Tensor:
    """Of each object what it is to the subject's place at each goal (B, G, 2), (B, G, N,
    OBSTRUCTION).

    The subject is in nobody's way there, and the reference only where the subject is beside it.
    """
    gap, sound = place_gaps(geometry, present, predicate, goals)
    gap = gap.transpose(2, 3)  # (B, G, N, T, 2, W)
    sound = sound[:, :, None, None] & torch.ones_like(gap[:, :, :1], dtype=torch.bool)
    return obstruction(reshaped(gap, _CHOICES), reshaped(sound, _CHOICES))


def obstruction(gap: Tensor, sound: Tensor) -> Tensor:
    """What each object is to each row, (B, R, N, OBSTRUCTION).

    gap (B, R, N, C), m, of each choice to each object, negative where that is in the way; sound
    (B, R, 1, C) bool: whether it is a choice at all. For each softness: how many more must leave if
    this object stays, how many more if it leaves, and how many at least; then how far it is from
    the choice that it is least in the way of.
    """
    found = []
    for soft in SOFTNESS:
        blocks = (gap / -soft).sigmoid()
        cost = blocks.sum(2, keepdim=True).masked_fill(~sound, 2 * MOST)
        least = cost.amin(3)
        stays, leaves = (cost + MOST * blocks).amin(3), (cost - MOST * blocks).amin(3) + MOST
        found += [stays - least, leaves - least, least.expand_as(stays)]
    away = gap.masked_fill(~sound, -FAR).amax(3)
    return torch.stack([*(one.clamp(max=MOST) for one in found), away / FAR * 3], dim=3)


def pick_gaps(geometry: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """From the hand at each object (row) to each other (column), (B, N, N, 2, W), m, less the room
    that it needs, FAR at most; and which ways there are to hold the row, (B, N, 2, W)."""
    boxes = boxes_of(geometry)
    rows, columns = boxes.each(lambda one: one[:, :, None]), boxes.each(lambda one: one[:, None])
    x, y, turn = seen_from(rows.x, rows.y, rows.yaw, columns)
    hand = hold(boxes, (*UPRIGHT, *LEANING, *BETWEEN_THEM))
    gap = hand_gaps(x, y, turn, columns.top - rows.bottom, columns, hand) - PICK_MARGIN
    # What stands on it or overhangs it is in the way however it is held.
    flat = box_gaps(x, y, rows.along, rows.across, turn.cos(), turn.sin(), columns)
    over = torch.where(columns.bottom >= rows.top - 2e-3, flat, FAR)
    gap = torch.minimum(gap, over[..., None, None])
    number = torch.arange(gap.shape[1], device=gap.device)
    nobody = (number[:, None] == number) | ~present[:, None]
    return gap.masked_fill(nobody[..., None, None], FAR).clamp(max=FAR), hand.sound


def place_gaps(
    geometry: Tensor, present: Tensor, predicate: Predicate, goals: Tensor
) -> tuple[Tensor, Tensor]:
    """From the subject and the hand with it, at places that make each goal (B, G, 2) true, to each
    object, (B, G, T, N, 2, W), m, less the room that they need, FAR at most; and which ways there
    are to hold the subject, (B, G, 2, W)."""
    boxes = boxes_of(geometry)
    table = torch.stack(boxes, -1)
    subject, reference = (Boxes(*pick(table, goals[..., k]).unbind(-1)) for k in range(2))
    number = torch.arange(geometry.shape[1], device=goals.device)
    is_reference = number == goals[..., 1:]
    base = reference.top if predicate.stacked else torch.zeros_like(reference.top)
    rises = boxes.top[:, None] - base[..., None]
    nobody = (number == goals[..., :1]) | (rises <= 1e-3) | ~present[:, None]
    if predicate.stacked:
        nobody = nobody | is_reference
    middle, tilted, half = goal_regions(geometry, subject, reference, predicate, goals)
    dx, dy = boxes.x[:, None] - middle[..., :1], boxes.y[:, None] - middle[..., 1:]
    away = (dx * dx + dy * dy).sqrt() - torch.maximum(boxes.along, boxes.across)[:, None]
    near = away.masked_fill(nobody | is_reference, math.inf).argmin(-1)
    near = pick(boxes.yaw[..., None], near)[..., 0]
    x, y, yaw = _places(middle, tilted, half, torch.stack([reference.yaw, near], -1))

    others = boxes.each(lambda one: one[:, None, None])
    along, across = subject.along[..., None, None], subject.across[..., None, None]
    nobody, rises = nobody[:, :, None], rises[:, :, None]

    def alone(x: Tensor, y: Tensor, turn: Tensor) -> Tensor:
        gap = box_gaps(x, y, along, across, turn.cos(), turn.sin(), others) - MARGIN
        return gap.masked_fill(nobody, FAR)

    gap = alone(*seen_from(x[..., None], y[..., None], yaw[..., None], others))
    cost = (gap / -SOFTNESS[0]).sigmoid().sum(-1) - 2 * gap.amin(-1).clamp(-FAR / 2, FAR / 2)
    cost = cost + _FIRST * torch.arange(4 * len(STEPS) ** 2, device=cost.device)
    tried = cost.topk(TRIED, largest=False).indices
    x, y, yaw = (one.gather(2, tried)[..., None] for one in (x, y, yaw))
    x, y, turn = seen_from(x, y, yaw, others)
    hand = hold(subject, (*UPRIGHT, *LEANING))
    offset, left, under = (one[:, :, None] for one in hand[:3])  # the same at all places
    everywhere = hand._replace(offset=offset, left=left, under=under)
    gap = hand_gaps(x, y, turn, rises, others, everywhere) - MARGIN
    gap = gap.masked_fill(nobody[..., None, None], FAR)
    return torch.minimum(gap, alone(x, y, turn)[..., None, None]).clamp(max=FAR), hand.sound


def _places(
    middle: Tensor, turn: Tensor, half: Tensor, yaws: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Where a subject is tried in regions as of `goal_regions`: x, y and yaw, (B, G, 36), with both
    of its edges along each of the yaws (B, G, 2)."""
    u, v = torch.meshgrid(half.new_tensor(STEPS), half.new_tensor(STEPS), indexing="ij")
    u, v = u.flatten(), v.flatten()
    room = (half - REGION_MARGIN).clamp(min=0)
    u, v, c, s = u * room[..., :1], v * room[..., 1:], turn.cos()[..., None], turn.sin()[..., None]
    x, y = middle[..., :1] + c * u - s * v, middle[..., 1:] + s * u + c * v
    yaw = torch.cat([yaws, yaws + math.pi / 2], 2)
    return x.repeat_interleave(4, 2), y.repeat_interleave(4, 2), yaw.repeat(1, 1, len(STEPS) ** 2)


def goal_regions(
    geometry: Tensor, subject: Boxes, reference: Boxes, predicate: Predicate, goals: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the subject's centre may be, as `Predicate.region` has it, m and rad: middle (B, G, 2)
    and turn (B, G) of a rectangle, its half extents (B, G, 2).

    For predicates that have neither a side nor a top: all around the reference.
    """
    middle, level = torch.stack([reference.x, reference.y], -1), torch.zeros_like(reference.yaw)
    if predicate.stacked:
        return middle, reference.yaw, torch.stack([reference.along, reference.across], -1)
    extents = pick(geometry[..., [6, 6 + ANGLES // 2]], goals[..., 1]) * DECIMETRE
    low = extents + torch.minimum(subject.along, subject.across)[..., None]
    toward = predicate.direction(ROBOT)
    if toward is None:
        return middle, level, low + GAP
    u = geometry.new_tensor(toward)
    return middle + u * (low + GAP / 2), level, torch.where(u.abs() > 0.5, GAP / 2, extents)
