"""Networks that run in ONNX Runtime: a scene is looked at once, every goal is answered from that.

Shape suffixes: N objects of the scene, G goals, H and W height and width in pixels.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime

from relevance.networks.edges import ROUNDS, expected_edges
from relevance.networks.files import Checkpoint, CheckpointError
from relevance.networks.obstruction import obstructed_goals, obstructed_picks
from relevance.networks.poses import GEOMETRY
from relevance.scene import PREDICATES, Camera, Predicate

GRAPHS_VERSION = 1
"""Raised when graphs of before would be given something else than they take."""
WEIGHTS = "weights"
"""Where graphs say that their weights are: in the checkpoint beside them."""


def label(graph: bytes, weights: Sequence[str]) -> bytes:
    """A graph as checkpoints hold it: a line of JSON (version, the weights that it takes) first."""
    return (
        json.dumps({"version": GRAPHS_VERSION, "weights": list(weights)}).encode() + b"\n" + graph
    )


class Network(Protocol):
    """What looks at scenes and answers goals, whatever computes it."""

    @property
    def body_name(self) -> str:
        """glimpse, vit, ..."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera that it learned from."""
        ...

    @property
    def predicates(self) -> tuple[str, ...]:
        """Names of those that it has a head for."""
        ...

    @property
    def told(self) -> bool:
        """Whether it is told poses instead of being shown pictures."""
        ...

    def look(self, image: np.ndarray, views: np.ndarray, poses: np.ndarray | None) -> Any:
        """What it sees in an image (H, W, 3) with views (N, 32, 32, 3), uint8, or in poses
        (N, GEOMETRY); for `judge`."""
        ...

    def judge(self, seen: Any, predicate: Predicate, goals: np.ndarray) -> np.ndarray:
        """Logits (G, N) for goals (G, 2), subject and reference by place in the scene."""
        ...

    def believed(self, seen: Any) -> np.ndarray | None:
        """Where it believes the objects to be, (N, GEOMETRY), if it does."""
        ...


class GraphNetwork:
    """The network of a checkpoint in ONNX Runtime, on one thread; a `Network`.

    The graph `encode` has inputs `image` and `views`, or `poses`; `edges`, if there is one, takes
    what is `known` of objects where they are `expected`, and what shows there
    (`relevance.networks.edges`), and gives `geometry`, which is expected next; `between`, if there
    is one, takes what these give, by name, and `picks`; that of a predicate likewise, `goals`, and
    `places` if it is told (`relevance.networks.obstruction`). It is loaded when it is first asked.
    """

    def __init__(self, checkpoint: Checkpoint, path: str | Path) -> None:
        self.path = path
        config = checkpoint.meta["config"]["model"]
        self.body_name: str = config["body"]
        self.camera = Camera(**config.get("camera", {}))
        self.predicates = tuple(checkpoint.meta["predicates"])
        self._checkpoint = checkpoint
        for name, values in checkpoint.weights.items():
            if not np.isfinite(values).all():
                raise CheckpointError(f"{path}: {name} is not finite, expected numbers")
        self._values: dict[str, onnxruntime.OrtValue] = {}
        self._sessions: dict[str, onnxruntime.InferenceSession] = {}
        self._taken: dict[str, list[str]] = {}
        self._given: dict[str, list[str]] = {}
        self._session("encode")
        self._closer, self._obstructed = (one in checkpoint.graphs for one in ("edges", "between"))
        # Kernels are compiled or loaded before a look's clock.
        if self._closer:
            blank = np.zeros((1, 3, 2, 2), np.uint8)
            expected_edges(
                blank, np.ones((1, 1, GEOMETRY), np.float32), _all(blank[:, :1]), self.camera
            )
        if self._obstructed:
            self._session("between")
            nothing = np.ones((1, 2, GEOMETRY), np.float32)
            obstructed_picks(nothing, _all(nothing))
            goals = np.array([[[0, 1]]])
            obstructed_goals(nothing, _all(nothing), PREDICATES["on"], goals)
        self.told = self._taken["encode"] == ["poses"]

    def look(
        self, image: np.ndarray, views: np.ndarray, poses: np.ndarray | None
    ) -> dict[str, Any]:
        """As `Network.look`."""
        if self.told:
            given: dict[str, Any] = {"poses": poses}
        else:
            given = {
                "image": np.ascontiguousarray(image.transpose(2, 0, 1)),
                "views": np.ascontiguousarray(views.transpose(0, 3, 1, 2)),
            }
        seen = self._run("encode", given)
        for _ in range(ROUNDS if self._closer else 0):
            where = seen["expected"]
            edges = expected_edges(given["image"][None], where, _all(where), self.camera)
            seen |= self._run("edges", seen | edges._asdict())
            seen["expected"] = seen["geometry"]
        if self._obstructed:
            where = seen["geometry"]
            seen |= self._run("between", seen | {"picks": obstructed_picks(where, _all(where))})
        return seen

    def judge(
        self, seen: Mapping[str, np.ndarray], predicate: Predicate, goals: np.ndarray
    ) -> np.ndarray:
        """As `Network.judge`."""
        self._session(predicate.name)
        given = {**seen, "goals": goals}
        if "places" in self._taken[predicate.name]:
            where = seen["geometry"]
            given["places"] = obstructed_goals(where, _all(where), predicate, goals[None])
        return self._run(predicate.name, given)["scores"]

    def believed(self, seen: Mapping[str, np.ndarray]) -> np.ndarray | None:
        """As `Network.believed`."""
        return seen["geometry"][0] if "geometry" in seen else None

    def _run(self, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """What a graph gives, by name; of the values it takes its own."""
        session = self._session(name)
        found = session.run(None, {one: values[one] for one in self._taken[name]})
        return dict(zip(self._given[name], map(np.asarray, found), strict=True))

    def _session(self, name: str) -> onnxruntime.InferenceSession:
        if name not in self._sessions:
            if name not in self._checkpoint.graphs:
                raise CheckpointError(
                    f"{self.path}: the model has no head for {name}, "
                    f"was trained on {', '.join(self.predicates)}"
                )
            self._sessions[name] = self._load(name)
            self._taken[name] = [one.name for one in self._sessions[name].get_inputs()]
            self._given[name] = [one.name for one in self._sessions[name].get_outputs()]
        return self._sessions[name]

    def _load(self, name: str) -> onnxruntime.InferenceSession:
        line, _, graph = self._checkpoint.graphs[name].partition(b"\n")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what goes wrong is raised
        try:
            said = json.loads(line)
            version, names = said["version"], said["weights"]
            options.add_external_initializers(names, [self._weight(weight) for weight in names])
            if version == GRAPHS_VERSION:
                return onnxruntime.InferenceSession(
                    graph, options, providers=["CPUExecutionProvider"]
                )
        except Exception as error:  # ONNX Runtime's have no common class of their own
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"{self.path}: its graph {name} does not fit its weights or this ONNX Runtime, "
                f"{onnxruntime.__version__} ({reason[:200]})"
            ) from None
        raise CheckpointError(
            f"{self.path}: its graphs are of version {version}, expected {GRAPHS_VERSION}"
        )

    def _weight(self, name: str) -> onnxruntime.OrtValue:
        """A weight in float32, as all graphs that take it share it."""
        if name not in self._values:
            values = np.asarray(self._checkpoint.weights[name], np.float32, order="C")
            self._values[name] = onnxruntime.OrtValue.ortvalue_from_numpy(values)
        return self._values[name]


def _all(geometry: np.ndarray) -> np.ndarray:
    """That all objects are there."""
    return np.ones(geometry.shape[:2], np.bool_)
