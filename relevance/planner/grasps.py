"""How the hand takes a box, and what then moves with the arm.

The hand points down over the box. In the plane it is a set of rectangles that share one angle
(box, finger tips, fingers, both halves of the palm); for the bounds that look at the arm it is
boxes on its links.

A box has families of grasps (`holding.holds`): across both edges that fit the hand, with the
finger tips at several depths, with the hand shifted along the box, and with the hand leaning along
it, the box level.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from relevance.holding.hand import SHALLOW, SPREAD, TILTS, hand_boxes
from relevance.holding.holds import (
    COLUMNS,
    WRIST_ABOVE,
    WRIST_LEFT,
    sound_holds,
)
from relevance.planner.kernels.boxes import Bodies
from relevance.planner.kernels.kinematics import FLANGE
from relevance.robot import HAND, panda
from relevance.scene import Box


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grasp:
    """The hand over a box, fingers along its x (axis 0) or y (axis 1)."""

    axis: int
    opening: float
    """Finger joint value before closing and after release, m."""
    closed: float
    """Finger joint value on the box, m."""
    above: float
    """Height of the hand's origin over the box's centre, m."""
    depth: float
    """How far the finger tips reach below the box's top, m."""
    shift: float
    """How far the hand's origin is from the box's centre, to the left of the finger axis, m."""
    tilt: float
    """How far the hand leans to the left of the finger axis, rad."""
    wrist: tuple[float, float]
    """What `shift` and `above` are for a hand that does not lean and has the same wrist, m."""
    price: float
    """What the plan's cost grows by, rad^2."""
    parts: np.ndarray
    """(P, 5): offset along the finger axis and to its left, half extents along and across it,
    height of the underside relative to the box's bottom; row 0 is the box itself. m."""

    @property
    def lopsided(self) -> bool:
        """Whether the hand, the other way round, would be elsewhere."""
        return self.shift != 0 or self.tilt != 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Family:
    """Some grasps of a box side by side; each is made when it is first asked for."""

    size: tuple[float, float, float]
    axes: np.ndarray
    """(G,)."""
    rows: np.ndarray
    """(G, COLUMNS): as `holding.holds` has them."""
    parts: np.ndarray
    """(G, P, 5): `Grasp.parts` of each."""
    _made: dict[int, Grasp] = field(default_factory=dict)

    @property
    def wrists(self) -> np.ndarray:
        """(G, 2): `Grasp.wrist` of each."""
        return self.rows[:, WRIST_LEFT : WRIST_ABOVE + 1]

    @cached_property
    def levels(self) -> tuple[np.ndarray, np.ndarray]:
        """The heights of the wrists over the box (L,), m, and which of them each grasp has (G,)."""
        heights = self.rows[:, WRIST_ABOVE].tolist()
        numbers = {height: number for number, height in enumerate(dict.fromkeys(heights))}
        return np.array(list(numbers)), np.array([numbers[height] for height in heights])

    def __len__(self) -> int:
        return len(self.axes)

    def __getitem__(self, number: int) -> Grasp:
        if number not in self._made:
            axis = int(self.axes[number])
            above, depth, shift, tilt, left, height, price = self.rows[number].tolist()
            closed = self.size[axis] / 2
            self._made[number] = Grasp(
                axis=axis, opening=closed + SPREAD, closed=closed, above=above, depth=depth,
                shift=shift, tilt=tilt, wrist=(left, height), price=price,
                parts=self.parts[number],
            )  # fmt: skip
        return self._made[number]

    def __iter__(self) -> Iterator[Grasp]:
        return (self[number] for number in range(len(self)))


_SHARES = (0.0, 1 / 3, -1 / 3, 2 / 3, -2 / 3, 1.0, -1.0)
_WAYS = tuple(
    np.array(list(ways), float)
    for ways in (
        [(0, 0.0, 0)],
        [*product((0,), _SHARES, range(1 + len(SHALLOW)))][1:],
        product(range(1, len(TILTS)), _SHARES, (0, 1)),
    )
)
"""What the deep, the other and the leaning grasps are chosen from, as `sound_holds` has it."""


def grasps(box: Box) -> tuple[Grasp, ...]:
    """The deep, centred grasps that the gripper's opening allows, narrower edge first."""
    return tuple(deep_grasps(box))


def deep_grasps(box: Box) -> Family:
    """The same side by side."""
    return _family(box.size, 0)


def other_grasps(box: Box) -> Family:
    """The shallower and shifted grasps, edge by edge, each shift from deep to shallow."""
    return _family(box.size, 1)


