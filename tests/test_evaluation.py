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

from relevance.configs import ConfigError
from relevance.errors import RelevanceWarning
from relevance.evaluation import (
    OWN,
    EvaluationConfig,
    EvaluationError,
    NetworkScorer,
    accuracy_table,
    checkpoint_id,
    choose_tasks,
    compare,
    evaluate,
    left_out,
    limits,
    load_guide,
    load_scorer,
    predict,
    read_evaluations,
    read_predictions,
    unjudged,
)
from relevance.models import BODIES, RelevanceModel
from relevance.pipeline import Counts, DatasetConfig, prepare
from relevance.planner import GUIDES, PlannerConfig, plan
from relevance.report import page
from relevance.scene import Box, Camera, Goal, Scene
from relevance.simulation import Renderer
from relevance.store import Dataset
from relevance.training import CheckpointError, TrainConfig, load_checkpoint, save_checkpoint

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
PRUNING = EvaluationConfig(guides=("prune", "prune-then-full"), priors=())


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
    config = replace(PRUNING, searches=(search,))
    scorer = Given(red=1.0, blue=1.0, lid=1.0, far=1.0)
    for row in compare(BLOCKED, GOAL, scorer, config):
        assert row["solved_unguided"]
        assert row["solved_guided"]
        assert row["n_kept"] == len(BLOCKED.objects)
        for column in ("nodes", "nlps", "n_actions"):
            assert row[f"{column}_guided"] == row[f"{column}_unguided"]


def test_a_perfect_guide_solves_with_fewer_nodes() -> None:
    for row in compare(BLOCKED, GOAL, Given(lid=1.0), PRUNING):
        assert row["solved_guided"]
        assert row["n_kept"] == 3
        assert row["n_actions_guided"] == row["n_actions_unguided"] == 4
        assert row["nodes_guided"] < row["nodes_unguided"]


def test_a_lost_blocker_is_a_miss_of_prune_and_a_fallback_of_prune_then_full() -> None:
    prune, full = compare(BLOCKED, GOAL, Given(far=1.0), PRUNING)
    assert (prune["guide"], full["guide"]) == ("prune", "prune-then-full")
    assert prune["solved_unguided"]
    assert not prune["solved_guided"]
    assert prune["n_actions_guided"] is None
    assert full["solved_guided"]
    # the fallback's work comes on top of the first attempt's
    assert full["nodes_guided"] == prune["nodes_guided"] + full["nodes_unguided"]


def test_goal_objects_are_kept_whatever_their_score() -> None:
    scorer = Given(lid=1.0, red=-99.0, blue=-99.0)
    assert all(row["solved_guided"] for row in compare(BLOCKED, GOAL, scorer, PRUNING))


def test_beta_moves_the_threshold_and_the_sweep_reruns_the_planner() -> None:
    config = replace(PRUNING, guides=("prune",), betas=(-3.0, 3.0))
    scorer = Given(lid=-2.0, far=-4.0)
    swept = {row["beta"]: row for row in compare(BLOCKED, GOAL, scorer, config, swept=True)}
    assert [swept[beta]["n_kept"] for beta in (-3.0, 0.0, 3.0)] == [2, 2, 3]
    assert [swept[beta]["solved_guided"] for beta in (-3.0, 0.0, 3.0)] == [False, False, True]
    plain = compare(BLOCKED, GOAL, scorer, config)
    assert [row["beta"] for row in plain] == [0.0]


def test_only_the_first_search_is_swept() -> None:
    config = replace(PRUNING, guides=("prune",), betas=(3.0,), searches=("tree", "informed"))
    rows = compare(BLOCKED, GOAL, Given(lid=1.0), config, swept=True)
    assert [(row["search"], row["beta"]) for row in rows] == [
        ("tree", 0.0),
        ("tree", 3.0),
        ("informed", 0.0),
    ]


class Slow(NetworkScorer):
    """A network that takes a tenth of a CPU second to encode a scene."""

    def score_goals(self, scene, goals):
        if not self._encodings:
            end = time.process_time() + 0.1
            while time.process_time() < end:
                pass
        scores = super().score_goals(scene, goals)
        scores[:] = 1.0
        return scores


