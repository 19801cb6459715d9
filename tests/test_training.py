"""Training: polling order, batches by (seed, step), losses, learning, metrics, config."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from ruled import ruled

from relevance import training
from relevance.cli import main
from relevance.metrics import accuracy
from relevance.models import BODIES, RelevanceModel
from relevance.models.geometry import GeometryConfig
from relevance.models.glimpse import GlimpseConfig
from relevance.models.vit import VitConfig
from relevance.scene import PREDICATES, Camera
from relevance.store import Dataset, DatasetError
from relevance.training import (
    TrainConfig,
    batch_loss,
    draw_batch,
    draw_batches,
    measure,
    polling,
    relevance_loss,
)
from relevance.training.examples import (
    Examples,
    gather,
    in_the_mirror,
    load_examples,
    true_geometry,
)

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


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy of its own for a test that writes."""
    return Path(shutil.copytree(made, tmp_path / "dataset"))


@pytest.fixture(scope="module")
def examples(made: Path) -> Examples:
    return load_examples(Dataset.open(made), "train", camera=Camera())


# --- polling and batches ------------------------------------------------------------------


def test_polling_takes_the_predicates_in_turn(examples: Examples) -> None:
    strict = replace(CONFIG, share_encodings=False, mirror=False)
    seen = [draw_batch(examples, strict, step).turns[0][0] for step in range(12)]
    assert seen == [*PREDICATES.values(), *PREDICATES.values(), *list(PREDICATES.values())[:2]]
    shared = replace(strict, share_encodings=True)
    steps = [[turn[0] for turn in draw_batch(examples, shared, s).turns] for s in range(4)]
    assert steps == [[*SAME_PLANE], [PREDICATES["on"]]] * 2
    assert [p for step in steps for p in step] == [*PREDICATES.values(), *PREDICATES.values()]


def test_polling_shares_steps_only_among_neighbours_of_a_family() -> None:
    mixed = [
        PREDICATES["on-the-left"],
        PREDICATES["on"],
        PREDICATES["behind"],
        PREDICATES["in-front"],
    ]
    assert polling(mixed, share=True) == [(mixed[0],), (mixed[1],), (mixed[2], mixed[3])]
    assert polling(mixed, share=False) == [(p,) for p in mixed]


def test_a_predicate_without_labels_is_left_out(root: Path) -> None:
    shutil.rmtree(root / "labels/predicate=behind")
    examples = load_examples(Dataset.open(root), "train", camera=Camera())
    steps = [draw_batch(examples, replace(CONFIG, mirror=False), s).turns for s in range(2)]
    names = [turn[0].name for turns in steps for turn in turns]
    assert names == ["on-the-left", "on-the-right", "in-front", "on"]


def test_every_scene_comes_before_any_comes_again(examples: Examples) -> None:
    config = replace(CONFIG, scenes_per_batch=3, mirror=False, recolor=False)
    for first, own in ((0, examples.scenes(SAME_PLANE)), (1, examples.scenes([PREDICATES["on"]]))):
        shown: list[int] = []
        for step in range(first, first + 2 * 2 * len(own), 2):
            image = draw_batch(examples, config, step).image.permute(0, 2, 3, 1).numpy()
            for picture in image:
                match = [i for i in own if np.array_equal(picture, examples.images[i])]
                assert len(match) == 1
                shown += match
        epochs = np.array(shown).reshape(-1, len(own))
        assert len(epochs) == 6
        assert (np.sort(epochs, axis=1) == own).all()
        assert (epochs[0] != epochs[1]).any(), "each epoch has an order of its own"


def test_a_batch_depends_on_seed_and_step_alone(examples: Examples) -> None:
    def same(a: training.Batch, b: training.Batch) -> bool:
        tensors = [(x.image, x.views, x.geometry, *x.turns[0][1:]) for x in (a, b)]
        return all(
            x.shape == y.shape and bool((x == y).all()) for x, y in zip(*tensors, strict=True)
        )

    batches = [draw_batch(examples, CONFIG, step) for step in range(6)]
    assert all(same(batches[s], draw_batch(examples, CONFIG, s)) for s in reversed(range(6)))
    other = replace(CONFIG, seed=1)
    assert not all(same(batches[s], draw_batch(examples, other, s)) for s in range(6))


