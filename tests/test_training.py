"""Training: recipes, losses, learning, metrics, config."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from ruled import ruled

from relevance.cli import main
from relevance.metrics import accuracy
from relevance.models import BODIES, RelevanceModel
from relevance.models.geometry import GeometryConfig
from relevance.models.glimpse import GlimpseConfig
from relevance.models.vit import VitConfig
from relevance.scene import PREDICATES
from relevance.store import Dataset
from relevance.training import (
    Batch,
    Catalogue,
    Reader,
    TrainConfig,
    Trainer,
    TrainingError,
    batch_loss,
    measure,
    relevance_loss,
)
from relevance.training.losses import OBJECTS
from relevance.training.trainer import reader_for

torch.set_num_threads(1)  # threads that wait for each other crawl on a busy machine

SAME_PLANE = tuple(p for p in PREDICATES.values() if p is not PREDICATES["on"])
CONFIG = TrainConfig(
    model=GlimpseConfig(width=32, heads=2, layers=1, channels=8),
    steps=6,
    scenes_per_batch=4,
    save_every=2,
    threads=1,
)


@pytest.fixture(scope="module")
def made() -> Path:
    """Real scenes and images in real shards."""
    return ruled()


def reader(root: Path, config: TrainConfig, split: str = "train") -> Reader:
    return Reader(catalogue=Catalogue.of(Dataset.open(root), split, config), config=config)


def draw_batches(root: Path, config: TrainConfig, step: int) -> list[Batch]:
    """What a step learns from."""
    return next(reader(root, config).steps(step))


def draw_batch(root: Path, config: TrainConfig, step: int) -> Batch:
    """What a step learns from, where it is one batch."""
    [batch] = draw_batches(root, config, step)
    return batch


def trainer_of(root: Path, config: TrainConfig) -> tuple[Trainer, Iterator[list[Batch]]]:
    """A trainer and what it learns from."""
    own = reader(root, config)
    return Trainer(config, own.catalogue.predicates), own.steps()


SMALL = {
    "glimpse": GlimpseConfig(width=64, heads=2, layers=1, channels=16),
    "vit": VitConfig(width=64, heads=2, layers=1, hidden=64),
    "geometry": GeometryConfig(width=64, heads=2, layers=1),
}


# --- recipes ------------------------------------------------------------------------------


def test_rounds_have_a_batch_of_each_in_every_step(made: Path) -> None:
    config = replace(CONFIG, polling="rounds", mirror=False)
    steps = [draw_batches(made, config, step) for step in range(3)]
    for batches in steps:
        assert [[turn[0] for turn in b.turns] for b in batches] == [
            [*SAME_PLANE],
            [PREDICATES["on"]],
        ]
    trainer, ahead = trainer_of(made, replace(config, model=GlimpseConfig.smoke()))
    parts = [batch_loss(trainer.model, batch, config)["loss"].item() for batch in steps[0]]
    assert trainer.take(ahead)["loss"] == pytest.approx(np.mean(parts), rel=1e-5)


@pytest.mark.parametrize("share", [True, False])
def test_one_by_one_trains_each_for_its_share_of_the_steps(made: Path, share: bool) -> None:
    config = replace(CONFIG, polling="one-by-one", steps=10, share_encodings=share, mirror=False)
    seen = [draw_batch(made, config, step).turns for step in range(10)]
    assert [[turn[0] for turn in turns] for turns in seen] == [
        [p] for p in PREDICATES.values() for _ in range(2)
    ]


def test_queries_are_drawn_uniformly(made: Path) -> None:
    """Each query of a predicate comes once before any comes again, whatever its scene has."""
    config = replace(
        CONFIG, queries_per_batch=7, goal_objects=False, share_encodings=False, steps=100,
        predicates=("behind",), mirror=False, recolor=False,
    )  # fmt: skip
    rows = Dataset.open(made).read_rows("labels", split="train", predicate="behind")
    names = ("scene_id", "subject", "reference", "query")
    asked = {
        tuple(row[n] for n in names): row["relevant"] for row in rows if not row["is_goal_object"]
    }
    scenes = {s.scene.id: s.scene.names for s in Dataset.open(made).samples("train")}
    drawn: list[tuple[str, ...]] = []
    for [batch] in reader(made, config).steps():
        [(_, pairs, relevant, wanted)] = batch.turns
        assert wanted.sum() <= 7
        for b, g, query in wanted.nonzero().tolist():
            own = scenes[batch.names[b]]
            drawn.append((batch.names[b], *(own[i] for i in [*pairs[b, g].tolist(), query])))
            assert asked[drawn[-1]] == relevant[b, g, query]
    first = drawn[: len(asked) // 7 * 7]
    assert len(first) == len({*first}) > 7, "none comes again in the first epoch"
    count = np.array([drawn.count(query) for query in asked])
    assert count.sum() == len(drawn) > 5 * len(asked)
    assert count.min() > 0.8 * count.max(), "drawn twice in one batch, it is asked once"


def objects(batch: Batch) -> float:
    """Of a scene, on average."""
    return float(batch.present.sum(-1).float().mean())


def test_a_query_weighs_the_same_in_large_scenes_and_in_small_ones(made: Path) -> None:
    """Scenes of a batch have like numbers of objects, so a mean over it would not do."""
    model = RelevanceModel(GeometryConfig(width=32, heads=2, layers=1)).eval()
    single = sorted(reader(made, CONFIG).whole(scenes=1), key=objects)
    assert objects(single[0]) < objects(single[-1])
    for batch in (single[0], single[-1]):
        sums = []
        for p, goals, relevant, labelled in batch.turns:
            scores = model.decode(model.told_of(batch.present, batch.geometry), p, goals)
            mean = relevance_loss(scores, relevant, labelled, CONFIG.eta(p)).item()
            sums.append(mean * int(labelled.sum()) / int(labelled.any(-1).sum()))
        found = batch_loss(model, batch, CONFIG)["relevance"].item()
        assert found == pytest.approx(np.mean(sums) / OBJECTS, rel=1e-4)


def test_first_it_is_told_then_it_is_shown(made: Path) -> None:
    config = replace(CONFIG, told_share=0.5, steps=8, workers=0)
    trainer, _ = trainer_of(made, config)
    ahead = reader_for(reader(made, config).catalogue, trainer).steps()
    eyes = {n: w.clone() for n, w in trainer.model.named_parameters() if ".scene." in n}
    assert eyes
    for step in range(config.steps):
        found = trainer.take(ahead)
        now = dict(trainer.model.named_parameters())
        assert ("geometry" in found) == (step >= 4), (
            "where objects are is not asked while it is told"
        )
        still = all(torch.equal(weight, now[name]) for name, weight in eyes.items())
        assert still == (step < 4)
    assert trainer.history[3].keys() != trainer.history[-1].keys()
    # A body that cannot be told is shown from the first step on.
    trainer, _ = trainer_of(made, replace(config, model=VitConfig.smoke()))
    [batch] = next(reader_for(reader(made, config).catalogue, trainer).steps())
    assert batch.image.any()


def test_goal_objects_can_be_left_out_of_the_loss(made: Path) -> None:
    torch.manual_seed(0)
    model = RelevanceModel(VitConfig.smoke())
    batch = draw_batch(made, replace(CONFIG, mirror=False), 1)
    [(predicate, goals, relevant, labelled)] = batch.turns
    encoding = model.encode(batch.image, batch.views, batch.present)
    scores = model.decode(encoding, predicate, goals)
    queries = labelled.clone()
    for b, g in np.ndindex(*goals.shape[:2]):
        queries[b, g, goals[b, g]] = False
    expected = objects(batch) / OBJECTS * relevance_loss(scores, relevant, queries, CONFIG.eta_on)
    found = batch_loss(model, batch, replace(CONFIG, goal_objects=False))["relevance"]
    assert found.item() == pytest.approx(expected.item(), rel=1e-5)
    assert found.item() != pytest.approx(batch_loss(model, batch, CONFIG)["relevance"].item())


def test_the_bare_recipe_is_plain_adam(made: Path) -> None:
    paper = TrainConfig.paper()
    config = replace(paper, model=VitConfig.smoke(), predicates=(), device="auto", bfloat16="off")
    trainer, ahead = trainer_of(made, config)
    assert {trainer.rate(step) for step in (0, 1, 1000, 499_999)} == {1e-5}
    before = [w.detach().clone() for w in trainer.model.parameters()]
    torch.manual_seed(0)
    plain, _ = trainer_of(made, config)
    adam = torch.optim.Adam(plain.model.parameters(), lr=1e-5)
    for step in range(2):
        trainer.take(ahead)
        adam.zero_grad()
        batch_loss(plain.model, draw_batch(made, config, step), config)["loss"].backward()
        adam.step()
    pairs = zip(trainer.model.parameters(), plain.model.parameters(), before, strict=True)
    assert any((a != c).any() for a, _, c in pairs)
    for a, b in zip(trainer.model.parameters(), plain.model.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8)


def test_a_loss_that_is_no_number_names_the_scenes(made: Path) -> None:
    trainer, ahead = trainer_of(made, CONFIG)
    trainer.take(ahead)
    with torch.no_grad():
        for weight in trainer.model.body.heads.parameters():
            weight.fill_(torch.inf)
    with pytest.raises(TrainingError, match="step 1: the loss is nan on scenes ") as error:
        trainer.take(ahead)
    assert trainer.done == 1
    names = draw_batch(made, CONFIG, 1).names
    assert all(name in str(error.value) for name in names)


# --- the loss and learning ----------------------------------------------------------------


def test_loss_weighs_each_predicate_with_its_eta(made: Path) -> None:
    torch.manual_seed(0)
    model = RelevanceModel(VitConfig.smoke())
    config = replace(CONFIG, mirror=False, eta_same_plane=0.8, eta_on=0.6)
    for step, eta in ((0, 0.8), (1, 0.6)):
        batch = draw_batch(made, config, step)
        encoding = model.encode(batch.image, batch.views, batch.present)
        terms = [
            relevance_loss(model.decode(encoding, p, goals), relevant, labelled, eta)
            for p, goals, relevant, labelled in batch.turns
        ]
        expected = sum(float(term.detach()) for term in terms) / len(terms)
        expected *= objects(batch) / OBJECTS
        parts = batch_loss(model, batch, config)
        assert parts["loss"].item() == pytest.approx(expected, rel=1e-5)
        assert set(parts) == {"loss", "relevance"}


def test_each_scene_is_encoded_once_for_all_goals_and_predicates(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = RelevanceModel(CONFIG.model)
    calls = []
    encode = model.encode
    monkeypatch.setattr(model, "encode", lambda *a: (calls.append(a[0].shape[0]), encode(*a))[1])
    batch = draw_batch(made, CONFIG, 0)
    batch_loss(model, batch, CONFIG)
    assert calls == [CONFIG.scenes_per_batch]
    assert len(batch.turns) == 4


@pytest.mark.parametrize(
    "body",
    [body if body == "glimpse" else pytest.param(body, marks=pytest.mark.slow) for body in SMALL],
)
def test_a_network_learns_a_few_scenes_by_heart(made: Path, body: str) -> None:
    model = SMALL[body]
    config = replace(
        CONFIG,
        model=model,
        steps=144,
        scenes_per_batch=6,
        learning_rate=3e-3,
        mirror=False,
        recolor=False,
        # the toy rule calls most objects relevant: weigh both sides alike
        eta_same_plane=0.5,
        eta_on=0.5,
    )
    trainer, ahead = trainer_of(made, config)
    before = measure(trainer.model, reader(made, config).whole())
    losses = [trainer.take(ahead) for _ in range(config.steps)]
    after = measure(trainer.model, reader(made, config).whole())
    # Batches of large scenes weigh more: like is held against like, all sizes against all.
    first, last = (np.mean([x["relevance"] for x in some]) for some in (losses[:16], losses[-16:]))
    assert last < 0.5 * first
    for family in ("same-plane", "on"):
        found = after[family]["with_goal_objects"]
        assert found["balanced"] > 0.8 > before[family]["with_goal_objects"]["balanced"]
        assert found["total"] > found["base_rate"] + 0.1


def test_rate_rises_then_falls(made: Path) -> None:
    trainer, _ = trainer_of(made, replace(CONFIG, steps=200, warmup=0.05))
    rates = [trainer.rate(step) for step in range(200)]
    assert rates[9] == pytest.approx(CONFIG.learning_rate)
    assert max(rates) == pytest.approx(CONFIG.learning_rate)
    assert rates[0] == pytest.approx(CONFIG.learning_rate / 10)
    assert all(a > b for a, b in pairwise(rates[10:]))
    assert rates[-1] < 1e-3 * CONFIG.learning_rate
    assert rates[105] == pytest.approx(CONFIG.learning_rate / 2, rel=1e-6)


def test_loss_by_hand() -> None:
    scores = torch.tensor([2.0, -1.0, 0.5, 9.0])
    relevant = torch.tensor([True, True, False, True])
    mask = torch.tensor([True, True, True, False])
    p = [1 / (1 + math.exp(-s)) for s in (2.0, -1.0, 0.5)]
    by_hand = -(0.86 * math.log(p[0]) + 0.86 * math.log(p[1]) + 0.14 * math.log(1 - p[2])) / 3
    assert float(relevance_loss(scores, relevant, mask, 0.86)) == pytest.approx(by_hand, abs=1e-6)
    # missing a relevant object costs more than keeping an irrelevant one
    missed = relevance_loss(torch.tensor([-1.0]), torch.ones(1), torch.ones(1), 0.86)
    kept = relevance_loss(torch.tensor([1.0]), torch.zeros(1), torch.ones(1), 0.86)
    assert float(missed / kept) == pytest.approx(0.86 / 0.14, rel=1e-5)


def test_loss_of_nothing_is_zero_and_of_extreme_scores_finite() -> None:
    scores = torch.tensor([400.0, -400.0], requires_grad=True)
    assert relevance_loss(scores, torch.zeros(2), torch.zeros(2), 0.7).item() == 0.0
    loss = relevance_loss(scores, torch.tensor([0.0, 1.0]), torch.ones(2), 0.7)
    loss.backward()
    assert torch.isfinite(loss)
    assert scores.grad is not None
    assert torch.isfinite(scores.grad).all()


# --- metrics and config -------------------------------------------------------------------


def test_accuracy_by_hand() -> None:
    score = np.array([3.0, -1.0, 0.5, -2.0, -3.0, 0.5])
    relevant = np.array([True, True, False, False, False, True])
    found = accuracy(score, relevant)
    assert found["relevant"] == 3
    assert found["irrelevant"] == 3
    assert found["true_relevant"] == pytest.approx(2 / 3)
    assert found["true_irrelevant"] == pytest.approx(2 / 3)
    assert found["total"] == pytest.approx(4 / 6)
    assert found["base_rate"] == pytest.approx(0.5)
    assert found["balanced"] == pytest.approx(2 / 3)
    # pairs won: 3.0 wins 3, -1.0 wins 2, 0.5 wins 2 and ties 1
    assert found["auc"] == pytest.approx((3 + 2 + 2.5) / 9)


def test_accuracy_of_one_class_or_of_nothing_has_no_balance() -> None:
    separable = accuracy(np.array([-1.0, 3.0, 2.0, -4.0]), np.array([False, True, True, False]))
    assert separable["best_beta"] == pytest.approx(-0.5)
    none = accuracy(np.array([1.0, 2.0]), np.array([False, False]))
    assert none["best_beta"] is not None
    assert none["best_beta"] < -2.0
    assert accuracy(np.array([1.0]), np.array([True]))["balanced"] is None
    assert accuracy(np.array([1.0]), np.array([True]))["auc"] is None
    assert accuracy(np.zeros(0), np.zeros(0, bool))["total"] is None


def test_measure_counts_queries_and_goals(made: Path) -> None:
    model = RelevanceModel(CONFIG.model)
    found = measure(model, reader(made, CONFIG).whole(scenes=3))
    rows = Dataset.open(made).read_rows("labels", split="train")
    for predicate in PREDICATES.values():
        own = [row for row in rows if row["predicate"] == predicate.name]
        queries = [row for row in own if not row["is_goal_object"]]
        group = found[predicate.name]
        assert group["goals"] == len({row["plan_id"] for row in own})
        for name, part in (("queries", queries), ("with_goal_objects", own)):
            relevant = sum(row["relevant"] for row in part)
            assert group[name]["relevant"] == relevant
            assert group[name]["irrelevant"] == len(part) - relevant
            assert group[name]["base_rate"] == pytest.approx(1 - relevant / len(part))
    assert found["same-plane"]["goals"] == sum(found[p.name]["goals"] for p in SAME_PLANE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, r"TrainConfig\.steps = 0: expected greater than or equal to 1"),
        ({"learning_rate": 0.0}, r"TrainConfig\.learning_rate = 0\.0: expected greater than 0"),
        ({"eta_on": 1.0}, r"TrainConfig\.eta_on = 1\.0: expected less than 1"),
        ({"warmup": 1.0}, r"TrainConfig\.warmup = 1\.0: expected less than 1"),
        ({"bfloat16": "maybe"}, r"TrainConfig\.bfloat16 = 'maybe': expected 'auto', 'on' or 'off'"),
    ],
)
def test_config_refuses(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrainConfig(**change)


def test_only_what_decides_the_weights_is_in_the_identity() -> None:
    """A setting that has its default, a word for people, or how it is run names nothing."""
    named = CONFIG.content_hash
    for change in (
        {"preset": "laptop"},
        {"threads": 2},
        {"save_every": 7},
        {"workers": 0},
        {"device": "cuda"},
        {"weight_decay": 0.02},
    ):
        assert replace(CONFIG, **change).content_hash == named
    vit = replace(CONFIG, model=VitConfig())
    glimpse = replace(CONFIG, model=GlimpseConfig())
    hashes = {named, vit.content_hash, glimpse.content_hash, replace(vit, seed=1).content_hash}
    assert len(hashes) == 4


def test_a_new_version_of_a_body_renames_its_own_checkpoints_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vit = replace(CONFIG, model=VitConfig())
    before = CONFIG.content_hash, vit.content_hash
    kind = replace(BODIES["vit"], version="next")
    monkeypatch.setitem(BODIES._items, "vit", kind)
    assert CONFIG.content_hash == before[0]
    assert vit.content_hash != before[1]


def test_another_body_takes_the_sizes_of_the_preset() -> None:
    assert TrainConfig.smoke().with_body("vit").model == VitConfig.smoke()
    assert TrainConfig.demo().with_body("vit").model == VitConfig()
    assert TrainConfig.paper().with_body("glimpse").model == GlimpseConfig.paper()
    assert CONFIG.with_body("glimpse") == CONFIG
    with pytest.raises(ValueError, match="unknown body 'cnn', expected one of geometry, "):
        CONFIG.with_body("cnn")


def test_presets_survive_plain_values() -> None:
    for config in (TrainConfig.smoke(), TrainConfig.demo(), TrainConfig.laptop()):
        assert TrainConfig.from_dict(config.to_dict()) == config
    paper = TrainConfig.from_dict(TrainConfig.paper().to_dict())
    assert paper.model == VitConfig.paper()
    assert TrainConfig.demo().content_hash != TrainConfig.smoke().content_hash


def test_flags_are_those_of_the_body_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    for body, own, other in (
        ("glimpse", "--model.window", "--model.hidden"),
        ("vit", "--model.hidden", "--model.window"),
    ):
        with pytest.raises(SystemExit) as left:
            main(["train", "--help", "--model.body", body])
        shown = capsys.readouterr().out
        assert left.value.code == 0
        assert {"--model.body", "--model.width", own} <= set(shown.split())
        assert other not in shown.split()
    assert main(["train", "none", "--model.body", "cnn"]) == 2
    assert "unknown body 'cnn', expected one of geometry, " in capsys.readouterr().err
    assert main(["train", "none", "--model.body", "vit", "--model.width", "64"]) == 2
    assert "no dataset.json there" in capsys.readouterr().err
