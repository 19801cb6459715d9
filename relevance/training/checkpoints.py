"""Checkpoints: files that carry their own hash and id, their rows, and how one is found.

A file is one line of JSON (version, kind, sha256 of the rest), then what `torch.save` wrote: a
changed, cut or foreign file is refused before anything in it is interpreted, and what is
interpreted is tensors and plain values only. The name of a file means nothing; its id is inside.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from relevance.errors import RelevanceError
from relevance.hashing import content_hash
from relevance.models import RelevanceModel
from relevance.store import Dataset, DatasetError, locate, replacing
from relevance.training.settings import TrainConfig

CHECKPOINT_VERSION = 2
"""Version of checkpoint files; a file of another version is refused."""
_START = b"relevance-checkpoint "


class CheckpointError(RelevanceError):
    """A file that is no checkpoint of this version: says which file, found and expected."""


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


def checkpoint_id(dataset: Dataset, config: TrainConfig) -> str:
    """Name of what these settings make of this data: labels of their policy, training split."""
    return f"{config.model.body}-{content_hash([config.content_hash, data_hash(dataset, config)])}"


def data_hash(dataset: Dataset, config: TrainConfig) -> str:
    """Hash of the labels and images that would be trained on."""
    return dataset.content_hash(policy=config.policy, split="train")


def save_checkpoint(path: Path, model: RelevanceModel, meta: Mapping[str, Any]) -> None:
    """Write a model and what is known of it; the file exists whole or not at all."""
    content = {"meta": {**meta, "predicates": list(model.predicates)}, "model": model.state_dict()}
    write_file(path, "checkpoint", content)


def load_checkpoint(
    path: str | Path, device: str | torch.device = "auto"
) -> tuple[RelevanceModel, dict[str, Any]]:
    """Read a model, ready to score, and what is known of it (id, config, metrics, history).

    The name of a model that comes with the package (see `shipped`) serves as a path. Raises
    CheckpointError in one line for anything but a whole file of this version.
    """
    path = named(path)
    where = pick_device(device) if isinstance(device, str) else device
    content = read_file(path, "checkpoint", where)
    try:
        meta = content["meta"]
        config = TrainConfig.from_dict(meta["config"])
        model = RelevanceModel(config.model, meta["predicates"])
        model.load_state_dict(content["model"])
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


def named(path: str | Path) -> Path:
    """The file, where there is one, else the model of that name that comes with the package."""
    file = locate(path)
    return file if file.exists() else shipped().get(str(path), file)


def shipped() -> dict[str, Path]:
    """The models that come with the package, by name."""
    package = Path(__file__).parents[1]
    installed, checkout = package / "shipped", package.parent / "data" / "models"
    folder = installed if installed.is_dir() else checkout
    return {file.stem: file for file in sorted(folder.glob("*.pt"))}


def write_file(path: Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values under a header with their hash."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    body = buffer.getvalue()
    header = {
        "version": CHECKPOINT_VERSION,
        "kind": kind,
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    with replacing(path) as temporary:
        temporary.write_bytes(_START + json.dumps(header).encode() + b"\n" + body)


def read_file(path: Path, kind: str, device: torch.device) -> dict[str, Any]:
    """Read what `write_file` wrote; raises CheckpointError for any other bytes."""
    wanted = f"expected a {kind} of version {CHECKPOINT_VERSION}"
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file, {wanted}") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}), {wanted}") from None
    line, _, body = content.partition(b"\n")
    try:
        header = json.loads(line.removeprefix(_START)) if line.startswith(_START) else None
    except ValueError:
        header = None
    if not isinstance(header, dict):
        raise CheckpointError(f"{path}: not a checkpoint, {wanted}")
    if header.get("version") != CHECKPOINT_VERSION:
        raise CheckpointError(f"{path}: is of version {header.get('version')}, {wanted}")
    if header.get("kind") != kind:
        raise CheckpointError(f"{path}: holds a {header.get('kind')}, {wanted}")
    if hashlib.sha256(body).hexdigest() != header.get("sha256"):
        raise CheckpointError(f"{path}: truncated or changed after it was written, {wanted}")
    # Its hash is right, so this is what was written here; weights_only bars all but plain values
    # even so, since anyone can write a hash.
    try:
        return torch.load(io.BytesIO(body), map_location=device, weights_only=True)
    except (RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError) as error:
        reason = str(error).strip().splitlines()[0]
        raise CheckpointError(f"{path}: cannot be read ({reason[:200]}), {wanted}") from None


# --- rows -----------------------------------------------------------------------------------


def write_row(dataset: Dataset, path: Path, meta: Mapping[str, Any]) -> None:
    """The checkpoint's row in `checkpoints`; nothing to do when it is there."""
    if dataset.has("checkpoints", name=meta["checkpoint_id"]):
        return
    inside = path.resolve().is_relative_to(dataset.path.resolve())
    row = {
        "checkpoint_id": meta["checkpoint_id"],
        "body": meta["config"]["model"]["body"],
        "preset": meta["config"]["preset"],
        "seed": meta["config"]["seed"],
        "dataset_hash": meta["dataset_hash"],
        "created": datetime.fromisoformat(meta["created"]).replace(tzinfo=None),
        "path": os.path.relpath(path, dataset.path) if inside else str(path.resolve()),
        "train_seconds": meta["train_seconds"],
        "metrics": json.dumps(meta["metrics"], sort_keys=True),
        "config": json.dumps(meta["config"], sort_keys=True),
        "config_hash": meta["config_hash"],
        "offsets": json.dumps(meta.get("offsets", {}), sort_keys=True),
    }
    dataset.write_rows("checkpoints", [row], name=meta["checkpoint_id"])


def age(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """By what rows of `checkpoints` are ordered: when training ended, then the id."""
    return row["created"], row["checkpoint_id"]


def newest_checkpoint(root: str | Path) -> Path:
    """The file of the dataset's checkpoint that was made last; DatasetError when there is none."""
    dataset = Dataset.open(root)
    rows = dataset.read_rows("checkpoints")
    if not rows:
        raise DatasetError(f"{dataset.path}: no checkpoints there, expected `train` first")
    return dataset.path / max(rows, key=age)["path"]


def find_checkpoint(root: str | Path, text: str | Path | None = None) -> Path:
    """The file that is meant by an id of the dataset, a path, or nothing: then the newest.

    Raises DatasetError with the ids that there are.
    """
    if text is None:
        return newest_checkpoint(root)
    dataset = Dataset.open(root)
    rows = {row["checkpoint_id"]: row for row in dataset.read_rows("checkpoints")}
    if str(text) in rows:
        return dataset.path / rows[str(text)]["path"]
    path = named(text)
    if path.is_file():
        return path
    known = ", ".join([*rows, *shipped()]) or "none: nothing was trained yet"
    raise DatasetError(
        f"{dataset.path}: unknown checkpoint {str(text)!r}, expected a file or one of {known}"
    )
