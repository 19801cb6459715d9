"""Promised recall: it holds whatever the scores are, and says so where it cannot be had."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evaluated import TRAINING, evaluated
from hypothesis import given
from hypothesis import strategies as st
from test_accuracies import predictions

from relevance.cli import main
from relevance.errors import RelevanceError
from relevance.evaluation import (
    CalibrationError,
    EvaluationConfig,
    Predictions,
    calibrate,
    covered,
    covered_speeds,
    load_guide,
    load_scorer,
    read_calibration,
    read_predictions,
)
from relevance.evaluation.calibration import Needs
from relevance.evaluation.coverage import calibration_of, out_of_reach
from relevance.metrics import binomial_interval
from relevance.networks import read_checkpoint
from relevance.report.page import build
from relevance.scene import Goal
from relevance.store import Dataset
from relevance.training import shipping


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A dataset and its checkpoint, calibrated on two scenes a family; read only."""
    root, checkpoint = evaluated()
    copy = tmp_path_factory.mktemp("calibrated") / "dataset"
    shutil.copytree(root, copy)
    path = copy / checkpoint.relative_to(root)
    calibrate(copy, path, split="test")  # three scenes a family; validation has one
    return copy, path


# --- the promise ------------------------------------------------------------------------------


@given(st.lists(st.integers(-99, 99), min_size=1, max_size=40, unique=True), st.floats(0.01, 0.99))
def test_with_one_goal_a_scene_it_is_the_usual_quantile(needs: list[int], coverage: float) -> None:
    found = Needs.of(np.array(needs, float) / 10, np.arange(len(needs)))
    rank = math.ceil((len(needs) + 1) * coverage - 1e-9)
    beta = found.beta(coverage)
    if rank > len(needs):
        assert beta is None
    else:
        assert beta == pytest.approx(sorted(needs)[rank - 1] / 10, abs=1e-3)


def test_scenes_weigh_the_same_however_many_goals_they_have() -> None:
    """Nine easy scenes of one goal, one hard scene of a hundred: the hundred are one scene."""
    needs, scenes = np.r_[np.zeros(9), np.full(100, 7.0)], np.r_[np.arange(9), np.full(100, 9)]
    found = Needs.of(needs, scenes)
    assert (found.scenes, found.goals) == (10, 109)
    assert found.beta(9 / 11) == pytest.approx(0, abs=1e-3)
    assert found.beta(10 / 11) == pytest.approx(7, abs=1e-3)
    assert found.beta(0.95) is None


def test_goals_that_need_nothing_ask_for_a_finite_beta() -> None:
    found = Needs.of(np.full(30, -np.inf), np.arange(30))
    beta = found.beta(0.9)
    assert beta is not None
    assert -100 < beta < -40


def drawn(rng: np.random.Generator, scenes: int, score: Callable[..., np.ndarray]) -> Predictions:
    """Made-up goals of scenes: the hard ones are asked fewest goals and have most relevant boxes.

    Pooling goals, as though they were independent, would promise too much there.
    """
    columns: dict[str, list] = {name: [] for name in ("scene", "task", "relevant", "score")}
    for scene in range(scenes):
        hard = rng.random() < 0.3
        for goal in range(1 if hard else 8):
            relevant = rng.random(6) < (0.7 if hard else 0.1)
            columns["scene"] += [scene] * 6
            columns["task"] += [10 * scene + goal] * 6
            columns["relevant"] += relevant.tolist()
            columns["score"] += score(rng, relevant, hard).tolist()
    return predictions(**columns)


SCORES = {
    "good": lambda rng, relevant, hard: 3 * relevant - 2 + rng.normal(size=6) * (1 + hard),
    "shuffled": lambda rng, relevant, hard: rng.normal(size=6),
    "adversarial": lambda rng, relevant, hard: -5.0 * relevant - 3 * hard + rng.normal(size=6),
    "tied": lambda rng, relevant, hard: np.round(relevant - hard * rng.random(6)),
    "constant": lambda rng, relevant, hard: np.zeros(6),
}


@pytest.mark.parametrize("kind", SCORES)
@pytest.mark.parametrize(("scenes", "coverage"), [(9, 0.9), (40, 0.9), (30, 0.75)])
def test_the_promise_holds_whatever_the_scores_are(kind: str, scenes: int, coverage: float) -> None:
    """Over many draws of calibration and new scene: of a goal, one a scene, all is kept."""
    rng, times = np.random.default_rng(scenes), 120
    reached = []
    for _ in range(times):
        before = calibration_of(drawn(rng, scenes, SCORES[kind]), dataset_hash="", split="")
        [row] = covered(drawn(rng, 4, SCORES[kind]), before, levels=(coverage,))
        reached.append(row.reached_all)
    spread = np.std(reached) / math.sqrt(times)
    assert np.mean(reached) >= coverage - 3 * spread


