"""Reasoning about a goal over all objects, given where they stand: the end of two bodies.

Shape suffixes: B scenes, N objects (padded), G goals, D width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from relevance.models.config import Answer, Encoding
from relevance.models.layers import Attention, columns, pick
from relevance.models.obstruction import obstructed_goals, obstructed_picks
from relevance.models.registry import Body
from relevance.models.tracing import tracing
from relevance.networks import ANGLES, GEOMETRY
from relevance.networks.obstruction import OBSTRUCTION, ROBOT
from relevance.scene import Predicate

GOAL_FEATURES = 3 * GEOMETRY + 2 + 2 * 8
APART = 3 + ANGLES + 1 + 2
BETWEEN = 64
"""Width of what lies between two objects."""


class Between(nn.Module):
    """What is made of what lies between every two objects."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(features, BETWEEN), nn.GELU(), nn.Linear(BETWEEN, BETWEEN), nn.GELU()
        )

    def forward(self, *features: Tensor) -> Tensor:
        """(B, N, N, BETWEEN), row from column, from features (B, N, N, some) side by side."""
        return self.net(torch.cat(features, dim=-1))


def apart(geometry: Tensor) -> Tensor:
    """How each object (row) stands to each other (column), (B, N, N, APART).

    Offset of the centres, gap of the footprints along ANGLES directions (negative where their
    shadows overlap) and the widest of these, heights of the column's top and bottom over the
    row's bottom.
    """
    row, column = geometry[:, :, None], geometry[:, None]
    offset = column[..., :3] - row[..., :3]
    angle = torch.arange(ANGLES, device=geometry.device) * (math.pi / ANGLES)
    axes = torch.stack([angle.cos(), angle.sin()]).to(geometry.dtype)
    gaps = (offset[..., :2] @ axes).abs() - row[..., 6:] - column[..., 6:]
    half = geometry[..., 5] / 2
    bottom, top = geometry[..., 2] - half, geometry[..., 2] + half
    heights = [edge[:, None] - bottom[:, :, None] for edge in (top, bottom)]
    return torch.cat([offset, gaps, gaps.amax(-1, keepdim=True), torch.stack(heights, -1)], dim=-1)


class Reasoning(nn.Module):
    """Attention over the objects of a scene, each told where it stands as the goal sees it."""

    def __init__(self, width: int, heads: int, layers: int, predicates: Sequence[str]) -> None:
        super().__init__()
        self.place = nn.Sequential(
            nn.Linear(GOAL_FEATURES + OBSTRUCTION, width), nn.GELU(), nn.Linear(width, width)
        )
        self.predicate = nn.ParameterDict(
            {name: nn.Parameter(torch.zeros(width)) for name in predicates}
        )
        self.between = Between(APART + 2 * OBSTRUCTION)
        self.layers = nn.ModuleList(
            Attention(width, heads, expansion=2, between=BETWEEN) for _ in range(layers)
        )

    def forward(self, encoding: Encoding, predicate: Predicate, goals: Tensor) -> Tensor:
        """Tokens (B, G, N, D) from what is known of a scene and its objects."""
        assert encoding.geometry is not None
        features = goal_features(encoding.geometry, predicate, goals)
        places = encoding.places
        if places is None:
            places = obstructed_goals(encoding.geometry, encoding.present, predicate, goals)
        features = torch.cat([features, places], dim=3)
        x_BGND = encoding.tokens[:, None] + self.place(features) + self.predicate[predicate.name]
        x = x_BGND[0] if tracing() else x_BGND.flatten(0, 1)
        allowed = columns(encoding.present)
        if allowed is not None:
            allowed = allowed.repeat_interleave(goals.shape[1], dim=0)
        for layer in self.layers:
            x = layer(x, allowed, encoding.between)
        return x[None] if tracing() else x.view(x_BGND.shape)


class Thinker(Body):
    """A body that thinks of where the objects are, whether it sees that or is told."""

    among_all = True
    tellable = True

    def thinks(self, width: int, heads: int, layers: int, predicates: Sequence[str]) -> None:
        """Make the layers; after all others, see `Body.heads`."""
        self.token = nn.Sequential(nn.Linear(GEOMETRY, width), nn.GELU())
        self.among = Attention(width, heads, expansion=2)
        self.reason = Reasoning(width, heads, layers, predicates)
        self.heads = object_heads(width, predicates)

    def told_of(self, present: Tensor, poses: Tensor) -> Encoding:
        """As `RelevanceModel.told_of`."""
        return self.thought(self.token(poses), present, poses)

    def thought(self, tokens: Tensor, present: Tensor, geometry: Tensor) -> Encoding:
        """What is known of each object, tokens (B, N, D), and where it is, (B, N, GEOMETRY)."""
        tokens = self.among(tokens, columns(present))
        encoding = Encoding(tokens=tokens, present=present, geometry=geometry)
        if tracing():  # a graph of its own, since what is in the way is reckoned outside
            return encoding
        between = self.between_all(geometry, obstructed_picks(geometry, present))
        return replace(encoding, between=between)

    def between_all(self, geometry: Tensor, picks: Tensor) -> Tensor:
        """(B, N, N, BETWEEN), the same for all goals of the scene; in the way of the row's pick,
        then of the column's."""
        return self.reason.between(apart(geometry), picks, picks.transpose(1, 2))

    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Answer:
        """As `RelevanceModel.answer`."""
        x = self.reason(encoding, predicate, goals)
        return Answer(scores=self.heads[predicate.name](x)[..., 0])


def object_heads(width: int, predicates: Sequence[str]) -> nn.ModuleDict:
    """For each predicate what makes a token (..., D) a score (..., 1)."""
    return nn.ModuleDict(
        {
            name: nn.Sequential(
                nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1)
            )
            for name in predicates
        }
    )


def goal_features(geometry: Tensor, predicate: Predicate, goals: Tensor) -> Tensor:
    """Where every object is as the goal sees it, (B, G, N, GOAL_FEATURES).

    Axes: along and across the predicate's direction (x and y for `on`). Own geometry, the
    subject's, the reference's, two role flags, and for subject and reference the distance
    and the signed clearance of the footprints along both axes: what "beside" turns on.
    """
    u = predicate.direction(ROBOT) or (1.0, 0.0)
    axes = geometry.new_tensor([[u[0], u[1]], [-u[1], u[0]]])
    # Extents along the goal's axes: those of the regressed directions that are nearest.
    turn = round(math.atan2(u[1], u[0]) / (math.pi / ANGLES))
    extents = geometry[..., 6:].roll(-turn, dims=-1)
    place = torch.cat([geometry[..., :2] @ axes.T, geometry[..., 2:6], extents], dim=-1)
    roles = torch.arange(place.shape[1], device=goals.device)[:, None] == goals[..., None, :]
    # Both roles at once, on an axis before the last.
    own, anchor = place[:, None, :, None], pick(place, goals)[:, :, None]
    both = own + anchor
    delta = own[..., :3] - anchor[..., :3]
    apart = delta[..., :2].abs()
    clear = apart - both[..., [6, 6 + ANGLES // 2]]
    by_role = [anchor.expand_as(both), delta, apart, clear, clear.amax(-1, keepdim=True)]
    subject, reference = torch.cat(by_role, dim=-1).unbind(-2)
    own = own.expand_as(both)[..., 0, :]
    return torch.cat([own, roles.to(place.dtype), subject, reference], dim=-1)
