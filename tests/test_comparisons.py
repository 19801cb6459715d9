"""Intervals and speed-ups against figures by hand."""

from __future__ import annotations

import numpy as np
import pytest
from evaluated import evaluated

from relevance.evaluation import (
    amortised_costs,
    guided_cost,
    read_evaluations,
    rerun_priors,
    settings,
    speed_table,
    summarise,
    with_oracle,
)
from relevance.metrics import bootstrap, over_groups, ratio_of_sums
from relevance.report import page
from relevance.store import Dataset


def row(
    unguided: float, guided: float, solved: tuple[bool, bool], predicate: str = "on", **more
) -> dict:
    return {
        "scene_id": f"{unguided}",
        "subject": "red",
        "reference": "blue",
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
        **more,
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
        found = bootstrap((rng.normal(3.0, 1.0, size=40),), np.mean)
        hits += found.low <= 3.0 <= found.high
    assert 0.55 <= hits / 120 <= 0.79
    values = rng.exponential(size=25)
    assert bootstrap((values,), np.mean) == bootstrap((values,), np.mean)
    assert bootstrap((np.array([2.0]),), np.mean).low == 2.0
    assert bootstrap((np.array([2.0, 2.0]),), np.mean).high == 2.0
    assert bootstrap((np.array([]),), np.mean).n == 0


def test_a_ratio_is_of_sums_and_paired() -> None:
    slow, scenes = np.array([1.0, 10.0, 100.0]), ["a", "b", "c"]
    found = over_groups(scenes, ratio_of_sums, slow, slow / 2)
    assert (found.low, found.value, found.high) == pytest.approx((2.0, 2.0, 2.0))
    assert over_groups(["a", "b"], ratio_of_sums, [1.0, 9.0], [1.0, 1.0]).value == 5.0


def test_goals_of_a_scene_are_drawn_together() -> None:
    rng = np.random.default_rng(1)
    each = rng.normal(size=60)
    values = np.repeat(each, 5)  # five goals that say the same
    scenes = np.repeat(np.arange(60), 5).tolist()
    together, alone = over_groups(scenes, np.nanmean, values), bootstrap((values,), np.mean)
    assert together.value == pytest.approx(alone.value)
    assert together.n == 300
    width = (together.high - together.low) / (alone.high - alone.low)
    assert width == pytest.approx(np.sqrt(5), rel=0.15)
    # scenes with fewer goals weigh less, and in whatever order rows come
    mixed = over_groups(["a", "b", "a", "c"], np.nanmean, [1.0, 2.0, 3.0, 6.0])
    assert mixed.value == pytest.approx(3.0)
    assert over_groups(["a", "b", "a", "c"], np.nanmedian, [1.0, 2.0, 3.0, 6.0]).value == 2.5
    assert np.isnan(over_groups([], np.nanmean, []).value)


def test_the_share_of_the_oracles_saving_by_hand() -> None:
    true = {"prior": "true", "seconds_inference": 0.0}
    rows = with_oracle(
        [
            row(8.0, 4.0, (True, True), looked=True),
            row(4.0, 4.5, (True, True), "behind", looked=False),
            row(6.0, 1.0, (True, False)),  # a miss: 1 s in vain, then 6 s
            row(8.0, 2.0, (True, True), **true),
            row(4.0, 2.0, (True, True), "behind", **true),
            row(6.0, 2.0, (True, True), **true),
        ]
    )
    assert [r["seconds_oracle"] for r in rows[:3]] == [2.0, 2.0, 2.0]
    found = summarise(rows[:3])
    assert found.oracle.value == pytest.approx(2.0)
    assert found.reached.value == pytest.approx((18 - 15.5) / (18 - 6))
    assert found.reached_free.value == pytest.approx((18 - 15.5 + 1.5) / (18 - 6))
    assert found.looked == pytest.approx(2 / 3)  # what an older row does not say, it did
    assert summarise(rows[3:]).reached.value == pytest.approx(1.0)
    slower = [r | {"seconds_oracle": 9.0, "solved_oracle": True} for r in rows[:3]]
    assert np.isnan(summarise(slower).reached.value)  # nothing to save
    assert np.isnan(summarise([row(8.0, 4.0, (True, True))]).oracle.value)


def test_goals_of_a_scene_share_one_encoding_among_those_that_looked() -> None:
    scene = {"scene_id": "one"}
    rows = [
        row(8.0, 4.0, (True, True), seconds_encoding=2.0, **scene),
        row(8.0, 3.0, (True, True), seconds_encoding=0.0, **scene),
        row(8.0, 5.0, (True, True), seconds_encoding=2.0, **scene),
        row(8.0, 5.0, (True, True), seconds_encoding=2.0, scene_id="other"),
        row(8.0, 5.0, (True, True)),
    ]
    assert amortised_costs(rows) == [3.0, 3.0, 4.0, 5.0, 5.0]
    assert summarise(rows).amortised.value == pytest.approx(4.0)


def test_rows_of_other_priors_are_kept_apart(tmp_path) -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    assert rerun_priors(dataset, checkpoint.stem) == ["true"]
    own = read_evaluations(dataset, checkpoint.stem)
    true = read_evaluations(dataset, checkpoint.stem, "true")
    assert {r["prior"] for r in own} == {"checkpoint"}
    assert len(own) + len(true) == len(dataset.read_rows("evaluations"))
    for r in true:  # what the stored plan moves is all that it keeps
        assert r["seconds_guided"] == r["seconds_oracle"]
        assert r["n_kept"] <= 1 + max(1, (r["n_actions_unguided"] or 2) // 2)
    text = page.build(root, tmp_path / "report.html", checkpoint_id=checkpoint.stem).read_text()
    assert "of their saving" in text
    assert "an oracle that says what the stored plan moves" in text


def test_the_table_of_speed_ups_counts_misses() -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    by_setting = settings(read_evaluations(dataset, checkpoint.stem))
    table = speed_table(dataset, checkpoint.stem)
    assert {(line["search"], line["guide"], line["beta"]) for line in table} == set(by_setting)
    missed = 0
    for line in table:
        rows = by_setting[line["search"], line["guide"], line["beta"]]
        found = summarise(rows, line["family"])
        assert line["speedup"] == pytest.approx(found.speedup.value, nan_ok=True)
        assert (line["tasks"], line["missed"]) == (found.n_tasks, found.misses)
        missed += line["missed"]
        if line["missed"]:
            assert line["speedup"] == pytest.approx(_by_hand(rows, line["family"]))
    assert missed


def _by_hand(rows: list[dict], family: str) -> float:
    """Unguided over guided seconds of the solvable tasks; a miss pays for both."""
    above = below = 0.0
    for row in rows:
        of = "on" if row["predicate"] == "on" else "same-plane"
        if row["solved_unguided"] and family in ("all", of):
            above += row["seconds_unguided"]
            below += row["seconds_guided"]
            below += 0.0 if row["solved_guided"] else row["seconds_unguided"]
    return above / below
