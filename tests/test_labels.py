"""Rows from planner results: what is relevant, what counts, what is kept of a failure."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from relevance.labels import (
    POLICIES,
    Verdict,
    label_rows,
    plan_id,
    plan_row,
    scene_row,
    stored_scene,
    timing_row,
)
from relevance.planner import PLANNER_VERSION, Counts, PlanResult, Seconds
from relevance.sampling import SceneConfig, sample_scene
from relevance.scene import Action, Box, Goal, Pose, Scene, SceneError
from relevance.simulation import Rendering, Replay
from relevance.store import Dataset, table_schema

NAMES = ("red", "green", "blue", "white")


def four() -> Scene:
    places = ((0.0, 0.2), (0.0, 0.0), (0.0, -0.2), (0.2, 0.0))
    return Scene(
        objects=tuple(
            Box(name=n, size=(0.05, 0.05, 0.05), position=(x, y, 0.025), color=(0.1, 0.2, i / 4))
            for i, (n, (x, y)) in enumerate(zip(NAMES, places, strict=True))
        )
    )


def seen(scene: Scene) -> Rendering:
    n = len(scene.objects)
    return Rendering(
        image=np.zeros((192, 320, 3), np.uint8),
        mask=np.zeros((192, 320), np.uint8),
        views=np.zeros((n, 32, 32, 3), np.uint8),
        visible_pixels=np.arange(n) + 100,
        visible_fraction=1 - np.arange(n) / 10,
    )


def row_of(scene: Scene) -> dict:
    return scene_row(
        scene,
        seen(scene),
        split="train",
        shard=0,
        family="same-plane",
        seed=0,
        index=0,
        attempt=0,
        config_hash="c",
    )


def found(moved: tuple[str, ...] = ("blue", "red"), **changes: object) -> PlanResult:
    actions = tuple(
        action
        for name in moved
        for action in (
            Action(name="pick", object=name),
            Action(name="place", object=name, support="table"),
        )
    )
    result = PlanResult(
        goal=Goal.parse("behind(red, green)"),
        status="solved",
        reason="",
        actions=actions,
        moved=moved,
        final={name: Pose(position=(0.1, 0.0, 0.025), yaw=0.2) for name in moved},
        cost=1.5,
        ambiguous=False,
        counts=Counts(nodes=5, pose=4, keyframe=3, path=2),
        check_ok=True,
        max_penetration=0.0002,
        phases=(),
        seconds=Seconds(total=0.5, pose=0.1, keyframe=0.2, path=0.15, guide=0.0),
    )
    return replace(result, **changes)  # type: ignore[arg-type]


def refused() -> PlanResult:
    return found(
        (),
        status="infeasible",
        reason="pose: red cannot stand there",
        cost=math.nan,
        check_ok=False,
        max_penetration=math.nan,
    )


def plan_of(result: PlanResult, replay: Replay | None = None) -> dict:
    return plan_row(four(), "train", 0, result, replay, config_hash="h")


def test_relevant_is_what_the_plan_manipulates() -> None:
    rows = label_rows(row_of(four()), plan_of(found()))
    assert [row["query"] for row in rows] == list(NAMES)
    assert {row["query"]: row["relevant"] for row in rows} == {
        "red": True,
        "green": False,
        "blue": True,
        "white": False,
    }
    assert [row["query"] for row in rows if row["is_goal_object"]] == ["red", "green"]
    assert [row["visible_fraction"] for row in rows] == [1.0, 0.9, 0.8, 0.7]
    assert {row["policy"] for row in rows} == {"found"}


def test_a_reference_that_is_moved_is_relevant() -> None:
    rows = label_rows(row_of(four()), plan_of(found(("green", "red"))))
    assert [row["query"] for row in rows if row["relevant"]] == ["red", "green"]


@pytest.mark.parametrize(
    ("result", "replay", "holds"),
    [
        (found(), None, True),
        (found(), Replay(ok=True, max_penetration=0.0004, reason=""), True),
        (found(), Replay(ok=False, max_penetration=0.004, reason="red in green"), False),
        (found(check_ok=False, reason="path penetrates"), None, False),
        (found(check_ok=False), Replay(ok=True, max_penetration=0.0, reason=""), False),
        (refused(), None, False),
        (found(status="limit", reason="node limit"), None, False),
    ],
)
def test_only_plans_that_hold_are_labelled(
    result: PlanResult, replay: Replay | None, holds: bool
) -> None:
    plan = plan_of(result, replay)
    assert plan["holds"] is holds
    assert len(label_rows(row_of(four()), plan)) == (4 if holds else 0)


def test_a_plan_that_the_replay_refuses_is_not_solved() -> None:
    plan = plan_of(found(), Replay(ok=False, max_penetration=0.004, reason="red in green"))
    assert (plan["status"], plan["reason"], plan["holds"]) == ("refused", "red in green", False)
    assert plan["actions"], "it is kept, to be looked at"
    assert label_rows(row_of(four()), plan) == []
    again = plan_of(found(), Replay(ok=True, max_penetration=0.0, reason=""))
    assert (again["status"], again["reason"]) == ("solved", "")


def test_a_policy_from_outside_is_found_by_name() -> None:
    class Nothing:
        plans = False

        def verdicts(self, scene: Any, plan: Any, config: Any) -> dict[str, Verdict]:
            return {box["name"]: Verdict(relevant=False, because="no") for box in scene["objects"]}

    POLICIES.register("nothing", Nothing())
    try:
        rows = label_rows(row_of(four()), plan_of(found()), "nothing")
    finally:
        POLICIES.unregister("nothing")
    assert {(row["policy"], row["relevant"], row["because"]) for row in rows} == {
        ("nothing", False, "no")
    }


def test_a_failure_keeps_its_reason_and_has_no_numbers(tmp_path: Path) -> None:
    plan = plan_of(refused())
    assert plan["status"] == "infeasible"
    assert plan["reason"] == "pose: red cannot stand there"
    assert plan["cost"] is None
    assert plan["max_penetration"] is None
    assert plan["check_ok"] is False
    assert (plan["nodes"], plan["pose_checks"]) == (5, 4)
    assert (plan["keyframe_nlps"], plan["path_nlps"]) == (3, 2)
    assert plan["actions"] == plan["moved"] == plan["final"] == []
    where = {"split": "train", "shard": 0, "predicate": "behind"}
    dataset = Dataset.create(tmp_path, {})
    dataset.write_rows("plans", [plan, plan_of(found())], **where)  # NaN would be refused
    assert dataset.read_rows("plans")[0] == plan


def test_rows_have_the_columns_of_their_schema() -> None:
    plan = plan_of(found(), Replay(ok=True, max_penetration=0.0, reason=""))
    rows = {
        "scenes": row_of(four()),
        "plans": plan,
        "timings": timing_row(plan, found(), seconds_replay=0.1),
        "labels": label_rows(row_of(four()), plan)[0],
    }
    for table, row in rows.items():
        assert set(row) == {column.name for column in table_schema(table).columns}, table
    assert rows["timings"]["seconds"] == 0.5
    assert rows["timings"]["seconds_keyframe"] == 0.2
    assert plan["actions"][0] == ["pick", "blue"]
    assert plan["actions"][-1] == ["place", "red", "table"]
    assert plan["planner_version"] == PLANNER_VERSION


def test_plan_ids_name_scene_goal_and_settings() -> None:
    ids = [
        plan_id("s1", "on(a, b)", config_hash="h"),
        plan_id("s2", "on(a, b)", config_hash="h"),
        plan_id("s1", "on(b, a)", config_hash="h"),
        plan_id("s1", "on(a, b)", config_hash="g"),
    ]
    assert len(set(ids)) == 4
    assert plan_of(found())["plan_id"] == plan_id(four().id, "behind(red, green)", config_hash="h")
    assert plan_of(found())["plan_id"] == plan_of(found(cost=9.0))["plan_id"]


def test_unknown_policy() -> None:
    with pytest.raises(ValueError, match="unknown policy 'guess', expected one of found"):
        label_rows(row_of(four()), plan_of(found()), "guess")


@pytest.mark.parametrize("family", ["same-plane", "on"])
def test_a_stored_scene_is_the_same_scene(family: str, tmp_path: Path) -> None:
    config = SceneConfig(family=family)
    drawn = [sample_scene(config, seed=7, index=i) for i in range(10)]
    scenes = [scene for scene in drawn if scene is not None]
    assert len(scenes) >= 5
    dataset = Dataset.create(tmp_path, {})
    dataset.write_rows("scenes", [row_of(scene) for scene in scenes], split="train", shard=0)
    again = [stored_scene(row) for row in dataset.read_rows("scenes")]
    assert again == scenes
    assert [scene.id for scene in again] == [scene.id for scene in scenes]


def test_an_impossible_stored_scene_is_refused() -> None:
    row = row_of(four())
    row["objects"][2]["position"] = [0.0, -0.2, 0.5]
    with pytest.raises(SceneError, match=r"floating above the table"):
        stored_scene(row)
