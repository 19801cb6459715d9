"""The rows of a motion: how smooth they are, and how fast they can be run."""

from __future__ import annotations

import numpy as np
from numba import njit

from relevance.robot import ARM

STEP = 0.1
"""Shortest time between rows, s."""
SPEED = 0.9
"""Share of the velocity limits that motions use."""
WIDTH = 2 * ARM + 1
"""Entries below the diagonal that a banded system of rows has, itself included: rows next to each
other share obstacles, and accelerations tie each joint to itself two rows on."""


@njit(cache=True)
def assign(to, source):
    """Copy one row (n,) into another.

    `to[:] = source` would bring in numba's strings, for an error that cannot be: 4 s to compile.
    """
    for i in range(len(to)):
        to[i] = source[i]


@njit(cache=True)
def smoothness(T):
    """Second derivative of half the squared accelerations, (n, WIDTH) as for `banded_solve`."""
    band = np.zeros(((T - 1) * ARM, WIDTH))
    for t in range(T + 1):
        for i in range(ARM):
            for u in range(-1, 2):
                for v in range(-1, u + 1):
                    row, column = t + u, t + v
                    if column < 1 or row > T - 1:
                        continue
                    product = (-2.0 if u == 0 else 1.0) * (-2.0 if v == 0 else 1.0)
                    band[(column - 1) * ARM + i, (row - column) * ARM] += product
    for i in range(len(band)):
        band[i, 0] += 1e-6
    return band


@njit(cache=True)
def time_step(arm, X):
    """Seconds between rows such that no joint exceeds its share of the velocity limit."""
    slowest = STEP
    for t in range(len(X) - 1):
        for i in range(ARM):
            slowest = max(slowest, abs(X[t + 1, i] - X[t, i]) / arm.velocity[i] / SPEED)
    return slowest


@njit(cache=True)
def acceleration_cost(X):
    """Sum of squared second differences of the rows, at rest before and after, rad^2."""
    total, T = 0.0, len(X) - 1
    for t in range(T + 1):
        for i in range(ARM):
            a = X[max(t - 1, 0), i] - 2 * X[t, i] + X[min(t + 1, T), i]
            total += a * a
    return total
