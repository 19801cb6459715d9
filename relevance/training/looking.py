"""How much cheaper a look is in ONNX Runtime than in torch: both in turns, on one thread each.

Shape suffixes: N objects.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from relevance.models import PATCH, RelevanceModel, export_graphs
from relevance.networks import GEOMETRY, Checkpoint, GraphNetwork, Network
from relevance.scene import PREDICATES

_PREDICATE = PREDICATES["on-the-left"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Looks:
    """CPU seconds of looking at a scene and of answering a goal, medians."""

    objects: int
    encode_torch: float
    encode_graph: float
    goal_torch: float
    goal_graph: float
    encode_ratio: float
    """Median of the ratios of pairs that ran one after the other."""
    goal_ratio: float
    off: float
    """Largest difference of a score."""


def graphs_of(model: RelevanceModel) -> GraphNetwork | None:
    """A model in ONNX Runtime; None where its body keeps torch."""
    if not model.body.traced:
        return None
    config = {"body": model.body_name}
    weights = {name: value.float().numpy(force=True) for name, value in model.state_dict().items()}
    meta = {"config": {"model": config}, "predicates": list(model.predicates)}
    made = Checkpoint(meta=meta, weights=weights, graphs=export_graphs(model))
    return GraphNetwork(made, Path("(made up)"))


def compare_looks(
    model: RelevanceModel,
    graphs: Network,
    *,
    sizes: Sequence[int] = (10, 30),
    repeats: int = 100,
) -> list[Looks]:
    """Both on the same made-up scenes, a row for each number of objects."""
    threads, camera = torch.get_num_threads(), model.camera
    torch.set_num_threads(1)
    rng, rows = np.random.default_rng(0), []
    try:
        for count in sizes:
            image = rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
            views = rng.integers(0, 256, (count, PATCH, PATCH, 3), np.uint8)
            poses = rng.uniform(0, 3, (count, GEOMETRY)).astype(np.float32)
            told = poses if model.told else None
            goal = np.array([[0, 1]])
            mine, its = model.look(image, views, told), graphs.look(image, views, told)
            looks = _pairs(
                lambda: model.look(image, views, told),  # noqa: B023
                lambda: graphs.look(image, views, told),  # noqa: B023
                repeats,
            )
            goals = _pairs(
                lambda: model.judge(mine, _PREDICATE, goal),  # noqa: B023
                lambda: graphs.judge(its, _PREDICATE, goal),  # noqa: B023
                repeats,
            )
            off = model.judge(mine, _PREDICATE, goal) - graphs.judge(its, _PREDICATE, goal)
            rows.append(
                Looks(
                    objects=count,
                    encode_torch=float(np.median(looks[0])),
                    encode_graph=float(np.median(looks[1])),
                    goal_torch=float(np.median(goals[0])),
                    goal_graph=float(np.median(goals[1])),
                    encode_ratio=float(np.median(looks[1] / looks[0])),
                    goal_ratio=float(np.median(goals[1] / goals[0])),
                    off=float(np.abs(off).max()),
                )
            )
    finally:
        torch.set_num_threads(threads)
    return rows


def _pairs(
    first: Callable[[], object], second: Callable[[], object], repeats: int
) -> tuple[np.ndarray, np.ndarray]:
    """CPU seconds of each of two, called in turns."""
    taken = np.empty((repeats, 3))
    for work in (first, second) * 3:
        work()  # what is loaded at first use
    for row in taken:
        row[0] = time.process_time()
        first()
        row[1] = time.process_time()
        second()
        row[2] = time.process_time()
    spent = np.diff(taken, axis=1)
    return spent[:, 0], spent[:, 1]
