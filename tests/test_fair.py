"""The fair recipe: what teaches a body to look, whichever it is, and that it changes no score."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from relevance.cli import main
from relevance.models import BODIES, GEOMETRY, ModelConfig, RelevanceModel, Sight
from relevance.models.vit import ViTBody, VitConfig
from relevance.training import TrainConfig, batch_loss
from relevance.training.losses import _look_losses, _shown
from relevance.training.speed import made_up_batch

torch.set_num_threads(1)

FAIR: dict[str, ModelConfig] = {
    f"{body} {reading}".strip(): config
    for body in BODIES
    if hasattr(BODIES[body].config(), "taught")
    for reading, config in replace(BODIES[body].config.smoke(), taught=True).readings().items()
}
EACH = pytest.mark.parametrize("name", list(FAIR))


def made(config: ModelConfig) -> RelevanceModel:
    torch.manual_seed(2)
    return RelevanceModel(config)


@EACH
def test_every_body_is_taught_the_same(name: str) -> None:
    model = made(FAIR[name])
    batch = made_up_batch(FAIR[name].camera, scenes=2, goals=2, objects=4)
    parts = batch_loss(model.train(), batch, TrainConfig.fair())
    attention = {"attention"} if name.startswith("vit") else set()
    assert set(parts) == {"loss", "relevance", "mask", "geometry"} | attention
    weights = TrainConfig.fair()
    seen = parts["mask"] + parts.get("attention", torch.zeros(()))
    expected = parts["relevance"] + weights.mask_weight * seen
    expected = expected + weights.geometry_weight * parts["geometry"]
    assert parts["loss"].item() == pytest.approx(expected.item(), rel=1e-6)
    parts["loss"].backward()
    untouched = {key for key, weight in model.named_parameters() if weight.grad is None}
    assert all(".heads." in key for key in untouched)  # of predicates that were not asked


@EACH
def test_what_teaches_changes_no_score(name: str) -> None:
    model = made(FAIR[name])
    batch = made_up_batch(FAIR[name].camera, scenes=2, goals=2, objects=4)
    ((predicate, goals, _, _),) = batch.turns
    scores = [
        m.decode(m.encode(batch.image, batch.views), predicate, goals)
        for m in (model.train(), model.eval())
    ]
    torch.testing.assert_close(*scores)
    assert (
        model.eval().answer(model.encode(batch.image, batch.views), predicate, goals).sight is None
    )


def test_attention_of_a_view_is_shared_out_among_the_patches() -> None:
    body = made(VitConfig(width=32, heads=4, layers=2, hidden=8, taught=True)).body.train()
    assert isinstance(body, ViTBody)
    batch = made_up_batch(VitConfig().camera, scenes=2, goals=1, objects=3)
    encoding = body.encode(batch.image / 255, batch.views / 255, batch.present)
    assert encoding.sight is not None
    assert encoding.sight.attention is not None
    assert encoding.sight.attention.shape == (2 * 3, 60)
    torch.testing.assert_close(encoding.sight.attention.logsumexp(-1), torch.zeros(6))


def test_masks_say_which_cells_show_an_object() -> None:
    batch = made_up_batch(VitConfig().camera, scenes=1, goals=1, objects=2)
    cells = torch.zeros(1, 48, 80, dtype=torch.uint8)
    cells[0, 0:8, 8:16] = 1  # the second patch, whole
    cells[0, 8:12, 0:8] = 2  # half of the first patch of the second row
    cells[0, 16:18, 0:8] = 2  # and a quarter of the one below
    batch = replace(batch, cells=cells)
    shown = _shown(batch, (6, 10))
    assert shown.shape == (1, 2, 60)
    assert {int(i): float(shown[0, 0, i]) for i in shown[0, 0].nonzero()} == {1: 1.0}
    assert {int(i): float(shown[0, 1, i]) for i in shown[0, 1].nonzero()} == {10: 0.5, 20: 0.25}

    def losses(match: torch.Tensor) -> dict[str, float]:
        sight = Sight(
            scene=torch.zeros(1, dtype=torch.long),
            place=torch.ones(1, dtype=torch.long),
            geometry=batch.geometry[0, 1:2],
            match=match,
            grid=(6, 10),
        )
        return {key: value.item() for key, value in _look_losses([sight], batch).items()}

    assert losses(torch.zeros(1, 60)) == {
        "mask": pytest.approx(torch.tensor(60.0).log().item()),
        "geometry": 0.0,
    }
    right = torch.full((1, 60), -50.0)
    right[0, 10], right[0, 20] = torch.tensor(2 / 3).log(), torch.tensor(1 / 3).log()
    entropy = torch.distributions.Categorical(torch.tensor([2 / 3, 1 / 3])).entropy()
    assert losses(right)["mask"] == pytest.approx(entropy.item(), rel=1e-5)


def test_hidden_objects_teach_nothing_of_where_they_are() -> None:
    batch = made_up_batch(VitConfig().camera, scenes=1, goals=1, objects=2)
    batch = replace(batch, cells=torch.zeros_like(batch.cells))
    at = torch.zeros(1, dtype=torch.long)
    sight = Sight(
        scene=at, place=at, geometry=torch.zeros(1, GEOMETRY), match=torch.rand(1, 60), grid=(6, 10)
    )
    assert _look_losses([sight], batch)["mask"] == 0


def test_presets_have_the_help_or_have_none() -> None:
    for body in BODIES:
        model = TrainConfig.fair().with_body(body).model
        assert model == BODIES[body].config.fair()
        assert getattr(model, "taught", True)
        assert not getattr(TrainConfig.paper().with_body(body).model, "taught", False)
        assert not getattr(TrainConfig.demo().with_body(body).model, "taught", False)


def test_fair_is_a_preset_of_training_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "nowhere", "--preset", "fair"]) == 2
    assert "nowhere" in capsys.readouterr().err
    assert main(["generate", "nowhere", "--preset", "fair"]) == 2
    assert "--preset fair: expected one of smoke, demo, " in capsys.readouterr().err