def test_most_goals_of_a_scene(examples: Examples) -> None:
    one = replace(CONFIG, goals_per_scene=1)
    for step in range(4):
        for _, goals, _, labelled in draw_batch(examples, one, step).turns:
            assert goals.shape[1] == 1
            assert labelled.any(-1).all()


def test_examples_are_the_stored_scenes_and_labels(made: Path, examples: Examples) -> None:
    dataset = Dataset.open(made)
    samples = list(dataset.samples("train"))
    assert len(examples.images) == len(samples) == 10
    place = {sample.scene.id: i for i, sample in enumerate(samples)}
    for i, sample in enumerate(samples):
        count = len(sample.scene.objects)
        assert np.array_equal(examples.images[i], sample.image)
        assert np.array_equal(examples.views[i, :count], sample.views)
        assert examples.present[i].sum() == count
        for row, box in zip(examples.geometry[i], sample.scene.objects, strict=False):
            np.testing.assert_allclose(row[:3] / 10, box.position, atol=1e-6)
            np.testing.assert_allclose(row[3:6] / 10, box.size, atol=1e-6)
            np.testing.assert_allclose(row[[6, 10]] / 10, box.extents, atol=1e-6)
        shown = set(np.unique(examples.cells[i])) - {0}
        assert shown == set(range(1, count + 1))
    for predicate in PREDICATES.values():
        goals = examples.goals[predicate]
        expected = {}
        for row in dataset.read_rows("labels", split="train", predicate=predicate.name):
            names = samples[place[row["scene_id"]]].scene.names
            key = place[row["scene_id"]], names.index(row["subject"]), names.index(row["reference"])
            expected.setdefault(key, {})[names.index(row["query"])] = row["relevant"]
        found = {}
        for i in range(len(samples)):
            for k in range(goals.first[i], goals.first[i + 1]):
                known = np.flatnonzero(goals.labelled[k]).tolist()
                found[i, *goals.pairs[k].tolist()] = {q: goals.relevant[k, q] for q in known}
        assert found == expected


def test_images_mapped_from_a_file_are_the_same(
    made: Path, examples: Examples, tmp_path: Path
) -> None:
    dataset = Dataset.open(made)
    mapped = load_examples(dataset, "train", camera=Camera(), cache_bytes=1, folder=tmp_path)
    assert isinstance(mapped.images, np.memmap)
    assert np.array_equal(mapped.images, examples.images)
    assert np.array_equal(mapped.views, examples.views)
    assert list(tmp_path.iterdir()) == [], "the file has no name, so it cannot be left behind"


def test_ambiguous_goals_and_other_policies_can_be_left_out(made: Path, examples: Examples) -> None:
    dataset = Dataset.open(made)
    clear = load_examples(dataset, "train", camera=Camera(), ambiguous=False)
    rows = dataset.read_rows("labels", split="train", predicate="on", ambiguous=False)
    assert len(clear.goals[PREDICATES["on"]].pairs) == len({row["plan_id"] for row in rows})
    assert len(clear.goals[PREDICATES["on"]].pairs) < len(examples.goals[PREDICATES["on"]].pairs)
    with pytest.raises(DatasetError, match="policy 'none': expected one of found"):
        load_examples(dataset, "train", camera=Camera(), policy="none")


def test_the_mirror_shows_the_mirrored_scene(made: Path, examples: Examples) -> None:
    sample = next(Dataset.open(made).samples("train"))
    batch = gather(examples, np.array([0]), SAME_PLANE)
    flipped = in_the_mirror(batch)
    boxes = tuple(
        replace(box, position=(box.position[0], -box.position[1], box.position[2]), yaw=-box.yaw)
        for box in sample.scene.objects
    )
    expected = true_geometry(replace(sample.scene, id="", goals=(), objects=boxes))
    np.testing.assert_allclose(flipped.geometry[0].numpy(), expected, atol=1e-5)
    assert np.array_equal(flipped.image[0].permute(1, 2, 0).numpy(), sample.image[:, ::-1])
    names = [turn[0].name for turn in flipped.turns]
    assert names == ["on-the-right", "on-the-left", "in-front", "behind"]
    assert torch.equal(flipped.turns[0][2], batch.turns[0][2])
    assert torch.equal(in_the_mirror(flipped).geometry, batch.geometry)


