"""A closer look at where the edges of boxes are expected, which puts their geometry right.

Shape suffixes: B scenes, N objects (padded), D width.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from relevance.models.config import Encoding
from relevance.models.reasoning import Thinker
from relevance.models.tracing import tracing
from relevance.networks import ANGLES, GEOMETRY
from relevance.networks.edges import EDGES, LINES, ROUNDS, SAMPLES, expected_edges
from relevance.scene import Camera

_LINE, _EDGE = 16, 64
"""What is known of a line and of an edge."""
_MOVES = 7
"""Of a box: its middle along and across, both half extents, its turn, its top, its bottom."""
_ALIKE = 0.02
"""Sizes that differ by less are hard to tell from each other, decimetres."""
_MOST = 0.1
"""What a box may well be off, in decimetres and in radians."""


class Edges(nn.Module):
    """Puts boxes right by what shows at their edges.

    Trackers take the steepest change on each line for the edge; here a small network reads them,
    which learns what hides an edge, too.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.line = nn.Sequential(
            nn.Linear(3 * SAMPLES, 2 * _LINE), nn.GELU(), nn.Linear(2 * _LINE, _LINE), nn.GELU()
        )
        self.edge = nn.Sequential(nn.Linear(LINES * _LINE, _EDGE), nn.GELU())
        self.shown = nn.Sequential(nn.Linear(EDGES * _EDGE + width + GEOMETRY, hidden), nn.GELU())
        self.move = nn.Linear(hidden, _MOVES)
        nn.init.zeros_(self.move.weight)  # at first boxes stay where they were
        nn.init.zeros_(self.move.bias)

    def forward(
        self, x: Tensor, geometry: Tensor, lines: Tensor, turn: Tensor, half: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Geometry (B, N, GEOMETRY) put right, and what was seen at the edges (B, N, hidden).

        From what is known of each object (B, N, D), boxes as they are expected, and what shows
        there, see `Expected`.
        """
        edges = self.edge(self.line(lines).flatten(3)).flatten(2)
        shown = self.shown(torch.cat([edges, x, geometry], dim=-1))
        return _moved(geometry, turn, half, self.move(shown).float() * _MOST), shown


class Looker(Thinker):
    """A body that expects objects somewhere, looks closer there, and then thinks."""

    def looks(self, width: int) -> None:
        """Make the layers; before those that think."""
        self.edges = Edges(width, 2 * width)
        self.carry = nn.Linear(3 * width, width)
        nn.init.zeros_(self.carry.weight)  # at first it thinks of where objects are alone
        nn.init.zeros_(self.carry.bias)

    def looked(
        self, image: Tensor, x: Tensor, geometry: Tensor, present: Tensor, camera: Camera
    ) -> tuple[Encoding, list[Tensor]]:
        """The encoding of objects (B, N, D) that are expected somewhere (B, N, GEOMETRY), and all
        guesses of where they are, the best last."""
        if tracing():  # what follows are graphs of their own: edges are looked at outside
            return Encoding(tokens=x, present=present, geometry=geometry), []
        guesses, shown = [geometry], x
        for _ in range(ROUNDS):
            expected = _expected(image, geometry, present, camera)
            geometry, shown = self.edges(x, geometry.detach(), *expected)
            guesses.append(geometry)
        return self.thought(self.known(x, shown, geometry), present, geometry), guesses

    def known(self, x: Tensor, shown: Tensor, geometry: Tensor) -> Tensor:
        """Tokens (B, N, D) from what was seen of objects, at first and at their edges."""
        return self.token(geometry) + self.carry(torch.cat([x, shown], dim=-1))


def _expected(image: Tensor, geometry: Tensor, present: Tensor, camera: Camera) -> list[Tensor]:
    """What `expected_edges` sees, for batches of tensors: lines, turn, half.

    It is reckoned on the processor, and no gradient goes through it.
    """
    picture, where = (tensor.detach().float().cpu().numpy() for tensor in (image, geometry))
    found = expected_edges(picture, where, present.cpu().numpy(), camera)
    return [torch.from_numpy(array).to(geometry.device) for array in found]


def _moved(geometry: Tensor, turn: Tensor, half: Tensor, move: Tensor) -> Tensor:
    """The geometry of boxes that were moved, turned and sized by (..., _MOVES)."""
    along, across, *_, top, bottom = move.unbind(-1)
    cos, sin = turn.cos(), turn.sin()
    x = geometry[..., 0] + along * cos - across * sin
    y = geometry[..., 1] + along * sin + across * cos
    z = geometry[..., 2] + (top + bottom) / 2
    height = geometry[..., 5] + top - bottom
    # Which of its own two sizes lies along: the nearer one, and of equal ones no matter which.
    size = geometry[..., 3:5]
    ahead, aside = (size - 2 * half).abs().sum(-1), (size - 2 * half.flip(-1)).abs().sum(-1)
    share = ((aside - ahead) / _ALIKE).sigmoid()[..., None]
    half = half + move[..., 2:4]
    size = 2 * (share * half + (1 - share) * half.flip(-1))
    angle = torch.arange(ANGLES, device=turn.device) * (math.pi / ANGLES)
    angle = angle - (turn + move[..., 4])[..., None]
    extents = angle.cos().abs() * half[..., :1] + angle.sin().abs() * half[..., 1:]
    place = torch.stack([x, y, z], dim=-1)
    return torch.cat([place, size, height[..., None], extents], dim=-1)
