"""Guides against no guide on real plans, the network as a scorer, and the figures by hand."""

from __future__ import annotations

import shutil
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluated import EVALUATION, evaluated
from hypothesis import given
from hypothesis import strategies as st

from relevance.evaluation import (
    EvaluationConfig,
    EvaluationError,
    NetworkScorer,
    choose_tasks,
    compare,
    evaluate,
    load_guide,
    load_scorer,
    predict,
)
from relevance.evaluation.comparisons import (
    Predictions,
    guided_cost,
    mean_interval,
    ratio_interval,
    read_evaluations,
    read_predictions,
    settings,
    summarise,
)
from relevance.models import BODIES, RelevanceModel
from relevance.planner import plan
from relevance.scene import Box, Goal, Scene
from relevance.simulation import Renderer
from relevance.store import Dataset
from relevance.training import CheckpointError

BLOCKED = Scene(
    objects=(
        Box(name="red", size=(0.05, 0.05, 0.06), position=(0, 0.2, 0.03), color=(1, 0, 0)),
        Box(name="blue", size=(0.09, 0.07, 0.05), position=(0, -0.1, 0.025), color=(0, 0, 1)),
        Box(
            name="lid",
            size=(0.05, 0.05, 0.05),
            position=(0, -0.1, 0.075),
            color=(0, 1, 0),
            on="blue",
        ),
        Box(name="far", size=(0.05, 0.05, 0.06), position=(0.1, 0.35, 0.03), color=(1, 1, 0)),
    )
)
"""`on(red, blue)` needs the lid to leave; `far` is irrelevant."""
GOAL = Goal.parse("on(red, blue)")


class Given:
    """A scorer that says what it was told."""

    def __init__(self, **scores: float) -> None:
        self.given = scores

    def scores(self, scene: Scene, goal: Goal) -> Mapping[str, float]:
        return {name: self.given.get(name, -1.0) for name in scene.names}


# --- reruns ---------------------------------------------------------------------------------


def test_the_blocked_task_needs_its_lid_moved() -> None:
    assert plan(BLOCKED, GOAL).moved == ("lid", "red")


@pytest.mark.parametrize("search", ["tree", "informed"])
def test_a_guide_that_keeps_everything_equals_no_guide(search) -> None:
    config = EvaluationConfig(searches=(search,))
    scorer = Given(red=1.0, blue=1.0, lid=1.0, far=1.0)
    for row in compare(BLOCKED, GOAL, scorer, config):
        assert row["solved_unguided"]
        assert row["solved_guided"]
        assert row["n_kept"] == len(BLOCKED.objects)
        for column in ("nodes", "nlps", "n_actions"):
            assert row[f"{column}_guided"] == row[f"{column}_unguided"]


def test_a_perfect_guide_solves_with_fewer_nodes() -> None:
    for row in compare(BLOCKED, GOAL, Given(lid=1.0), EvaluationConfig()):
        assert row["solved_guided"]
        assert row["n_kept"] == 3
        assert row["n_actions_guided"] == row["n_actions_unguided"] == 4
        assert row["nodes_guided"] < row["nodes_unguided"]


def test_a_lost_blocker_is_a_miss_of_prune_and_a_fallback_of_prune_then_full() -> None:
    prune, full = compare(BLOCKED, GOAL, Given(far=1.0), EvaluationConfig())
    assert (prune["guide"], full["guide"]) == ("prune", "prune-then-full")
    assert prune["solved_unguided"]
    assert not prune["solved_guided"]
    assert prune["n_actions_guided"] is None
    assert full["solved_guided"]
    # the fallback's work comes on top of the first attempt's
    assert full["nodes_guided"] == prune["nodes_guided"] + full["nodes_unguided"]


def test_goal_objects_are_kept_whatever_their_score() -> None:
    scorer = Given(lid=1.0, red=-99.0, blue=-99.0)
    assert all(row["solved_guided"] for row in compare(BLOCKED, GOAL, scorer, EvaluationConfig()))


