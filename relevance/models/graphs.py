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
from relevance.models.reasoning import Thinker
from relevance.models.registry import RelevanceModel
from relevance.networks import GEOMETRY, WEIGHTS, label
from relevance.networks.obstruction import OBSTRUCTION
from relevance.scene import PREDICATES

_OPSET = 20
_SEEN = ("tokens", "geometry", "scene")


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
    """The graphs that a `GraphNetwork` runs: `encode`, `between` of bodies that are told what is in
    the way, and one for each predicate.

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
    camera, objects = config.camera, 3
    if model.told:
        given: dict[str, Tensor] = {"poses": torch.ones(objects, GEOMETRY)}
    else:
        given = {
            "image": torch.zeros(3, camera.height, camera.width, dtype=torch.uint8),
            "views": torch.zeros(objects, 3, PATCH, PATCH, dtype=torch.uint8),
        }
    varies = {"views": {0: "N"}, "poses": {0: "N"}, "tokens": {1: "N"}, "geometry": {1: "N"}}
    varies |= {"picks": {1: "N", 2: "N"}, "between": {1: "N", 2: "N"}}
    varies |= {"goals": {0: "G"}, "places": {1: "G", 2: "N"}, "scores": {0: "G", 1: "N"}}
    with torch.no_grad():
        encoder = _Encoder(model)
        found = encoder(*given.values())
        whole = model.encode(
            torch.zeros(1, 3, camera.height, camera.width),
            torch.zeros(1, objects, 3, PATCH, PATCH),
            poses=torch.ones(1, objects, GEOMETRY),
        )
        seen = [name for name in _SEEN if getattr(whole, name) is not None]
        graphs = {"encode": _traced(encoder, given, seen, varies)}
        parts = dict(zip(seen, found, strict=True))
        if isinstance(model.body, Thinker):
            told = {"geometry": parts["geometry"]}
            told["picks"] = torch.zeros(1, objects, objects, OBSTRUCTION)
            graphs["between"] = _traced(_Between(model.body), told, ["between"], varies)
            assert whole.between is not None
            parts["between"] = whole.between
            parts["places"] = torch.zeros(1, 2, objects, OBSTRUCTION)
        for name in predicates:
            inputs = parts | {"goals": torch.tensor([[0, 1], [1, 2]])}
            graphs[name] = _traced(_Decoder(model, name, list(parts)), inputs, ["scores"], varies)
    return tuple(graphs.items())


def _traced(
    module: nn.Module, given: dict[str, Tensor], outputs: Sequence[str], varies: dict
) -> bytes:
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
            dynamic_axes={k: v for k, v in varies.items() if k in given or k in outputs},
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