def test_every_guided_run_pays_for_its_own_encoding() -> None:
    config = replace(PRUNING, repeats=2)
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
        ("guides", (), "at least 1"),
        ("split", "tests", "tests"),
        ("tasks", -1, "tasks"),
        ("repeats", 0, "repeats"),
        ("beta", float("nan"), "finite"),
        ("betas", (float("inf"),), "finite"),
        ("searches", ("random",), "random"),
        ("priors", ("checkpoint",), "checkpoint is the one that is evaluated"),
        ("priors", ("true", "true"), "distinct"),
    ],
)
def test_impossible_settings_are_refused_by_name(field, value, named) -> None:
    with pytest.raises(ConfigError, match=named):
        EvaluationConfig(**{field: value})


def test_searches_stop_alike_on_both_sides() -> None:
    config = EvaluationConfig(guides=("expand", "order"), priors=("all",))
    rows = compare(BLOCKED, GOAL, Given(lid=1.0), config)
    assert [(row["prior"], row["guide"], row["stop"]) for row in rows] == [
        ("checkpoint", "expand", "level"),
        ("checkpoint", "order", "first"),
        ("all", "expand", "level"),
        ("all", "order", "first"),
    ]
    for row in rows:
        alone = plan(BLOCKED, GOAL, config=PlannerConfig(search="tree", stop=row["stop"]))
        assert row["nodes_unguided"] == alone.counts.nodes
        assert row["sequences_unguided"] == alone.counts.sequences


class Late(Given):
    """A scorer with a patience of its own, that counts how often it is asked."""

    patience, asked = 10**9, 0

    def scores(self, scene: Scene, goal: Goal) -> Mapping[str, float]:
        self.asked += 1
        return super().scores(scene, goal)


def test_a_guide_that_does_not_look_pays_for_no_look() -> None:
    scorer = Late(lid=1.0)
    config = EvaluationConfig(guides=("lazy", "order"))
    lazy, order, true, _ = compare(BLOCKED, GOAL, scorer, config, moved=("lid", "red"))
    assert scorer.asked == 2  # for the row, and by `order`
    assert (lazy["looked"], lazy["seconds_inference"]) == (False, 0.0)
    assert order["looked"]
    assert order["seconds_inference"] > 0
    # the oracle's look costs nothing: it does not wait
    assert (true["prior"], true["guide"], true["looked"]) == ("true", "lazy", True)
    assert true["sequences"] == 1
    assert true["n_kept"] == 3


def test_what_a_further_goal_of_the_scene_pays_is_no_encoding() -> None:
    scorer = Slow(small_model())
    with Renderer() as renderer:
        pictures = renderer.render(BLOCKED)
    scorer.observe(BLOCKED, pictures.image, pictures.views)
    config = EvaluationConfig(guides=("order",), priors=())
    compare(BLOCKED, GOAL, scorer, config)  # loads compiled code
    [row] = compare(BLOCKED, GOAL, scorer, config)
    assert 0 < row["seconds_encoding"] <= row["seconds_inference"] < row["seconds_guided"]
    scorer.scores(BLOCKED, GOAL)
    assert scorer.seconds_encoding < row["seconds_encoding"]


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
        far = replace(BLOCKED.objects[-1], yaw=0.1 * number)
        scene = replace(BLOCKED, objects=(*BLOCKED.objects[:-1], far))
        scorer.observe(scene, image, views)
        scorer.scores(scene, GOAL)
    assert list(scorer._seen) == list(scorer._encodings)
    assert len(scorer._seen) == 2


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


# --- never silently wrong -----------------------------------------------------------------------


def moved(scene: Scene) -> Scene:
    """The scene under its own id, its last box elsewhere."""
    box = scene.objects[-1]
    there = replace(box, position=(box.position[0], -box.position[1], box.position[2]))
    return replace(scene, id=scene.id, objects=(*scene.objects[:-1], there))


def test_a_box_moved_under_the_same_id_gets_its_own_scores() -> None:
    scorer, elsewhere = NetworkScorer(small_model()), moved(BLOCKED)
    assert elsewhere.id == BLOCKED.id
    scorer.scores(BLOCKED, GOAL)
    assert scorer.scores(elsewhere, GOAL) == NetworkScorer(small_model()).scores(elsewhere, GOAL)
    assert scorer.scores(elsewhere, GOAL) != scorer.scores(BLOCKED, GOAL)


def test_the_same_picture_under_another_id_is_not_drawn_again(monkeypatch) -> None:
    scorer = NetworkScorer(small_model())
    scorer.scores(BLOCKED, GOAL)
    monkeypatch.setattr("relevance.simulation.Renderer", None)
    assert scorer.scores(replace(BLOCKED, id="x"), GOAL) == scorer.scores(BLOCKED, GOAL)


