"""What every body learns in equal time of one core, by each recipe: accuracy on unseen scenes.

A run is remade by its settings: what was trained on the dataset is not trained again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from relevance.benchmarks.runs import Measured, Progress
from relevance.models import BODIES
from relevance.report.tables import Table, cell
from relevance.scene import FAMILIES, PREDICATES
from relevance.store import Dataset, replacing
from relevance.training import (
    Catalogue,
    Reader,
    TrainConfig,
    checkpoint_id,
    load_checkpoint,
    measure,
    measure_speed,
    one_core,
    steps_within,
    train,
)

Networks = tuple[TrainConfig, ...]
"""What is trained side by side and shares the time evenly: one network or one a family."""


def _fair(body: str) -> Networks:
    return (TrainConfig.fair().with_body(body),)


def _paper(body: str) -> Networks:
    """A network a family, bare but for sizes that a CPU can train."""
    bare = replace(TrainConfig.paper(), model=BODIES[body].config.bare())
    names: dict[str, list[str]] = {}
    for predicate in PREDICATES.values():
        names.setdefault(predicate.family, []).append(predicate.name)
    return tuple(
        replace(bare, predicates=tuple(own), families=(family,)) for family, own in names.items()
    )


RECIPES: dict[str, Callable[[str], Networks]] = {
    "fair": _fair,
    "paper": _paper,
    "fair-no-goal-objects": lambda body: (replace(*_fair(body), goal_objects=False),),
    "fair-soft-labels": lambda body: (replace(*_fair(body), soft_labels=True),),
}
"""By name, from a body to the settings of its networks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Learned:
    """What a run learned of one family of scenes."""

    body: str
    reading: str
    """Of the paper's description, where the body has several."""
    recipe: str
    seed: int
    parameters: int
    """Of the network of this family."""
    scenes: float
    """Scenes a core second in training, on made-up pictures, see `Speed`."""
    look: float
    """Core seconds of one goal of one scene."""
    steps: int
    core_minutes: float
    """That these steps took, reading included."""
    checkpoint_id: str
    family: str
    queries: int
    """Of the test split, subject and reference left out; the shares are of them, at beta = 0."""
    true_relevant: float | None
    true_irrelevant: float | None
    total: float | None
    base_rate: float | None
    average_precision: float | None
    auc: float | None


def learning_runs(
    root: Path,
    *,
    bodies: Sequence[str] = (),
    recipes: Sequence[str] = ("fair", "paper"),
    seeds: Sequence[int] = (0,),
    minutes: float = 10.0,
    seconds: float = 2.0,
    folder: Path,
) -> Iterator[tuple[str, Callable[[Progress], list[Learned]]]]:
    """Every run, with its name, to be called with progress; a run has a row a family.

    How many steps fit into the time is measured once and kept in FOLDER/steps.json.
    """
    for recipe in recipes:
        for seed in seeds:
            for body in bodies or list(BODIES):
                networks = [replace(network, seed=seed) for network in RECIPES[recipe](body)]
                run = partial(_run, root, recipe, networks, 60 * minutes, seconds, folder)
                yield f"{body}, {recipe}, seed {seed}", run


def _run(
    root: Path,
    recipe: str,
    networks: Sequence[TrainConfig],
    budget: float,
    seconds: float,
    folder: Path,
    progress: Progress | None = None,
) -> list[Learned]:
    speed = measure_speed(one_core(networks[0]), seconds=seconds)
    model, rows = networks[0].model, []
    reading = next(name for name, config in model.readings().items() if config == model)
    each = budget / len(networks)
    for network in networks:
        steps = _steps(root, network, each, folder / "steps.json")
        path = train(root, one_core(replace(network, steps=steps)), progress=progress)
        found, meta = load_checkpoint(path, "cpu")
        metrics = measure(found, _unseen(root, network, told=found.told), meta["offsets"])
        rows += [
            Learned(
                body=model.body,
                reading=reading,
                recipe=recipe,
                seed=network.seed,
                parameters=meta["parameters"],
                scenes=speed.scenes,
                look=speed.look,
                steps=steps,
                core_minutes=meta["core_seconds"] / 60,
                checkpoint_id=meta["checkpoint_id"],
                family=family,
                **_figures(metrics[family]["queries"]),
            )
            for family in FAMILIES
            if family in metrics
        ]
    return rows


def _steps(root: Path, network: TrainConfig, seconds: float, file: Path) -> int:
    """How many steps fit, as measured the first time; the same where a step costs the same."""
    alike = replace(network, steps=1, seed=0, goal_objects=True, soft_labels=False)
    key = f"{checkpoint_id(Dataset.open(root), alike)} in {seconds:g} s"
    known = json.loads(file.read_text()) if file.exists() else {}
    if key not in known:
        known[key] = steps_within(root, network, seconds)
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(known, indent=2) + "\n")
    return known[key]


def _unseen(root: Path, network: TrainConfig, *, told: bool) -> Iterator[Any]:
    """The test scenes with all their goals."""
    catalogue = Catalogue.of(Dataset.open(root), "test", network)
    return Reader(catalogue=catalogue, config=network, pictures=not told).whole()


def _figures(found: Mapping[str, Any]) -> dict[str, Any]:
    shares = ("true_relevant", "true_irrelevant", "total", "base_rate")
    return {
        "queries": found["relevant"] + found["irrelevant"],
        **{name: found[name] for name in (*shares, "average_precision", "auc")},
    }


def learned(rows: Sequence[Learned], minutes: float) -> Measured:
    """Runs as a part of a benchmark."""
    columns = (
        "body", "recipe", "seed", "M", "scenes/s", "look, ms", "steps", "core min", "family",
        "true relevant", "true irrelevant", "total", "base rate", "average precision", "AUC",
    )  # fmt: skip
    table = Table(
        name="learning",
        title=f"Learning, {minutes:g} minutes of one core: queries of unseen scenes at beta = 0, %",
        columns=columns,
        rows=tuple(
            (
                f"{row.body} {row.reading}".strip(),
                row.recipe,
                row.seed,
                f"{row.parameters / 1e6:.2f}",
                cell(row.scenes),
                f"{1e3 * row.look:.1f}",
                row.steps,
                f"{row.core_minutes:.1f}",
                row.family,
                *map(_percent, (row.true_relevant, row.true_irrelevant, row.total)),
                *map(_percent, (row.base_rate, row.average_precision)),
                cell(row.auc),
            )
            for row in rows
        ),
    )
    return Measured(name="learning", rows=tuple(rows), tables=(table,))


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"
