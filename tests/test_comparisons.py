"""Intervals and speed-ups against figures by hand."""

from __future__ import annotations

import numpy as np
import pytest
from evaluated import evaluated

from relevance.evaluation import (
    guided_cost,
    read_evaluations,
    settings,
    speed_table,
    summarise,
)
from relevance.metrics import mean_interval, ratio_interval
from relevance.store import Dataset


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