def test_beta_moves_the_threshold_and_the_sweep_reruns_the_planner() -> None:
    config = EvaluationConfig(guides=("prune",), betas=(-3.0, 3.0))
    scorer = Given(lid=-2.0, far=-4.0)
    swept = {row["beta"]: row for row in compare(BLOCKED, GOAL, scorer, config, swept=True)}
    assert [swept[beta]["n_kept"] for beta in (-3.0, 0.0, 3.0)] == [2, 2, 3]
    assert [swept[beta]["solved_guided"] for beta in (-3.0, 0.0, 3.0)] == [False, False, True]
    plain = compare(BLOCKED, GOAL, scorer, config)
    assert [row["beta"] for row in plain] == [0.0]


def test_only_the_first_search_is_swept() -> None:
    config = EvaluationConfig(guides=("prune",), betas=(3.0,), searches=("tree", "informed"))
    rows = compare(BLOCKED, GOAL, Given(lid=1.0), config, swept=True)
    assert [(row["search"], row["beta"]) for row in rows] == [
        ("tree", 0.0),
        ("tree", 3.0),
        ("informed", 0.0),
    ]


class Slow(NetworkScorer):
    """A network that takes a tenth of a CPU second to encode a scene."""

    def score_goals(self, scene, goals):
        if scene.id not in self._encodings:
            end = time.process_time() + 0.1
            while time.process_time() < end:
                pass
        scores = super().score_goals(scene, goals)
        scores[:] = 1.0
        return scores


def test_every_guided_run_pays_for_its_own_encoding() -> None:
    config = EvaluationConfig(guides=("prune", "prune-then-full"), repeats=2)
    scorer = Slow(small_model())
    with Renderer() as renderer:
        pictures = renderer.render(BLOCKED)
    scorer.observe(BLOCKED, pictures.image, pictures.views)
    compare(BLOCKED, GOAL, scorer, config)  # loads compiled code
    for row in compare(BLOCKED, GOAL, scorer, config):
        assert row["seconds_guided"] > 0.1 > row["seconds_unguided"]
        assert 0 < row["seconds_inference"] < row["seconds_guided"]


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("guides", ("none",), "none"),
        ("guides", ("best",), "best"),
        ("guides", (), "at least one"),
        ("split", "tests", "tests"),
        ("tasks", -1, "tasks"),
        ("repeats", 0, "repeats"),
        ("betas", (float("nan"),), "finite"),
        ("searches", ("random",), "random"),
    ],
)
def test_impossible_settings_are_refused_by_name(field, value, named) -> None:
    with pytest.raises(ValueError, match=named):
        EvaluationConfig(**{field: value})


# --- the network as a scorer ------------------------------------------------------------------


def small_model() -> RelevanceModel:
    torch.manual_seed(1)
    return RelevanceModel(BODIES["glimpse"].config.smoke()).eval()


def test_scores_are_the_models_own_and_cached_equals_uncached() -> None:
    model = small_model()
    with Renderer() as renderer:
        pictures = renderer.render(BLOCKED)
    scorer = NetworkScorer(model)
    scorer.observe(BLOCKED, pictures.image, pictures.views)
    goals = [GOAL, Goal.parse("behind(far, red)"), Goal.parse("on(far, red)")]
    together = scorer.score_goals(BLOCKED, goals)
    image = torch.from_numpy(pictures.image).permute(2, 0, 1)[None]
    views = torch.from_numpy(pictures.views).permute(0, 3, 1, 2)[None]
    for goal, row in zip(goals, together, strict=True):
        names = BLOCKED.names
        pair = torch.tensor([[[names.index(goal.subject), names.index(goal.reference)]]])
        with torch.inference_mode():
            expected = model.decode(model.encode(image, views), goal.predicate, pair)[0, 0]
        np.testing.assert_allclose(row, expected.numpy(), atol=1e-5)
        scorer.forget()
        alone = scorer.scores(BLOCKED, goal)
        assert tuple(alone) == names
        np.testing.assert_allclose(list(alone.values()), row, atol=1e-5)


