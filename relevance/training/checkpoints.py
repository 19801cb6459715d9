"""Checkpoints as models: written with their graphs, read, and entered in a dataset.

The name of a file means nothing; its id is inside (`relevance.networks`).
"""

from __future__ import annotations

import io
import json
import os
import pickle
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from relevance.errors import RelevanceError, RelevanceWarning
from relevance.hashing import content_hash
from relevance.models import PATCH, RelevanceModel, export_graphs
from relevance.networks import (
    CHECKPOINT_VERSION,
    GEOMETRY,
    Checkpoint,
    CheckpointError,
    GraphNetwork,
    Network,
    frame,
    named,
    read_checkpoint,
    unframe,
    write_checkpoint,
)
from relevance.scene import PREDICATES
from relevance.store import Dataset, is_remote
from relevance.training.settings import TrainConfig

STATE_VERSION = 3
"""Version of the files of unfinished runs."""
SAME = 3e-5
"""How far scores of a graph may be from those in torch, as a share of the largest."""


def pick_device(choice: str = "auto") -> torch.device:
    """The device of that name; `auto` is the accelerator if there is one.

    Raises RelevanceError for a device that is not there.
    """
    if choice == "auto":
        if torch.accelerator.is_available() and (found := torch.accelerator.current_accelerator()):
            return found
        return torch.get_default_device()
    try:
        return torch.zeros(0, device=choice).device
    except (RuntimeError, AssertionError) as error:  # torch has no one error for it
        reason = str(error).strip().splitlines()[0]
        raise RelevanceError(f"device {choice!r}: cannot be used here ({reason})") from None


