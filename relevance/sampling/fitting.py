"""Where a box may stand: within reach, on the table, in the picture, apart, and to be seen.

Visibility is judged while a scene is drawn, so that a full table does not have to be drawn,
rendered and thrown away until one happens to show all its boxes; that made scenes with few
boxes come out more often than they were drawn. Rays from the camera end at nine points of each
face that it can see.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from relevance.sampling.projection import project, vertices
from relevance.scene import Box, footprint_gap

if TYPE_CHECKING:
    from relevance.sampling.scenes import SceneConfig

GRASPABLE_EDGE = 0.07
"""Longest footprint edge that the hand (opening 8 cm) takes with room to spare, m."""


class Standing:
    """The boxes drawn so far, as the arm and the camera meet them."""

    def __init__(self, config: SceneConfig) -> None:
        self.boxes: list[Box] = []
        self._config = config
        self._eye = np.array(config.camera.eye)
        self._limit = np.array([config.camera.width, config.camera.height]) - config.image_margin
        # Of each box: its bounds in the image (x and y, low and high, px), the points of its
        # faces (27, 3), the share of it that each stands for (27,), and which of them are hidden.
        self._bounds: list[tuple[float, float, float, float]] = []
        self._points: list[np.ndarray] = []
        self._shares: list[np.ndarray] = []
        self._hidden: list[np.ndarray] = []

    def admits(self, box: Box) -> bool:
        """Whether the box can be reached and seen whole, keeps its distance and hides none."""
        if not (self._within(box) and self._apart(box)):
            return False
        bounds = self._seen(box)
        return bounds is not None and self._shows(box, bounds)

    def add(self, box: Box) -> None:
        """Put the box there."""
        bounds, (points, shares) = self._seen(box), self._faces(box)
        assert bounds is not None, "only what is admitted is added"
        hidden = np.zeros(len(points), dtype=bool)
        for i in self._overlapping(bounds):
            self._hidden[i] = self._hidden[i] | self._behind(self._points[i], box)
            hidden |= self._behind(points, self.boxes[i])
        self.boxes.append(box)
        self._bounds.append(bounds)
        self._points.append(points)
        self._shares.append(shares)
        self._hidden.append(hidden)

    def _within(self, box: Box) -> bool:
        config, (x, y, _) = self._config, box.position
        base = config.robot.base
        if not config.reach[0] <= math.hypot(x - base[0], y - base[1]) <= config.reach[1]:
            return False
        (ex, ey), (along, across) = box.extents, config.table.size
        margin = config.table_margin
        return abs(x) + ex <= along / 2 - margin and abs(y) + ey <= across / 2 - margin

    def _apart(self, box: Box) -> bool:
        spacing, radius = self._config.spacing, math.hypot(*box.size[:2]) / 2
        for other in self.boxes:
            if other.name == box.on or box.bottom - other.top >= spacing:
                continue
            reach = radius + math.hypot(*other.size[:2]) / 2 + spacing
            dx, dy = box.position[0] - other.position[0], box.position[1] - other.position[1]
            # Disks that are apart settle most pairs.
            if dx * dx + dy * dy < reach * reach and footprint_gap(box, other) < spacing:
                return False
        return True

    def _shows(self, box: Box, bounds: tuple[float, float, float, float]) -> bool:
        """Whether enough of this box and of every other would show."""
        near = self._overlapping(bounds)
        if not near:
            return True
        least = self._config.visible
        for i in near:
            hidden = self._hidden[i] | self._behind(self._points[i], box)
            if self._shares[i][~hidden].sum() < least:
                return False
        points, shares = self._faces(box)
        hidden = np.zeros(len(points), dtype=bool)
        for i in near:
            hidden |= self._behind(points, self.boxes[i])
        return bool(shares[~hidden].sum() >= least)

    def _seen(self, box: Box) -> tuple[float, float, float, float] | None:
        """Bounds of the box in the image, px; None when it is not wholly in the picture."""
        pixels, depth = project(self._config.camera, vertices(box))
        if depth.min() <= self._config.camera.near:
            return None
        (left, upper), (right, lower) = pixels.min(axis=0), pixels.max(axis=0)
        margin = self._config.image_margin
        if min(left, upper) < margin or right > self._limit[0] or lower > self._limit[1]:
            return None
        return left, right, upper, lower

    def _overlapping(self, bounds: tuple[float, float, float, float]) -> list[int]:
        left, right, upper, lower = bounds
        return [
            i
            for i, (a, b, c, d) in enumerate(self._bounds)
            if a < right and left < b and c < lower and upper < d
        ]

    def _faces(self, box: Box) -> tuple[np.ndarray, np.ndarray]:
        """Nine points of each of three faces, (27, 3), m, and their shares of what shows, (27,).

        Of two opposite faces it is the one towards the camera; its share is what it takes of
        the picture of the box alone, which is none when the camera stands between the two.
        """
        half, turn = np.array(box.size) / 2, _turn(box)
        eye = (self._eye - np.array(box.position)) @ turn
        points = _FACES * np.where(eye >= 0, half, -half)
        sight = eye - points
        facing = np.repeat(np.maximum(np.abs(eye) - half, 0.0) / half, 9)
        shares = facing * (sight * sight).sum(axis=1) ** -1.5
        return points @ turn.T + np.array(box.position), shares / shares.sum()

    def _behind(self, points: np.ndarray, box: Box) -> np.ndarray:
        """Which points (K, 3) the box hides from the camera, (K,)."""
        half, turn = np.array(box.size) / 2, _turn(box)
        start = (self._eye - np.array(box.position)) @ turn
        along = (points - self._eye) @ turn
        along[along == 0] = 1e-12
        a, b = (-half - start) / along, (half - start) / along
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        return (enter < leave) & (enter < 1 - 1e-6) & (leave > 0)


def _turn(box: Box) -> np.ndarray:
    """The axes of a box as columns, (3, 3)."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


_GRID = [(u, v) for u in (-2 / 3, 0.0, 2 / 3) for v in (-2 / 3, 0.0, 2 / 3)]
_FACES = np.array([np.insert(uv, axis, 1.0) for axis in range(3) for uv in _GRID])
