"""What is in the way (`relevance.networks.obstruction`), for batches of tensors.

It is reckoned on the processor, and no gradient goes through it: holds and places are chosen.

Shape suffixes: B scenes, N objects (padded), G goals.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from relevance.networks import obstruction
from relevance.scene import Predicate


def obstructed_picks(geometry: Tensor, present: Tensor) -> Tensor:
    """Of each object (column) what it is to a pick of each other (row), (B, N, N, OBSTRUCTION).

    geometry (B, N, GEOMETRY), decimetres; present (B, N) bool.
    """
    found = obstruction.obstructed_picks(*_numbers(geometry, present))
    return torch.from_numpy(found).to(geometry.device)


def obstructed_goals(
    geometry: Tensor, present: Tensor, predicate: Predicate, goals: Tensor
) -> Tensor:
    """Of each object what it is to the subject's place at each goal (B, G, 2), (B, G, N,
    OBSTRUCTION)."""
    where, there = _numbers(geometry, present)
    found = obstruction.obstructed_goals(where, there, predicate, goals.cpu().numpy())
    return torch.from_numpy(found).to(geometry.device)


def _numbers(geometry: Tensor, present: Tensor) -> tuple[np.ndarray, np.ndarray]:
    return geometry.detach().float().cpu().numpy(), present.cpu().numpy()
