"""Processes that train together: those that `torchrun` started, or one alone.

Each learns from its share of every batch; gradients are averaged, so all have the same weights.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed
from torch.nn import Parameter


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranks:
    """This process among those that train together."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it is the one that writes."""
        return self.rank == 0

    def device(self, chosen: torch.device) -> torch.device:
        """The chosen device; of several accelerators of a machine, each process takes its own."""
        if self.count == 1 or chosen.type == "cpu" or chosen.index:
            return chosen
        return torch.device(chosen.type, int(os.environ.get("LOCAL_RANK", "0")))

    def means(self, values: Sequence[Tensor]) -> list[float]:
        """Each value, averaged over the processes."""
        found = torch.stack([value.detach().float() for value in values])
        if self.count > 1:
            distributed.all_reduce(found)
        return (found / self.count).tolist()

    def share_gradients(self, weights: Iterable[Parameter]) -> None:
        """Make every gradient the mean of those of all processes."""
        if self.count == 1:
            return
        gradients = [weight.grad for weight in weights if weight.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        distributed.all_reduce(flat)
        parts = (flat / self.count).split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def all(self, names: Sequence[str]) -> list[str]:
        """The names of all processes."""
        found: list[Sequence[str]] = [names]
        if self.count > 1:
            found = [[]] * self.count
            distributed.all_gather_object(found, names)
        return [name for own in found for name in own]

    def totals(self, counts: Mapping[str, int]) -> dict[str, int]:
        """Counts by name, summed over the processes, of which each may have met other names."""
        found: list[Mapping[str, int]] = [counts]
        if self.count > 1:
            found = [{}] * self.count
            distributed.all_gather_object(found, counts)
        total = Counter[str]()
        for own in found:
            total.update(own)
        return dict(total)

    def wait(self) -> None:
        """Wait until all are here."""
        if self.count > 1:
            distributed.barrier()


ALONE = Ranks()


@contextmanager
def together() -> Iterator[Ranks]:
    """The processes that torchrun started with this one; this one alone without it."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield ALONE
        return
    if torch.accelerator.is_available():
        torch.accelerator.set_device_index(int(os.environ.get("LOCAL_RANK", "0")))
    distributed.init_process_group()  # nccl between accelerators, gloo between processors
    try:
        yield Ranks(rank=distributed.get_rank(), count=distributed.get_world_size())
    finally:
        distributed.destroy_process_group()
