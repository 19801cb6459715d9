"""Checkpoint files, read without torch: they carry their own hash, version and id.

A file is one line of JSON (version, kind, sha256 of the rest), then an npz archive: what is known
of the network (JSON), its weights, and the graphs that run it without torch. A changed, cut or
foreign file is refused before anything in it is interpreted.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from relevance.errors import RelevanceError
from relevance.store import locate, replacing

CHECKPOINT_VERSION = 3
"""Version of checkpoint files."""
_START = b"relevance-checkpoint "
_META, _WEIGHT, _GRAPH = "meta", "weight/", "graph/"


class CheckpointError(RelevanceError):
    """A file that is no checkpoint of this version: says which file, found and expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """What a checkpoint file holds."""

    meta: dict[str, Any]
    """Plain JSON: id, config, predicates, metrics, ..."""
    weights: Mapping[str, np.ndarray]
    """By the names that torch has for them."""
    graphs: Mapping[str, bytes] = field(default_factory=dict)
    """Those that a `GraphNetwork` has, by name; none where a body keeps torch."""


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; the file exists whole or not at all."""
    parts = {_META: np.frombuffer(json.dumps(checkpoint.meta).encode(), np.uint8)}
    parts |= {_WEIGHT + name: values for name, values in checkpoint.weights.items()}
    for name, graph in checkpoint.graphs.items():
        parts[_GRAPH + name] = np.frombuffer(graph, np.uint8)
    body = io.BytesIO()
    # Halved weights hardly shrink, graphs do, by four.
    np.savez_compressed(body, **parts)  # pyright: ignore[reportArgumentType]
    frame(path, "checkpoint", CHECKPOINT_VERSION, body.getvalue())


def read_checkpoint(path: Path) -> Checkpoint:
    """Read what `write_checkpoint` wrote; raises CheckpointError for any other bytes."""
    body = unframe(path, "checkpoint", CHECKPOINT_VERSION)
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as parts:
            found = {name: parts[name] for name in parts.files}
        meta = json.loads(found.pop(_META).tobytes())
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"{path}: cannot be read ({reason[:200]}), "
            f"expected a checkpoint of version {CHECKPOINT_VERSION}"
        ) from None
    return Checkpoint(
        meta=meta,
        weights={
            name.removeprefix(_WEIGHT): values
            for name, values in found.items()
            if name.startswith(_WEIGHT)
        },
        graphs={
            name.removeprefix(_GRAPH): values.tobytes()
            for name, values in found.items()
            if name.startswith(_GRAPH)
        },
    )


def frame(path: Path, kind: str, version: int, body: bytes) -> None:
    """Write bytes under a header with their version, kind and hash."""
    header = {"version": version, "kind": kind, "sha256": hashlib.sha256(body).hexdigest()}
    with replacing(path) as temporary:
        temporary.write_bytes(_START + json.dumps(header).encode() + b"\n" + body)


def unframe(path: Path, kind: str, version: int) -> bytes:
    """The bytes that `frame` wrote; raises CheckpointError for any other."""
    wanted = f"expected a {kind} of version {version}"
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        models = f" or one of {', '.join(shipped())}" if kind == "checkpoint" else ""
        raise CheckpointError(f"{path}: no such file, {wanted}{models}") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}), {wanted}") from None
    line, _, body = content.partition(b"\n")
    try:
        header = json.loads(line.removeprefix(_START)) if line.startswith(_START) else None
    except ValueError:
        header = None
    if not isinstance(header, dict):
        raise CheckpointError(f"{path}: not a checkpoint, {wanted}")
    if header.get("kind") != kind:
        raise CheckpointError(f"{path}: holds a {header.get('kind')}, {wanted}")
    if header.get("version") != version:
        raise CheckpointError(f"{path}: is of version {header.get('version')}, {wanted}")
    if hashlib.sha256(body).hexdigest() != header.get("sha256"):
        raise CheckpointError(f"{path}: truncated or changed after it was written, {wanted}")
    return body


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