def test_a_camera_of_another_size_is_refused_before_a_picture_is_drawn(monkeypatch) -> None:
    monkeypatch.setattr("relevance.simulation.Renderer", None)
    large = replace(BLOCKED, camera=Camera(width=640, height=384))
    with pytest.raises(EvaluationError, match="640x384 pixels, the model was trained on 320x192"):
        NetworkScorer(small_model()).scores(large, GOAL)


@pytest.mark.parametrize(
    "camera", [Camera(target=(-2.0, 0.0, 1.0)), Camera(eye=(-0.5, 0.1, 0.7)), Camera(fov=60)]
)
def test_a_camera_that_looks_from_elsewhere_is_warned_of(camera) -> None:
    with pytest.warns(RelevanceWarning, match=r"its camera \(eye .* trained with \(eye -0.66, 0"):
        NetworkScorer(small_model()).scores(replace(BLOCKED, camera=camera), GOAL)


def test_a_camera_that_randomised_scenes_have_and_distinct_boxes_are_not_warned_of(recwarn) -> None:
    near = Camera(eye=(-0.655, 0.005, 0.66), fov=47.4)
    NetworkScorer(small_model()).scores(replace(BLOCKED, camera=near), GOAL)
    assert not [w for w in recwarn if issubclass(w.category, RelevanceWarning)]


def test_boxes_that_look_the_same_are_named() -> None:
    far = replace(BLOCKED["far"], size=BLOCKED["red"].size, color=BLOCKED["red"].color)
    alike = replace(BLOCKED, objects=(*BLOCKED.objects[:-1], far))
    with pytest.warns(RelevanceWarning, match="red, far look the same") as told:
        NetworkScorer(small_model()).scores(alike, GOAL)
    assert len(told) == 1


def test_broken_weights_and_a_beta_that_is_no_number_are_refused() -> None:
    model = small_model()
    with torch.no_grad():
        for weight in model.parameters():
            weight.fill_(float("nan"))
    with pytest.raises(EvaluationError, match="not finite"):
        NetworkScorer(model, checkpoint_id="glimpse-1").scores(BLOCKED, GOAL)
    for beta in (float("nan"), float("inf")):
        with pytest.raises(EvaluationError, match="beta"):
            load_guide("nothing.pt", beta=beta)


def relabelled(tmp_path: Path, policy: str) -> tuple[Path, Path]:
    """A copy whose labels of that policy call everything relevant; its checkpoint learned it."""
    root, checkpoint = copied(tmp_path)
    dataset = Dataset.open(root)
    of = replace(dataset.labelling, policy=policy)
    for file in dataset.files("labels", split="test"):
        keys = dataset.file_keys(file)
        where = {k: keys[k] for k in ("predicate", "split", "shard")}
        rows = dataset.read_file(file).to_pylist()
        rows = [row | {"policy": policy, "relevant": True} for row in rows]
        dataset.write_rows("labels", rows, of=of, made_by=of.made_by, **where)
    learned = checkpoint.with_name("learned.pt")
    rewritten(checkpoint, learned, policy=policy)
    shutil.rmtree(root / "predictions")
    return root, learned


def rewritten(checkpoint: Path, to: Path, **config) -> None:
    """A checkpoint with another id and other training settings."""
    model, meta = load_checkpoint(checkpoint)
    meta = meta | {"checkpoint_id": "glimpse-foreign", "config": meta["config"] | config}
    save_checkpoint(to, model, meta)


def test_predictions_are_judged_by_the_policy_that_the_checkpoint_learned(tmp_path) -> None:
    root, learned = relabelled(tmp_path, "any-minimal")
    predict(root, learned)
    dataset = Dataset.open(root)
    rows = dataset.read_rows("predictions")
    assert rows
    assert all(row["relevant"] for row in rows)
    assert read_predictions(dataset, "glimpse-foreign").accuracy().share_relevant == 1.0


