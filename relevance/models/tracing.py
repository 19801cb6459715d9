"""The same sums in the forms that ONNX Runtime does fastest, for while a graph is traced.

A traced network is asked about one scene without padding. What is here is equal to what bodies
do otherwise but for rounding.

Shape suffixes: B scenes (one), N objects, L tokens, D width, E channels, H and W height and width
in pixels, S samples along an edge, R pixels of a line, C channels of a picture, M maps,
K whatever.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from relevance.models.config import PATCH

_TILE = 16
"""Pixels of a row that are copied together, if rows are made of so many."""


def tracing() -> bool:
    """Whether a graph is being made, in place of numbers."""
    return torch.onnx.is_in_onnx_export()


def sums(x_BEK: Tensor) -> Tensor:
    """Sums over the channels, (B, 1, K)."""
    return x_BEK.new_ones(1, x_BEK.shape[1]) @ x_BEK if tracing() else x_BEK.sum(1, keepdim=True)


def windows(maps_MCHW: Tensor, centre_N2: Tensor, edge: float, *, own: bool) -> Tensor:
    """Squares around centres (u and v in -1..1), resampled: (N, C, 32, 32).

    Of the one map, or of each object's own; outside is nothing. Samples lie on rows and columns,
    so that a square is a small part of the map, copied in tiles, between two small matrices;
    GridSample takes twice as long.
    """
    channels, height, width = maps_MCHW.shape[1:]
    step_S = ((torch.arange(PATCH) + 0.5) / PATCH - 0.5) * edge - 0.5
    middle_N2 = (centre_N2 + 1) * torch.tensor([width / 2, height / 2])
    x_NS, y_NS = (middle_N2[:, axis, None] + step_S for axis in range(2))
    tile = math.gcd(_TILE, width)
    rows = min(int(edge) + 2, height)
    tiles = min((rows + 2 * tile - 2) // tile, width // tile)
    x_N1 = (x_NS[:, :1] / tile).floor().clamp(0, width // tile - tiles)
    y_N1 = y_NS[:, :1].floor().clamp(0, height - rows)
    corner_N1 = (y_N1 * (width // tile) + x_N1).long()
    if own:
        map_N = torch.arange(centre_N2.shape[0])
        corner_N1 = corner_N1 + map_N[:, None] * (height * width // tile)
    part = torch.arange(channels)[:, None] * height + torch.arange(rows)
    part = part[..., None] * (width // tile) + torch.arange(tiles)
    place_NK = corner_N1 + part.flatten()
    cut = maps_MCHW.reshape(-1, tile)[place_NK].view(-1, channels * rows, tiles * tile)
    across_NSR = _taps(x_NS - x_N1 * tile, tiles * tile)
    down_NSR = _taps(y_NS - y_N1, rows)
    cut = (cut @ across_NSR.transpose(1, 2)).view(-1, channels, rows, PATCH)
    return down_NSR[:, None] @ cut


def _taps(at_NS: Tensor, count: int) -> Tensor:
    """How much each pixel of a line counts for each sample of it, bilinear: (N, S, R)."""
    return (1 - (at_NS[..., None] - torch.arange(count)).abs()).relu()


class _Attention(torch.autograd.Function):
    """Self-attention of all to all, the projection to queries, keys and values included."""

    @staticmethod
    def forward(ctx: Any, x_BLD: Tensor, weight: Tensor, bias: Tensor, heads: int) -> Tensor:
        return torch.empty_like(x_BLD)

    @staticmethod
    def symbolic(g: Any, x: Any, weight: Any, bias: Any, heads: int) -> Any:
        turned = g.op("Transpose", weight, perm_i=[1, 0])
        seen = g.op("com.microsoft::Attention", x, turned, bias, num_heads_i=heads)
        return seen.setType(x.type())


def attend(x_BLD: Tensor, qkv: nn.Linear, heads: int) -> Tensor:
    """What `scaled_dot_product_attention` makes of x with these projections, (B, L, D)."""
    return _Attention.apply(x_BLD, qkv.weight, qkv.bias, heads)  # pyright: ignore


class _Reshaped(torch.autograd.Function):
    """As `reshaped`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, sizes: tuple[int, ...]) -> Tensor:
        return x.reshape([size or x.shape[i] for i, size in enumerate(sizes)])

    @staticmethod
    def symbolic(g: Any, x: Any, sizes: tuple[int, ...]) -> Any:
        return g.op("Reshape", x, g.op("Constant", value_t=torch.tensor(sizes)))


def reshaped(x: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """x in another shape; 0 keeps a size: torch's own asks for each and puts them together."""
    return _Reshaped.apply(x, sizes)  # pyright: ignore


def shares(x_BLD: Tensor, qkv: nn.Linear, heads: int, say: Tensor) -> tuple[Tensor, Tensor]:
    """Who looks at whom, (B, heads, L, L), and what is seen so, (B, L, D).

    `say` (1, heads, L, L) is added to the logits.
    """
    each = qkv.in_features // heads
    q, k, v = reshaped(qkv(x_BLD), (0, -1, 3, heads, each)).permute(2, 0, 3, 1, 4)
    logits = q @ k.transpose(2, 3) / math.sqrt(each) + say
    share = logits.softmax(3)  # not -1: the exporter may have lost count of the dimensions
    return share, reshaped((share @ v).transpose(1, 2), (0, 0, -1))
