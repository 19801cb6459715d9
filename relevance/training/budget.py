"""How many steps fit into some time of one core: a few are taken, on the data itself."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from relevance.models import RelevanceModel
from relevance.store import Dataset
from relevance.training.catalogue import Catalogue
from relevance.training.settings import TrainConfig
from relevance.training.trainer import Trainer, on_threads, reader_for

_SHARE = 0.02
"""Part of the time that is spent on measuring, beyond the first round."""


def one_core(config: TrainConfig, device: str = "cpu") -> TrainConfig:
    """The same on one thread that also reads, so that a process' time is all there is to count."""
    return replace(config, device=device, threads=1, workers=0)


def steps_within(root: str | Path, config: TrainConfig, seconds: float, device: str = "cpu") -> int:
    """Steps of these settings that one core takes in so many seconds; those of `config` mean
    nothing. Reading is in, what comes before the first step and after the last one is not.

    The first round of turns fills what scenes are drawn from; it is paid once.
    """
    config = one_core(replace(config, steps=10**9), device)
    dataset = Dataset.open(root)
    first, each, turns = _costs(dataset, replace(config, told_share=0.0), seconds)
    if config.told_share and RelevanceModel(config.model).tellable:
        _, told, _ = _costs(dataset, replace(config, told_share=1 - 1e-6), seconds)
        each = config.told_share * told + (1 - config.told_share) * each
    return turns + max(0, int((seconds - first) / each))


def _costs(dataset: Dataset, config: TrainConfig, seconds: float) -> tuple[float, float, int]:
    """Seconds of the first round of turns and of each later step, and the steps of a round."""
    catalogue = Catalogue.of(dataset, "train", config)
    turns = len(catalogue.groups if config.share_encodings else catalogue.predicates)
    with on_threads(1):
        trainer = Trainer(config, catalogue.predicates)
        with closing(reader_for(catalogue, trainer).steps()) as steps:
            began = time.process_time()

            def a_round() -> float:
                for _ in range(turns):
                    trainer.take(steps)
                return time.process_time() - began

            first = now = a_round()
            while now < first + _SHARE * seconds or trainer.done == turns:
                now = a_round()
    return first, (now - first) / (trainer.done - turns), turns