def test_a_network_for_one_predicate_is_judged_by_that_one_alone(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    _, meta = load_checkpoint(checkpoint)
    config = meta["config"] | {"predicates": ["on"]}
    alone = tmp_path / "alone.pt"
    model = RelevanceModel(TrainConfig.from_dict(config).model, ["on"])
    save_checkpoint(alone, model, meta | {"config": config, "checkpoint_id": "glimpse-alone"})
    assert predict(root, alone) > 0
    assert evaluate(root, alone, EVALUATION) > 0
    dataset = Dataset.open(root)
    of_it = {"checkpoint_id": "glimpse-alone"}
    assert {row["predicate"] for row in dataset.read_rows("predictions", **of_it)} == {"on"}
    assert {row["predicate"] for row in dataset.read_rows("evaluations", **of_it)} == {"on"}
    assert unjudged(dataset, "glimpse-alone") == []
    assert accuracy_table(read_predictions(dataset, "glimpse-alone"))
    assert page.build(root, checkpoint_id="glimpse-alone").is_file()


def test_a_policy_that_the_dataset_does_not_have_is_refused_and_nothing_is_left(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    learned = tmp_path / "learned.pt"
    rewritten(checkpoint, learned, policy="necessary")
    before = sorted(root.rglob("*"))
    with pytest.raises(EvaluationError, match="no labels of split test by policy necessary"):
        predict(root, learned)
    assert sorted(root.rglob("*")) == before


def test_a_renamed_or_foreign_checkpoint_is_known_by_the_id_inside(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    renamed = checkpoint.rename(checkpoint.with_name("renamed.pt"))
    assert checkpoint_id(renamed) == load_scorer(renamed).checkpoint_id == checkpoint.stem
    foreign = tmp_path / "foreign.pt"
    rewritten(renamed, foreign)
    assert evaluate(root, foreign, replace(EVALUATION, tasks=1, sweep_tasks=0)) == 40
    names = [row["checkpoint_id"] for row in Dataset.open(root).read_rows("checkpoints")]
    assert sorted(names) == sorted([checkpoint.stem, "glimpse-foreign"])


def test_rows_of_another_planner_are_left_out_and_said(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    dataset = Dataset.open(root)
    every = read_evaluations(dataset, checkpoint.stem)
    assert left_out(dataset, checkpoint.stem) == []
    where = {"name": checkpoint.stem, "split": "test", "shard": dataset.shards("test")[0]}
    stored = dataset.read_file(dataset.shard_path("evaluations", **where)).to_pylist()
    old = [row | {"planner_version": "0", "seconds_unguided": 1e6} for row in stored]
    dataset.write_rows("evaluations", old, **where)
    kept = read_evaluations(dataset, checkpoint.stem)
    assert len(kept) == len(every) - sum(row["prior"] == OWN for row in stored)
    assert "0" not in {row["planner_version"] for row in kept}
    (said,) = left_out(dataset, checkpoint.stem)
    assert said.startswith(f"{len(stored)} rows of planner 0 are left out")


def test_labels_that_changed_after_the_prediction_count_and_are_said(tmp_path) -> None:
    root, checkpoint = copied(tmp_path)
    dataset = Dataset.open(root)
    assert unjudged(dataset, checkpoint.stem) == []
    for file in dataset.files("labels", split="test"):
        keys = dataset.file_keys(file)
        where = {k: keys[k] for k in ("predicate", "split", "shard")}
        rows = [row | {"relevant": True} for row in dataset.read_file(file).to_pylist()]
        dataset.write_rows("labels", rows, made_by=dataset.metadata(file) | {}, **where)
    assert read_predictions(dataset, checkpoint.stem).accuracy().share_relevant == 1.0
    assert any("labels changed since" in note for note in unjudged(dataset, checkpoint.stem))


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
        # one unguided run that stops as they do stands beside all guided ones
        for stop in ("first", "level"):
            some = [row for row in found if row["stop"] == stop]
            assert {GUIDES[row["guide"]].first for row in some} == {stop == "first"}
            for column in ("seconds_unguided", "nodes_unguided", "solved_unguided"):
                assert len({row[column] for row in some}) == 1
        assert all(row["seconds_oracle"] > 0 for row in found)
        ran = {(row["guide"], row["beta"]) for row in found}
        assert {("prune", 0.0), ("prune-then-full", 0.0)} <= ran
        swept += ran >= {("prune", -50.0), ("prune", 50.0)}
        for row in found:
            if row["guide"] != "prune" or row["beta"] == 50.0:
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
    assert evaluate(root, checkpoint, fewer, progress=lambda *at: seen.append(at)) == 40
    assert len(Dataset.open(root).read_rows("evaluations")) == 40
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


def test_a_dataset_is_asked_for_plans_as_long_as_its_own(tmp_path) -> None:
    own = PlannerConfig(max_actions=2, node_limit=77)
    prepare(tmp_path, DatasetConfig(test=Counts(on=1), planner=own))
    dataset = Dataset.open(tmp_path)
    assert limits(dataset, PlannerConfig()) == own
    asked = PlannerConfig(max_actions=4)
    assert limits(dataset, asked) == asked


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