def test_pooled_goals_would_break_it() -> None:
    """What the test above can see: the same draws, each goal weighing as much as a scene."""
    rng, reached = np.random.default_rng(40), []
    for _ in range(120):
        before = drawn(rng, 40, SCORES["good"])
        before.scene[:] = before.task
        [row] = covered(
            drawn(rng, 4, SCORES["good"]),
            calibration_of(before, dataset_hash="", split=""),
            levels=(0.9,),
        )
        reached.append(row.reached_all)
    assert np.mean(reached) < 0.88


def test_a_better_network_keeps_less_and_a_larger_coverage_more() -> None:
    rng = np.random.default_rng(1)
    kept = {}
    for kind in ("good", "shuffled"):
        before = calibration_of(drawn(rng, 200, SCORES[kind]), dataset_hash="", split="")
        rows = covered(drawn(rng, 50, SCORES[kind]), before, levels=(0.7, 0.9, 0.99))
        kept[kind] = [row.kept for row in rows]
        assert kept[kind] == sorted(kept[kind])
    assert kept["good"][1] < kept["shuffled"][1]


def test_every_family_that_asks_a_predicate_is_promised() -> None:
    rng = np.random.default_rng(2)
    easy, hard = drawn(rng, 50, SCORES["good"]), drawn(rng, 50, SCORES["adversarial"])
    names = [*["on"] * len(easy), *["stacks"] * len(hard)]
    columns = ("scene", "task", "relevant", "score")
    both = {name: [*getattr(easy, name), *getattr(hard, name)] for name in columns}
    both["scene"] = [*easy.scene, *(100 + hard.scene)]
    both["task"] = [*easy.task, *(10_000 + hard.task)]
    found = calibration_of(predictions(family=names, **both), dataset_hash="", split="")
    assert set(found.needs["on"]) == {"on", "stacks"}
    assert found.beta("on", 0.9) == max(needs.beta(0.9) for needs in found.needs["on"].values())


# --- what it came to ----------------------------------------------------------------------------


def test_exact_intervals() -> None:
    none, all_ = (binomial_interval(hits, 10, confidence=0.95) for hits in (0, 10))
    assert (none.value, none.low, none.n) == (0, 0, 10)
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 10))
    assert (all_.value, all_.high) == (1, 1)
    assert all_.low == pytest.approx(0.025 ** (1 / 10))
    assert math.isnan(binomial_interval(0, 0, confidence=0.95).value)


def test_covered_by_hand_and_a_breach_is_seen() -> None:
    """Calibrated on easy scenes, met by hard ones; an interval counts one goal a scene."""
    rng = np.random.default_rng(3)
    before = calibration_of(drawn(rng, 100, SCORES["good"]), dataset_hash="", split="")
    home = covered(drawn(rng, 100, SCORES["good"]), before, levels=(0.9,))
    away = covered(drawn(rng, 100, SCORES["adversarial"]), before, levels=(0.9,))
    assert [row.breached for row in (*home, *away)] == [False, True]
    assert [row.reached.n for row in (*home, *away)] == [100, 100]
    beta = before.beta("on", 0.9)
    rows = predictions(
        scene=[0, 0, 0, 1, 1, 1],
        task=[0, 0, 0, 1, 1, 1],
        relevant=[True, True, False, True, True, False],
        is_goal_object=[True, False, False, True, False, False],
        score=[-99.0, -beta + 1, -beta + 1, -99.0, -beta - 1, -beta - 1],
        n_objects=[3] * 6,
    )
    [row] = covered(rows, before, levels=(0.9,))
    assert (row.reached.value, row.reached_all, row.goals) == (0.5, 0.5, 2)
    assert (row.kept, row.objects) == (2.0, 3.0)  # three of the first goal, one of the second


def test_what_cannot_be_had_is_left_out_and_said() -> None:
    rng = np.random.default_rng(4)
    few = calibration_of(drawn(rng, 10, SCORES["good"]), dataset_hash="", split="")
    asked = drawn(rng, 10, SCORES["good"])
    assert [row.coverage for row in covered(asked, few)] == [0.9]
    assert len(out_of_reach(asked, few)) == 2
    with pytest.raises(CalibrationError, match=r"on: coverage 0.95 takes 19 calibrated"):
        few.beta("on", 0.95)
    with pytest.raises(CalibrationError, match="not calibrated for behind, expected one of on"):
        few.beta("behind", 0.9)


# --- in a checkpoint ----------------------------------------------------------------------------


def test_a_calibration_is_kept_in_the_file_and_changes_nothing_else(
    calibrated: tuple[Path, Path],
) -> None:
    before, after = read_checkpoint(evaluated()[1]), read_checkpoint(calibrated[1])
    assert {k: v for k, v in after.meta.items() if k != "calibration"} == before.meta
    assert before.graphs == after.graphs
    assert all((before.weights[name] == after.weights[name]).all() for name in before.weights)
    root, path = calibrated
    whole = path.read_bytes()
    calibrate(root, path, split="test")
    assert path.read_bytes() == whole
    found = read_calibration(path)
    assert found.dataset_hash == Dataset.open(root).content_hash(policy="found", split="test")
    assert found.split == "test"


