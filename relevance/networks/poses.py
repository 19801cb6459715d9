"""Where a box is as networks are told it or asked for it: position, size, half-extents.

Geometry is in decimetres, so that its numbers are near 1.

Shape suffixes: N objects of a scene; GEOMETRY is the last axis of whatever comes in.
"""

from __future__ import annotations

import math

import numpy as np

from relevance.scene import Scene

ANGLES = 8
"""Directions over a half turn along which footprint half-extents are regressed."""
GEOMETRY = 3 + 3 + ANGLES
"""Position (3), size (3), half-extents (ANGLES), all in decimetres."""
DECIMETRE = 0.1
"""Metres per unit of the geometry vectors."""


def true_geometry(scene: Scene) -> np.ndarray:
    """Position, size and footprint half-extents of every box, (N, GEOMETRY), decimetres."""
    size = np.array([box.size for box in scene.objects])
    yaw = np.array([box.yaw for box in scene.objects])
    position = np.array([box.position for box in scene.objects])
    angle = np.arange(ANGLES) * (math.pi / ANGLES) - yaw[:, None]
    across = np.abs(np.cos(angle)) * size[:, :1] + np.abs(np.sin(angle)) * size[:, 1:2]
    rows = np.concatenate([position, size, across / 2], axis=1)
    return (rows / DECIMETRE).astype(np.float32)
