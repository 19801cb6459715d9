"""A tiny dataset that went through every stage, made once for the tests that read one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

from conftest import shared

from relevance.evaluation import EvaluationConfig, evaluate, predict
from relevance.pipeline import (
    Counts,
    DatasetConfig,
    generate_shard,
    label_shard,
    prepare,
)
from relevance.sampling import SceneConfig
from relevance.training import TrainConfig, train

DATA = DatasetConfig(
    seed=6,
    train=Counts(same_plane=2, on=2),
    validation=Counts(same_plane=1, on=1),
    test=Counts(same_plane=3, on=3),
    scenes_per_shard=3,
    goals_per_scene=2,
    scene=SceneConfig(max_objects=6),
)
TRAINING = replace(TrainConfig.smoke(), steps=2, threads=1)
EVALUATION = EvaluationConfig(tasks=3, sweep_tasks=2, betas=(-50.0, 50.0))


def label(root: Path) -> Path:
    """Scenes, images, plans and labels."""
    for spec in prepare(root, DATA):
        generate_shard(root, DATA, spec)
        for predicate in spec.predicates:
            label_shard(root, DATA, spec, predicate)
    return root


@cache
def labelled() -> Path:
    """A dataset without a checkpoint; read only."""
    return shared("labelled", label)


@cache
def evaluated() -> tuple[Path, Path]:
    """A dataset with predictions and reruns, and its checkpoint; read only."""
    root = shared("evaluated", _evaluate)
    [checkpoint] = (root / "checkpoints").glob("*.pt")
    return root, checkpoint


def _evaluate(root: Path) -> None:
    label(root)
    checkpoint = train(root, TRAINING)
    predict(root, checkpoint)
    evaluate(root, checkpoint, EVALUATION)
