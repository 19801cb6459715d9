"""The hand around boxes, in tensors: the rectangles of the planner's grasps and their gaps.

The hand comes straight down over a box, across either pair of its edges, shifted along it or
leaning; in the plane it is rectangles that begin at heights.

Shape suffixes: B scenes, N objects (padded), W ways to hold a box, P parts of the hand, 2 the pairs
of edges; what comes before is of the boxes that are held.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from relevance.holding import (
    DEPTH,
    FARTHEST,
    GRIP,
    GROUND,
    INSET,
    MARGIN,
    PALM_ROOM,
    SHALLOW,
    SPREAD,
    TILTS,
    hand_boxes,
)
from relevance.networks import ANGLES, DECIMETRE

FAR = 0.1
"""No gap counts for more, m."""

Way = tuple[float, float]
"""Tilt of the hand, rad, and share of the farthest shift; as shallow as it may be, for then fewest
are in the way."""
UPRIGHT: tuple[Way, ...] = ((0.0, 0.0), (0.0, 1.0), (0.0, -1.0))
LEANING: tuple[Way, ...] = ((0.6, 1.0), (-0.6, -1.0))
BETWEEN_THEM: tuple[Way, ...] = (
    *((0.0, share / 3) for share in (1, -1, 2, -2)),
    *((tilt, math.copysign(1, tilt)) for tilt in (0.4, -0.4)),
)
"""With these, who must leave before a pick is what it is with all ways of the planner for 98 of 100
boxes, with the five above for 96."""


class Boxes(NamedTuple):
    """Boxes as they stand, m and rad, all of one shape."""

    x: Tensor
    y: Tensor
    bottom: Tensor
    top: Tensor
    yaw: Tensor
    """Of either pair of edges."""
    along: Tensor
    """Half sizes along that and across it."""
    across: Tensor

    def each(self, change: Callable[[Tensor], Tensor]) -> Boxes:
        """All of it changed alike."""
        return Boxes._make(change(one) for one in self)


def boxes_of(geometry: Tensor) -> Boxes:
    """From geometry (..., GEOMETRY), which has half extents in the place of a yaw.

    Those at right angles add up to sqrt(2) (along + across) cos(yaw + pi / 4 - angle), but for a
    kink where the angle is the yaw: next to the direction in which the sum is least. So the other
    three of four give the yaw.
    """
    x, y, z, height = (geometry[..., k] * DECIMETRE for k in (0, 1, 2, 5))
    extents = geometry[..., 6:] * DECIMETRE
    step, quarter = math.pi / ANGLES, ANGLES // 2
    both = extents[..., :quarter] + extents[..., quarter:]
    least = both.argmin(-1, keepdim=True)
    before, after = (both.gather(-1, (least + k) % quarter) for k in (1, quarter - 1))
    off = (after - before) / (after + before).clamp(min=1e-6) / math.tan(step)
    yaw = ((least + quarter // 2) * step + off.atan())[..., 0] - math.pi / 4
    angle = torch.arange(ANGLES, device=yaw.device) * step - yaw[..., None]
    c, s = angle.cos().abs(), angle.sin().abs()
    cc, cs, ss = (c * c).sum(-1), (c * s).sum(-1), (s * s).sum(-1)
    c, s = (extents * c).sum(-1), (extents * s).sum(-1)
    of = cc * ss - cs * cs
    return Boxes(
        x=x, y=y, bottom=z - height / 2, top=z + height / 2, yaw=yaw,
        along=(c * ss - s * cs) / of, across=(s * cc - c * cs) / of,
    )  # fmt: skip


class Hand(NamedTuple):
    """The hand around boxes, as `Grasp.parts` has it, m."""

    offset: Tensor
    """(..., 2, W, P) along the finger axis, from the middle of the box."""
    left: Tensor
    """(..., 2, W, P)."""
    under: Tensor
    """(..., 2, W, P): height of the underside over that of the box."""
    along: Tensor
    """(W, P): half extents along the finger axis and across it."""
    across: Tensor
    sound: Tensor
    """(..., 2, W) bool: whether the box can be held so."""


def hold(boxes: Boxes, ways: tuple[Way, ...]) -> Hand:
    """The hand around boxes (...), as `kernels.holds` has it."""
    own, new = hand_boxes(), boxes.x.new_tensor
    tilt, share = new(ways).unbind(-1)
    over, shape = new(own.over)[[TILTS.index(way[0]) for way in ways]], new(own.shape)
    closed = torch.stack([boxes.along, boxes.across], -1)[..., None]
    edge = torch.stack([boxes.across, boxes.along], -1)[..., None]
    height = (boxes.top - boxes.bottom)[..., None, None]
    s, c = tilt.sin().abs(), tilt.cos()
    deep = torch.maximum(height - 0.012, 0.3 * height)
    deep = torch.maximum(deep, (height - GROUND).clamp(max=0.010)).clamp(max=DEPTH)
    lowest = torch.minimum(deep, height - GROUND - shape[0, 0] * s)
    shallow = torch.where(tilt == 0, SHALLOW[1], SHALLOW[0])
    depth = torch.where(shallow < lowest - 0.002, shallow, lowest)
    most = (edge - INSET).clamp(max=FARTHEST)
    shift = share * most.clamp(min=0)
    sound = (closed + SPREAD <= own.max_opening) & (depth >= GRIP)
    sound = sound & ((share == 0) | (most > INSET))
    reach, room = shape[-2, 0], shape[-2, 1] - PALM_ROOM
    end = edge - torch.where(tilt > 0, shift, -shift)
    end = torch.minimum(end, (reach + depth * s) / c)
    sound = sound & (end * s + depth * c <= room)
    return Hand(
        offset=over[..., 0] + shape[:, 2] * (closed[..., None] + SPREAD),
        left=over[..., 1] + shift[..., None],
        under=over[..., 4] + (height - depth)[..., None],
        along=over[..., 2],
        across=over[..., 3],
        sound=sound,
    )


def seen_from(x: Tensor, y: Tensor, yaw: Tensor, others: Boxes) -> tuple[Tensor, Tensor, Tensor]:
    """Where others are in these frames (x and y), and how they are turned there."""
    dx, dy, c, s = others.x - x, others.y - y, yaw.cos(), yaw.sin()
    return c * dx + s * dy, c * dy - s * dx, others.yaw - yaw


def hand_gaps(
    x: Tensor, y: Tensor, turn: Tensor, rises: Tensor, others: Boxes, hand: Hand
) -> Tensor:
    """From each way to hold boxes to others, (..., N, 2, W), m; FAR where they pass under it.

    The others are at x, y, turn (..., N) in the frames of the boxes and rise so far, (..., N), over
    their undersides.
    """
    c, s, last = turn.cos(), turn.sin(), turn.dim()
    # Across the other edges all is turned by a quarter.
    x, y = (torch.stack(two, last)[..., None, None] for two in ((x, y), (y, -x)))
    c, s = (torch.stack(two, last)[..., None, None] for two in ((c, s), (s, -c)))
    others = others.each(lambda one: one[..., None, None, None])
    offset, left, under = (one[..., None, :, :, :] for one in hand[:3])
    gap = box_gaps(x - offset, y - left, hand.along, hand.across, c, s, others)
    return torch.where(rises[..., None, None, None] - under > -MARGIN, gap, FAR).amin(-1)


def box_gaps(
    x: Tensor, y: Tensor, along: Tensor, across: Tensor, c: Tensor, s: Tensor, others: Boxes
) -> Tensor:
    """Separating-axis distance, m, of rectangles of these half sizes and others at x, y, turned by
    an angle of which c and s are cosine and sine."""
    p, q, ca, sa = others.along, others.across, c.abs(), s.abs()
    own = torch.maximum(x.abs() - along - (p * ca + q * sa), y.abs() - across - (p * sa + q * ca))
    its = torch.maximum(
        (c * x + s * y).abs() - p - (along * ca + across * sa),
        (c * y - s * x).abs() - q - (along * sa + across * ca),
    )
    return torch.maximum(own, its)