def device_name(device: torch.device) -> str:
    """What trains there, in words."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type.upper()


def checkpoint_id(dataset: Dataset, config: TrainConfig) -> str:
    """Name of what these settings make of this data: labels of their policy, training split."""
    return id_of(config, data_hash(dataset, config))


def id_of(config: TrainConfig, data: str) -> str:
    """The same for data of a known hash."""
    return f"{config.model.body}-{content_hash([config.content_hash, data])}"


def data_hash(dataset: Dataset, config: TrainConfig) -> str:
    """Hash of the labels and images that would be trained on."""
    return dataset.content_hash(policy=config.policy, split="train")


def save_checkpoint(path: Path, model: RelevanceModel, meta: Mapping[str, Any]) -> None:
    """Write a model, what is known of it, and the graphs that run it without torch.

    A body of which no graph can be made keeps torch; a RelevanceWarning says why.
    """
    known = {**meta, "predicates": list(model.predicates)}
    weights = {name: value.cpu().numpy() for name, value in model.state_dict().items()}
    made = Checkpoint(meta=known, weights=weights)
    if model.body.traced:
        try:
            made = replace(made, graphs=export_graphs(model))
            check_graphs(model, GraphNetwork(made, path))
        except Exception as error:  # whatever a body is made of, its checkpoint is not lost
            made = replace(made, graphs={})
            reason = " ".join(str(error).split())
            warnings.warn(
                f"{path}: no graph of body {model.body_name} ({reason[:200]}), it will guide in "
                "torch",
                RelevanceWarning,
                stacklevel=2,
            )
    write_checkpoint(path, made)


def check_graphs(model: RelevanceModel, graphs: Network, sizes: Sequence[int] = (2, 5)) -> None:
    """Raise CheckpointError unless graphs score made-up scenes of these sizes as their model does,
    to SAME of its largest score.

    Weights that are not finite have no scores to compare.
    """
    rng, camera = np.random.default_rng(0), model.camera
    # Blots, of which every view shows some: what is nowhere, as in noise, is sought everywhere.
    blots = rng.integers(0, 256, (camera.height // 16, camera.width // 16, 3), np.uint8)
    image = cv2.resize(blots, (camera.width, camera.height))
    plain = deepcopy(model).to("cpu").float().eval()
    for count in sizes:
        corners = rng.integers(0, [camera.height - PATCH, camera.width - PATCH], (count, 2))
        views = np.stack([image[r : r + PATCH, c : c + PATCH] for r, c in corners])
        poses = rng.uniform(0, 3, (count, GEOMETRY)).astype(np.float32) if model.told else None
        goals = np.array([[0, 1], [1, 0], [count - 1, 0]])
        mine, its = plain.look(image, views, poses), graphs.look(image, views, poses)
        for name in model.predicates:
            expected = plain.judge(mine, PREDICATES[name], goals)
            found = graphs.judge(its, PREDICATES[name], goals)
            # Rounding grows with what a well trained network multiplies, so with its scores.
            near = SAME * max(1.0, float(np.abs(expected).max(initial=0.0)))
            if not np.allclose(found, expected, rtol=0, atol=near, equal_nan=True):
                off = np.abs(found - expected).max()
                raise CheckpointError(f"its scores for {name} are off by {off:.2g}")


def load_checkpoint(
    path: str | Path, device: str | torch.device = "auto"
) -> tuple[RelevanceModel, dict[str, Any]]:
    """Read a model, ready to score, and what is known of it (id, config, metrics, history).

    The name of a model that comes with the package (see `shipped`) serves as a path. Raises
    CheckpointError in one line for anything but a whole file of this version.
    """
    path = named(path)
    where = pick_device(device) if isinstance(device, str) else device
    found = read_checkpoint(path)
    meta = found.meta
    try:
        config = TrainConfig.from_dict(meta["config"])
        model = RelevanceModel(config.model, meta["predicates"])
        weights = {name: torch.from_numpy(values) for name, values in found.weights.items()}
        model.load_state_dict(weights)
        name = meta["checkpoint_id"]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"{path}: its config does not fit its weights or this version ({reason[:200]}), "
            f"expected a checkpoint of version {CHECKPOINT_VERSION}"
        ) from None
    for weight, values in model.state_dict().items():
        if not torch.isfinite(values).all():
            raise CheckpointError(f"{path}: {name}: {weight} is not finite, expected numbers")
    return model.to(where).eval(), meta


def write_file(path: Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values under a header with their hash."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    frame(path, kind, STATE_VERSION, buffer.getvalue())


def read_file(path: Path, kind: str, device: torch.device) -> dict[str, Any]:
    """Read what `write_file` wrote; raises CheckpointError for any other bytes."""
    body = unframe(path, kind, STATE_VERSION)
    # Its hash is right, so this is what was written here; weights_only bars all but plain values
    # even so, since anyone can write a hash.
    try:
        return torch.load(io.BytesIO(body), map_location=device, weights_only=True)
    except (RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError) as error:
        reason = str(error).strip().splitlines()[0]
        raise CheckpointError(
            f"{path}: cannot be read ({reason[:200]}), expected a {kind} of version {STATE_VERSION}"
        ) from None


# --- rows -----------------------------------------------------------------------------------


def write_row(dataset: Dataset, path: Path, meta: Mapping[str, Any]) -> None:
    """The checkpoint's row in `checkpoints`; nothing to do when it is there."""
    if dataset.has("checkpoints", name=meta["checkpoint_id"]):
        return
    row = {
        "checkpoint_id": meta["checkpoint_id"],
        "body": meta["config"]["model"]["body"],
        "preset": meta["config"]["preset"],
        "seed": meta["config"]["seed"],
        "dataset_hash": meta["dataset_hash"],
        "created": datetime.fromisoformat(meta["created"]).replace(tzinfo=None),
        "path": _told(dataset, path),
        "train_seconds": meta["train_seconds"],
        "metrics": json.dumps(meta["metrics"], sort_keys=True),
        "config": json.dumps(meta["config"], sort_keys=True),
        "config_hash": meta["config_hash"],
        "offsets": json.dumps(meta.get("offsets", {}), sort_keys=True),
    }
    dataset.write_rows("checkpoints", [row], name=meta["checkpoint_id"])


def _told(dataset: Dataset, path: Path) -> str:
    """Where a checkpoint lies: within the dataset, if it does, else anywhere."""
    if is_remote(path):
        return str(path).removeprefix(f"{dataset.path}/")
    whole = path.resolve()
    if not is_remote(dataset.path) and whole.is_relative_to(dataset.path.resolve()):
        return os.path.relpath(path, dataset.path)
    return str(whole)
