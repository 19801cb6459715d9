"""One run: model, optimiser and schedule; a killed one goes on where it was saved.

The batch of a step is a pure function of (seed, step), so a run that was killed and started
again ends with the same weights as one that was not; there is no sampler state to save.

Shape suffixes: B scenes, N objects (padded), G goals.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from relevance.errors import RelevanceError
from relevance.metrics import accuracy
from relevance.models import RelevanceModel
from relevance.scene import PREDICATES, group_of
from relevance.store import Dataset, DatasetError, locate
from relevance.training.checkpoints import (
    CheckpointError,
    checkpoint_id,
    data_hash,
    find_checkpoint,
    load_checkpoint,
    pick_device,
    read_file,
    save_checkpoint,
    write_file,
    write_row,
)
from relevance.training.decision import offsets, yaws
from relevance.training.examples import Examples, draw_batches, gather, load_examples
from relevance.training.losses import batch_loss
from relevance.training.settings import TrainConfig

Progress = Callable[[int, int], None]


class TrainingError(RelevanceError):
    """A run that cannot go on: says at which step, on which scenes."""


class Trainer:
    """Model, optimiser and schedule of one run; `step` does one optimiser step."""

    def __init__(
        self, config: TrainConfig, examples: Examples, start: RelevanceModel | None = None
    ) -> None:
        self.config, self.examples = config, examples
        self.done = 0
        """Steps that were taken."""
        self.seconds = 0.0
        """Wall time of those steps, over all the processes that took them."""
        self.history: list[dict[str, float]] = []
        """Loss and its parts, averaged between two entries; each with its step."""
        self._sums: dict[str, float] = {}
        self.device = pick_device(config.device)
        # Weights are drawn before they move: equal ones on every device.
        learned = trained_predicates(examples, config)
        known = start.predicates if start else ()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = RelevanceModel(config.model, (*known, *learned))
        if start:
            self.model.load_state_dict({**self.model.state_dict(), **start.state_dict()})
            for name, weight in self.model.named_parameters():
                # What belongs to a predicate alone has its name in its own.
                weight.requires_grad_(not set(learned).isdisjoint(name.split(".")))
        self.model.to(self.device)
        weights = [weight for weight in self.model.parameters() if weight.requires_grad]
        # Biases, norms and embeddings are not pulled towards zero.
        groups = [
            {"params": [w for w in weights if w.ndim >= 2], "weight_decay": config.weight_decay},
            {"params": [w for w in weights if w.ndim < 2], "weight_decay": 0.0},
        ]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=config.betas)
        self.bfloat16 = use_bfloat16(config.bfloat16, self.device)

    def rate(self, step: int) -> float:
        """Learning rate of a step: linear warm-up, then a cosine to zero or no change."""
        rise = max(1.0, self.config.warmup * self.config.steps)
        if step < rise:
            return self.config.learning_rate * (step + 1) / rise
        if self.config.schedule == "constant":
            return self.config.learning_rate
        share = (step - rise) / max(1.0, self.config.steps - rise)
        return self.config.learning_rate * 0.5 * (1 + float(np.cos(np.pi * min(1.0, share))))

    def step(self) -> dict[str, float]:
        """One step of the optimiser on the batch of `done`; returns the loss and its parts."""
        start = time.perf_counter()
        self.model.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate(self.done)
        batches = draw_batches(self.examples, self.config, self.done)
        found = []
        for batch in batches:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                found.append(batch_loss(self.model, batch.to(self.device), self.config))
        parts = {name: torch.stack([part[name] for part in found]).mean() for name in found[0]}
        if not torch.isfinite(parts["loss"]):
            names = ", ".join(name for batch in batches for name in batch.names)
            raise TrainingError(
                f"step {self.done}: the loss is {float(parts['loss'].detach())} on scenes {names}; "
                "expected a number (a lower learning rate, or other data)"
            )
        self.optimizer.zero_grad(set_to_none=True)
        parts["loss"].backward()
        if self.config.clip:
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


def trained_predicates(examples: Examples, config: TrainConfig) -> list[str]:
    """Names of the predicates that are learned: those with labels, and their mirror images."""
    seen = {predicate.name for predicate in examples.goals}
    if config.mirror:
        seen |= {predicate.mirror for predicate in examples.goals}
    return [name for name in PREDICATES if name in seen]


def use_bfloat16(choice: str, device: torch.device) -> bool:
    """Whether to autocast: `auto` asks the processor for native bfloat16 arithmetic."""
    if choice != "auto":
        return choice == "on"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    flags = torch.cpu.get_capabilities()
    return any(flags.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def train(
    root: str | Path,
    config: TrainConfig,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Train on a dataset and write ROOT/checkpoints/ID.pt and its row; returns the file.

    ID is a hash of the config and of the data, see `checkpoint_id`. A finished run is not
    repeated; one that was killed goes on from its last saved state. `out` is another folder for
    the files. Raises DatasetError when there is nothing to learn from.
    """
    dataset = Dataset.open(root)
    name = checkpoint_id(dataset, config)
    folder = locate(out) if out is not None else dataset.path / "checkpoints"
    path, unfinished = folder / f"{name}.pt", folder / f"{name}.state"
    if path.exists():
        _, meta = load_checkpoint(path)
        if meta["checkpoint_id"] != name:
            raise CheckpointError(f"{path}: holds {meta['checkpoint_id']}, expected {name}")
        write_row(dataset, path, meta)
        return path
    examples = _load(dataset, "train", config, folder)
    if not examples.goals:
        raise DatasetError(
            f"{dataset.path}: no labels with split train and policy {config.policy}, "
            "expected at least one labelled goal"
        )
    if config.predicates and (lacking := set(config.predicates) - {p.name for p in examples.goals}):
        raise DatasetError(
            f"{dataset.path}: no labels of {min(lacking)} with split train and policy "
            f"{config.policy}, which the settings ask for"
        )
    start, before = _start(dataset, config, examples)
    with _threads(config.threads):
        trainer = Trainer(replace(config, model=start.config) if start else config, examples, start)
        if unfinished.exists():
            trainer.resume(read_file(unfinished, "state", trainer.device))
        while trainer.done < config.steps:
            try:
                trainer.step()
            except TrainingError:
                write_file(unfinished, "state", trainer.state())  # as it was before the step
                raise
            if progress:
                progress(trainer.done, config.steps)
            if trainer.done % config.save_every == 0 and trainer.done < config.steps:
                write_file(unfinished, "state", trainer.state())
        del examples
        trainer.examples = _load(dataset, "validation", config, folder)
        metrics = measure(trainer.model, trainer.examples)
    meta = {
        "checkpoint_id": name,
        "config": trainer.config.to_dict(),
        "config_hash": config.content_hash,
        "dataset_hash": data_hash(dataset, config),
        "created": datetime.now(UTC).isoformat(),
        "train_seconds": trainer.seconds,
        "bfloat16": trainer.bfloat16,
        "parameters": sum(p.numel() for p in trainer.model.parameters()),
        "metrics": metrics,
        "offsets": offsets(metrics, before),
        "yaws": yaws(dataset),
        "history": trainer.history,
    }
    save_checkpoint(path, trainer.model, meta)
    write_row(dataset, path, meta)
    unfinished.unlink(missing_ok=True)
    return path


