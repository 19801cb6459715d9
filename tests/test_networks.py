"""Networks without torch: equal to torch's, one with their weights, else refused."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from relevance.errors import RelevanceWarning
from relevance.evaluation import NetworkScorer, load_scorer
from relevance.models import BODIES, PATCH, RelevanceModel
from relevance.networks import (
    GEOMETRY,
    CheckpointError,
    GraphNetwork,
    named,
    read_checkpoint,
    write_checkpoint,
)
from relevance.scene import PREDICATES
from relevance.training import TrainConfig, load_checkpoint, save_checkpoint

torch.set_num_threads(1)
ROOT = Path(__file__).parent.parent


def saved(path: Path, body: str, seed: int = 0) -> Path:
    """A checkpoint of untrained weights."""
    config = TrainConfig.smoke().with_body(body)
    torch.manual_seed(seed)
    model = RelevanceModel(config.model, ["on-the-left", "on"])
    save_checkpoint(path, model, {"checkpoint_id": f"{body}-1", "config": config.to_dict()})
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("networks")
    return {body: saved(folder / f"{body}.pt", body) for body in ("glimpse", "geometry", "vit")}


def opened(path: str | Path) -> GraphNetwork:
    file = named(path)
    return GraphNetwork(read_checkpoint(file), file)


def asked(network: GraphNetwork | RelevanceModel, objects: int) -> np.ndarray:
    """Scores of made-up scenes: what they show is smooth, as pictures are."""
    rng, camera = np.random.default_rng(objects), network.camera
    blots = rng.integers(0, 256, (camera.height // 16, camera.width // 16, 3), np.uint8)
    image = cv2.resize(blots, (camera.width, camera.height))
    # Some stand at the very edge, where a window reaches beyond the picture.
    places = rng.integers(0, [camera.height - PATCH, camera.width - PATCH], (objects, 2))
    places[:2] = [[0, 0], [camera.height - PATCH, camera.width - PATCH]]
    views = np.stack([image[r : r + PATCH, c : c + PATCH] for r, c in places])
    poses = rng.uniform(-3, 3, (objects, GEOMETRY)).astype(np.float32) if network.told else None
    goals = np.array([[0, 1], [1, 0], [objects - 1, 0]])
    seen = network.look(image, views, poses)
    heads = [PREDICATES[name] for name in ("on-the-left", "on")]
    return np.stack([network.judge(seen, head, goals) for head in heads])


def assert_equal(network: GraphNetwork, model: RelevanceModel, objects: int) -> None:
    found, expected = asked(network, objects), asked(model, objects)
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-5 * max(1, abs(expected).max()))


@pytest.mark.parametrize("name", ["glimpse", "geometry"])
def test_shipped_networks_score_as_in_torch(name: str) -> None:
    network, (model, _) = opened(name), load_checkpoint(name, "cpu")
    assert network.predicates == model.predicates
    assert network.camera == model.camera
    assert network.told == model.told
    for objects in (2, 3, 7, 10, 30):
        assert_equal(network, model, objects)


@pytest.mark.parametrize("body", ["glimpse", "geometry", "vit"])
def test_graphs_of_every_body_that_has_some(body: str, files: dict[str, Path]) -> None:
    network, (model, _) = opened(files[body]), load_checkpoint(files[body], "cpu")
    outside = {"glimpse": {"edges", "between"}, "geometry": {"between"}, "vit": set()}[body]
    assert set(read_checkpoint(files[body]).graphs) == {"encode", "on-the-left", "on"} | outside
    for objects in (2, 3, 11):
        assert_equal(network, model, objects)


def test_a_graph_has_no_weights_of_its_own(files: dict[str, Path], tmp_path: Path) -> None:
    """What is changed in a checkpoint changes its graphs' scores: they cannot drift apart."""
    found = read_checkpoint(files["geometry"])
    rng = np.random.default_rng(0)
    weights = {
        name: values + rng.normal(0, 0.05, values.shape).astype(values.dtype)
        for name, values in found.weights.items()
    }
    path = tmp_path / "changed.pt"
    write_checkpoint(path, replace(found, weights=weights))
    model, _ = load_checkpoint(path, "cpu")
    before, after = asked(opened(files["geometry"]), 5), asked(opened(path), 5)
    assert np.abs(after - before).max() > 1e-2
    expected = asked(model, 5)
    np.testing.assert_allclose(after, expected, rtol=0, atol=3e-5 * max(1, abs(expected).max()))
    assert all(graph == read_checkpoint(path).graphs[name] for name, graph in found.graphs.items())
    again = saved(tmp_path / "again.pt", "geometry", seed=1)
    assert read_checkpoint(again).graphs == found.graphs, "graphs are of the settings alone"