def test_a_covering_guide_keeps_what_the_calibration_says(calibrated: tuple[Path, Path]) -> None:
    root, path = calibrated
    calibration, plain = read_calibration(path), load_scorer(path)
    sample = next(iter(Dataset.open(root).samples("test")))
    for coverage in (0.3, 0.6):
        guide = load_guide(path, mode="prune", coverage=coverage)
        assert guide.beta == 0
        for name in ("behind", "on"):
            goal = Goal.parse(f"{name}({', '.join(sample.scene.names[:2])})")
            beta = calibration.beta(name, coverage)
            kept = guide.scorer.scores(sample.scene, goal)
            for box, score in plain.scores(sample.scene, goal).items():
                assert kept[box] == pytest.approx(score + beta)


def test_calibrated_goals_are_covered(calibrated: tuple[Path, Path]) -> None:
    """Of the goals that it was calibrated on, as many are kept whole as were promised."""
    root, path = calibrated
    rows = read_predictions(Dataset.open(root), read_checkpoint(path).meta["checkpoint_id"])
    for row in covered(rows, read_calibration(path), levels=(0.5, 0.7)):
        assert row.reached_all >= row.coverage


def test_the_planner_is_rerun_at_every_coverage(calibrated: tuple[Path, Path]) -> None:
    config = EvaluationConfig(tasks=1, guides=("prune-then-full",))
    found = covered_speeds(*calibrated, config, levels=(0.5, 0.99))
    assert list(found) == [0.5]  # 0.99 takes more scenes
    [[comparison]] = found.values()
    assert comparison.n_tasks == 5  # one a predicate
    assert comparison.misses == comparison.gains == 0


def test_halved_weights_are_not_those_that_were_calibrated(
    calibrated: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shipping, "train", lambda *_, **__: calibrated[1])
    made = shipping.ship(calibrated[0], TRAINING, tmp_path, name="mine")
    assert "calibration" not in read_checkpoint(made).meta


def test_commands_and_page(
    calibrated: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, _ = calibrated
    assert main(["calibrate", str(root), "--split", "test", "--format", "csv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "predicate,family,scenes,goals,90%,95%,99%"
    assert len(lines) == 6
    assert main(["coverage", str(root), "--levels", "0.5", "0.9", "--format", "csv"]) == 0
    told = capsys.readouterr()
    rows = [line.split(",") for line in told.out.splitlines()]
    assert rows[0][:3] == ["goals of", "promised", "reached"]
    assert {row[1] for row in rows[1:]} == {"0.5"}
    assert "on: coverage 0.9 takes 9 calibrated scenes of on, found 3" in told.err
    page = build(root, tmp_path / "page.html").read_text()
    assert 'id="coverage"' in page
    assert "boxes that are kept" in page


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"coverage": 1.0}, "coverage 1: expected more than 0 and less than 1"),
        ({"coverage": 0.0}, "coverage 0: expected more than 0 and less than 1"),
        ({"coverage": float("nan")}, "coverage nan: expected more than 0 and less than 1"),
        ({"coverage": 0.5, "mode": "order"}, "coverage: guide order leaves nothing out, expected"),
        ({"coverage": 0.5, "beta": 1.0}, "coverage 0.5 and beta 1: expected one of them"),
    ],
)
def test_promises_that_cannot_be_made(
    calibrated: tuple[Path, Path], given: dict, message: str
) -> None:
    with pytest.raises(RelevanceError, match=message):
        load_guide(calibrated[1], **given)


def test_errors_are_one_line(
    calibrated: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, path = calibrated
    scenes = tmp_path / "scene.json"
    scenes.write_text(
        '{"objects": [{"name": "a", "size": [0.05, 0.05, 0.05], "position": [0, 0.1, 0.025], '
        '"color": [1, 0, 0]}, {"name": "b", "size": [0.05, 0.05, 0.05], '
        '"position": [0, -0.1, 0.025], "color": [0, 0, 1]}], "goals": ["on(a, b)"]}'
    )
    asked = ["plan", str(scenes), "--guide", "prune", "--coverage"]
    plain = str(evaluated()[1])
    for arguments, message in (
        ([*asked, "0.95", "--checkpoint", plain], "is not calibrated, which a coverage needs"),
        ([*asked, "1.5", "--checkpoint", str(path)], "coverage 1.5: expected more than 0"),
        (
            [*asked, "0.9", "--checkpoint", str(path)],
            "on: coverage 0.9 takes 9 calibrated scenes of on, found 3: expected more, or a "
            "coverage of at most 0.75",
        ),
        ([*asked, "0.9"], "--coverage needs a --guide and a --checkpoint"),
        (["coverage", str(root), "--checkpoint", plain], "is not calibrated"),
        (["coverage", str(root), "--levels", "2"], "coverage 2: expected more than 0"),
    ):
        assert main(arguments) == 2
        told = capsys.readouterr()
        assert told.out == ""
        [line] = told.err.splitlines()
        assert message in line
    assert main([*asked, "0.5", "--checkpoint", str(path)]) == 0
    assert "on(a, b): solved" in capsys.readouterr().out
