"""The report's errors: every relevant query that is left out has one cause; ties bound the rest."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from evaluated import evaluated, labelled

from relevance.evaluation import read_predictions
from relevance.report.gallery import outlined
from relevance.report.misses import CAUSES, misses_section
from relevance.report.page import _ask, build
from relevance.scene import project
from relevance.store import Dataset


def section(root: Path, name: str) -> dict:
    dataset = Dataset.open(root)
    return misses_section(dataset, _ask(dataset, None), name, "found")


def changed(tmp_path: Path, change) -> tuple[Path, str]:
    """A copy of the evaluated dataset, `change` applied to every row of its test plans."""
    root, checkpoint = evaluated()
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    dataset = Dataset.open(copy)
    for file in dataset.files("plans", split="test"):
        rows = [row | change(row) for row in dataset.read_file(file).to_pylist()]
        dataset.write_rows("plans", rows, **dataset.file_keys(file))
    return copy, checkpoint.stem


def certain(row: dict) -> dict:
    return {"ambiguous": False, "alternatives": [row["moved"]] if row["holds"] else None}


def others(row: dict) -> dict:
    """Another set as short: the goal's own objects alone."""
    own = [name for name in row["moved"] if name in (row["subject"], row["reference"])]
    sets = [row["moved"], row["moved"][::-1], own]
    return {"ambiguous": True, "alternatives": sets if row["holds"] else None}


def test_each_relevant_query_that_is_left_out_has_one_cause() -> None:
    root, checkpoint = evaluated()
    queries = read_predictions(Dataset.open(root), checkpoint.stem).queries()
    found = section(root, checkpoint.stem)["causes"]
    assert {row["cause"] for row in found} <= set(CAUSES)
    assert sum(row["asked"] for row in found) == queries.relevant.sum()
    assert sum(row["left_out"] for row in found) == (queries.relevant & (queries.score <= 0)).sum()


def test_without_ties_the_ceiling_is_everything(tmp_path) -> None:
    found = section(*changed(tmp_path, certain))
    assert {row["cause"] for row in found["causes"]} <= {"wrong", "occluded"}
    assert found["others"]["unharmed"] == 0
    for row in found["ties"]:
        assert (row["tied"], row["open"]) == (0, 0)
        assert (row["ceiling"], row["goals_ceiling"]) == (1.0, 1.0)


def test_ties_take_half_of_what_they_leave_open(tmp_path) -> None:
    root, name = changed(tmp_path, others)
    found = section(root, name)
    assert {row["cause"] for row in found["causes"]} == {"tie"}
    queries = read_predictions(Dataset.open(root), name).queries()
    for row in found["ties"]:
        part = queries.of(row["family"])
        assert row["open"] == part.relevant.sum()
        assert row["ceiling"] == pytest.approx(1 - part.relevant.mean() / 2)
        tied = len(np.unique(part.task[part.relevant]))
        assert row["tied"] == tied
    # nothing but the goal's own objects is needed, and those are always kept
    assert found["others"]["unharmed"] == found["others"]["goals"]


def test_a_close_call_is_no_tie(tmp_path) -> None:
    found = section(*changed(tmp_path, lambda row: certain(row) | {"ambiguous": True}))
    assert {row["cause"] for row in found["causes"]} == {"close call"}


def test_the_page_shows_the_plans_that_were_missed(tmp_path) -> None:
    root, name = changed(tmp_path, certain)
    dataset = Dataset.open(root)
    for shard in dataset.shards("test"):
        where = {"name": name, "split": "test", "shard": shard}
        stored = dataset.read_file(dataset.shard_path("predictions", **where)).to_pylist()
        rows = [row | {"score": -3.0} for row in stored]
        dataset.write_rows("predictions", rows, **where)
    found = section(root, name)
    assert found["worst"]
    text = build(root, tmp_path / "page.html", checkpoint_id=name).read_text()
    for group in found["worst"]:
        for goal in group["goals"]:
            assert goal["picture"].count("<title>1: ") == 1
            assert goal["why"] in text


def test_arrows_end_where_boxes_end() -> None:
    dataset = Dataset.open(labelled())
    [plan, *_] = [row for row in dataset.read_rows("plans", split="test") if row["holds"]]
    sample = next(s for s in dataset.samples("test") if s.key == plan["scene_id"])
    roles = {"subject": plan["subject"], "reference": plan["reference"]}
    svg = outlined(sample, relevant=set(), final=plan["final"], **roles)
    assert "<title>1: " not in outlined(sample, relevant=set(), **roles)
    for number, place in enumerate(plan["final"], 1):
        box = sample.scene[place["name"]]
        x, y, z = place["position"]
        (u, v), _ = project(sample.scene.camera, np.array([x, y, z + box.size[2] / 2]))
        moved = re.search(rf"<g><title>{number}: {place['name']}</title>.*?</g>", svg)
        assert moved
        assert f'cx="{u:.1f}" cy="{v:.1f}"' in moved[0]
