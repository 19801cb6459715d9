"""What is minimised: the paper's weighted cross entropy, and two losses that teach to look.

Shape suffixes: B scenes, N objects (padded), G goals, h and w height and width of the stride-4
feature map. Tensors here are small and keep plain names; their shapes are in the docstrings.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from relevance.models import GEOMETRY, RelevanceModel
from relevance.training.examples import Batch
from relevance.training.settings import TrainConfig


def batch_loss(model: RelevanceModel, batch: Batch, config: TrainConfig) -> dict[str, Tensor]:
    """The loss of a batch and its parts; every scene is encoded once for all its goals."""
    encoding = model.encode(batch.image, batch.views, batch.present, batch.geometry)
    parts: dict[str, Tensor] = {}
    terms = []
    for predicate, goals, relevant, labelled in batch.turns:
        if not config.goal_objects:
            objects = torch.arange(labelled.shape[-1], device=goals.device)
            labelled = labelled & (objects != goals[..., None]).all(-2)
        scores = model.decode(encoding, predicate, goals, labelled)
        terms.append(relevance_loss(scores, relevant, labelled, config.eta(predicate)))
    parts["relevance"] = torch.stack(terms).mean()
    loss = config.relevance_weight * parts["relevance"]
    if encoding.match is not None and encoding.geometry is not None:
        parts["mask"] = _mask_loss(encoding.match, batch)
        parts["geometry"] = _geometry_loss(encoding.geometry, batch)
        loss = loss + config.mask_weight * parts["mask"]
        loss = loss + config.geometry_weight * parts["geometry"]
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


def _mask_loss(match: Tensor, batch: Batch) -> Tensor:
    """Cross entropy between where an object was matched and where the mask shows it."""
    number = torch.arange(1, match.shape[1] + 1, device=match.device)[:, None]
    there = (batch.cells.flatten(1)[:, None] == number) & batch.present[..., None]
    count = there.sum(-1)
    each = -(match.log_softmax(-1) * there).sum(-1) / count.clamp(min=1)
    return each.sum() / (count > 0).sum().clamp(min=1)


def _geometry_loss(geometry: Tensor, batch: Batch) -> Tensor:
    """Smooth L1 in decimetres, position, size and half-extents weighing the same."""
    error = F.smooth_l1_loss(geometry, batch.geometry, beta=0.1, reduction="none")
    parts = [error[..., a:b].mean(-1) for a, b in ((0, 3), (3, 6), (6, GEOMETRY))]
    each = torch.stack(parts).sum(0) * batch.present
    return each.sum() / batch.present.sum().clamp(min=1)
