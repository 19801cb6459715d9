"""Training: polling over the predicates' datasets, checkpoints that survive a kill, metrics.

What is unusual here:

- The batch of a step is a pure function of (seed, step), so a run that was killed and started
  again ends with the same weights as one that was not; there is no sampler state to save.
- Polling is strict: the predicates take turns p0, p1, ... as in the paper. The same-plane
  predicates label the same scenes, so their consecutive turns may share one encoding
  (`share_encodings`); the order of turns is the same either way.
- Two exact symmetries of the task enlarge a small dataset: a scene in the mirror swaps
  `on-the-left` and `on-the-right`, and exchanging colour channels changes no geometry.

Shape suffixes as in `models`: B scenes, N objects (padded), G goals, K goals of a split.
"""

from __future__ import annotations

import json
import os
import pickle
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from relevance.errors import RelevanceError
from relevance.hashing import content_hash
from relevance.metrics import accuracy
from relevance.models import (
    GEOMETRY,
    ModelConfig,
    RelevanceModel,
    relevance_loss,
    vit_paper,
)
from relevance.scene import PREDICATES, Predicate
from relevance.store import Dataset, DatasetError, replacing
from relevance.training.examples import Batch, Examples, gather, in_the_mirror, load_examples

CHECKPOINT_VERSION = 1
"""Schema version of checkpoint files; a file of another version is refused."""
Progress = Callable[[int, int], None]


