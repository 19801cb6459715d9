"""How right a checkpoint is: figures by hand, rules, breakdowns, and the decision it stores."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evaluated import TRAINING, evaluated
from hypothesis import given
from hypothesis import strategies as st

from relevance.evaluation import (
    BREAKDOWNS,
    NETWORK,
    RULE,
    EvaluationError,
    NetworkScorer,
    Predictions,
    accuracy_table,
    breakdown_table,
    load_scorer,
    predict,
    read_predictions,
)
from relevance.metrics import (
    Accuracy,
    accuracy,
    average_precision,
    best_beta,
    calibration_error,
    recall_at,
)
from relevance.models import BODIES, RelevanceModel
from relevance.scene import Goal, Robot
from relevance.store import Dataset
from relevance.training import Catalogue, load_checkpoint, save_checkpoint, train
from relevance.training.decision import offsets
from relevance.training.soft import target, tied_sets

rows_of_scores = st.lists(
    st.tuples(st.booleans(), st.integers(-8, 8).map(float)), min_size=1, max_size=30
)


def predictions(**columns: list) -> Predictions:
    """Columns by hand; what is not given is the same for all rows."""
    n = len(columns["score"])
    given = {"raw_score": columns["score"], **columns}
    constant = {
        "predicate": "on",
        "family": "on",
        "scene": 0,
        "task": 0,
        "is_goal_object": False,
        "is_subject": False,
        "stands": "elsewhere",
        "n_objects": 5,
        "visible_fraction": 1.0,
        "ambiguous": False,
    }
    names = [field.name for field in fields(Predictions)]
    return Predictions(
        **{k: np.array(given[k] if k in given else [constant[k]] * n) for k in names}
    )


BY_HAND = predictions(
    predicate=["on", "on", "on", "behind", "behind", "behind"],
    family=["on", "on", "on", "same-plane", "same-plane", "same-plane"],
    task=[1, 1, 1, 2, 2, 2],
    relevant=[True, False, True, False, True, False],
    score=[2.0, -1.0, -3.0, 0.0, 1.0, 4.0],
    is_goal_object=[False, False, False, False, True, False],
    is_subject=[False, False, False, False, True, False],
    stands=["on the subject", "on the reference", *["elsewhere"] * 4],
)


def drawn(rows: list[tuple[bool, float]]) -> tuple[np.ndarray, np.ndarray]:
    relevant, score = (np.array(column) for column in zip(*rows, strict=True))
    return score, relevant


# --- figures ----------------------------------------------------------------------------------


def test_accuracy_by_hand() -> None:
    found = BY_HAND.accuracy()
    assert (found.n_tasks, found.n_rows) == (2, 6)
    assert found.true_relevant == pytest.approx(2 / 3)
    assert found.true_irrelevant == pytest.approx(2 / 3)  # a score of 0 is left out at beta 0
    assert found.total == pytest.approx(4 / 6)
    assert found.base_rate == pytest.approx(3 / 6)
    assert found.set_recall == pytest.approx((1 / 2 + 1) / 2)
    assert found.tasks_whole == pytest.approx(1 / 2)
    assert found.tasks_right == 0.0
    looser = BY_HAND.accuracy(beta=3.5)
    assert looser.true_relevant == 1.0
    assert looser.true_irrelevant == 0.0
    assert BY_HAND.of("on").accuracy().total == pytest.approx(2 / 3)
    assert BY_HAND.of("same-plane").queries().accuracy().n_rows == 2
    assert np.isnan(BY_HAND.of("same-plane").queries().accuracy().true_relevant)
    assert np.isnan(BY_HAND.of("same-plane").queries().accuracy().set_recall)


def test_a_checkpoint_keeps_the_same_shares_that_a_report_shows() -> None:
    given = {"task": BY_HAND.task}
    kept = accuracy(BY_HAND.score, BY_HAND.relevant, **given)
    assert kept["best_beta"] is not None
    for shares, beta in ((kept, 0.0), (kept["tuned"], kept["best_beta"])):
        found = Accuracy.of(BY_HAND.score, BY_HAND.relevant, beta=beta, **given)
        for name in ("true_relevant", "true_irrelevant", "total", "base_rate", "balanced"):
            assert shares[name] == getattr(found, name)
        assert shares["set_recall"] == found.set_recall
    assert Accuracy.of(BY_HAND.score, BY_HAND.relevant).n_tasks == 0


@given(rows_of_scores, st.floats(-9, 9), st.floats(0, 9))
def test_a_larger_beta_keeps_more(rows, beta, more) -> None:
    score, relevant = drawn(rows)
    task = np.arange(len(rows)) // 3
    tight = Accuracy.of(score, relevant, beta=beta, task=task)
    loose = Accuracy.of(score, relevant, beta=beta + more, task=task)
    if relevant.any():
        assert loose.true_relevant >= tight.true_relevant
        assert loose.set_recall >= tight.set_recall
    if not relevant.all():
        assert loose.true_irrelevant <= tight.true_irrelevant
    assert loose.tasks_whole >= tight.tasks_whole >= tight.tasks_right


@given(rows_of_scores)
def test_no_beta_judges_more_rightly_than_the_best_and_none_as_good_is_much_nearer_to_0(
    rows,
) -> None:
    score, relevant = drawn(rows)

    def total(beta: float) -> float:
        return Accuracy.of(score, relevant, beta=beta).total

    best = best_beta(score, relevant)
    assert best is not None
    # between any two scores, and beyond them
    others = [quarter / 4 for quarter in range(-37, 38)]
    assert total(best) == max(map(total, others))
    as_good = [beta for beta in others if total(beta) == total(best)]
    gaps = np.diff(np.unique(score), prepend=-12, append=12)
    assert abs(best) <= min(map(abs, as_good)) + gaps.max() / 2


def test_recall_where_most_of_the_irrelevant_are_left_out_by_hand() -> None:
    relevant = np.array([True] * 4 + [False] * 20)
    score = np.array([25.0, 18.5, 19.5, -1.0, *range(20)])  # 19 of 20 irrelevant: up to 18
    assert recall_at(score, relevant) == 3 / 4
    assert recall_at(score, relevant, 0.951) == 2 / 4
    assert recall_at(score, relevant, 1.0) == 2 / 4
    assert recall_at(np.zeros(24), relevant) == 0, "a constant score keeps none"
    assert math.isnan(recall_at(score[:4], relevant[:4]))
    assert math.isnan(recall_at(score[4:], relevant[4:]))


def test_average_precision_by_hand() -> None:
    # places 1, 3 and 4 are relevant: 1/1, 2/3, 3/4
    score = np.array([5.0, 4.0, 3.0, 2.0, 1.0])
    relevant = np.array([True, False, True, True, False])
    assert average_precision(score, relevant) == pytest.approx((1 + 2 / 3 + 3 / 4) / 3)
    assert average_precision(np.zeros(5), relevant) == pytest.approx(3 / 5)
    assert average_precision(np.full(5, -np.inf), relevant) == pytest.approx(3 / 5)
    assert np.isnan(average_precision(score, np.zeros(5, bool)))


@given(rows_of_scores, st.randoms())
def test_average_precision_asks_for_the_order_alone(rows, random) -> None:
    found = average_precision(*drawn(rows))
    random.shuffle(rows)
    score, relevant = drawn(rows)
    again = average_precision(np.exp(score / 3) - 7, relevant)
    assert again == pytest.approx(found, nan_ok=True)
    if relevant.any():
        assert average_precision(np.where(relevant, 1.0, 0.0), relevant) == 1.0 >= found > 0


def test_calibration_error_by_hand() -> None:
    logit = math.log(0.25 / 0.75)
    relevant = np.array([True, False, False, False])
    assert calibration_error(np.full(4, logit), relevant) == pytest.approx(0.0)
    assert calibration_error(np.full(4, logit), ~relevant) == pytest.approx(0.5)
    sure = np.where(relevant, np.inf, -np.inf)
    assert calibration_error(sure, relevant) == pytest.approx(0.0)
    assert calibration_error(sure, ~relevant) == 1.0
    # gaps of opposite sign in two tenths do not cancel
    both = np.concatenate([np.full(4, logit), np.full(4, -logit)])
    assert calibration_error(both, np.concatenate([~relevant, relevant])) == pytest.approx(0.5)
    assert np.isnan(calibration_error(np.zeros(0), np.zeros(0, bool)))


# --- judges and breakdowns --------------------------------------------------------------------


def test_the_rules_by_hand() -> None:
    table = {(row["family"], row["judge"]): row for row in accuracy_table(BY_HAND)}
    rule, never = table["on", RULE], table["on", "always irrelevant"]
    assert (rule["true_relevant"], rule["true_irrelevant"]) == (0.5, 0.0)
    assert rule["total"] == pytest.approx(1 / 3)
    assert never["total"] == never["base_rate"] == pytest.approx(1 / 3)
    assert never["average_precision"] == never["relevant"] == pytest.approx(2 / 3)
    # the subject always moves
    assert table["same-plane", RULE]["total"] == 1.0
    # beta is the network's alone, and nothing was added to its scores
    moved = {(row["family"], row["judge"]): row for row in accuracy_table(BY_HAND, beta=99.0)}
    assert moved["on", NETWORK]["true_relevant"] == 1.0
    assert moved["on", RULE] == rule
    assert "network, offset left out" not in {judge for _, judge in table}


def test_an_offset_is_a_row_of_its_own() -> None:
    found = replace(BY_HAND, raw_score=BY_HAND.score - 2.0)
    table = {(row["family"], row["judge"]): row for row in accuracy_table(found)}
    assert table["same-plane", NETWORK]["total"] != 1.0
    assert table["same-plane", "network, offset left out"]["true_irrelevant"] == 0.5


@pytest.mark.parametrize("by", BREAKDOWNS)
def test_parts_add_up_to_the_whole(by) -> None:
    root, checkpoint = evaluated()
    found = read_predictions(Dataset.open(root), checkpoint.stem).queries()
    whole = {row["family"]: row for row in accuracy_table(found) if row["judge"] == NETWORK}
    rule = {row["family"]: row for row in accuracy_table(found) if row["judge"] == RULE}
    table = breakdown_table(found, by)
    for family, expected in whole.items():
        parts = [row for row in table if row["family"] == family]
        assert len({row[by] for row in parts}) == len(parts)
        assert sum(row["objects"] for row in parts) == expected["objects"]
        for name, of in (("total", expected), ("relevant", expected), ("rule", rule[family])):
            weighted = sum(row["objects"] * row[name] for row in parts) / expected["objects"]
            assert weighted == pytest.approx(of["total" if name == "rule" else name])


def test_predictions_are_read_with_their_tasks_and_where_they_stand() -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    found = read_predictions(dataset, checkpoint.stem)
    plans = {r["plan_id"] for r in dataset.read_rows("labels", split="test")}
    assert len(np.unique(found.task)) == len(plans)
    assert len(found.queries()) == len(found) - 2 * len(plans)
    assert found.is_subject.sum() == len(plans)
    assert len(read_predictions(dataset, "none")) == 0

    def below(boxes: dict, name: str) -> set[str]:
        base = boxes[name]["on"]
        return {base} | below(boxes, base) if base else set()

    scenes = {r["scene_id"]: r for r in dataset.read_rows("scenes", split="test")}
    expected = []
    for row in dataset.read_rows("predictions"):
        scene = scenes[row["scene_id"]]
        under = below({box["name"]: box for box in scene["objects"]}, row["query"])
        stands = "elsewhere"
        for role in ("reference", "subject"):
            stands = f"on the {role}" if row[role] in under else stands
        expected.append((row["predicate"], row["score"], stands, scene["n_objects"]))
    columns = (found.predicate, found.score, found.stands, found.n_objects)
    assert sorted(zip(*(column.tolist() for column in columns), strict=True)) == sorted(expected)
    assert {"on the reference", "elsewhere"} <= set(found.of("on").stands)
    assert set(found.of("same-plane").stands) == {"elsewhere"}


# --- the decision that a checkpoint stores ----------------------------------------------------


def test_beta_0_is_what_validation_chose(tmp_path) -> None:
    root, checkpoint = evaluated()
    root = shutil.copytree(root, tmp_path / "copy")
    model, meta = load_checkpoint(checkpoint)
    dataset = Dataset.open(root)
    (row,) = dataset.read_rows("checkpoints")
    assert json.loads(row["offsets"]) == meta["offsets"] == offsets(meta["metrics"])
    assert set(meta["offsets"]) == set(model.predicates)
    predict(root, checkpoint, split="validation")
    found = read_predictions(dataset, checkpoint.stem, split="validation").queries()
    for name, offset in meta["offsets"].items():
        mine = found.of(name)
        assert mine.score - mine.raw_score == pytest.approx(np.full(len(mine), offset))
        totals = [mine.accuracy(float(beta)).total for beta in np.linspace(-3, 3, 121)]
        assert mine.accuracy().total == max(totals)
        again = meta["metrics"][name]["queries"]["tuned"]["total"]
        assert mine.accuracy().total == pytest.approx(again)


def test_scores_are_logits_and_offset_and_an_older_checkpoint_has_none(tmp_path) -> None:
    root, checkpoint = evaluated()
    model, meta = load_checkpoint(checkpoint)
    older = tmp_path / "older.pt"
    save_checkpoint(older, model, {k: v for k, v in meta.items() if k not in ("offsets", "yaws")})
    mine, plain = load_scorer(checkpoint), load_scorer(older)
    assert mine.checkpoint_id == plain.checkpoint_id
    sample = next(iter(Dataset.open(root).samples("test")))
    goal = Goal.parse(f"behind({sample.scene.names[0]}, {sample.scene.names[1]})")
    for scorer in (mine, plain):
        scorer.observe(sample.scene, sample.image, sample.views)
    raw = plain.scores(sample.scene, goal)
    assert plain.offset("behind") == 0.0
    assert mine.scores(sample.scene, goal) == {
        name: pytest.approx(score + meta["offsets"]["behind"]) for name, score in raw.items()
    }


def test_predicates_that_a_run_starts_with_keep_their_offsets() -> None:
    metrics = {
        "on": {"queries": {"best_beta": -1.0}},
        "behind": {"queries": {"best_beta": None}},
        "in-front": {"queries": {"best_beta": -2.0}},
        "same-plane": {"queries": {"best_beta": -1.5}},
    }
    assert offsets(metrics) == {"on": -1.0, "in-front": -2.0}
    assert offsets(metrics, {"on": -7.0}) == {"on": -7.0, "in-front": -2.0}


def test_a_turned_robot_is_refused_unless_it_was_learned_from() -> None:
    root, checkpoint = evaluated()
    sample = next(iter(Dataset.open(root).samples("test")))
    turned = replace(sample.scene, robot=Robot(base=sample.scene.robot.base, yaw=0.4))
    goal = Goal.parse(f"behind({turned.names[0]}, {turned.names[1]})")
    assert load_checkpoint(checkpoint)[1]["yaws"] == [0.0]
    message = rf"scene {turned.id}: its robot is turned by 0\.4 rad, the model was trained with"
    scorer = load_scorer(checkpoint)
    with pytest.raises(EvaluationError, match=message):
        scorer.observe(turned, sample.image, sample.views)
    with pytest.raises(EvaluationError, match=message):
        scorer.scores(turned, goal)
    torch.manual_seed(1)
    model = RelevanceModel(BODIES["glimpse"].config.smoke()).eval()
    learned = NetworkScorer(model, yaws=(0.0, 0.4 + math.tau))
    learned.observe(turned, sample.image, sample.views)
    assert set(learned.scores(turned, goal)) == set(turned.names)


# --- soft labels ------------------------------------------------------------------------------


def test_two_sets_that_tie_share_the_target() -> None:
    def plan(name: str, *sets: list[str]) -> dict:
        return {"plan_id": name, "alternatives": list(sets) or None}

    sets = tied_sets(
        [
            plan("two", ["a", "s"], ["b", "s"], ["s", "a"]),  # the first again, in another order
            plan("one", ["a", "s"], ["s", "a"]),
            plan("old"),
        ]
    )
    assert set(sets) == {"two"}
    assert [target(query, query != "b", sets["two"]) for query in "absr"] == [0.5, 0.5, 1.0, 0.0]
    assert [target("a", answer, ()) for answer in (True, False)] == [1.0, 0.0]


def test_targets_are_shares_where_sets_tie_and_labels_elsewhere(tmp_path) -> None:
    dataset = Dataset.open(tied(tmp_path))
    shares = [
        [
            answer
            for shard in catalogue.shards
            for example in catalogue.read(shard, catalogue.predicates)
            for answers in example.answers.values()
            for answer in answers
        ]
        for yes in (True, False)
        for catalogue in [Catalogue.of(dataset, "train", replace(TRAINING, soft_labels=yes))]
    ]
    pairs = [(s, h) for s, h in zip(*shares, strict=True) if s != h]
    assert all(s[:3] == h[:3] for s, h in pairs)
    changed = {one for s, h in pairs for one, of in zip(s[3], h[3], strict=True) if one != of}
    assert changed == {0.5}
    assert {one for answer in shares[1] for one in answer.relevant} == {0.0, 1.0}


def test_soft_labels_are_learned_and_the_loss_stays_a_number(tmp_path) -> None:
    root = tied(tmp_path)
    soft, hard = (train(root, replace(TRAINING, soft_labels=yes)) for yes in (True, False))
    assert soft != hard
    (model, meta), (other, _) = load_checkpoint(soft), load_checkpoint(hard)
    assert all(math.isfinite(entry["loss"]) for entry in meta["history"])
    weights = other.state_dict()
    assert any(not torch.equal(w, weights[name]) for name, w in model.state_dict().items())
    with pytest.raises(ValueError, match="soft_labels are of policy found"):
        replace(TRAINING, soft_labels=True, policy="necessary")


def tied(tmp_path: Path) -> Path:
    """A copy in which every plan to learn from ties with another set, both in two orders."""
    root = Path(shutil.copytree(evaluated()[0], tmp_path / "tied"))
    shutil.rmtree(root / "checkpoints")
    dataset = Dataset.open(root)
    for file in dataset.files("plans", split="train"):
        where = {k: dataset.file_keys(file)[k] for k in ("predicate", "split", "shard")}
        rows = dataset.read_file(file).to_pylist()
        scenes = {row["scene_id"]: row for row in dataset.read_rows("scenes", split="train")}
        for row in rows:
            names = [box["name"] for box in scenes[row["scene_id"]]["objects"]]
            if row["holds"] and (more := set(names) - {*row["moved"], row["reference"]}):
                second = [min(more), row["subject"]]
                row["alternatives"] = [row["moved"], row["moved"][::-1], second, second[::-1]]
        dataset.write_rows("plans", rows, made_by=dataset.metadata(file) | {}, **where)
    return root