SMALL = {
    "glimpse": GlimpseConfig(width=64, heads=2, layers=1, channels=16),
    "vit": VitConfig(width=64, heads=2, layers=1, hidden=64),
    "geometry": GeometryConfig(width=64, heads=2, layers=1),
}


# --- recipes ------------------------------------------------------------------------------


def test_rounds_have_a_batch_of_each_in_every_step(examples: Examples) -> None:
    config = replace(CONFIG, polling="rounds", mirror=False)
    steps = [draw_batches(examples, config, step) for step in range(3)]
    for batches in steps:
        assert [[turn[0] for turn in b.turns] for b in batches] == [
            [*SAME_PLANE],
            [PREDICATES["on"]],
        ]
    trainer = training.Trainer(replace(config, model=GlimpseConfig.smoke()), examples)
    parts = [batch_loss(trainer.model, batch, config)["loss"].item() for batch in steps[0]]
    assert trainer.step()["loss"] == pytest.approx(np.mean(parts), rel=1e-5)


def test_one_by_one_trains_each_for_its_share_of_the_steps(examples: Examples) -> None:
    config = replace(CONFIG, polling="one-by-one", steps=10, share_encodings=False, mirror=False)
    seen = [draw_batch(examples, config, step).turns[0][0] for step in range(10)]
    assert seen == [p for p in PREDICATES.values() for _ in range(2)]


def test_queries_are_drawn_uniformly(examples: Examples) -> None:
    """Each query of a predicate comes as often as any other, whatever its scene or goal has."""
    config = replace(
        CONFIG, queries_per_batch=50, goal_objects=False, share_encodings=False,
        predicates=("behind",), mirror=False, recolor=False,
    )  # fmt: skip
    goals = examples.goals[PREDICATES["behind"]]
    only = replace(examples, goals={PREDICATES["behind"]: goals})
    asked = goals.asked(goal_objects=False)
    count = np.zeros(asked.shape)
    name = {scene: i for i, scene in enumerate(examples.names)}
    for step in range(200):
        batch = draw_batch(only, config, step)
        [(_, pairs, relevant, wanted)] = batch.turns
        for b, g, query in wanted.nonzero().tolist():
            scene = name[batch.names[b]]
            [k] = [
                k
                for k in range(goals.first[scene], goals.first[scene + 1])
                if goals.pairs[k].tolist() == pairs[b, g].tolist()
            ]
            assert goals.relevant[k, query] == relevant[b, g, query]
            assert query not in pairs[b, g].tolist()
            count[k, query] += 1
    assert (count[~asked] == 0).all()
    share = 1 - (1 - 1 / asked.sum()) ** 50  # drawn at least once in a batch
    assert np.abs(count[asked] / 200 - share).max() < 5 * np.sqrt(share * (1 - share) / 200)


def test_goal_objects_can_be_left_out_of_the_loss(examples: Examples) -> None:
    torch.manual_seed(0)
    model = RelevanceModel(VitConfig.smoke())
    batch = draw_batch(examples, replace(CONFIG, mirror=False), 1)
    [(predicate, goals, relevant, labelled)] = batch.turns
    encoding = model.encode(batch.image, batch.views, batch.present)
    scores = model.decode(encoding, predicate, goals)
    queries = labelled.clone()
    for b, g in np.ndindex(*goals.shape[:2]):
        queries[b, g, goals[b, g]] = False
    expected = relevance_loss(scores, relevant, queries, CONFIG.eta_on)
    found = batch_loss(model, batch, replace(CONFIG, goal_objects=False))["relevance"]
    assert found.item() == pytest.approx(expected.item(), rel=1e-5)
    assert found.item() != pytest.approx(batch_loss(model, batch, CONFIG)["relevance"].item())