class CheckpointError(RelevanceError):
    """A file that is no checkpoint of this version: says which file, found and expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How a model is trained; raises ValueError that names the field on impossible settings."""

    preset: str = "custom"
    model: ModelConfig = field(default_factory=ModelConfig)
    seed: int = 0
    """Of the weights, the order of scenes and the augmentation."""
    steps: int = 1000
    """Optimiser steps."""
    scenes_per_batch: int = 16
    goals_per_scene: int = 16
    """Most goals of a scene and predicate in one batch."""
    share_encodings: bool = True
    """Consecutive turns of the same-plane predicates take the same scenes and one step."""
    learning_rate: float = 8e-4
    weight_decay: float = 0.02
    betas: tuple[float, float] = (0.9, 0.98)
    warmup: float = 0.05
    """Share of the steps over which the learning rate rises; then it falls as a cosine."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    eta_same_plane: float = 0.86
    eta_on: float = 0.66
    """Weight of the relevant objects in the loss (the paper's)."""
    relevance_weight: float = 1.0
    mask_weight: float = 0.3
    """Weight of the loss on where each object is in the image (glimpse)."""
    geometry_weight: float = 1.0
    """Weight of the loss on position, size and footprint half-extents (glimpse)."""
    mirror: bool = True
    """Show half of the batches in a mirror."""
    recolor: bool = True
    """Exchange colour channels, image and views alike."""
    policy: str = "found"
    """The label policy to learn."""
    ambiguous: bool = True
    """Whether goals with a second moved set of the same length are learned from."""
    bfloat16: Literal["auto", "on", "off"] = "auto"
    """Autocast; auto: only on processors that multiply bfloat16 (others emulate it slowly)."""
    threads: int = 0
    """CPU threads; 0 leaves torch's choice. Not part of the checkpoint's identity."""
    save_every: int = 50
    """Steps between saved states. Not part of the checkpoint's identity."""
    cache_bytes: int = 1_500_000_000
    """Decoded images up to this size stay in memory. Not part of the checkpoint's identity."""

    def __post_init__(self) -> None:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                value = getattr(self, name)
                raise ValueError(f"TrainConfig.{name} is {value!r}, expected {expected}")

        for name in ("steps", "scenes_per_batch", "goals_per_scene", "save_every"):
            require(name, getattr(self, name) >= 1, "at least 1")
        for name in ("threads", "cache_bytes", "weight_decay", "mask_weight", "geometry_weight"):
            require(name, getattr(self, name) >= 0, "at least 0")
        for name in ("learning_rate", "clip", "relevance_weight"):
            require(name, getattr(self, name) > 0, "more than 0")
        for name in ("eta_same_plane", "eta_on"):
            require(name, 0 < getattr(self, name) < 1, "between 0 and 1")
        require("warmup", 0 <= self.warmup < 1, "a share below 1")
        require("betas", all(0 <= b < 1 for b in self.betas), "two numbers in [0, 1)")
        require("bfloat16", self.bfloat16 in ("auto", "on", "off"), "auto, on or off")

    @classmethod
    def smoke(cls) -> TrainConfig:
        """Seconds: every part runs, nothing is learned."""
        model = ModelConfig(width=32, heads=2, layers=1, channels=8)
        return cls(preset="smoke", model=model, steps=8, scenes_per_batch=4, save_every=4)

    @classmethod
    def demo(cls) -> TrainConfig:
        """About five minutes on two cores.

        More steps on smaller batches learned more in the same time; exchanging colour channels
        changed nothing in so short a run. One thread, since two wait for each other as soon as a
        core is busy.
        """
        return cls(
            preset="demo",
            steps=2200,
            scenes_per_batch=4,
            goals_per_scene=3,
            recolor=False,
            threads=1,
        )

    @classmethod
    def laptop(cls) -> TrainConfig:
        """About an hour on two cores."""
        return cls(preset="laptop", steps=20_000, scenes_per_batch=8)

    @classmethod
    def paper(cls) -> TrainConfig:
        """The paper's ViT, loss weights and batch of 50; wants far more than a laptop."""
        return cls(
            preset="paper",
            model=vit_paper(),
            steps=500_000,
            scenes_per_batch=50,
            learning_rate=1e-5,
            betas=(0.9, 0.999),
            share_encodings=False,
            mirror=False,
            recolor=False,
        )

    def eta(self, predicate: Predicate) -> float:
        """The loss weight of relevant objects for this predicate."""
        return self.eta_on if predicate.stacked else self.eta_same_plane

    @property
    def content_hash(self) -> str:
        """16 hex digits that depend on all settings but those of execution."""
        same = replace(self, threads=0, save_every=1, cache_bytes=0)
        return content_hash(asdict(same))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; `from_dict` gives an equal config back."""
        return json.loads(json.dumps(asdict(self)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """Read what `to_dict` wrote; raises ValueError or TypeError on anything else."""
        model = ModelConfig.from_dict(values["model"])
        return cls(**{**values, "model": model, "betas": tuple(values["betas"])})


# --- polling: which scenes and goals a step sees ---------------------------------------


def polling(predicates: Sequence[Predicate], *, share: bool) -> list[tuple[Predicate, ...]]:
    """One round of turns p0, p1, ...: the predicates of each optimiser step, in order.

    With `share`, neighbours of one scene family make one step; the order stays the same.
    """
    if not share:
        return [(predicate,) for predicate in predicates]
    return [tuple(group) for _, group in groupby(predicates, key=lambda p: p.family)]


def draw_batch(examples: Examples, config: TrainConfig, step: int) -> Batch:
    """The batch of a step: a pure function of the examples, the config and the step.

    Step s takes group s mod n of the polling round. Each group goes through its own scenes in
    an order of its own, all of them before any comes again.
    """
    groups = polling(list(examples.goals), share=config.share_encodings)
    predicates, visit = groups[step % len(groups)], step // len(groups)
    scenes = examples.scenes(predicates)
    stream = list(PREDICATES.values()).index(predicates[0])
    wanted = np.arange(visit * config.scenes_per_batch, (visit + 1) * config.scenes_per_batch)
    epochs, places = np.divmod(wanted, len(scenes))
    orders = {
        epoch: _rng(config.seed, 1, stream, epoch).permutation(len(scenes))
        for epoch in set(epochs.tolist())
    }
    chosen = np.array([scenes[orders[e][p]] for e, p in zip(epochs, places, strict=True)])
    rng = _rng(config.seed, 2, 0, step)
    channels = rng.permutation(3) if config.recolor else None
    flip = config.mirror and bool(rng.integers(2))
    batch = gather(examples, chosen, predicates, limit=config.goals_per_scene, rng=rng)
    if channels is not None:
        order = torch.from_numpy(channels)
        batch = replace(batch, image=batch.image[:, order], views=batch.views[:, :, order])
    return in_the_mirror(batch) if flip else batch


def _rng(seed: int, purpose: int, stream: int, index: int) -> np.random.Generator:
    return np.random.Generator(
        np.random.Philox(key=seed, counter=[0, int(index), int(stream), purpose])
    )


# --- one run ------------------------------------------------------------------------------


def batch_loss(model: RelevanceModel, batch: Batch, config: TrainConfig) -> dict[str, Tensor]:
    """The loss of a batch and its parts; every scene is encoded once for all its goals."""
    encoding = model.encode(batch.image, batch.views, batch.present)
    parts: dict[str, Tensor] = {}
    terms = [
        relevance_loss(
            model.decode(encoding, predicate, goals), relevant, labelled, config.eta(predicate)
        )
        for predicate, goals, relevant, labelled in batch.turns
    ]
    parts["relevance"] = torch.stack(terms).mean()
    loss = config.relevance_weight * parts["relevance"]
    if encoding.match is not None and encoding.geometry is not None:
        parts["mask"] = _mask_loss(encoding.match, batch)
        parts["geometry"] = _geometry_loss(encoding.geometry, batch)
        loss = loss + config.mask_weight * parts["mask"]
        loss = loss + config.geometry_weight * parts["geometry"]
    return {"loss": loss, **parts}


def _mask_loss(match: Tensor, batch: Batch) -> Tensor:
    """Cross entropy between where an object was matched and where the mask shows it."""
    number = torch.arange(1, match.shape[1] + 1)[:, None]
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


class Trainer:
    """Model, optimiser and schedule of one run; `step` does one optimiser step."""

    def __init__(self, config: TrainConfig, examples: Examples) -> None:
        self.config, self.examples = config, examples
        self.done = 0
        """Steps that were taken."""
        self.seconds = 0.0
        """Wall time of those steps, over all the processes that took them."""
        self.history: list[dict[str, float]] = []
        """Loss and its parts, averaged between two entries; each with its step."""
        self._sums: dict[str, float] = {}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = RelevanceModel(config.model)
        weights = list(self.model.parameters())
        # Biases, norms and embeddings are not pulled towards zero.
        groups = [
            {"params": [w for w in weights if w.ndim >= 2], "weight_decay": config.weight_decay},
            {"params": [w for w in weights if w.ndim < 2], "weight_decay": 0.0},
        ]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=config.betas)
        self.bfloat16 = use_bfloat16(config.bfloat16)

    def rate(self, step: int) -> float:
        """Learning rate of a step: linear warm-up, then a cosine to zero."""
        rise = max(1.0, self.config.warmup * self.config.steps)
        if step < rise:
            return self.config.learning_rate * (step + 1) / rise
        share = (step - rise) / max(1.0, self.config.steps - rise)
        return self.config.learning_rate * 0.5 * (1 + float(np.cos(np.pi * min(1.0, share))))

    def step(self) -> dict[str, float]:
        """One step of the optimiser on the batch of `done`; returns the loss and its parts."""
        start = time.perf_counter()
        self.model.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate(self.done)
        batch = draw_batch(self.examples, self.config, self.done)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bfloat16):
            parts = batch_loss(self.model, batch, self.config)
        self.optimizer.zero_grad(set_to_none=True)
        parts["loss"].backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip)
        self.optimizer.step()
        self.done += 1
        self.seconds += time.perf_counter() - start
        values = {name: float(value.detach()) for name, value in parts.items()}
        self._record(values)
        return values

    def _record(self, values: dict[str, float]) -> None:
        for name, value in {**values, "steps": 1.0}.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        every = max(1, self.config.steps // 100)
        if self.done % every == 0 or self.done == self.config.steps:
            count = self._sums.pop("steps")
            means = {name: total / count for name, total in self._sums.items()}
            self.history.append({"step": float(self.done), **means})
            self._sums = {}

    def state(self) -> dict[str, Any]:
        """All that the rest of the run depends on."""
        return {
            "done": self.done,
            "seconds": self.seconds,
            "history": self.history,
            "sums": self._sums,
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from a saved `state`."""
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.done, self.seconds = state["done"], state["seconds"]
        self.history, self._sums = list(state["history"]), dict(state["sums"])


def use_bfloat16(choice: str) -> bool:
    """Whether to autocast: `auto` asks the processor for native bfloat16 arithmetic."""
    if choice != "auto":
        return choice == "on"
    ask = getattr(torch.cpu, "get_capabilities", None)  # not in the oldest supported torch
    flags = ask() if ask else {}
    return any(flags.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def train(
    root: str | Path,
    config: TrainConfig,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Train on a dataset and write ROOT/checkpoints/ID.pt and its row; returns the file.

    ID is a hash of the config and of the data. A finished run is not repeated; one that was
    killed goes on from its last saved state. `out` is another folder for the files.
    Raises DatasetError when there is nothing to learn from.
    """
    dataset = Dataset.open(root)
    data_hash = dataset.content_hash()
    checkpoint_id = f"{config.model.body}-{content_hash([config.content_hash, data_hash])}"
    folder = Path(out) if out is not None else dataset.path / "checkpoints"
    path, unfinished = folder / f"{checkpoint_id}.pt", folder / f"{checkpoint_id}.state"
    if path.exists():
        _, meta = load_checkpoint(path)
        write_row(dataset, path, meta)
        return path
    examples = _load(dataset, "train", config, folder)
    if not examples.goals:
        raise DatasetError(
            f"{dataset.path}: no labels with split train and policy {config.policy}, "
            "expected at least one labelled goal"
        )
    with _threads(config.threads):
        trainer = Trainer(config, examples)
        if unfinished.exists():
            trainer.resume(_read(unfinished, "state")["state"])
        while trainer.done < config.steps:
            trainer.step()
            if progress:
                progress(trainer.done, config.steps)
            if trainer.done % config.save_every == 0 and trainer.done < config.steps:
                _save(unfinished, {"kind": "state", "state": trainer.state()})
        del examples
        trainer.examples = _load(dataset, "validation", config, folder)
        metrics = measure(trainer.model, trainer.examples)
    meta = {
        "checkpoint_id": checkpoint_id,
        "config": config.to_dict(),
        "config_hash": config.content_hash,
        "dataset_hash": data_hash,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "train_seconds": trainer.seconds,
        "bfloat16": trainer.bfloat16,
        "parameters": sum(p.numel() for p in trainer.model.parameters()),
        "metrics": metrics,
        "history": trainer.history,
    }
    _save(path, {"kind": "checkpoint", "meta": meta, "model": trainer.model.state_dict()})
    write_row(dataset, path, meta)
    unfinished.unlink(missing_ok=True)
    return path


def _load(dataset: Dataset, split: str, config: TrainConfig, folder: Path) -> Examples:
    return load_examples(
        dataset,
        split,
        camera=config.model.camera,
        policy=config.policy,
        ambiguous=config.ambiguous,
        cache_bytes=config.cache_bytes,
        folder=folder,
    )


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def write_row(dataset: Dataset, path: Path, meta: Mapping[str, Any]) -> None:
    """Give a dataset the row of a checkpoint; nothing to do when it is there."""
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
    }
    dataset.write_rows("checkpoints", [row], name=meta["checkpoint_id"])


def _save(path: Path, content: dict[str, Any]) -> None:
    with replacing(path) as temporary:
        torch.save({"version": CHECKPOINT_VERSION, **content}, temporary)


def _read(path: Path, kind: str) -> dict[str, Any]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file, expected a checkpoint") from None
    except (RuntimeError, EOFError, OSError, pickle.UnpicklingError, zipfile.BadZipFile):
        raise CheckpointError(
            f"{path}: truncated or not a checkpoint, expected a file of schema version "
            f"{CHECKPOINT_VERSION}"
        ) from None
    version = content.get("version") if isinstance(content, dict) else None
    if version != CHECKPOINT_VERSION:
        raise CheckpointError(
            f"{path}: schema version {version}, expected schema version {CHECKPOINT_VERSION}"
        )
    if content.get("kind") != kind:
        raise CheckpointError(f"{path}: holds a {content.get('kind')}, expected a {kind}")
    return content


def load_checkpoint(path: str | Path) -> tuple[RelevanceModel, dict[str, Any]]:
    """Read a model, ready to score, and what is known of it (config, metrics, hashes, history).

    Raises CheckpointError in one line for a missing or truncated file or another version.
    """
    path = Path(path)
    content = _read(path, "checkpoint")
    try:
        config = TrainConfig.from_dict(content["meta"]["config"])
        model = RelevanceModel(config.model)
        model.load_state_dict(content["model"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"{path}: its config does not fit its weights or this version ({reason[:200]}), "
            f"expected a checkpoint of schema version {CHECKPOINT_VERSION}"
        ) from None
    return model.eval(), content["meta"]


# --- metrics ------------------------------------------------------------------------------


def measure(model: RelevanceModel, examples: Examples, batch: int = 16) -> dict[str, Any]:
    """Metrics per predicate on all goals of the examples, at beta = 0; see `accuracy`.

    `queries` leaves subject and reference out, `with_goal_objects` has them; `whole_goals` is
    the share of goals with every query right. `same-plane` pools its four predicates.
    """
    model.eval()
    pooled: dict[str, list[tuple[np.ndarray, ...]]] = {}
    with torch.inference_mode():
        for predicate in examples.goals:
            scenes = examples.scenes([predicate])
            for start in range(0, len(scenes), batch):
                drawn = gather(examples, scenes[start : start + batch], [predicate])
                encoding = model.encode(drawn.image, drawn.views, drawn.present)
                ((_, goals, relevant, labelled),) = drawn.turns
                score = model.decode(encoding, predicate, goals)
                asked = torch.arange(score.shape[-1])[:, None] != goals[..., None, :]
                arrays = (score, relevant, labelled, asked.all(-1))
                rows = tuple(array.flatten(0, 1).numpy() for array in arrays)
                for name in {predicate.name, predicate.family}:
                    pooled.setdefault(name, []).append(rows)
    return {name: _metrics(parts) for name, parts in sorted(pooled.items())}


def _metrics(parts: list[tuple[np.ndarray, ...]]) -> dict[str, Any]:
    goals = [goal for part in parts for goal in zip(*part, strict=True) if goal[2].any()]
    right = [
        bool((((score > 0) == relevant) | ~(labelled & query)).all())
        for score, relevant, labelled, query in goals
    ]
    score, relevant, query = (
        np.concatenate([goal[i][goal[2]] for goal in goals]) for i in (0, 1, 3)
    )
    return {
        "goals": len(goals),
        "whole_goals": float(np.mean(right)),
        "queries": accuracy(score[query], relevant[query]),
        "with_goal_objects": accuracy(score, relevant),
    }
