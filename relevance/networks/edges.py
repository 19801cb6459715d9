"""What a picture shows across the edges where boxes are expected: lines of samples.

Lines cross the four edges of a box's top and the four of its bottom, in the plane of top or
bottom, at right angles to the edge. So a box that is off by a millimetre is off by as much on
them, wherever it stands, however large and however turned it is (edge-based tracking: Harris and
Stennett, RAPID, BMVC 1990).

Shape suffixes: B scenes, N objects (padded), H and W height and width in pixels; EDGES, LINES and
SAMPLES are axes, too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from relevance.networks.poses import DECIMETRE, boxes_of
from relevance.scene import Camera, pinhole

ROUNDS = 2
"""How often boxes are put right by what shows at their edges."""
EDGES = 8
"""Of the top, then of the bottom: ahead, behind, to the left, to the right of the box."""
LINES = 10
"""Lines across each edge."""
SAMPLES = 16
"""Samples of a line."""
STEP = 0.00125
"""From one sample to the next, m: half a pixel. A line reaches 9 mm to either side."""
_REACH = 0.85
"""Share of an edge that has lines: its ends are other edges', too."""
_SMALLEST = 0.005
"""No half extent is less, m."""
_NEAR = 0.05
"""Nothing is nearer to the camera, m."""
_SIDES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


class Expected(NamedTuple):
    """Boxes as they are expected, and what shows at their edges; zero for what is not there, and
    for boxes that are expected at no finite place."""

    lines: np.ndarray
    """(B, N, EDGES, LINES, 3 SAMPLES) float32: colours from within to without, less their mean."""
    turn: np.ndarray
    """(B, N) float32: of the footprint, some -pi / 4 to pi / 4."""
    half: np.ndarray
    """(B, N, 2) float32: half extents of the footprint along and across that, decimetres."""


def expected_edges(
    image: np.ndarray, geometry: np.ndarray, present: np.ndarray, camera: Camera
) -> Expected:
    """Look where the edges of boxes should be.

    image (B, 3, H, W), uint8 or float in 0..1; geometry (B, N, GEOMETRY), decimetres; present
    (B, N) bool.
    """
    shape = geometry.shape[:2]
    found = Expected(
        lines=np.zeros((*shape, EDGES, LINES, 3 * SAMPLES), np.float32),
        turn=np.zeros(shape, np.float32),
        half=np.zeros((*shape, 2), np.float32),
    )
    unit = 1 / 255 if image.dtype == np.uint8 else 1.0
    finite = present & np.isfinite(geometry).all(-1)  # a network that diverges must not crash
    _look(image, unit, geometry, finite, *pinhole(camera), found)
    return found


@njit(cache=True)
def _look(image, unit, geometry, present, eye, axes, focal, found):
    """Fill `found`."""
    lines, turns, halves = found
    for b in range(len(geometry)):
        there = np.flatnonzero(present[b])
        boxes = boxes_of(geometry[b], there)
        for k in range(len(there)):
            n, box, half = there[k], boxes[k], np.maximum(boxes[k, 4:6], _SMALLEST)
            turn = box[3]
            if turn > math.pi / 4:  # the same rectangle, less turned
                turn, half = turn - math.pi / 2, half[::-1].copy()
            turns[b, n], halves[b, n] = turn, half / DECIMETRE
            cos, sin = math.cos(turn), math.sin(turn)
            # As the camera has them: the box's middle, and its axes.
            middle = axes.T @ (box[:3] - eye)
            ahead, left, up = cos * axes[0] + sin * axes[1], cos * axes[1] - sin * axes[0], axes[2]
            for edge in range(EDGES):
                x, y = _SIDES[edge % len(_SIDES)]
                face = middle + (box[6] if edge < len(_SIDES) else -box[6]) * up
                step = STEP * (x * ahead + y * left)
                for line in range(LINES):
                    share = _REACH * (2 * line / (LINES - 1) - 1)
                    along, across = x + share * (1 - abs(x)), y + share * (1 - abs(y))
                    start = face + half[0] * along * ahead + half[1] * across * left
                    start -= (SAMPLES - 1) / 2 * step
                    _sample(image[b], unit, start, step, focal, lines[b, n, edge, line])


@njit(cache=True)
def _sample(image, unit, ray, step, focal, found):
    """Fill found (3 SAMPLES) with what shows along a ray that goes on by steps; outside of the
    image with its border."""
    height, width = image.shape[1:]
    mean = np.zeros(3)
    for s in range(SAMPLES):
        depth = max(ray[2] + s * step[2], _NEAR)
        x = (ray[0] + s * step[0]) / depth * focal + width / 2 - 0.5
        y = (ray[1] + s * step[1]) / depth * focal + height / 2 - 0.5
        x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
        left, above = min(int(x), width - 2), min(int(y), height - 2)
        right, below = x - left, y - above
        for channel in range(3):
            pixels = image[channel]
            upper = (1 - right) * pixels[above, left] + right * pixels[above, left + 1]
            lower = (1 - right) * pixels[above + 1, left] + right * pixels[above + 1, left + 1]
            value = unit * ((1 - below) * upper + below * lower)
            found[3 * s + channel] = value
            mean[channel] += value / SAMPLES
    for s in range(SAMPLES):
        for channel in range(3):
            found[3 * s + channel] -= mean[channel]
