"""A shift of the label balance is told from noise, and from nothing."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruled import ruled

from relevance.pipeline import Balance, balances, balances_between, shifting
from relevance.store import Dataset, Labelling


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    shutil.copytree(ruled(), tmp_path / "d")
    return Dataset.open(tmp_path / "d")


def rewritten(
    dataset: Dataset, file: dict[str, Any], change: Callable[[dict], dict], of: Any = None
) -> None:
    rows = [change(row) for row in dataset.read_rows("labels", **file)]
    dataset.write_rows("labels", rows, of=of, made_by=of and of.made_by, **file)


def balance(n: tuple[int, int], shares: tuple[float, float], error: float) -> Balance:
    return Balance(family="on", predicate="on", scenes=n, shares=shares, error=error)


def test_a_shift_is_more_than_three_points_and_more_than_noise() -> None:
    assert balance((900, 900), (0.10, 0.15), 0.01).shifted
    assert balance((900, 900), (0.15, 0.10), 0.01).shifted
    assert not balance((900, 900), (0.10, 0.12), 0.001).shifted, "less than 3 points"
    assert not balance((900, 900), (0.10, 0.20), 0.05).shifted, "noise"
    assert not balance((900, 3), (0.10, 0.90), 0.0).shifted, "three that are alike"
    assert str(balance((900, 30), (0.1, 0.15), 0.01)) == (
        "on: 15.0% of the queries in 30 new scenes are relevant, 10.0% in 900 before (+5.0 points)"
    )


def test_new_files_are_held_against_all_others(dataset: Dataset) -> None:
    new = [("on", "train", shard) for _, shard in files(dataset, "on", "train")][:1]
    [found] = [b for b in balances(dataset, new) if b.predicate == "on"]
    rows = [row for row in dataset.read_rows("labels") if not row["is_goal_object"]]
    rows = [row for row in rows if row["predicate"] == "on"]
    mine = [(row["split"], row["shard"]) == new[0][1:] for row in rows]
    for place, which in enumerate((np.logical_not(mine), np.array(mine))):
        asked = [row for row, chosen in zip(rows, which, strict=True) if chosen]
        share = np.mean([row["relevant"] for row in asked])
        assert found.shares[place] == pytest.approx(share)
        assert found.scenes[place] == len({row["scene_id"] for row in asked})
    assert 0 < found.error < 1
    every = [("on", split, shard) for split, shard in files(dataset, "on")]
    assert balances(dataset, every) == [], "there is nothing before"
    assert balances(dataset, []) == []


def test_labels_that_were_made_otherwise_shift(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shifting, "FEWEST", 2)
    new = files(dataset, "behind", "train")[0]
    file = {"predicate": "behind", "split": new[0], "shard": new[1]}
    [before] = [b for b in balances(dataset, [("behind", *new)]) if b.predicate == "behind"]
    rewritten(dataset, file, lambda row: {**row, "relevant": False})
    [after] = [b for b in balances(dataset, [("behind", *new)]) if b.predicate == "behind"]
    assert after.shares == (before.shares[0], 0.0)
    assert after.shifted
    assert after.error <= before.error, "no scene of the new ones differs from another"


def test_the_error_is_that_of_scenes_drawn_again(dataset: Dataset) -> None:
    new = [("on", "train", shard) for _, shard in files(dataset, "on", "train")][:1]
    [found] = [b for b in balances(dataset, new) if b.predicate == "on"]
    rows = [row for row in dataset.read_rows("labels") if not row["is_goal_object"]]
    scenes: dict[tuple[bool, str], list[bool]] = {}
    for row in rows:
        if row["predicate"] == "on":
            side = (row["split"], row["shard"]) == new[0][1:]
            scenes.setdefault((side, row["scene_id"]), []).append(row["relevant"])
    drawn, squared = np.random.default_rng(0), 0.0
    for side in (False, True):
        sums = np.array([(sum(r), len(r)) for (of, _), r in scenes.items() if of is side])
        again = sums[drawn.integers(len(sums), size=(4000, len(sums)))].sum(1)
        squared += np.var(again[:, 0] / again[:, 1])
    assert found.error == pytest.approx(np.sqrt(squared), rel=0.15)


def test_one_scene_is_no_shift(dataset: Dataset) -> None:
    split, shard = files(dataset, "behind", "train")[0]
    file = {"predicate": "behind", "split": split, "shard": shard}
    first = dataset.read_rows("labels", **file)[0]["scene_id"]
    rows = [row for row in dataset.read_rows("labels", **file) if row["scene_id"] == first]
    dataset.write_rows("labels", [{**row, "relevant": False} for row in rows], **file)
    [found] = [b for b in balances(dataset, [("behind", split, shard)]) if b.predicate == "behind"]
    assert found.shares == (1.0, 0.0)
    assert found.scenes[1] == 1
    assert abs(found.change) > 3 * found.error, "by its formula alone it would be a shift"
    assert not found.shifted


def test_new_plans_are_held_against_old_ones_of_their_scenes(dataset: Dataset) -> None:
    old = Labelling(planner="1", config="old", policy="found")
    assert balances_between(dataset, old) == [], "nothing is beside"
    split, shard = files(dataset, "behind", "train")[0]
    file = {"predicate": "behind", "split": split, "shard": shard}
    made = {"planner_version": "1", "config_hash": "old"}
    rewritten(dataset, file, lambda row: {**row, **made}, of=old)
    [same] = balances_between(dataset, old)
    assert same.shares[0] == same.shares[1]
    assert same.scenes[0] == same.scenes[1]
    assert not same.shifted
    rewritten(dataset, file, lambda row: {**row, "relevant": False})
    [gone] = balances_between(dataset, old)
    assert gone.shares == (same.shares[0], 0.0)
    assert balances_between(dataset, replace(old, config="other")) == []


def files(dataset: Dataset, predicate: str, split: str | None = None) -> list[tuple[str, int]]:
    where = {} if split is None else {"split": split}
    found = [dataset.file_keys(f) for f in dataset.files("labels", predicate=predicate, **where)]
    return [(keys["split"], keys["shard"]) for keys in found]