def test_a_scene_without_a_picture_is_rendered() -> None:
    shown, blind = NetworkScorer(small_model()), NetworkScorer(small_model())
    with Renderer() as renderer:
        pictures = renderer.render(BLOCKED)
    shown.observe(BLOCKED, pictures.image, pictures.views)
    assert shown.scores(BLOCKED, GOAL) == blind.scores(BLOCKED, GOAL)


def test_a_new_picture_of_a_scene_replaces_its_encoding() -> None:
    scorer = NetworkScorer(small_model())
    with Renderer() as renderer:
        pictures = renderer.render(BLOCKED)
    scorer.observe(BLOCKED, pictures.image, pictures.views)
    before = scorer.scores(BLOCKED, GOAL)
    scorer.observe(BLOCKED, 255 - pictures.image, pictures.views)
    assert scorer.scores(BLOCKED, GOAL) != before


def test_the_cache_is_bounded() -> None:
    scorer = NetworkScorer(small_model(), capacity=2)
    image, views = np.zeros((192, 320, 3), np.uint8), np.zeros((4, 32, 32, 3), np.uint8)
    for number in range(4):
        scene = replace(BLOCKED, id=f"s{number}")
        scorer.observe(scene, image, views)
        scorer.scores(scene, GOAL)
    assert list(scorer._seen) == list(scorer._encodings) == ["s2", "s3"]


def test_views_of_another_number_of_objects_are_refused() -> None:
    views = np.zeros((3, 32, 32, 3), np.uint8)
    with pytest.raises(EvaluationError, match="3 views, expected one for each of its 4"):
        NetworkScorer(small_model()).observe(BLOCKED, np.zeros((192, 320, 3), np.uint8), views)


def test_a_missing_checkpoint_is_named(tmp_path) -> None:
    with pytest.raises(CheckpointError, match=r"nothing\.pt"):
        load_guide(tmp_path / "nothing.pt")


def test_a_loaded_guide_guides() -> None:
    _, checkpoint = evaluated()
    guide = load_guide(checkpoint, mode="prune-then-full", beta=50.0)
    result = plan(BLOCKED, GOAL, guide=guide)
    assert result.moved == plan(BLOCKED, GOAL).moved
    assert result.seconds.guide > 0


# --- rows -------------------------------------------------------------------------------------


def test_predictions_are_the_labels_with_the_networks_scores() -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    key = ("scene_id", "predicate", "subject", "reference", "query")
    labels = {tuple(r[k] for k in key): r for r in dataset.read_rows("labels", split="test")}
    rows = dataset.read_rows("predictions")
    assert {tuple(row[k] for k in key) for row in rows} == set(labels)
    assert len(rows) == len(labels) > 0
    scorer = load_scorer(checkpoint)
    scenes = {sample.scene.id: sample for sample in dataset.samples("test")}
    for row in rows[::17]:
        label = labels[tuple(row[k] for k in key)]
        assert (row["relevant"], row["is_goal_object"]) == (
            label["relevant"],
            label["is_goal_object"],
        )
        sample = scenes[row["scene_id"]]
        scorer.observe(sample.scene, sample.image, sample.views)
        goal = Goal(predicate=row["predicate"], subject=row["subject"], reference=row["reference"])
        scores = scorer.scores(sample.scene, goal)
        assert scores[row["query"]] == pytest.approx(row["score"], abs=1e-5)


