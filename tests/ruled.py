"""A dataset with real scenes and images, labelled by a rule that needs no planner."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from relevance.pipeline import Counts, DatasetConfig, generate_shard, prepare
from relevance.sampling import SceneConfig, sample_goals
from relevance.scene import PREDICATES
from relevance.store import Dataset

DATA = DatasetConfig(
    seed=5,
    train=Counts(same_plane=6, on=4),
    validation=Counts(same_plane=2, on=2),
    scenes_per_shard=4,
    scene=SceneConfig(max_objects=5),
)


def label(dataset: Dataset) -> None:
    """Labels by a rule that needs no planner: the subject, and what stands within 20 cm of it."""
    for predicate in PREDICATES.values():
        for split in ("train", "validation"):
            for shard in shards_of_family(dataset, split, predicate.family):
                rows = []
                for sample in dataset.samples(split, [shard]):
                    scene = sample.scene
                    for goal in sample_goals(scene, predicate, 2, seed=1):
                        middle = np.array(scene[goal.subject].position)
                        for box in scene.objects:
                            near = np.linalg.norm(np.array(box.position) - middle) < 0.2
                            names = {"subject": goal.subject, "reference": goal.reference}
                            rows.append(
                                {
                                    "plan_id": f"{scene.id}-{goal}",
                                    "scene_id": scene.id,
                                    "split": split,
                                    "shard": shard,
                                    "predicate": predicate.name,
                                    **names,
                                    "query": box.name,
                                    "relevant": bool(near and box.name != goal.reference),
                                    "is_goal_object": box.name in names.values(),
                                    "ambiguous": goal.subject == scene.names[0],
                                    "policy": "found",
                                    "visible_fraction": 1.0,
                                    "planner_version": "rule",
                                    "config_hash": "rule",
                                }
                            )
                dataset.write_rows(
                    "labels", rows, split=split, shard=shard, predicate=predicate.name
                )


def shards_of_family(dataset: Dataset, split: str, family: str) -> list[int]:
    """Numbers of the shards that hold scenes of a family."""
    listed = dataset.description["shards"]
    return [s["shard"] for s in listed if (s["split"], s["family"]) == (split, family)]


@cache
def ruled() -> Path:
    """Real scenes and images in real shards, rule-made labels; read only."""
    _FOLDERS.append(tempfile.TemporaryDirectory())  # lives until the process ends
    root = Path(_FOLDERS[-1].name) / "ruled"
    for spec in prepare(root, DATA):
        generate_shard(root, DATA, spec)
    label(Dataset.open(root))
    return root


_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []
