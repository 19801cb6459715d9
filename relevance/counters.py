"""Random numbers that depend on counters alone: who draws, and in what order, is nothing."""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, stream: str, index: int = 0, attempt: int = 0) -> np.random.Generator:
    """A generator of its own for each counter; Philox counts up in the first word."""
    word = int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8], "little")
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, attempt, index, word]))
