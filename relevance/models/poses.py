"""Where a box is as networks are told it or asked for it: position, size, half-extents.

Geometry is in decimetres, so that its numbers are near 1.

Shape suffixes: N objects of a scene; GEOMETRY is the last axis of whatever comes in.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from relevance.scene import Scene

ANGLES = 8
"""Directions over a half turn along which footprint half-extents are regressed."""
GEOMETRY = 3 + 3 + ANGLES
"""Position (3), size (3), half-extents (ANGLES), all in decimetres."""
DECIMETRE = 0.1
"""Metres per unit of the geometry vectors."""


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


def true_geometry(scene: Scene) -> np.ndarray:
    """Position, size and footprint half-extents of every box, (N, GEOMETRY), decimetres."""
    size = torch.tensor([box.size for box in scene.objects], dtype=torch.float64)
    yaw = torch.tensor([box.yaw for box in scene.objects], dtype=torch.float64)
    position = torch.tensor([box.position for box in scene.objects], dtype=torch.float64)
    extents = half_extents(size[:, 0], size[:, 1], yaw)
    return (torch.cat([position, size, extents], dim=1) / DECIMETRE).numpy().astype(np.float32)
