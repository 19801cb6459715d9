"""Patterns on the table, in closed form: how much of the second colour each point takes.

A pattern is a function of the place on the table and of the texture's parameters alone, so a
stored scene gives the same pixels again, on any machine, with no texture file. Noise comes
from hashed whole numbers rather than from a generator or a sine, whose last digits differ
between machines.
"""

from __future__ import annotations

import math

import numpy as np

from relevance.scene import Texture


def pattern(texture: Texture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Share of the second colour at points x, y on the table (any shape), m: 0 to 1."""
    c, s = math.cos(texture.angle), math.sin(texture.angle)
    along, across = (c * x + s * y) / texture.scale, (c * y - s * x) / texture.scale
    # Where the pattern lies: two numbers in 0..1 of the seed.
    shift = _hashed(np.arange(2), np.zeros(2, dtype=np.int64), texture.seed)
    along, across = along + shift[0], across + shift[1]
    if texture.kind == "checks":
        return (np.floor(along) + np.floor(across)) % 2
    if texture.kind == "stripes":
        # Bands that waver slowly along their length, like the grain of wood.
        place = across + 0.6 * _noise(along / 8, across / 2, texture.seed)
        return np.abs(place % 2 - 1)
    return (
        2 * _noise(along, across, texture.seed) + _noise(3 * along, 3 * across, texture.seed)
    ) / 3


def _noise(u: np.ndarray, v: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in 0..1: hashed values at whole numbers, blended between them."""
    i, j = np.floor(u), np.floor(v)
    a, b = u - i, v - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    i, j = i.astype(np.int64), j.astype(np.int64)
    near = _hashed(i, j, seed) * (1 - a) + _hashed(i + 1, j, seed) * a
    far = _hashed(i, j + 1, seed) * (1 - a) + _hashed(i + 1, j + 1, seed) * a
    return near * (1 - b) + far * b


def _hashed(i: np.ndarray, j: np.ndarray, seed: int) -> np.ndarray:
    """A number in [0, 1) for each lattice point: multiply, fold, multiply (as murmur3 ends)."""
    mixed = i.astype(np.uint32) * np.uint32(0x9E3779B1)
    mixed ^= j.astype(np.uint32) * np.uint32(0x85EBCA77)
    mixed += np.uint32(seed)
    for factor in (0x85EBCA6B, 0xC2B2AE35):
        mixed ^= mixed >> np.uint32(15)
        mixed *= np.uint32(factor)
    mixed ^= mixed >> np.uint32(16)
    return mixed / 2**32
