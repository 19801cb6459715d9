"""Where a box may stand: within reach, on the table, in the picture, apart, and to be seen.

Visibility is judged while a scene is drawn, so that a full table does not have to be drawn,
rendered and thrown away until one happens to show all its boxes; that made scenes with few
boxes come out more often than they were drawn. Rays from the camera end at nine points of each
face that it can see.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from relevance.sampling.settings import SceneConfig
from relevance.scene import GAP, Box, pinhole
from relevance.scene.contacts import ROBOT_RADIUS
from relevance.scene.geometry import (
    UPRIGHT,
    bound,
    corners,
    covers,
    crossing,
    extents,
    flat_gap,
    packed,
    projected,
)

COMMON_RADIUS = 0.0275
"""Half the shorter footprint edge of a common subject, m."""

_GRID = [(u, v) for u in (-2 / 3, 0.0, 2 / 3) for v in (-2 / 3, 0.0, 2 / 3)]
_FACES = np.array([np.insert(uv, axis, 1.0) for axis in range(3) for uv in _GRID])


class _Limits(NamedTuple):
    """What a box must keep to, as plain numbers (see SceneConfig)."""

    base_x: float
    base_y: float
    nearest: float
    farthest: float
    half_x: float
    half_y: float
    spacing: float
    width: float
    height: float
    image_margin: float
    near: float
    far: float
    visible: float


class _Shown(NamedTuple):
    """The boxes drawn so far, up to N: rows to fill in, of which the first few are in use."""

    boxes: np.ndarray
    """(N, UPRIGHT)."""
    bounds: np.ndarray
    """(N, 4): in the image, lowest x and y, then highest, px from its middle."""
    points: np.ndarray
    """(N, 27, 3): nine of each of the three faces towards the camera, m."""
    shares: np.ndarray
    """(N, 27): the share of what shows of the box that each point stands for."""
    hidden: np.ndarray
    """(N, 27): which of them other boxes hide."""


class Standing:
    """The boxes drawn so far, as the arm and the camera meet them; candidates come as rows."""

    def __init__(self, config: SceneConfig, *, most: int | None = None) -> None:
        """most: how many boxes there will be at most, as `config` says when None."""
        self.config = config
        self.boxes: list[Box] = []
        margin, (x, y), camera = config.table_margin, config.table.size, config.camera
        limits = (
            *config.robot.base[:2],
            *config.reach,
            x / 2 - margin,
            y / 2 - margin,
            config.spacing,
            camera.width,
            camera.height,
            config.image_margin,
            camera.near,
            camera.far,
            config.visible,
        )
        self._limits = _Limits(*map(float, limits))  # one type of number: compiled once
        turn = config.robot.yaw
        self._turn = math.cos(turn), math.sin(turn)
        self._eye, self._axes, self._focal = pinhole(camera)
        most = most or config.numbers[1]
        self._shown = _Shown(
            np.empty((most, UPRIGHT)),
            np.empty((most, 4)),
            np.empty((most, 27, 3)),
            np.empty((most, 27)),
            np.zeros((most, 27), dtype=np.bool_),
        )

    def admits(self, candidate: np.ndarray, carrier: int = -1) -> bool:
        """Whether the box can be reached and seen whole, keeps its distance and hides none.

        carrier: index of the box that it stands on, if any.
        """
        count, view = len(self.boxes), (self._eye, self._axes, self._focal)
        return _fits(candidate, carrier, count, self._shown, self._limits, *view)

    def closes(self, candidate: np.ndarray) -> int:
        """How many goal regions a new box closes: those it stands in, and its own."""
        return _closed(candidate, len(self.boxes), self._shown.boxes, *self._turn)

    def add(self, box: Box) -> None:
        """Put the box there; it must have been admitted."""
        count, view = len(self.boxes), (self._eye, self._axes, self._focal)
        self._shown.boxes[count] = packed(box.size, box.position, box.yaw)
        _place(count, self._shown, self._limits, *view)
        self.boxes.append(box)


@njit(cache=True)
def _fits(box, carrier, count, shown, limits, eye, axes, focal):
    """`Standing.admits` for a box (UPRIGHT,) among the first few that are shown."""
    distance = math.hypot(box[0] - limits.base_x, box[1] - limits.base_y)
    if not limits.nearest <= distance <= limits.farthest:
        return False
    if distance - box[7] < ROBOT_RADIUS:
        return False
    ex, ey = extents(box, 1.0, 0.0)
    if abs(box[0]) + ex > limits.half_x or abs(box[1]) + ey > limits.half_y:
        return False
    for j in range(count):
        other = shown.boxes[j]
        above = (box[2] - box[6]) - (other[2] + other[6]) >= limits.spacing
        if j != carrier and not above and flat_gap(box, other) < limits.spacing:
            return False
    bounds = np.empty(4)
    return _seen(box, limits, eye, axes, focal, bounds) and _shows(
        box, bounds, count, shown, limits.visible, eye
    )


@njit(cache=True)
def _seen(box, limits, eye, axes, focal, bounds):
    """Whether the box is wholly in the picture; fills its bounds there (4,), px."""
    points = projected(corners(box), eye, axes, focal)
    for k in range(8):
        if not limits.near < points[k, 2] < limits.far:
            return False
    bound(points, bounds)
    x, y = limits.width / 2 - limits.image_margin, limits.height / 2 - limits.image_margin
    return bounds[0] >= -x and bounds[1] >= -y and bounds[2] <= x and bounds[3] <= y


@njit(cache=True)
def _shows(box, bounds, count, shown, least, eye):
    """Whether enough of this box and of every other would show."""
    points, shares, alone = np.empty((27, 3)), np.empty(27), True
    for j in range(count):
        if not _overlap(bounds, shown.bounds[j]):
            continue
        alone, seen = False, 0.0
        for k in range(27):
            if not shown.hidden[j, k] and not _behind(shown.points[j, k], box, eye):
                seen += shown.shares[j, k]
        if seen < least:
            return False
    if alone:
        return True
    _faces(box, eye, points, shares)
    seen = 0.0
    for k in range(27):
        hidden = False
        for j in range(count):
            if not hidden and _overlap(bounds, shown.bounds[j]):
                hidden = _behind(points[k], shown.boxes[j], eye)
        if not hidden:
            seen += shares[k]
    return seen >= least


@njit(cache=True)
def _place(i, shown, limits, eye, axes, focal):
    """Fill in what is shown of box i, and what it hides of those before it."""
    box, bounds = shown.boxes[i], shown.bounds[i]
    admitted = _seen(box, limits, eye, axes, focal, bounds)
    assert admitted, "only what is admitted is added"
    _faces(box, eye, shown.points[i], shown.shares[i])
    for j in range(i):
        if _overlap(bounds, shown.bounds[j]):
            for k in range(27):
                shown.hidden[j, k] |= _behind(shown.points[j, k], box, eye)
                shown.hidden[i, k] |= _behind(shown.points[i, k], shown.boxes[j], eye)


@njit(cache=True)
def _overlap(a, b):
    """Whether two bounds in the image (4,) overlap."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


