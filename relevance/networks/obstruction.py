"""Which objects are in the way, at each pick and at the goal, as networks are told it.

Who must have left is decided in millimetres, by the best of many holds and places: attention over
objects does not find it. So it is told: of each object what it costs to leave it where it is, and
what to take it away, in objects that must leave. Holds, gaps and margins are the planner's.

Shape suffixes: B scenes, N objects (padded), G goals, C choices: of a hold, of a place and a hold.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from relevance.holding.clearances import clearance, pick_gaps
from relevance.holding.hand import MARGIN, PICK_MARGIN, REGION_MARGIN, TILTS, hand_boxes
from relevance.holding.holds import COLUMNS, sound_holds
from relevance.networks.poses import boxes_of
from relevance.scene import Predicate, Robot
from relevance.scene.geometry import extents, rectangle_gap
from relevance.scene.predicates import GAP

ROBOT = Robot()
"""Whose axes the directions of goals are: every picture was taken in front of this one."""
SOFTNESS = (0.0005, 0.003, 0.01)
"""Gaps over which a decision turns, m: as the planner has it, and as well as a box is seen."""
FAR = 0.05
"""No gap counts for more, m; what is so far away is in nobody's way."""
MOST = 4.0
"""No more objects than that are counted."""
OBSTRUCTION = 3 * len(SOFTNESS) + 1
"""How many numbers there are of each object. For each softness: how many more must leave if it
stays, how many more if it leaves, and how many at least, all MOST at most; then how far it is from
the choice that it is least in the way of, in thirds of FAR."""

_UPRIGHT = ((0.0, 0.0), (0.0, 1.0), (0.0, -1.0))
_LEANING = ((0.6, 1.0), (-0.6, -1.0))
_SHIFTED = tuple((0.0, share / 3) for share in (1, -1, 2, -2))
_LESS = ((0.4, 1.0), (-0.4, -1.0))


def _ways(*of: tuple[float, float]) -> np.ndarray:
    """Tilts (rad) and shares of the farthest shift as `sound_holds` has them: as shallow as may be,
    for then fewest are in the way."""
    return np.array([(TILTS.index(tilt), share, -1 if tilt else -2) for tilt, share in of])


PICK_WAYS = _ways(*_UPRIGHT, *_LEANING, *_SHIFTED, *_LESS)
"""With these, who must leave before a pick is what it is with all ways of the planner for 98 of 100
boxes, with the five of a place for 96."""
PLACE_WAYS = _ways(*_UPRIGHT, *_LEANING)
_STEPS = (-1.0, 0.0, 1.0)
"""Where in a goal's region a subject is tried, along both of its axes, in half extents."""
_PLACES = 4 * len(_STEPS) ** 2
_TRIED = 4
"""How many of these places, turned as the reference and as the nearest other, get a hand: those
where the fewest are in the way of the box alone."""
_FIRST = 1e-3
"""By how much an earlier place is preferred: of equal ones every machine takes the same."""


