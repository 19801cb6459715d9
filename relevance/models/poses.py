"""Geometry of boxes (`relevance.networks.true_geometry`) as tensors: batches of it, and its mirror.

Shape suffixes: GEOMETRY is the last axis of whatever comes in.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from relevance.networks import ANGLES, GEOMETRY


def half_extents(size_x: Tensor, size_y: Tensor, yaw: Tensor) -> Tensor:
    """Half-extents of a rotated rectangle along ANGLES directions k pi / ANGLES, (..., ANGLES).

    Same unit as the sizes. Unlike the yaw itself they are continuous under the symmetries of
    a rectangle, so they can be regressed.
    """
    steps = torch.arange(ANGLES, dtype=yaw.dtype, device=yaw.device)
    angle = steps * (math.pi / ANGLES) - yaw[..., None]
    return (angle.cos().abs() * size_x[..., None] + angle.sin().abs() * size_y[..., None]) / 2


def mirrored(geometry: Tensor) -> Tensor:
    """The geometry (..., GEOMETRY) of the scene seen in a mirror: y changes sign."""
    sign = torch.ones(GEOMETRY, device=geometry.device)
    sign[1] = -1
    order = [*range(6), *(6 + (ANGLES - k) % ANGLES for k in range(ANGLES))]
    return (geometry * sign)[..., order]
