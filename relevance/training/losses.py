"""What is minimised: the paper's weighted cross entropy, and losses that teach to look.

Shape suffixes: B scenes, N objects (padded), G goals, K looks at objects, P cells of a grid over
the image. Tensors here are small and keep plain names; their shapes are in the docstrings.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from relevance.models import GEOMETRY, RelevanceModel, Sight
from relevance.training.examples import Batch
from relevance.training.settings import TrainConfig

OBJECTS = 6.5
"""Objects of a batch that weighs 1."""


def batch_loss(model: RelevanceModel, batch: Batch, config: TrainConfig) -> dict[str, Tensor]:
    """The loss of a batch and its parts; every scene is encoded once for all its goals."""
    if batch.told:
        encoding = model.told_of(batch.present, batch.geometry)
    else:
        encoding = model.encode(batch.image, batch.views, batch.present, batch.geometry)
    parts: dict[str, Tensor] = {}
    terms, sights = [], [encoding.sight]
    for predicate, goals, relevant, labelled in batch.turns:
        if not config.goal_objects:
            objects = torch.arange(labelled.shape[-1], device=goals.device)
            labelled = labelled & (objects != goals[..., None]).all(-2)
        answer = model.answer(encoding, predicate, goals, labelled)
        terms.append(relevance_loss(answer.scores, relevant, labelled, config.eta(predicate)))
        sights.append(answer.sight)
    parts["relevance"] = torch.stack(terms).mean()
    if not config.queries_per_batch:
        # Scenes of a batch have like numbers of objects: so each query weighs the same in all.
        parts["relevance"] = parts["relevance"] * batch.present.sum(-1).float().mean() / OBJECTS
    loss = config.relevance_weight * parts["relevance"]
    parts |= _look_losses([sight for sight in sights if sight], batch)
    weights = {
        "mask": config.mask_weight,
        "attention": config.mask_weight,
        "geometry": config.geometry_weight,
    }
    for name, weight in weights.items():
        if name in parts and weight:
            loss = loss + weight * parts[name]
    return {"loss": loss, **parts}


def relevance_loss(scores: Tensor, relevant: Tensor, mask: Tensor, eta: float) -> Tensor:
    """-mean(eta z log p + (1 - eta) (1 - z) log(1 - p)) over `mask`, p = sigmoid(score).

    All of one shape; z = relevant in 0..1. The paper's formula read literally would give the
    rarer class the smaller weight; here the relevant objects weigh eta (CONTRIBUTING, The words).
    Zero when the mask is empty.
    """
    z = relevant.to(scores.dtype)
    terms = eta * z * F.logsigmoid(scores) + (1 - eta) * (1 - z) * F.logsigmoid(-scores)
    weight = mask.to(scores.dtype)
    return -(terms * weight).sum() / weight.sum().clamp(min=1)


def _look_losses(sights: Sequence[Sight], batch: Batch) -> dict[str, Tensor]:
    """How far from masks and poses objects were seen, the mean over all looks.

    mask, attention: cross entropy between where an object was seen and where the mask shows it.
    geometry: smooth L1 in decimetres, position, size and half-extents weighing the same; summed
    over the guesses.
    """
    found: dict[str, list[Tensor]] = {}
    for sight in sights:
        at = sight.scene, sight.place
        shown = _shown(batch, sight.grid)[at]
        found.setdefault("mask", []).append(_mask_loss(sight.match, shown))
        if sight.attention is not None:
            found.setdefault("attention", []).append(_mask_loss(sight.attention, shown))
        truth = batch.geometry[at]
        error = F.smooth_l1_loss(
            sight.geometry, truth.expand_as(sight.geometry), beta=0.02, reduction="none"
        )
        error = error.reshape(-1, *truth.shape).sum(0)
        parts = [error[:, a:b].mean() for a, b in ((0, 3), (3, 6), (6, GEOMETRY))]
        found.setdefault("geometry", []).append(torch.stack(parts).sum())
    return {name: torch.stack(values).mean() for name, values in found.items()}


def _shown(batch: Batch, grid: tuple[int, int]) -> Tensor:
    """How much of each cell of a grid over the image shows each object, (B, N, P)."""
    number = torch.arange(1, batch.present.shape[1] + 1, device=batch.cells.device)
    there = batch.cells[:, None] == number[:, None, None]
    return F.adaptive_avg_pool2d(there.float(), grid).flatten(2)


def _mask_loss(match: Tensor, shown: Tensor) -> Tensor:
    """Cross entropy of logits (K, P) against shares (K, P); objects that are hidden left out."""
    total = shown.sum(-1)
    each = -(match.float().log_softmax(-1) * shown).sum(-1) / total.clamp(min=1e-6)
    return each.sum() / (total > 0).sum().clamp(min=1)