def refused(path: Path) -> str:
    with pytest.raises(CheckpointError) as error:
        load_scorer(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_graphs_that_do_not_fit(files: dict[str, Path], tmp_path: Path) -> None:
    found, path = read_checkpoint(files["geometry"]), tmp_path / "other.pt"
    line, _, graph = found.graphs["encode"].partition(b"\n")

    def write(encode: bytes, **more: np.ndarray) -> None:
        graphs = dict(found.graphs) | {"encode": encode}
        write_checkpoint(path, replace(found, graphs=graphs, weights=dict(found.weights) | more))

    write(line.replace(b'"version": 1', b'"version": 7') + b"\n" + graph)
    assert "graphs are of version 7, expected 1" in refused(path)
    write(line + b"\n" + graph[: len(graph) // 2])
    assert "graph encode does not fit" in refused(path)
    write(graph)
    assert "graph encode does not fit" in refused(path)
    write(line + b"\n" + graph, **{"body.token.0.bias": np.zeros(3, np.float32)})
    assert "graph encode does not fit" in refused(path)
    lacking = {name: v for name, v in found.weights.items() if name != "body.token.0.bias"}
    write_checkpoint(path, replace(found, weights=lacking))
    assert "graph encode does not fit" in refused(path)


def test_a_damaged_file_is_refused_without_torch(files: dict[str, Path], tmp_path: Path) -> None:
    content, path = files["geometry"].read_bytes(), tmp_path / "damaged.pt"
    for damaged in (content[:-1], content[: len(content) // 2], content + b"0", content[:20]):
        path.write_bytes(damaged)
        refused(path)


def test_bodies_without_graphs_keep_torch_and_say_so(tmp_path: Path) -> None:
    path = saved(tmp_path / "resnet.pt", "resnet")
    with pytest.warns(RelevanceWarning, match="body resnet has no graph") as warned:
        scorer = load_scorer(path)
    assert "\n" not in str(warned[0].message)
    assert isinstance(scorer, NetworkScorer)
    assert isinstance(scorer.model, RelevanceModel)


def test_what_cannot_be_traced_is_saved_without_graphs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = BODIES["geometry"]

    class Twisted(kind.make):  # pyright: ignore
        def decode(self, encoding, predicate, goals, asked):
            if torch.onnx.is_in_onnx_export():
                raise RuntimeError("not\nthis one")
            return super().decode(encoding, predicate, goals, asked)

    monkeypatch.setitem(BODIES._items, "geometry", replace(kind, make=Twisted))
    path = tmp_path / "twisted.pt"
    config = TrainConfig.smoke().with_body("geometry")
    model = RelevanceModel(config.model, ["in-front"])
    with pytest.warns(RelevanceWarning, match="no graph of body geometry \\(not this one\\)"):
        save_checkpoint(path, model, {"checkpoint_id": "g-1", "config": config.to_dict()})
    assert read_checkpoint(path).graphs == {}


def test_planning_with_a_guide_imports_no_torch() -> None:
    script = f"""
import sys, relevance
from relevance.planner import PlannerConfig
scene = relevance.read_scenes({str(ROOT / "tests/cases/already-true.jsonl")!r})[0]
for name in ("glimpse", "geometry"):
    guide = relevance.load_guide(name, mode="order")
    goal = scene.goal(f"on-the-left({{scene.names[0]}}, {{scene.names[1]}})")
    result = relevance.plan(scene, goal, config=PlannerConfig(node_limit=1), guide=guide)
    guide.scorer.scores(scene, goal)
    print(name, result.status, *(m for m in ("torch", "onnx", "monai") if m in sys.modules))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["glimpse", "geometry"]
    assert all(len(line.split()) == 2 for line in lines), lines