def _start(
    dataset: Dataset, config: TrainConfig, examples: Examples
) -> tuple[RelevanceModel | None, dict[str, float]]:
    """The model whose weights stay, and its offsets, which stay too.

    Raises CheckpointError where nothing new would be learned.
    """
    if not config.start:
        return None, {}
    model, meta = load_checkpoint(find_checkpoint(dataset.path, config.start))
    if meta["checkpoint_id"] != config.start:
        raise CheckpointError(f"start: {config.start} is no id, it holds {meta['checkpoint_id']}")
    there = set(trained_predicates(examples, config)) & set(model.predicates)
    if there:
        raise CheckpointError(
            f"start: {config.start} has a head for {min(there)}, expected new --predicates"
        )
    return model, meta.get("offsets", {})


def _load(dataset: Dataset, split: str, config: TrainConfig, folder: Path) -> Examples:
    return load_examples(
        dataset,
        split,
        camera=config.model.camera,
        policy=config.policy,
        ambiguous=config.ambiguous,
        predicates=config.predicates,
        families=config.families,
        cache_bytes=config.cache_bytes,
        folder=folder,
        soft=config.soft_labels and split == "train",
    )


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# --- metrics ------------------------------------------------------------------------------


def measure(model: RelevanceModel, examples: Examples, batch: int = 16) -> dict[str, Any]:
    """Metrics per predicate on all goals of the examples, of the network's own scores (no offset
    added); see `accuracy`.

    `queries` leaves subject and reference out, `with_goal_objects` has them. `same-plane` pools
    its four predicates; what a predicate is asked in another family than its own stands under
    that family.
    """
    model.eval()
    pooled: dict[str, list[tuple[np.ndarray, ...]]] = {}
    with torch.inference_mode():
        for predicate, family in product(examples.goals, sorted(set(examples.families), key=str)):
            if predicate.name not in model.predicates:
                continue
            scenes = examples.scenes([predicate], family)
            for start in range(0, len(scenes), batch):
                drawn = gather(examples, scenes[start : start + batch], [predicate])
                drawn = drawn.to(model.device)
                encoding = model.encode(drawn.image, drawn.views, drawn.present, drawn.geometry)
                ((_, goals, relevant, labelled),) = drawn.turns
                score = model.decode(encoding, predicate, goals)
                places = torch.arange(score.shape[-1], device=score.device)
                asked = places[:, None] != goals[..., None, :]
                arrays = (score, relevant, labelled, asked.all(-1))
                rows = tuple(array.flatten(0, 1).cpu().numpy() for array in arrays)
                for name in {group_of(predicate.name, family), family or predicate.family}:
                    pooled.setdefault(name, []).append(rows)
    return {name: _metrics(parts) for name, parts in sorted(pooled.items())}


def _metrics(parts: list[tuple[np.ndarray, ...]]) -> dict[str, Any]:
    goals = [goal for part in parts for goal in zip(*part, strict=True) if goal[2].any()]
    score, relevant, query = (
        np.concatenate([goal[i][goal[2]] for goal in goals]) for i in (0, 1, 3)
    )
    task = np.repeat(np.arange(len(goals)), [goal[2].sum() for goal in goals])
    return {
        "goals": len(goals),
        "queries": accuracy(score[query], relevant[query], task=task[query]),
        "with_goal_objects": accuracy(score, relevant, task=task),
    }
