"""One run: model, optimiser and schedule; a killed one goes on where it was saved.

What a step learns from is a pure function of (seed, step), so a run that was killed and started
again ends with the same weights as one that was not; there is no sampler state to save.

Shape suffixes: B scenes and G goals of a batch, N objects (padded).
"""

from __future__ import annotations

import math
import multiprocessing
import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from relevance.errors import RelevanceWarning
from relevance.metrics import accuracy
from relevance.models import RelevanceModel
from relevance.networks import CheckpointError, find_checkpoint
from relevance.scene import PREDICATES, Predicate, group_of
from relevance.store import Dataset, DatasetError, locate
from relevance.training.catalogue import Catalogue
from relevance.training.checkpoints import (
    checkpoint_id,
    data_hash,
    device_name,
    load_checkpoint,
    pick_device,
    read_file,
    save_checkpoint,
    write_file,
    write_row,
)
from relevance.training.decision import offsets, yaws
from relevance.training.examples import Batch
from relevance.training.losses import batch_loss
from relevance.training.ranks import ALONE, Ranks, together
from relevance.training.reading import Reader, TrainingError
from relevance.training.settings import TrainConfig

Progress = Callable[[int, int], None]


class Trainer:
    """Model, optimiser and schedule of one run; `step` does one optimiser step."""

    def __init__(
        self,
        config: TrainConfig,
        predicates: Sequence[Predicate],
        start: RelevanceModel | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        self.config, self.ranks = config, ranks
        self.done = 0
        """Steps that were taken."""
        self.seconds = 0.0
        """Wall time of those steps and of waiting for them, over all the runs that took them."""
        self.waited = 0.0
        """Seconds of it that were spent waiting for data."""
        self.core_seconds = 0.0
        """Processor time of this process in them; all of it where no other one reads ahead."""
        self.history: list[dict[str, float]] = []
        """Loss and its parts, averaged between two entries; each with its step."""
        self._sums: dict[str, tuple[float, int]] = {}
        self.scenes = 0
        """Scenes that were shown, each time one was."""
        self.asked: dict[str, int] = {}
        """By predicate (or family, see `group_of`), queries that were answered: subject and
        reference left out, repetitions counted."""
        self.validations: list[dict[str, Any]] = []
        """What some validation scenes said on the way; each with its step."""
        self.device = ranks.device(pick_device(config.device))
        # Weights are drawn before they move: equal ones on every device.
        learned = trained_predicates(predicates, config)
        known = start.predicates if start and not config.continues else ()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = RelevanceModel(config.model, (*known, *learned))
        if start:
            self.model.load_state_dict({**self.model.state_dict(), **start.state_dict()})
        if known:
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
        self.optimizer = torch.optim.AdamW(
            groups, lr=config.learning_rate, betas=config.betas, fused=True
        )
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

    def take(self, steps: Iterator[list[Batch]]) -> dict[str, float]:
        """One step on what comes next, and how long that took to come."""
        start, began = time.perf_counter(), time.process_time()
        batches = next(steps)
        waited = time.perf_counter() - start
        found = self.step(batches)
        self.waited += waited
        self.seconds += time.perf_counter() - start
        self.core_seconds += time.process_time() - began
        return found

    def step(self, batches: Sequence[Batch]) -> dict[str, float]:
        """One step of the optimiser on some batches; returns the loss and its parts.

        Raises TrainingError for a loss that is no number, and is then as it was before.
        """
        self.model.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate(self.done)
        found = []
        for batch in batches:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                found.append(batch_loss(self.model, batch.to(self.device), self.config))
        parts = {name: torch.stack([part[name] for part in found]).mean() for name in found[0]}
        values = dict(zip(parts, self.ranks.means([*parts.values()]), strict=True))
        if not math.isfinite(values["loss"]):
            names = ", ".join(self.ranks.all([name for batch in batches for name in batch.names]))
            raise TrainingError(
                f"step {self.done}: the loss is {values['loss']} on scenes {names}; "
                "expected a number (a lower learning rate, or other data)"
            )
        self.optimizer.zero_grad(set_to_none=True)
        parts["loss"].backward()
        self.ranks.share_gradients(self.model.parameters())
        if self.config.clip:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip)
        self.optimizer.step()
        self.done += 1
        self._record(values)
        self._count(batches)
        return values

    def _record(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            total, count = self._sums.get(name, (0.0, 0))
            self._sums[name] = total + value, count + 1
        every = max(1, self.config.steps // 100)
        if self.done % every == 0 or self.done == self.config.steps:
            means = {name: total / count for name, (total, count) in self._sums.items()}
            self.history.append({"step": float(self.done), **means})
            self._sums = {}

    def _count(self, batches: Sequence[Batch]) -> None:
        for batch in batches:
            self.scenes += len(batch.names)
            for predicate, goals, _, labelled in batch.turns:
                asked = labelled.sum((1, 2)) - labelled.gather(-1, goals).sum((1, 2))
                for family, count in zip(batch.families, asked.tolist(), strict=True):
                    group = group_of(predicate.name, family)
                    self.asked[group] = self.asked.get(group, 0) + count

    def state(self) -> dict[str, Any]:
        """All that the rest of the run depends on."""
        return {
            "done": self.done,
            "seconds": self.seconds,
            "waited": self.waited,
            "core_seconds": self.core_seconds,
            "history": self.history,
            "sums": self._sums,
            "scenes": self.scenes,
            "asked": self.asked,
            "validations": self.validations,
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from a saved `state`."""
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.done, self.seconds, self.waited = (state[k] for k in ("done", "seconds", "waited"))
        self.core_seconds = state["core_seconds"]
        self.history, self._sums = list(state["history"]), dict(state["sums"])
        self.scenes, self.asked = state["scenes"], dict(state["asked"])
        self.validations = list(state["validations"])


def trained_predicates(predicates: Sequence[Predicate], config: TrainConfig) -> list[str]:
    """Names of the predicates that are learned: those with labels, and their mirror images."""
    seen = {predicate.name for predicate in predicates}
    if config.mirror:
        seen |= {predicate.mirror for predicate in predicates}
    return [name for name in PREDICATES if name in seen]


def use_bfloat16(choice: str, device: torch.device) -> bool:
    """Whether to autocast; `auto`: on an accelerator that has bfloat16."""
    if choice != "auto":
        return choice == "on"
    return device.type == "cuda" and torch.cuda.is_bf16_supported()


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
    the files. Under `torchrun` its processes train together, and the first one writes. Raises
    DatasetError when there is nothing to learn from.
    """
    dataset = Dataset.open(root)
    name, data = checkpoint_id(dataset, config), data_hash(dataset, config)
    folder = locate(out) if out is not None else dataset.path / "checkpoints"
    path = folder / f"{name}.pt"
    if path.exists():
        _, meta = load_checkpoint(path)
        if meta["checkpoint_id"] != name:
            raise CheckpointError(f"{path}: holds {meta['checkpoint_id']}, expected {name}")
        write_row(dataset, path, meta)
        return path
    catalogue = Catalogue.of(dataset, "train", config)
    _check(dataset, catalogue, config)
    start, before = _start(dataset, config, catalogue)
    own = replace(config, model=start.config) if config.start and start else config
    run = _Run(folder=folder, settings=f"{own.model.body}-{config.content_hash}", data=data)
    with on_threads(config.threads), together() as ranks:
        trainer = Trainer(own, catalogue.predicates, start, ranks)
        run.resume(trainer)
        validation, validated = Catalogue.of(dataset, "validation", config), _validated(config)
        with closing(reader_for(catalogue, trainer).steps(trainer.done)) as steps:
            while trainer.done < config.steps:
                try:
                    trainer.take(steps)
                except TrainingError:
                    run.save(trainer)  # as it was before the step
                    raise
                if progress and ranks.first:
                    progress(trainer.done, config.steps)
                if ranks.first and trainer.done in validated:
                    _validate(trainer, validation)
                if trainer.done % config.save_every == 0 and trainer.done < config.steps:
                    run.save(trainer)
        counted = ranks.totals({"scenes": trainer.scenes, **trainer.asked})
        if ranks.first:
            with closing(reader_for(validation, trainer).whole()) as batches:
                metrics = measure(trainer.model, batches)
            meta = {
                "checkpoint_id": name,
                "config": own.to_dict(),
                "config_hash": config.content_hash,
                "dataset_hash": data,
                "created": datetime.now(UTC).isoformat(),
                "train_seconds": trainer.seconds,
                "wait_seconds": trainer.waited,
                "core_seconds": trainer.core_seconds,
                "device": device_name(trainer.device),
                "bfloat16": trainer.bfloat16,
                "parameters": sum(p.numel() for p in trainer.model.parameters()),
                "metrics": metrics,
                "offsets": offsets(metrics, before),
                "yaws": yaws(dataset),
                "history": trainer.history,
                "validations": trainer.validations,
                "scenes": counted.pop("scenes"),
                "asked": counted,
            }
            save_checkpoint(path, trainer.model, meta)
            write_row(dataset, path, meta)
            run.path.unlink(missing_ok=True)
        ranks.wait()
    return path


def _validated(config: TrainConfig) -> set[int]:
    """The steps after which the learning curve gets a point; the last one of them."""
    times = config.validations
    return {-(-config.steps * time // times) for time in range(1, times + 1)}


def _validate(trainer: Trainer, validation: Catalogue) -> None:
    """Judge some validation scenes: a point of the learning curve."""
    most = trainer.config.validation_scenes
    with closing(reader_for(validation.some(most), trainer).whole(most=most)) as batches:
        found = measure(trainer.model, batches)
    queries = {group: its["queries"] for group, its in found.items()}
    trainer.validations.append({"step": trainer.done, "queries": queries})


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """Where an unfinished run of some settings on some data is kept."""

    folder: Path
    settings: str
    data: str

    @property
    def path(self) -> Path:
        return self.folder / f"{self.settings}-{self.data}.state"

    def save(self, trainer: Trainer) -> None:
        if trainer.ranks.first:
            write_file(self.path, "state", trainer.state())

    def resume(self, trainer: Trainer) -> None:
        """Go on from the saved state, if there is one; what others learned stays where it is."""
        if self.path.exists():
            trainer.resume(read_file(self.path, "state", trainer.device))
        elif trainer.ranks.first and self.folder.is_dir():
            for other in sorted(self.folder.glob(f"{self.settings}-*.state")):
                warnings.warn(
                    f"{other}: an unfinished run of these settings, on data that has grown or was "
                    "labelled anew since; this run begins at step 0 (delete that file if nobody "
                    "needs it)",
                    RelevanceWarning,
                    stacklevel=2,
                )


def _check(dataset: Dataset, catalogue: Catalogue, config: TrainConfig) -> None:
    """Raise DatasetError unless there is something to learn for all that is asked for."""
    names = {predicate.name for predicate in catalogue.predicates}
    where = f"with split train and policy {config.policy}"
    if lacking := set(config.predicates) - names:
        raise DatasetError(
            f"{dataset.path}: no labels of {min(lacking)} {where}, which the settings ask for"
        )
    if not names:
        raise DatasetError(
            f"{dataset.path}: no labels {where}, expected at least one labelled goal"
        )


def _start(
    dataset: Dataset, config: TrainConfig, catalogue: Catalogue
) -> tuple[RelevanceModel | None, dict[str, float]]:
    """The model whose weights are taken over, and those of its offsets that stay.

    Raises CheckpointError where they do not fit, or nothing new would be learned.
    """
    if config.continues:
        return _taken_over(dataset, config, catalogue), {}
    if not config.start:
        return None, {}
    model, meta = _named(dataset, "start", config.start)
    there = set(trained_predicates(catalogue.predicates, config)) & set(model.predicates)
    if there:
        raise CheckpointError(
            f"start: {config.start} has a head for {min(there)}, expected new --predicates"
        )
    return model, meta.get("offsets", {})


def _taken_over(dataset: Dataset, config: TrainConfig, catalogue: Catalogue) -> RelevanceModel:
    name = config.continues
    model, _ = _named(dataset, "continues", name)
    if model.config != config.model:
        raise CheckpointError(
            f"continues: {name} has body {model.config.body} of other settings, expected "
            f"{config.model.body} with those of this training"
        )
    learned = trained_predicates(catalogue.predicates, config)
    if set(learned) != set(model.predicates):
        raise CheckpointError(
            f"continues: {name} has heads for {', '.join(model.predicates)}, expected "
            f"{', '.join(learned)}"
        )
    return model


def _named(dataset: Dataset, what: str, name: str) -> tuple[RelevanceModel, dict[str, Any]]:
    model, meta = load_checkpoint(find_checkpoint(dataset.path, name))
    if meta["checkpoint_id"] != name:
        raise CheckpointError(f"{what}: {name} is no id, it holds {meta['checkpoint_id']}")
    return model, meta


def continued(root: str | Path, config: TrainConfig, checkpoint: str, share: float) -> TrainConfig:
    """These settings, going on from the weights of a checkpoint for a share of the steps.

    Raises RelevanceError where they do not fit.
    """
    config = replace(config, continues=checkpoint, steps=max(1, round(share * config.steps)))
    dataset = Dataset.open(root)
    _taken_over(dataset, config, Catalogue.of(dataset, "train", config))
    return config


def reader_for(catalogue: Catalogue, trainer: Trainer) -> Reader:
    """What reads for a trainer; a network that is told where objects are needs no pictures."""
    ahead = trainer.config.workers
    if ahead is None:
        ahead = 1 if trainer.device.type == "cpu" else min(8, max(1, (os.cpu_count() or 2) - 1))
    if multiprocessing.current_process().daemon:
        ahead = 0  # Dask's workers may not have processes of their own
    return Reader(
        catalogue=catalogue,
        config=trainer.config,
        pictures=not trainer.model.told,
        told=trainer.config.told_share if trainer.model.tellable else 0.0,
        workers=ahead,
        rank=trainer.ranks.rank,
        ranks=trainer.ranks.count,
    )


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """So many threads of the processor; torch's choice for 0."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# --- metrics ------------------------------------------------------------------------------


def precision(metrics: Mapping[str, Any]) -> float:
    """One figure of what `measure` found, to choose among runs by: average precision, which asks
    for the order of scores alone, averaged over predicates; nan where nothing was measured."""
    found = [
        metrics[name]["queries"]["average_precision"] for name in PREDICATES if name in metrics
    ]
    known = [value for value in found if value is not None]
    return float(np.mean(known)) if known else math.nan


def measure(
    model: RelevanceModel, batches: Iterable[Batch], offsets: Mapping[str, float] = {}
) -> dict[str, Any]:
    """Metrics per predicate on all goals of the batches, of the network's own scores and the
    offsets of predicates that have one; see `accuracy`.

    `queries` leaves subject and reference out, `with_goal_objects` has them. `same-plane` pools
    its four predicates; what a predicate is asked in another family than its own stands under
    that family.
    """
    return metrics_of(judged(model, batches, offsets))


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """What a model says of the goals of a predicate in a batch, offset included."""

    batch: Batch
    predicate: Predicate
    goals: np.ndarray
    """(B, G, 2) places of subject and reference."""
    score: np.ndarray
    """(B, G, N)."""
    relevant: np.ndarray
    labelled: np.ndarray
    query: np.ndarray
    """(B, G, N) bool; False for subject and reference."""


def judged(
    model: RelevanceModel, batches: Iterable[Batch], offsets: Mapping[str, float] = {}
) -> Iterator[Judged]:
    """Score all goals of the batches, those of the model's predicates."""
    model.eval()
    for batch in batches:
        with torch.inference_mode():
            drawn = batch.to(model.device)
            encoding = model.encode(drawn.image, drawn.views, drawn.present, drawn.geometry)
            for predicate, goals, relevant, labelled in drawn.turns:
                if predicate.name not in model.predicates:
                    continue
                score = model.decode(encoding, predicate, goals, labelled)
                score = score + offsets.get(predicate.name, 0.0)
                places = torch.arange(score.shape[-1], device=score.device)
                query = (places[:, None] != goals[..., None, :]).all(-1)
                arrays = (goals, score, relevant.bool(), labelled, query)
                names = ("goals", "score", "relevant", "labelled", "query")
                found = {n: a.cpu().numpy() for n, a in zip(names, arrays, strict=True)}
                yield Judged(batch=batch, predicate=predicate, **found)


def metrics_of(found: Iterable[Judged]) -> dict[str, Any]:
    """Metrics of what a model said, see `measure`."""
    pooled: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for one in found:
        arrays = (one.score, one.relevant, one.labelled, one.query)
        for family in set(one.batch.families):
            own = [i for i, its in enumerate(one.batch.families) if its == family]
            rows = tuple(array[own].reshape(-1, array.shape[-1]) for array in arrays)
            for name in {group_of(one.predicate.name, family), family}:
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
