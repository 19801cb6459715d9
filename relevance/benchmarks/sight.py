"""What seeing costs: a network that is told where objects are, told what another one sees instead.

How far what is seen is from what is there, and which part of it costs accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from relevance.benchmarks.runs import Measured, Progress
from relevance.models import RelevanceModel
from relevance.networks import DECIMETRE, GEOMETRY
from relevance.report.tables import Table
from relevance.store import Dataset, DatasetError
from relevance.training import (
    Batch,
    Catalogue,
    CheckpointError,
    Judged,
    Reader,
    TrainConfig,
    find_checkpoint,
    judged,
    load_checkpoint,
    metrics_of,
)

PARTS: Mapping[str, slice] = {
    "along the view (x)": slice(0, 1),
    "across the view (y)": slice(1, 2),
    "height (z)": slice(2, 3),
    "size": slice(3, 6),
    "half-extents": slice(6, GEOMETRY),
}
"""Parts of a geometry vector."""
TOLD: Mapping[str, tuple[str, ...]] = {
    "what is there": (),
    "all as it is seen": tuple(PARTS),
    **{f"{part} as it is seen": (part,) for part in [*PARTS][:3]},
    "sizes as they are seen": ("size", "half-extents"),
}
"""What the other one is told, by which parts of it are those that are seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """How one network does, told or shown something."""

    told: str
    group: str
    """A predicate, or a family."""
    relevant: int
    irrelevant: int
    true_relevant: float
    true_irrelevant: float
    total: float
    auc: float


def measure_sight(
    root: str | Path,
    *,
    sees: str | None = "glimpse",
    told: str | None = "geometry",
    split: str = "test",
    scenes: int = 60,
    progress: Progress | None = None,
) -> Measured:
    """Judge the first `scenes` of each shard of a split by both, each at the decision of its own.

    Raises RelevanceError for checkpoints that see nothing of where objects are, or are not told.
    """
    dataset = Dataset.open(root)
    eyes, its = _loaded(dataset, sees, "sees where objects are", lambda model: model.tellable)
    mind, own = _loaded(dataset, told, "is told where objects are", lambda model: model.told)
    config = TrainConfig.from_dict(its["config"])
    catalogue = Catalogue.of(dataset, split, config)
    if not catalogue.shards:
        raise DatasetError(f"{dataset.path}: no labels of split {split}, expected some to judge by")
    found: dict[str, list[Judged]] = {}
    errors: list[np.ndarray] = []
    for done, shard in enumerate(catalogue.shards, 1):
        reader = Reader(catalogue=replace(catalogue, shards=(shard,)), config=config)
        for batch in reader.whole(most=scenes):
            found.setdefault("shown pictures", []).extend(judged(eyes, [batch], its["offsets"]))
            seen = _seen(eyes, batch)
            errors.append((seen - batch.geometry)[batch.present].numpy())
            for name, parts in TOLD.items():
                geometry = batch.geometry.clone()
                for part in parts:
                    geometry[..., PARTS[part]] = seen[..., PARTS[part]]
                other = replace(batch, geometry=geometry)
                found.setdefault(name, []).extend(judged(mind, [other], own["offsets"]))
        if progress:
            progress(done, len(catalogue.shards))
    rows = tuple(row for name, some in found.items() for row in _rows(name, some))
    millimetres = 1e3 * DECIMETRE * np.abs(np.concatenate(errors))
    return Measured(
        name="sight",
        rows=rows,
        tables=(
            _accuracy(rows, its["checkpoint_id"], own["checkpoint_id"]),
            _distances(millimetres, its["checkpoint_id"]),
        ),
    )


def _loaded(
    dataset: Dataset, name: str | None, what: str, fits: Callable[[RelevanceModel], bool]
) -> tuple[RelevanceModel, dict[str, Any]]:
    path = find_checkpoint(dataset.path, name)
    model, meta = load_checkpoint(path, "cpu")
    if not fits(model):
        raise CheckpointError(f"{path}: body {model.body_name}, expected one that {what}")
    return model.eval(), meta


def _seen(model: RelevanceModel, batch: Batch) -> Any:
    """Where a model sees the objects of a batch, (B, N, GEOMETRY)."""
    seen = batch.geometry.clone()
    images = batch.image.permute(0, 2, 3, 1).numpy()
    views = batch.views.permute(0, 1, 3, 4, 2).numpy()
    for place, names in enumerate(batch.objects):
        objects = slice(len(names))
        found = model.believed(model.look(images[place], views[place, objects], None))
        seen.numpy()[place, objects] = found
    return seen


def _rows(told: str, found: list[Judged]) -> Iterator[Seen]:
    metrics = metrics_of(found)
    for group in metrics:
        queries = metrics[group]["queries"]
        figures = {field.name: queries[field.name] for field in fields(Seen)[2:]}
        if None not in figures.values():  # there is something relevant and something that is not
            yield Seen(told=told, group=group, **figures)


def _accuracy(rows: tuple[Seen, ...], eyes: str, mind: str) -> Table:
    groups = [g for g in ("same-plane", "on", "stacks") if any(row.group == g for row in rows)]
    by = {(row.told, row.group): row for row in rows}
    named = {row.told: None for row in rows}
    return Table(
        name="sight",
        title=f"Queries, true relevant / irrelevant / total, %: {eyes}, and {mind} told",
        columns=("told", *groups),
        rows=tuple(
            (
                told,
                *(_shares(by.get((told, group))) for group in groups),
            )
            for told in named
        ),
    )


def _shares(row: Seen | None) -> str:
    """Of a group that a network has a head for."""
    if row is None:
        return "-"
    shares = row.true_relevant, row.true_irrelevant, row.total
    return " / ".join(f"{100 * share:.1f}" for share in shares)


def _distances(millimetres: np.ndarray, eyes: str) -> Table:
    return Table(
        name="distances",
        title=f"How far {eyes} sees objects from where they are, mm ({len(millimetres):,} objects)",
        columns=("", "median", "90%", "99%"),
        rows=tuple(
            (part, *(f"{q:.2f}" for q in np.quantile(millimetres[:, places], (0.5, 0.9, 0.99))))
            for part, places in PARTS.items()
        ),
    )
