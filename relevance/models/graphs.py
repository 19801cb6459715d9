"""Graphs of networks for ONNX Runtime: made of their settings alone, the weights stay outside.

Shape suffixes: N objects, G goals, D width, H and W height and width in pixels.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from functools import lru_cache

import onnx
import torch
from torch import Tensor, nn

from relevance.models.config import PATCH, Encoding, ModelConfig
from relevance.models.edges import Looker
from relevance.models.reasoning import Thinker
from relevance.models.registry import RelevanceModel
from relevance.networks import GEOMETRY, WEIGHTS, label
from relevance.networks.edges import EDGES, LINES, SAMPLES
from relevance.networks.obstruction import OBSTRUCTION
from relevance.scene import PREDICATES

_OPSET = 20
_SEEN = ("tokens", "geometry", "scene")
_VARIES = {
    "views": {0: "N"},
    "poses": {0: "N"},
    **{name: {1: "N"} for name in ("tokens", "geometry", "known", "expected", "shown")},
    **{name: {1: "N"} for name in ("lines", "turn", "half")},
    **{name: {1: "N", 2: "N"} for name in ("picks", "between")},
    "goals": {0: "G"},
    "places": {1: "G", 2: "N"},
    "scores": {0: "G", 1: "N"},
}
"""By name, which sizes are those of a scene or of a question."""


class _Encoder(nn.Module):
    """From what one scene shows to the parts of its encoding that there are."""

    def __init__(self, model: RelevanceModel) -> None:
        super().__init__()
        self.body, self.told, self.whole = model.body, model.told, [model]

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        (model,) = self.whole
        camera = model.config.camera
        if self.told:
            (poses,) = given
            image = poses.new_zeros(1, 3, camera.height, camera.width)
            views = poses.new_zeros(1, poses.shape[0], 3, PATCH, PATCH)
            found = model.encode(image, views, poses=poses[None])
        else:
            found = model.encode(given[0][None], given[1][None])
        return tuple(part for name in _SEEN if (part := getattr(found, name)) is not None)


class _Between(nn.Module):
    """From where objects are and who is in the way of a pick to what lies between them."""

    def __init__(self, body: Thinker) -> None:
        super().__init__()
        self.body = body

    def forward(self, geometry: Tensor, picks: Tensor) -> Tensor:
        return self.body.between_all(geometry, picks)


class _Closer(nn.Module):
    """From where objects are expected and what shows there to where they are; see `Edges`."""

    def __init__(self, body: Looker) -> None:
        super().__init__()
        self.body = body

    def forward(self, *given: Tensor) -> tuple[Tensor, Tensor]:
        return self.body.edges(*given)


class _Known(nn.Module):
    """As `_Between`, from objects whose edges were looked at; and their tokens."""

    def __init__(self, body: Looker) -> None:
        super().__init__()
        self.body = body

    def forward(
        self, known: Tensor, shown: Tensor, geometry: Tensor, picks: Tensor
    ) -> tuple[Tensor, Tensor]:
        present = known.new_ones(known.shape[:2], dtype=torch.bool)
        tokens = self.body.known(known, shown, geometry)
        thought = self.body.thought(tokens, present, geometry).tokens
        return thought, self.body.between_all(geometry, picks)


class _Decoder(nn.Module):
    """From the parts of an encoding and goals (G, 2) to scores (G, N)."""

    def __init__(self, model: RelevanceModel, predicate: str, seen: Sequence[str]) -> None:
        super().__init__()
        self.body, self.predicate, self.seen = model.body, PREDICATES[predicate], seen

    def forward(self, *given: Tensor) -> Tensor:
        parts, goals = dict(zip(self.seen, given[:-1], strict=True)), given[-1]
        tokens = parts["tokens"]
        present = tokens.new_ones(tokens.shape[:2], dtype=torch.bool)
        asked = tokens.new_ones((1, goals.shape[0], tokens.shape[1]), dtype=torch.bool)
        encoding = Encoding(
            tokens=tokens,
            present=present,
            geometry=parts.get("geometry"),
            between=parts.get("between"),
            places=parts.get("places"),
            scene=parts.get("scene"),
        )
        return self.body.decode(encoding, self.predicate, goals[None], asked).scores[0]


def export_graphs(model: RelevanceModel) -> dict[str, bytes]:
    """The graphs that a `GraphNetwork` runs: `encode`, `edges` of bodies that look closer at where
    they expect objects, `between` of those that are told what is in the way, and one for each
    predicate.

    Raises RuntimeError, or what the body raises, where a body cannot be traced.
    """
    return dict(_graphs(model.config, model.predicates))


@lru_cache(maxsize=32)
def _graphs(config: ModelConfig, predicates: tuple[str, ...]) -> tuple[tuple[str, bytes], ...]:
    """Of an untrained network: its weights are left out, so that any will do."""
    with torch.random.fork_rng(devices=[]):
        model = RelevanceModel(config, predicates).eval()
        for weight in model.parameters():
            nn.init.uniform_(weight)  # equal ones would be taken for one
    camera, objects, body = config.camera, 3, model.body
    values = {
        "poses": torch.ones(objects, GEOMETRY),
        "image": torch.zeros(3, camera.height, camera.width, dtype=torch.uint8),
        "views": torch.zeros(objects, 3, PATCH, PATCH, dtype=torch.uint8),
        "picks": torch.zeros(1, objects, objects, OBSTRUCTION),
        "places": torch.zeros(1, 2, objects, OBSTRUCTION),
        "lines": torch.zeros(1, objects, EDGES, LINES, 3 * SAMPLES),
        "turn": torch.zeros(1, objects),
        "half": torch.ones(1, objects, 2),
        "goals": torch.tensor([[0, 1], [1, 2]]),
    }
    graphs: dict[str, bytes] = {}

    def add(name: str, module: nn.Module, takes: Sequence[str], gives: Sequence[str]) -> None:
        given = {one: values[one] for one in takes}
        found = module(*given.values())
        values.update(zip(gives, found if isinstance(found, tuple) else (found,), strict=True))
        graphs[name] = _traced(module, given, gives)

    with torch.no_grad():
        whole = model.encode(
            values["image"][None], values["views"][None], poses=values["poses"][None]
        )
        seen = [name for name in _SEEN if getattr(whole, name) is not None]
        closer = isinstance(body, Looker)
        given = ["poses"] if model.told else ["image", "views"]
        add("encode", _Encoder(model), given, ["known", "expected"] if closer else seen)
        if closer:
            expected = ["known", "expected", "lines", "turn", "half"]
            add("edges", _Closer(body), expected, ["geometry", "shown"])
            shown = ["known", "shown", "geometry", "picks"]
            add("between", _Known(body), shown, ["tokens", "between"])
        elif isinstance(body, Thinker):
            add("between", _Between(body), ["geometry", "picks"], ["between"])
        if isinstance(body, Thinker):
            seen += ["between", "places"]
        for name in predicates:
            add(name, _Decoder(model, name, seen), [*seen, "goals"], ["scores"])
    return tuple(graphs.items())


def _traced(module: nn.Module, given: dict[str, Tensor], outputs: Sequence[str]) -> bytes:
    """A module as a graph without its weights.

    torch's older exporter: a hundred times faster than its newer one, which matters to whoever
    trains for seconds, and it keeps the weights' names.
    """
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it is the older one, and of sizes that do not vary
        torch.onnx.export(
            module.eval(),
            tuple(given.values()),
            file,  # pyright: ignore[reportArgumentType]
            dynamo=False,
            input_names=list(given),
            output_names=list(outputs),
            dynamic_axes={k: v for k, v in _VARIES.items() if k in given or k in outputs},
            opset_version=_OPSET,
            do_constant_folding=False,
        )
    graph = onnx.load_from_string(file.getvalue())
    weights, outside = dict(module.named_parameters()), []
    for tensor in graph.graph.initializer:
        if tensor.name in weights:
            outside.append(tensor.name)
            tensor.ClearField("raw_data")
            tensor.data_location = onnx.TensorProto.EXTERNAL
            tensor.external_data.add(key="location", value=WEIGHTS)
    for node in graph.graph.node:
        node.ClearField("doc_string")
    return label(graph.SerializeToString(deterministic=True), outside)
