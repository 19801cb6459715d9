"""How boxes look: colours as people see them apart, and boxes that no picture can tell apart."""

from __future__ import annotations

import itertools

import numpy as np

from relevance.scene.boxes import Box
from relevance.scene.scenes import Scene

SAME_COLOR = 5.0
"""Delta E below which two colours are one in a picture: shades differ more than that."""
SAME_EDGE = 0.003
"""Difference of edges that is a pixel or less on the table, m."""


def lookalikes(scene: Scene) -> tuple[tuple[str, ...], ...]:
    """Names of boxes of equal size and colour, as far as a picture shows, in groups of two or more.

    A model scores them by what they look like: it cannot know which of them is meant.
    """
    places = lab(np.array([box.color for box in scene.objects]))
    group = list(range(len(scene.objects)))
    for (i, a), (j, b) in itertools.combinations(enumerate(scene.objects), 2):
        if np.linalg.norm(places[i] - places[j]) < SAME_COLOR and _of_one_size(a, b):
            group = [group[i] if g == group[j] else g for g in group]
    names = (
        tuple(box.name for box, g in zip(scene.objects, group, strict=True) if g == k)
        for k in dict.fromkeys(group)
    )
    return tuple(alike for alike in names if len(alike) > 1)


def _of_one_size(a: Box, b: Box) -> bool:
    """Whether they are equal boxes, one perhaps turned by a quarter."""
    ours, its = ([*sorted(box.size[:2]), box.size[2]] for box in (a, b))
    return all(abs(x - y) < SAME_EDGE for x, y in zip(ours, its, strict=True))


def lab(color: np.ndarray) -> np.ndarray:
    """CIELAB (..., 3) of sRGB (..., 3) in 0..1, white point D65; distances in it are Delta E.

    Not OpenCV's conversion, which is up to 0.6 off: other colours would be drawn.
    """
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    relative = linear @ _TO_XYZ.T / _TO_XYZ.sum(axis=1)
    f = np.where(relative > _KNEE**3, np.cbrt(relative), relative / (3 * _KNEE**2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


_KNEE = 6 / 29
_TO_XYZ = np.array(  # IEC 61966-2-1
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
