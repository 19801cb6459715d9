"""Families of scenes: a predicate that two of them ask has its figures kept apart."""

from __future__ import annotations

from pathlib import Path

import pytest
from stored import fill, label_values, plan_values

from relevance.evaluation import choose_tasks, in_group, read_predictions, shown_as
from relevance.report.style import GROUPS, groups, named, pooled
from relevance.scene import FAMILIES, PREDICATES, Scene, asked_of, group_of
from relevance.store import Dataset, DatasetError, replanned, sql

ON = {"split": "train", "predicate": "on"}
KINDS = ("on", "stacks")


def goal(number: int) -> dict[str, str]:
    return {"predicate": "on", "subject": ("red", "blue")[number], "reference": "green"}


def filled(root: Path) -> tuple[Dataset, list[list[Scene]]]:
    """Two shards of four scenes, one of family `on`, one of `stacks`, without plans."""
    dataset = Dataset.create(root, {"shards": []})
    scenes = []
    for shard, family in enumerate(KINDS):
        scenes.append(fill(dataset, shard))
        file = dataset.shard_path("scenes", split="train", shard=shard)
        made_by = {k: v for k, v in dataset.metadata(file).items() if k == "images_sha256"}
        rows = [row | {"family": family} for row in dataset.read_file(file).to_pylist()]
        dataset.write_rows("scenes", rows, split="train", shard=shard, made_by=made_by)
    return dataset, scenes


def plan(
    dataset: Dataset, shard: int, scenes: list[Scene], moved: list[list[str] | None], version: str
) -> None:
    """One goal a scene, on(red, green), whose plan moves those (None: no plan)."""
    plans, labels = [], []
    for of, names in zip(scenes, moved, strict=True):
        holds, made = names is not None, {"planner_version": version, "shard": shard, **goal(0)}
        found = {"status": "solved" if holds else "limit", "holds": holds, "moved": names or []}
        plans.append(plan_values(of, **made, **found, plan_id=f"{version}{of.id}"))
        for query in of.names if names is not None else ():
            more = {"plan_id": f"{version}{of.id}", "relevant": query in names, **made}
            labels.append(label_values(of, query, **more))  # type: ignore[arg-type]
    dataset.write_rows("plans", plans, **ON, shard=shard)
    dataset.write_rows("labels", labels, **ON, shard=shard)


def test_every_family_asks_something_and_every_predicate_is_asked() -> None:
    for family in FAMILIES:
        assert asked_of(family)
    for predicate in PREDICATES.values():
        assert [f for f in FAMILIES if predicate in asked_of(f)]
        assert group_of(predicate.name, predicate.family) == predicate.name
        assert group_of(predicate.name, None) == predicate.name
    assert asked_of("on") == asked_of("stacks") == (PREDICATES["on"],)
    assert group_of("on", "stacks") == "stacks"
    assert not in_group(group_of("on", "stacks"), "on")
    assert in_group(group_of("behind", "same-plane"), "same-plane")


def test_tables_have_a_row_for_each() -> None:
    assert groups()[0] == "same-plane"
    assert set(groups()) == {*FAMILIES, *PREDICATES}
    assert [group for group in GROUPS if pooled(group)] == ["same-plane"]
    rows = [{"predicate": p, "family": f} for p, f in (("on", "stacks"), ("all", "same-plane"))]
    assert [row["group"] for row in named(rows)] == ["same-plane", "stacks"]


def test_one_predicate_of_two_families_is_counted_apart(tmp_path: Path) -> None:
    dataset, scenes = filled(tmp_path / "data")
    plan(dataset, 0, scenes[0], [["red", "blue"], ["red"], ["red"], None], "1")
    plan(dataset, 1, scenes[1], [["red", "blue"]] * 4, "1")
    _, rows = sql(
        dataset.path, "select family, predicate, plans, queries, relevant from label_balance"
    )
    assert rows == [("on", "on", 3, 3, 1), ("stacks", "on", 4, 4, 4)]
    _, rows = sql(
        dataset.path,
        "select family, predicate, goals, solved from paper_label_distribution"
        " where n_actions = 'all'",
    )
    assert rows == [("on", "on", 4, 3), ("stacks", "on", 4, 4)]
    for view in ("plan_lengths", "plan_verdicts", "plan_blockers", "plan_ambiguity"):
        _, rows = sql(dataset.path, f"select distinct family from {view} order by all")
        assert rows == [("on",), ("stacks",)], view
    tasks = choose_tasks(dataset, split="train", per_predicate=1)
    assert len({task.shard for task in tasks}) == len(tasks) == 2


def test_accuracies_of_two_families_are_apart(tmp_path: Path) -> None:
    dataset, scenes = filled(tmp_path / "data")
    for shard in (0, 1):
        plan(dataset, shard, scenes[shard], [["red", "blue"]] * 4, "1")
        labels = dataset.read_rows("labels", split="train", shard=shard)
        kept = ("scene_id", "split", "subject", "reference", "query", "is_goal_object", "relevant")
        rows = [
            {key: row[key] for key in (*kept, "predicate")}
            | {"checkpoint_id": "c", "score": 1.0 if shard else -1.0}
            for row in labels
        ]
        dataset.write_rows("predictions", rows, name="c", split="train", shard=shard)
    found = read_predictions(dataset, "c", split="train").queries()
    assert found.of("on").accuracy().total == 0
    assert found.of("stacks").accuracy().total == 1
    assert len(found.of("on")) == len(found.of("stacks")) == 4 == len(found) / 2
    assert shown_as({"predicate": "on", "family": "stacks"}) == "stacks"


def test_what_planning_anew_changed_is_counted(tmp_path: Path) -> None:
    old, scenes = filled(tmp_path / "old")
    new, _ = filled(tmp_path / "new")
    before = [["red", "blue"], ["red"], None, ["red"]]
    now = [["red"], ["red", "blue"], ["red"], ["red"]]
    for dataset, moved, version in ((old, before, "1"), (new, now, "2")):
        plan(dataset, 0, scenes[0], moved, version)
        plan(dataset, 1, scenes[1], [["red"]] * 4, version)
    columns, rows = replanned(new.path, old.path)
    on, stacks = (dict(zip(columns, row, strict=True)) for row in rows)
    assert (on["family"], on["planner_before"], on["planner_now"]) == ("on", "1", "2")
    counts = {key: value for key, value in on.items() if isinstance(value, int)}
    assert counts == {
        "goals": 4,
        "newly_solved": 1,
        "no_longer_solved": 0,
        "never_solved": 0,
        "same_boxes_moved": 1,
        "fewer_boxes_moved": 1,
        "more_boxes_moved": 1,
        "other_boxes_moved": 0,
        "queries": 3,
        "equal": 1,
        "to_irrelevant": 1,
        "to_relevant": 1,
    }
    assert (stacks["goals"], stacks["same_boxes_moved"], stacks["equal"]) == (4, 4, 4)
    with pytest.raises(DatasetError, match="no planned goal in common with other labels"):
        replanned(new.path)
