"""What bodies compute is the same on every device and however queries share encodings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from relevance.models import BODIES, GEOMETRY, ModelConfig, RelevanceModel
from relevance.training import TrainConfig, batch_loss, measure_speed
from relevance.training.speed import made_up_batch

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
READINGS: dict[str, ModelConfig] = {
    f"{body} {reading}".strip(): config
    for body in BODIES
    for reading, config in BODIES[body].config.smoke().readings().items()
}
EACH = pytest.mark.parametrize("name", list(READINGS))
ON = pytest.mark.parametrize("device", DEVICES)


@pytest.fixture(autouse=True)
def exact() -> Iterator[None]:
    """float32 means float32 on accelerators, too."""
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


def made(config: ModelConfig, device: str) -> RelevanceModel:
    """A model whose weights are drawn before it moves, so that they are equal everywhere."""
    torch.manual_seed(1)
    model = RelevanceModel(config)
    with torch.no_grad():  # away from zero, so that no term hides
        for weight in model.parameters():
            weight += 0.05 * torch.randn_like(weight)
    return model.to(device)


@ON
@EACH
@torch.inference_mode()
def test_shared_encodings_equal_one_a_query(name: str, device: str) -> None:
    model = made(READINGS[name], device).eval()
    batch = made_up_batch(READINGS[name].camera, scenes=2, goals=3, objects=5)
    ((predicate, goals, _, asked),) = batch.turns
    shared = model.decode(
        model.encode(batch.image, batch.views, poses=batch.geometry), predicate, goals
    ).cpu()
    for b, g, query in asked.nonzero().tolist():
        pair = goals[b, g].tolist()
        seen = [0, 1, 2, 3, 4] if model.body.among_all else [*pair, query]
        goal = torch.tensor([[[seen.index(pair[0]), seen.index(pair[1])]]])
        at = query if model.body.among_all else 2
        alone = model.encode(
            batch.image[b : b + 1],
            batch.views[b : b + 1, seen],
            poses=batch.geometry[b : b + 1, seen],
        )
        score = model.decode(alone, predicate, goal)[0, 0, at].cpu()
        assert abs(score - shared[b, g, query]) < 1e-5


@ON
@EACH
@torch.inference_mode()
def test_only_what_is_asked_is_scored(name: str, device: str) -> None:
    """Scores of the queries that are asked do not depend on which others are."""
    model = made(READINGS[name], device).eval()
    batch = made_up_batch(READINGS[name].camera, scenes=2, goals=3, objects=5)
    ((predicate, goals, asked, _),) = batch.turns
    assert 0 < asked.sum() < asked.numel()
    encoding = model.encode(batch.image, batch.views, poses=batch.geometry)
    every = model.decode(encoding, predicate, goals).cpu()
    some = model.decode(encoding, predicate, goals, asked).cpu()
    torch.testing.assert_close(some[asked], every[asked], atol=1e-5, rtol=0)
    none = model.decode(encoding, predicate, goals, torch.zeros_like(asked))
    assert none.shape == every.shape


@pytest.mark.skipif(len(DEVICES) == 1, reason="no accelerator")
@EACH
def test_a_step_is_the_same_on_every_device(name: str) -> None:
    config = replace(TrainConfig(), model=READINGS[name])
    found = []
    for device in DEVICES:
        model = made(config.model, device)
        optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
        batch = made_up_batch(config.model.camera, scenes=3, goals=2, objects=5)
        losses = []
        for _ in range(2):
            loss = batch_loss(model, batch.to(torch.device(device)), config)["loss"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(float(loss.detach()))
        found.append((losses, {k: v.cpu() for k, v in model.state_dict().items()}))
    (losses, weights), (losses_there, weights_there) = found
    assert losses_there == pytest.approx(losses, rel=1e-4)
    assert losses[1] != losses[0]
    for key, weight in weights.items():
        torch.testing.assert_close(weights_there[key], weight, atol=1e-4, rtol=1e-3)


@ON
def test_speed_of_a_body(device: str) -> None:
    config = TrainConfig(model=BODIES["vit"].config.smoke(), device=device)
    speed = measure_speed(config, scenes=2, goals=1, objects=4, queries=3, seconds=0.0)
    model = RelevanceModel(config.model, ["on-the-left"])
    assert speed.parameters == sum(weight.numel() for weight in model.parameters())
    assert speed.queries == pytest.approx(4 * speed.scenes)  # one goal, four objects
    assert min(speed.scenes, speed.queries_alone, speed.look) > 0


def test_made_up_batches_are_what_models_take() -> None:
    batch = made_up_batch(TrainConfig().model.camera, scenes=2, goals=3, objects=5)
    assert batch.image.shape == (2, 3, 192, 320)
    assert batch.geometry.shape == (2, 5, GEOMETRY)
    ((_, goals, relevant, asked),) = batch.turns
    assert goals.shape == (2, 3, 2)
    assert (goals[..., 0] != goals[..., 1]).all()
    assert relevant.shape == asked.shape == (2, 3, 5)
    assert asked.all()
