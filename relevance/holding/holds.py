"""Which ways to take a box are sound, and what they are in the plane.

A hold is sound when at least GRIP of the pads' height and the middle line of the pads, INSET from
the corner, lie on the face. Deep, centred and upright is preferred: what a hold lacks of that is
its price.
"""

from __future__ import annotations

import math

from numba import njit

from relevance.holding.hand import (
    DEPTH,
    FARTHEST,
    GRIP,
    GROUND,
    INSET,
    PALM_ROOM,
    SHALLOW,
    SPREAD,
    TILTS,
)

PRICE = 20.0
"""Price of a hold for each metre that it is shallower, or farther from the middle, rad^2/m."""
LEAN_PRICE = 3.0
"""Price of a hold for each radian that the hand leans, rad^2/rad."""
ABOVE, DEEP, SHIFT, TILT, WRIST_LEFT, WRIST_ABOVE, COST = range(7)
"""Columns of a hold: as `Grasp` has them."""
COLUMNS = 7


@njit(cache=True)
def sound_holds(size, ways, hand, over, tip, opening, flange, axes, rows, parts):
    """Fill in the sound ones of some ways to take a box across both edges, narrower edge first;
    returns how many.

    size (3,). ways (W, 3): index in TILTS, share of the farthest shift, 0 for the deepest or
    index + 1 in SHALLOW (negative: or the deepest, where the box is too low for that). hand (P, 3),
    over (T, P, 5), tip, opening: as `HandBoxes` has them, of finger tips, fingers and both halves
    of the palm. flange: its length, m. Fills axes (2 W,), rows (2 W, COLUMNS),
    parts (2 W, 1 + P, 5).
    """
    count, palm, height = 0, len(hand) - 2, size[2]
    deep = min(DEPTH, max(height - 0.012, 0.3 * height, min(0.010, height - GROUND)))
    for turn in range(2):
        axis = turn if size[0] <= size[1] else 1 - turn
        closed, edge = size[axis] / 2, size[1 - axis] / 2
        if closed + SPREAD > opening:
            continue
        most = min(edge - INSET, FARTHEST)
        for w in range(len(ways)):
            which, level = int(ways[w, 0]), int(ways[w, 2])
            if ways[w, 1] != 0.0 and most <= INSET:
                continue
            shift, tilt = ways[w, 1] * max(most, 0.0), TILTS[which]
            s, c = math.sin(tilt), math.cos(tilt)
            lowest = min(deep, height - GROUND - hand[0, 0] * abs(s))  # of the tips' lower corner
            depth = lowest if level == 0 else SHALLOW[abs(level) - 1]
            if depth >= lowest - 0.002:
                if level > 0:
                    continue
                depth = lowest
            if depth < GRIP:
                continue
            # Where, on the side that the hand leans to, the box's top is nearest to the palm.
            end = edge - (shift if tilt > 0 else -shift)
            end = min(end, (hand[palm, 0] + depth * abs(s)) / c)
            if end * abs(s) + depth * c > hand[palm, 1] - PALM_ROOM:
                continue
            left, above = shift + tip * s, height / 2 - depth + tip * c
            axes[count] = axis
            row, part = rows[count], parts[count]
            row[ABOVE], row[DEEP], row[SHIFT], row[TILT] = above, depth, left, tilt
            row[WRIST_LEFT], row[WRIST_ABOVE] = left + flange * s, above - flange * (1 - c)
            row[COST] = PRICE * (deep - depth + abs(shift)) + LEAN_PRICE * abs(tilt)
            part[0, 0], part[0, 1], part[0, 2], part[0, 3], part[0, 4] = 0.0, 0.0, closed, edge, 0.0
            for p in range(len(hand)):
                for i in range(5):
                    part[1 + p, i] = over[which, p, i]
                part[1 + p, 0] += hand[p, 2] * (closed + SPREAD)
                part[1 + p, 1] += shift
                part[1 + p, 4] += height - depth
            count += 1
    return count
