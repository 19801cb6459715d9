"""Where a box is as networks are told it or asked for it: position, size, half-extents.

Geometry is in decimetres, so that its numbers are near 1.

Shape suffixes: N objects of a scene; GEOMETRY is the last axis of whatever comes in.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from relevance.scene import Scene
from relevance.scene.geometry import UPRIGHT, upright

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


@njit(cache=True)
def boxes_of(geometry, there):
    """Boxes (K, UPRIGHT) from rows `there` (K,) of geometry (N, GEOMETRY), which has half extents
    in the place of a yaw; of either pair of edges.

    Those at right angles add up to sqrt(2) (along + across) cos(yaw + pi / 4 - angle), but for a
    kink where the angle is the yaw: next to the direction in which the sum is least. So the other
    three of four give the yaw.
    """
    boxes = np.empty((len(there), UPRIGHT))
    step, quarter = math.pi / ANGLES, ANGLES // 2
    for n in range(len(there)):
        row = geometry[there[n]] * DECIMETRE
        least = 0
        for k in range(1, quarter):
            if row[6 + k] + row[6 + k + quarter] < row[6 + least] + row[6 + least + quarter]:
                least = k
        k = (least + 1) % quarter
        before = row[6 + k] + row[6 + k + quarter]
        k = (least + quarter - 1) % quarter
        after = row[6 + k] + row[6 + k + quarter]
        off = (after - before) / max(after + before, 1e-7) / math.tan(step)
        yaw = (least + quarter // 2) * step + math.atan(off) - math.pi / 4
        cc = cs = ss = own = other = 0.0
        for k in range(ANGLES):
            c, s = abs(math.cos(k * step - yaw)), abs(math.sin(k * step - yaw))
            cc, cs, ss = cc + c * c, cs + c * s, ss + s * s
            own, other = own + row[6 + k] * c, other + row[6 + k] * s
        of = cc * ss - cs * cs
        along, across = (own * ss - other * cs) / of, (other * cc - own * cs) / of
        upright(row[0], row[1], row[2], yaw, along, across, row[5] / 2, boxes[n])
    return boxes