def leaning_grasps(box: Box) -> Family:
    """The grasps of a hand that leans, edge by edge, each tilt and shift from deep to shallow."""
    return _family(box.size, 2)


@lru_cache(maxsize=1024)
def _family(size: tuple[float, float, float], number: int) -> Family:
    hand, ways = hand_boxes(), _WAYS[number]
    most = 2 * len(ways)
    axes, rows = np.empty(most, np.int64), np.empty((most, COLUMNS))
    parts = np.empty((most, 1 + len(hand.shape), 5))
    count = sound_holds(
        np.array(size), ways, hand.shape, hand.over, hand.tip, hand.max_opening, FLANGE, axes, rows,
        parts,
    )  # fmt: skip
    return Family(size=size, axes=axes[:count], rows=rows[:count], parts=parts[:count])


def fits(box: Box) -> bool:
    """Whether the hand opens wide enough for one of its edges."""
    return min(box.size[:2]) / 2 + SPREAD <= hand_boxes().max_opening


def pick_target(box: Box, grasp: Grasp) -> np.ndarray:
    """Hand target (TARGET,) over a standing box, m and rad."""
    x, y, z = box.position
    return hand_target(x, y, z + grasp.above, box.yaw + grasp.axis * math.pi / 2, grasp)


def hand_target(x: float, y: float, z: float, angle: float, grasp: Grasp) -> np.ndarray:
    """Hand target (TARGET,) at the height z for a box at x, y whose finger axis has this angle."""
    s, c = math.sin(angle), math.cos(angle)
    return np.array([x - grasp.shift * s, y + grasp.shift * c, z, angle, grasp.tilt])


class Held(NamedTuple):
    """A box in the hand, in the hand's frame (y = finger axis)."""

    centre: np.ndarray
    """(3,) m."""
    half: np.ndarray
    """(3,) m."""
    turn: float
    """About y, rad."""


def carried(box: Box, grasp: Grasp, way: float = 1.0) -> Held:
    """The box that is held so.

    way: 1 where the hand's y points along the finger angle, -1 where it points against it.
    """
    half = np.array([box.size[1 - grasp.axis], box.size[grasp.axis], box.size[2]]) / 2
    s, c = math.sin(grasp.tilt), math.cos(grasp.tilt)
    x, z = grasp.above * s - grasp.shift * c, grasp.above * c + grasp.shift * s
    return Held(np.array([way * x, 0.0, z]), half, way * grasp.tilt)


def bodies(opening: float, held: Held | None = None, *, upper: bool = False) -> Bodies:
    """Arm, hand and fingers at this opening; last the box in the hand, if any.

    upper: with the links near the base too. Not to be written to: it is kept.
    """
    if held is None:
        return _bodies_of(opening, None, None, 0.0, upper)
    centre, half, turn = held
    return _bodies_of(opening, tuple(centre.tolist()), tuple(half.tolist()), turn, upper)


@lru_cache(maxsize=256)
def _bodies_of(
    opening: float, centre: tuple | None, half: tuple | None, turn: float, upper: bool
) -> Bodies:
    shut, sides = _shut_hand(upper)
    count = len(sides) - (centre is None)
    link, centres, halves, turns, radius = (rows[:count].copy() for rows in shut)
    centres[:, 1] += opening * sides[:count]
    if half is not None:
        centres[-1], halves[-1], turns[-1] = centre, half, turn
        radius[-1] = math.hypot(*half)
    return Bodies(link, centres, halves, turns, radius)


@cache
def upper_bodies() -> Bodies:
    """The links near the base alone."""
    return _bodies(list(panda().upper_arm))


@cache
def _shut_hand(upper: bool) -> tuple[Bodies, np.ndarray]:
    """Arm, hand, fingers at opening 0 and room for a box; and which way opening moves each in y."""
    arm = panda()
    rows = [*(arm.upper_arm if upper else ()), *arm.arm]
    sides = [0.0] * len(rows)
    for low, high in arm.finger:
        for side in (1.0, -1.0):
            rows.append((HAND, (low + high) / 2 * [1.0, side, 1.0], (high - low) / 2))
            sides.append(side)
    rows.append((HAND, np.zeros(3), np.zeros(3)))
    return _bodies(rows), np.array([*sides, 0.0])


def _bodies(rows: list[tuple[int, np.ndarray, np.ndarray]]) -> Bodies:
    link, centre, half = (np.array(column) for column in zip(*rows, strict=True))
    return Bodies(link, centre, half, np.zeros(len(link)), np.sqrt((half**2).sum(1)))