def test_the_bare_recipe_is_plain_adam(examples: Examples) -> None:
    paper = TrainConfig.paper()
    config = replace(paper, model=VitConfig.smoke(), predicates=(), device="auto", bfloat16="off")
    trainer = training.Trainer(config, examples)
    assert {trainer.rate(step) for step in (0, 1, 1000, 499_999)} == {1e-5}
    before = [w.detach().clone() for w in trainer.model.parameters()]
    torch.manual_seed(0)
    plain = training.Trainer(config, examples)
    adam = torch.optim.Adam(plain.model.parameters(), lr=1e-5)
    for step in range(2):
        trainer.step()
        adam.zero_grad()
        batch_loss(plain.model, draw_batch(examples, config, step), config)["loss"].backward()
        adam.step()
    pairs = zip(trainer.model.parameters(), plain.model.parameters(), before, strict=True)
    assert any((a != c).any() for a, _, c in pairs)
    for a, b in zip(trainer.model.parameters(), plain.model.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8)


def test_a_loss_that_is_no_number_names_the_scenes(examples: Examples) -> None:
    trainer = training.Trainer(CONFIG, examples)
    trainer.step()
    with torch.no_grad():
        for weight in trainer.model.body.heads.parameters():
            weight.fill_(torch.inf)
    with pytest.raises(training.TrainingError, match="step 1: the loss is nan on scenes ") as error:
        trainer.step()
    assert trainer.done == 1
    names = draw_batch(examples, CONFIG, 1).names
    assert all(name in str(error.value) for name in names)


# --- the loss and learning ----------------------------------------------------------------


def test_loss_weighs_each_predicate_with_its_eta(examples: Examples) -> None:
    torch.manual_seed(0)
    model = RelevanceModel(VitConfig.smoke())
    config = replace(CONFIG, mirror=False, eta_same_plane=0.8, eta_on=0.6)
    for step, eta in ((0, 0.8), (1, 0.6)):
        batch = draw_batch(examples, config, step)
        encoding = model.encode(batch.image, batch.views, batch.present)
        terms = [
            relevance_loss(model.decode(encoding, p, goals), relevant, labelled, eta)
            for p, goals, relevant, labelled in batch.turns
        ]
        expected = sum(float(term.detach()) for term in terms) / len(terms)
        parts = batch_loss(model, batch, config)
        assert parts["loss"].item() == pytest.approx(expected, rel=1e-5)
        assert set(parts) == {"loss", "relevance"}


def test_each_scene_is_encoded_once_for_all_goals_and_predicates(
    examples: Examples, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = RelevanceModel(CONFIG.model)
    calls = []
    encode = model.encode
    monkeypatch.setattr(model, "encode", lambda *a: (calls.append(a[0].shape[0]), encode(*a))[1])
    batch = draw_batch(examples, CONFIG, 0)
    batch_loss(model, batch, CONFIG)
    assert calls == [CONFIG.scenes_per_batch]
    assert len(batch.turns) == 4


@pytest.mark.parametrize("body", list(SMALL))
def test_a_network_learns_a_few_scenes_by_heart(examples: Examples, body: str) -> None:
    model = SMALL[body]
    config = replace(
        CONFIG,
        model=model,
        steps=80,
        scenes_per_batch=6,
        learning_rate=3e-3,
        mirror=False,
        recolor=False,
        # the toy rule calls most objects relevant: weigh both sides alike
        eta_same_plane=0.5,
        eta_on=0.5,
    )
    trainer = training.Trainer(config, examples)
    before = measure(trainer.model, examples)
    losses = [trainer.step() for _ in range(config.steps)]
    after = measure(trainer.model, examples)
    assert np.mean([x["relevance"] for x in losses[-6:]]) < 0.5 * losses[0]["relevance"]
    for family in ("same-plane", "on"):
        found = after[family]["with_goal_objects"]
        assert found["balanced"] > 0.8 > before[family]["with_goal_objects"]["balanced"]
        assert found["total"] > found["base_rate"] + 0.1


def test_rate_rises_then_falls(examples: Examples) -> None:
    trainer = training.Trainer(replace(CONFIG, steps=200, warmup=0.05), examples)
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


def test_measure_counts_queries_and_goals(examples: Examples, made: Path) -> None:
    model = RelevanceModel(CONFIG.model)
    found = measure(model, examples, batch=3)
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
        {"cache_bytes": 0},
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