@njit(cache=True)
def _faces(box, eye, points, shares):
    """Fill nine points of each of three faces, (27, 3), m, and their shares of what shows, (27,).

    Of two opposite faces it is the one towards the camera; its share is what it takes of
    the picture of the box alone, which is none when the camera stands between the two.
    """
    c, s = box[8], box[9]
    dx, dy = eye[0] - box[0], eye[1] - box[1]
    local = (c * dx + s * dy, c * dy - s * dx, eye[2] - box[2])
    total = 0.0
    for k in range(27):
        half = box[4 + k // 9]
        facing = max(abs(local[k // 9]) - half, 0.0) / half
        x = _FACES[k, 0] * math.copysign(box[4], local[0])
        y = _FACES[k, 1] * math.copysign(box[5], local[1])
        z = _FACES[k, 2] * math.copysign(box[6], local[2])
        sight = (local[0] - x) ** 2 + (local[1] - y) ** 2 + (local[2] - z) ** 2
        shares[k] = facing * sight**-1.5
        total += shares[k]
        points[k, 0], points[k, 1] = box[0] + c * x - s * y, box[1] + s * x + c * y
        points[k, 2] = box[2] + z
    for k in range(27):
        shares[k] /= total


@njit(cache=True)
def _behind(point, box, eye):
    """Whether the box hides a point (3,) from the camera."""
    dx, dy, dz = point[0] - eye[0], point[1] - eye[1], point[2] - eye[2]
    enter, leave = crossing(box, eye[0], eye[1], eye[2], dx, dy, dz)
    return enter < leave and enter < 1 - 1e-6 and leave > 0


@njit(cache=True)
def _closed(box, count, boxes, c, s):
    """`Standing.closes` for a box (UPRIGHT,) among the first few of boxes (N, UPRIGHT).

    c, s: cosine and sine of the robot's yaw, whose directions the regions have.
    """
    closed = 0
    for quarter in range(4):
        x, y = _way_in(box, quarter, c, s)
        own = False
        for j in range(count):
            own |= covers(boxes[j], x, y)
            other_x, other_y = _way_in(boxes[j], quarter, c, s)
            closed += covers(box, other_x, other_y)
        closed += own
    return closed


@njit(cache=True)
def _way_in(box, quarter, c, s):
    """The middle of one of a box's four goal regions, for a subject of common width."""
    ex, ey = extents(box, c, s)
    away = (1 - quarter // 2 * 2) * ((ex if quarter % 2 == 0 else ey) + COMMON_RADIUS + GAP / 2)
    if quarter % 2 == 0:
        return box[0] + away * c, box[1] + away * s
    return box[0] - away * s, box[1] + away * c