def obstructed_picks(geometry: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Of each object (column) what it is to a pick of each other (row), (B, N, N, OBSTRUCTION).

    geometry (B, N, GEOMETRY), decimetres; present (B, N) bool. Zero for what is not there.
    """
    found = np.zeros((*geometry.shape[:2], geometry.shape[1], OBSTRUCTION), np.float32)
    _picks(geometry, present, PICK_WAYS, hand_boxes(), found)
    return found


def obstructed_goals(
    geometry: np.ndarray, present: np.ndarray, predicate: Predicate, goals: np.ndarray
) -> np.ndarray:
    """Of each object what it is to the subject's place at each goal (B, G, 2), (B, G, N,
    OBSTRUCTION).

    The subject is in nobody's way there, and the reference only where the subject is beside it.
    """
    found = np.zeros((*goals.shape[:2], geometry.shape[1], OBSTRUCTION), np.float32)
    toward = predicate.direction(ROBOT) or (math.nan, math.nan)
    stacked = predicate.stacked
    _goals(geometry, present, goals, stacked, toward, PLACE_WAYS, hand_boxes(), found)
    return found


@njit(cache=True)
def _picks(geometry, present, ways, hand, found):
    """Fill found (B, N, N, OBSTRUCTION)."""
    for b in range(len(geometry)):
        there = np.flatnonzero(present[b])
        boxes = boxes_of(geometry[b], there)
        for i in range(len(there)):
            axes, parts = hold(boxes[i], ways, hand)
            gaps = np.empty((len(axes), len(there)))
            pick_gaps(i, axes, parts, boxes, PICK_MARGIN, FAR, gaps)
            obstruction(gaps, there, found[b, there[i]])


@njit(cache=True)
def _goals(geometry, present, goals, stacked, toward, ways, hand, found):
    """Fill found (B, G, N, OBSTRUCTION)."""
    at = np.empty(geometry.shape[1], np.int64)
    for b in range(len(geometry)):
        there = np.flatnonzero(present[b])
        boxes = boxes_of(geometry[b], there)
        at[there] = np.arange(len(there))
        for g in range(goals.shape[1]):
            subject, reference = at[goals[b, g, 0]], at[goals[b, g, 1]]
            held = hold(boxes[subject], ways, hand)
            gaps = place_gaps(boxes, subject, reference, stacked, toward, held)
            obstruction(gaps, there, found[b, g])


@njit(cache=True)
def hold(box, ways, hand):
    """Edges (C,) and parts (C, P, 5) of the sound ways to hold a box (UPRIGHT,) with a hand as
    `HandBoxes` has it."""
    shape, over, tip, opening = hand
    size, most = 2 * box[4:7], 2 * len(ways)
    axes, rows = np.empty(most, np.int64), np.empty((most, COLUMNS))
    parts = np.empty((most, 1 + len(shape), 5))
    count = sound_holds(size, ways, shape, over, tip, opening, 0.0, axes, rows, parts)
    return axes[:count], parts[:count]


@njit(cache=True)
def obstruction(gaps, there, found):
    """Fill found (N, OBSTRUCTION) where objects are `there` (K,).

    gaps (C, K), m, of each choice to each of them, negative where it is in the way.
    """
    choices, count = gaps.shape
    blocks, cost = np.empty((choices, count)), np.empty(choices)
    for n in range(len(SOFTNESS)):
        least = 2 * MOST
        for c in range(choices):
            cost[c] = 0.0
            for k in range(count):
                gap = gaps[c, k]
                blocks[c, k] = 1 / (1 + math.exp(gap / SOFTNESS[n])) if gap < FAR else 0.0
                cost[c] += blocks[c, k]
            least = min(least, cost[c])
        for k in range(count):
            stays, leaves = 2 * MOST, MOST
            for c in range(choices):
                stays = min(stays, cost[c] + MOST * blocks[c, k])
                leaves = min(leaves, cost[c] - MOST * blocks[c, k])
            row = found[there[k]]
            row[3 * n] = min(stays - least, MOST)
            row[3 * n + 1] = min(leaves + MOST - least, MOST)
            row[3 * n + 2] = min(least, MOST)
    for k in range(count):
        away = -FAR
        for c in range(choices):
            away = max(away, gaps[c, k])
        found[there[k], 3 * len(SOFTNESS)] = 3 * min(away, FAR) / FAR


@njit(cache=True)
def place_gaps(boxes, subject, reference, stacked, toward, held):
    """From the subject and the hand with it, at places that make a goal true, to each object,
    (C, N), m, less the room that they need, FAR at most.

    boxes (N, UPRIGHT); subject, reference: rows of it; stacked: whether the goal is on the
    reference; toward (2,): else the side, nan: all around; held: edges and parts of its holds.
    """
    axes, parts = held
    o, r, count = boxes[subject], boxes[reference], len(boxes)
    base = r[2] + r[6] if stacked else 0.0
    others = np.empty(count, np.bool_)
    for k in range(count):
        rises = boxes[k, 2] + boxes[k, 6] - base > 1e-3
        others[k] = rises and k != subject and not (stacked and k == reference)
    area = np.empty(5)
    goal_region(o, r, stacked, toward, area)
    near, nearest = r[3], np.inf
    for k in range(count):
        dx, dy = boxes[k, 0] - area[0], boxes[k, 1] - area[1]
        away = math.sqrt(dx * dx + dy * dy) - max(boxes[k, 4], boxes[k, 5])
        if others[k] and k != reference and away < nearest:
            nearest, near = away, boxes[k, 3]
    places = _best_places(area, r[3], near, o[4], o[5], boxes, others)
    choices = len(axes)
    gaps = np.full((_TRIED * choices, count), FAR)
    for n in range(_TRIED * choices):
        (x, y, yaw), h = places[n // choices], n % choices
        angle = yaw + axes[h] * math.pi / 2
        for k in range(count):
            if others[k]:
                gap = clearance(x, y, angle, base, parts[h], boxes[k : k + 1], FAR + MARGIN)
                gaps[n, k] = gap - MARGIN
    return gaps


@njit(cache=True)
def _best_places(area, yaw, near, along, across, boxes, others):
    """Where in an area (5,) a box of these half sizes, turned in one of these ways or by a quarter
    more, is in the way of the fewest others (N,), (_TRIED, 3): x, y, yaw."""
    c, s = math.cos(area[2]), math.sin(area[2])
    places, cost = np.empty((_TRIED, 3)), np.full(_TRIED, np.inf)
    for p in range(_PLACES):
        u = _STEPS[p // 4 // len(_STEPS)] * max(area[3] - REGION_MARGIN, 0.0)
        v = _STEPS[p // 4 % len(_STEPS)] * max(area[4] - REGION_MARGIN, 0.0)
        x, y = area[0] + c * u - s * v, area[1] + s * u + c * v
        turn = (near if p % 2 else yaw) + (p // 2 % 2) * math.pi / 2
        ct, st = math.cos(turn), math.sin(turn)
        closest, own = FAR, _FIRST * p
        for k in range(len(boxes)):
            if others[k]:
                gap = _flat_gap(x, y, ct, st, along, across, boxes[k]) - MARGIN
                closest = min(closest, gap)
                own += 1 / (1 + math.exp(gap / SOFTNESS[0])) if gap < FAR else 0.0
        own -= 2 * max(closest, -FAR)
        last = _TRIED - 1
        if own < cost[last]:
            while last > 0 and own < cost[last - 1]:
                cost[last], places[last] = cost[last - 1], places[last - 1]
                last -= 1
            cost[last] = own
            places[last, 0], places[last, 1], places[last, 2] = x, y, turn
    return places


@njit(cache=True)
def _flat_gap(x, y, c, s, along, across, box):
    """From a rectangle to the footprint of a box (UPRIGHT,), m; FAR and more where that is far."""
    dx, dy = box[0] - x, box[1] - y
    far = math.sqrt(along * along + across * across) + box[7] + FAR + MARGIN
    if dx * dx + dy * dy > far * far:
        return FAR + MARGIN
    return rectangle_gap(x, y, c, s, along, across, box[0], box[1], box[8], box[9], box[4], box[5])


@njit(cache=True)
def goal_region(subject, reference, stacked, toward, area):
    """Where the subject's centre may be, as `Predicate.region` has it: fill area (5,): centre x, y,
    angle, half extents.

    For predicates that have neither a side nor a top: all around the reference.
    """
    area[0], area[1] = reference[0], reference[1]
    if stacked:
        area[2], area[3], area[4] = reference[3], reference[4], reference[5]
        return
    wide = extents(reference, 1.0, 0.0)
    area[2] = 0.0
    for a in range(2):
        low = wide[a] + min(subject[4], subject[5])
        if math.isnan(toward[a]):
            area[3 + a] = low + GAP
        else:
            area[a] += toward[a] * (low + GAP / 2)
            area[3 + a] = GAP / 2 if abs(toward[a]) > 0.5 else wide[a]
