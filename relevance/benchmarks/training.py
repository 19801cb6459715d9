"""How fast every body trains and looks, shared encodings against one a query: no dataset needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

from relevance.benchmarks.runs import Measured, Progress
from relevance.models import BODIES, ModelConfig, RelevanceModel
from relevance.networks import named
from relevance.report.tables import Table
from relevance.training import (
    Looks,
    Speed,
    TrainConfig,
    compare_looks,
    graphs_of,
    load_checkpoint,
    measure_speed,
    shipped,
)

Sizes = Literal["cpu", "paper"]
"""Widths that a CPU can train (the defaults), or the paper's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained(Speed):
    """One body of one size, and what it takes."""

    body: str
    sizes: Sizes


def measure_training(
    config: TrainConfig,
    *,
    sizes: Sequence[Sizes] = ("cpu",),
    bodies: Sequence[str] = (),
    scenes: int = 4,
    goals: int = 4,
    objects: int = 10,
    queries: int = 50,
    seconds: float = 2.0,
    progress: Progress | None = None,
) -> Measured:
    """Every body (or those named) in all its readings, of each size; settings from `config`."""
    chosen = list(_configs(sizes, bodies or list(BODIES)))
    for body in {row[0].split()[0] for row in chosen}:
        # What libraries load when they are first used is in nobody's memory or time.
        small = replace(config, model=BODIES[body].config.smoke())
        measure_speed(small, scenes=1, goals=1, queries=1, seconds=0.0)
    rows: list[Trained] = []
    for done, (body, size, model) in enumerate(chosen, 1):
        speed = measure_speed(
            replace(config, model=model),
            scenes=scenes,
            goals=goals,
            objects=objects,
            queries=queries,
            seconds=seconds,
        )
        rows.append(Trained(body=body, sizes=size, **asdict(speed)))
        if progress:
            progress(done, len(chosen))
    return Measured(
        name="training",
        rows=tuple(rows),
        tables=(
            _table(rows, f"{scenes} scenes of {goals} goals and {objects} objects"),
            _looks_table(list(_looks(chosen, sizes=(3, 10, 30)))),
        ),
    )


def _configs(sizes: Sequence[Sizes], bodies: Sequence[str]) -> list[tuple[str, Sizes, ModelConfig]]:
    found: list[tuple[str, Sizes, ModelConfig]] = []
    for size in sizes:
        for body in bodies:
            kind = BODIES[body].config
            config = kind() if size == "cpu" else kind.paper()
            if size == "paper" and "cpu" in sizes and config == kind():
                continue  # the paper has no such body: once is enough
            for reading, model in config.readings().items():
                found.append((f"{body} {reading}".strip(), size, model))
    return found


def _looks(
    chosen: Sequence[tuple[str, Sizes, ModelConfig]], sizes: Sequence[int]
) -> Iterator[tuple[str, Looks]]:
    """Each body that has graphs, in torch and in ONNX Runtime: the shipped network where its sizes
    are asked for, else fresh weights."""
    for body, _, config in chosen:
        model = RelevanceModel(config, ["on-the-left"]).eval()
        if body in shipped():
            known, _meta = load_checkpoint(named(body), "cpu")
            model = known if known.config == config else model
        graphs = graphs_of(model)
        if graphs is not None:
            for looks in compare_looks(model, graphs, sizes=sizes):
                yield body, looks


def _looks_table(rows: Sequence[tuple[str, Looks]]) -> Table:
    return Table(
        name="looks",
        title="A look in ONNX Runtime against torch, CPU ms on one thread each, in turns (medians)",
        columns=(
            "body",
            "objects",
            "scene, torch",
            "scene, ONNX",
            "ratio",
            "goal, torch",
            "goal, ONNX",
            "ratio of goals",
            "scores differ by",
        ),
        rows=tuple(
            (
                body,
                str(looks.objects),
                f"{1e3 * looks.encode_torch:.2f}",
                f"{1e3 * looks.encode_graph:.2f}",
                f"{looks.encode_ratio:.2f}",
                f"{1e3 * looks.goal_torch:.2f}",
                f"{1e3 * looks.goal_graph:.2f}",
                f"{looks.goal_ratio:.2f}",
                f"{looks.off:.0e}",
            )
            for body, looks in rows
        ),
    )


def _table(rows: Sequence[Trained], batch: str) -> Table:
    first = rows[0]
    per = "core second" if first.device == "cpu" else "second"
    arithmetic = "bfloat16" if first.bfloat16 else "float32"
    return Table(
        name="training",
        title=f"Training, a {per} of {first.device}, {arithmetic}, batches of {batch}",
        columns=(
            "body",
            "sizes",
            "parameters, M",
            "scenes",
            "queries",
            "queries, each encoded alone",
            "times",
            "a look, ms",
            "memory, MB",
        ),
        rows=tuple(
            (
                row.body,
                row.sizes,
                f"{row.parameters / 1e6:.2f}",
                f"{row.scenes:.3g}",
                f"{row.queries:.3g}",
                f"{row.queries_alone:.3g}",
                f"{row.queries / row.queries_alone:.1f}",
                f"{1e3 * row.look:.2f}",
                "-" if row.memory is None else f"{row.memory / 1e6:.0f}",
            )
            for row in rows
        ),
    )