def test_predicting_again_gives_equal_bytes(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    files = Dataset.open(root).files("predictions")
    before = [file.read_bytes() for file in files]
    predict(root, checkpoint)
    assert [file.read_bytes() for file in files] == before


def test_reruns_are_paired_and_hold_every_guide() -> None:
    root, checkpoint = evaluated()
    rows = read_evaluations(Dataset.open(root), checkpoint.stem)
    tasks = defaultdict(list)
    for row in rows:
        tasks[row["scene_id"], row["predicate"], row["subject"], row["reference"]].append(row)
    assert len(tasks) == 5 * EVALUATION.tasks
    swept = 0
    for found in tasks.values():
        # one unguided run stands beside all guided ones
        for column in ("seconds_unguided", "nodes_unguided", "solved_unguided"):
            assert len({row[column] for row in found}) == 1
        ran = {(row["guide"], row["beta"]) for row in found}
        assert {("prune", 0.0), ("prune-then-full", 0.0)} <= ran
        swept += ran >= {("prune", -50.0), ("prune", 50.0)}
        for row in found:
            if row["guide"] == "prune-then-full" or row["beta"] == 50.0:
                assert row["solved_guided"] == row["solved_unguided"]
            assert row["n_kept"] == {50.0: row["n_objects"], -50.0: 2}.get(
                row["beta"], row["n_kept"]
            )
    assert swept == 5 * EVALUATION.sweep_tasks


def test_finished_shards_are_left_and_other_settings_replace_them(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    files = Dataset.open(root).files("evaluations")
    before = [(file.stat().st_mtime_ns, file.read_bytes()) for file in files]
    count = evaluate(root, checkpoint, EVALUATION)
    assert [(file.stat().st_mtime_ns, file.read_bytes()) for file in files] == before
    assert count == len(Dataset.open(root).read_rows("evaluations"))
    seen = []
    fewer = replace(EVALUATION, tasks=1, sweep_tasks=0)
    assert evaluate(root, checkpoint, fewer, progress=lambda *at: seen.append(at)) == 10
    assert len(Dataset.open(root).read_rows("evaluations")) == 10
    assert seen == [(n, 5) for n in range(1, 6)]


def test_shards_one_by_one_make_the_rows_of_all_at_once(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    dataset = Dataset.open(root)
    steady = [column for column in dataset.read_rows("evaluations")[0] if "seconds" not in column]

    def rows() -> list[list]:
        return [[row[c] for c in steady] for row in dataset.read_rows("evaluations")]

    before = rows()
    shutil.rmtree(root / "evaluations")
    for shard in reversed(dataset.shards("test")):
        evaluate(root, checkpoint, EVALUATION, shards=[shard])
    assert rows() == before


def test_tasks_are_drawn_by_their_id_alone() -> None:
    root, _ = evaluated()
    dataset = Dataset.open(root)
    everything = choose_tasks(dataset, split="test", per_predicate=0)
    assert {t.plan_id for t in everything} == {
        row["plan_id"] for row in dataset.read_rows("plans", split="test")
    }
    few = choose_tasks(dataset, split="test", per_predicate=2)
    assert [task for task in everything if task.nth <= 2] == few
    assert len(few) == 10


def copied(tmp_path: Path) -> tuple[Path, Path]:
    root, checkpoint = evaluated()
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    return copy, copy / checkpoint.relative_to(root)


# --- figures by hand --------------------------------------------------------------------------

BY_HAND = Predictions(
    predicate=np.array(["on", "on", "on", "behind", "behind", "behind"]),
    task=np.array([1, 1, 1, 2, 2, 2]),
    relevant=np.array([True, False, True, False, True, False]),
    score=np.array([2.0, -1.0, -3.0, 0.0, 1.0, 4.0]),
    is_goal_object=np.array([False, False, False, False, True, False]),
)


def test_accuracy_by_hand() -> None:
    found = BY_HAND.accuracy()
    assert (found.n_tasks, found.n_rows) == (2, 6)
    assert found.true_relevant == pytest.approx(2 / 3)
    assert found.true_irrelevant == pytest.approx(2 / 3)  # a score of 0 is left out at beta 0
    assert found.total == pytest.approx(4 / 6)
    assert found.base_rate == pytest.approx(3 / 6)
    assert found.tasks_whole == pytest.approx(1 / 2)
    looser = BY_HAND.accuracy(beta=3.5)
    assert looser.true_relevant == 1.0
    assert looser.true_irrelevant == 0.0
    assert BY_HAND.of("on").accuracy().total == pytest.approx(2 / 3)
    assert BY_HAND.of("same-plane").queries().accuracy().n_rows == 2
    assert np.isnan(BY_HAND.of("same-plane").queries().accuracy().true_relevant)


@given(
    st.lists(st.tuples(st.booleans(), st.floats(-9, 9)), min_size=1, max_size=30),
    st.floats(-9, 9),
    st.floats(0, 9),
)
def test_a_larger_beta_keeps_more(rows, beta, more) -> None:
    relevant, score = (np.array(column) for column in zip(*rows, strict=True))
    n = len(rows)
    predictions = Predictions(
        predicate=np.full(n, "on"),
        task=np.arange(n) // 3,
        relevant=relevant,
        score=score,
        is_goal_object=np.zeros(n, bool),
    )
    tight, loose = predictions.accuracy(beta), predictions.accuracy(beta + more)
    if relevant.any():
        assert loose.true_relevant >= tight.true_relevant
    if not relevant.all():
        assert loose.true_irrelevant <= tight.true_irrelevant
    assert loose.tasks_whole >= tight.tasks_whole


def row(unguided: float, guided: float, solved: tuple[bool, bool], predicate: str = "on") -> dict:
    return {
        "guide": "prune",
        "search": "tree",
        "beta": 0.0,
        "predicate": predicate,
        "n_objects": 4,
        "n_kept": 2,
        "solved_unguided": solved[0],
        "solved_guided": solved[1],
        "seconds_unguided": unguided,
        "seconds_guided": guided,
        "seconds_inference": 0.5,
        "nodes_unguided": 10,
        "nodes_guided": 4,
        "nlps_unguided": 6,
        "nlps_guided": 2,
        "n_actions_unguided": 4 if solved[0] else None,
        "n_actions_guided": 4 if solved[1] else None,
    }


def test_a_comparison_by_hand() -> None:
    rows = [
        row(8.0, 2.0, (True, True)),
        row(4.0, 2.0, (True, True), "behind"),
        row(6.0, 1.0, (True, False)),  # a miss: 1 s in vain, then 6 s
        row(5.0, 1.0, (False, False)),
        row(9.0, 1.0, (False, True)),
    ]
    found = summarise(rows)
    assert (found.n_tasks, found.n_solvable, found.n_both) == (5, 3, 2)
    assert (found.misses, found.gains) == (1, 1)
    assert [guided_cost(r) for r in rows] == [2.0, 2.0, 7.0, 1.0, 1.0]
    assert found.unguided.value == pytest.approx(6.0)
    assert found.guided.value == pytest.approx(11 / 3)
    assert found.speedup.value == pytest.approx(18 / 11)
    assert found.speedup_both.value == pytest.approx(12 / 4)
    assert found.reduction == pytest.approx(2 / 3)
    assert found.speedup_all.value == pytest.approx(32 / 13)
    assert found.kept == pytest.approx(0.5)
    assert summarise(rows, "on").n_solvable == 2
    assert summarise(rows, "same-plane").n_tasks == 1
    assert list(settings(rows)) == [("tree", "prune", 0.0)]


def test_no_tasks_give_no_figure() -> None:
    found = summarise([row(1.0, 1.0, (False, False))], "behind")
    assert found.n_tasks == 0
    assert np.isnan(found.speedup.value)


def test_intervals_cover_two_thirds() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(120):
        found = mean_interval(rng.normal(3.0, 1.0, size=40))
        hits += found.low <= 3.0 <= found.high
    assert 0.55 <= hits / 120 <= 0.79
    values = rng.exponential(size=25)
    assert mean_interval(values) == mean_interval(values)
    assert mean_interval([2.0]).low == mean_interval([2.0, 2.0]).high == 2.0
    assert mean_interval([]).n == 0


def test_a_ratio_is_of_sums_and_paired() -> None:
    slow = np.array([1.0, 10.0, 100.0])
    found = ratio_interval(slow, slow / 2)
    assert (found.low, found.value, found.high) == pytest.approx((2.0, 2.0, 2.0))
    assert ratio_interval([1.0, 9.0], [1.0, 1.0]).value == pytest.approx(5.0)


def test_predictions_are_read_with_their_tasks() -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    found = read_predictions(dataset, checkpoint.stem)
    plans = {r["plan_id"] for r in dataset.read_rows("labels", split="test")}
    assert len(np.unique(found.task)) == len(plans)
    assert len(found.queries()) == len(found) - 2 * len(plans)
    assert len(read_predictions(dataset, "none")) == 0
