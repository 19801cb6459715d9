"""`check` finds every broken contract and nothing else; the tables are what a recount gives."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import pyarrow.parquet as pq
import pytest
from conftest import CONFIG, small_dataset

from relevance.pipeline import beyond_repair, missing, prepare
from relevance.pipeline.checking import Breach, check, rules
from relevance.report.card import write_card
from relevance.report.tables import statistics
from relevance.scene import PREDICATES, scene_to_json
from relevance.store import Dataset, DatasetError, sql

SCENES = {"split": "train", "shard": 0}
PLANS = {**SCENES, "predicate": "behind"}
SCENES_FILE = "scenes/split=train/shard-000000.parquet"
IMAGES_FILE = "images/split=train/shard-000000.tar"
PLANS_FILE = "plans/predicate=behind/split=train/shard-000000.parquet"
LABELS_FILE = "labels/predicate=behind/split=train/shard-000000.parquet"


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset.open(shutil.copytree(small_dataset(), tmp_path / "dataset"))


def rewrite(
    dataset: Dataset, table: str, change: Callable[[list[dict]], object], predicate: str = "behind"
) -> None:
    """Change rows of the first train shard and write a file that is whole and has a right hash."""
    where = SCENES if table == "scenes" else {**SCENES, "predicate": predicate}
    file = dataset.shard_path(table, **where)
    stored = dataset.metadata(file)
    made_by = {k: v for k, v in stored.items() if k not in ("table", "version", "sha256")}
    rows = dataset.read_file(file).to_pylist()
    change(rows)
    dataset.write_rows(table, rows, made_by=made_by, **where)


def found(dataset: Dataset, *, render: bool = False) -> list[Breach]:
    return check(dataset.path, render=render)


# a good dataset --------------------------------------------------------------------------------


def test_a_good_dataset_has_no_breach() -> None:
    seen: list[tuple[int, int]] = []
    assert check(small_dataset(), progress=lambda done, of: seen.append((done, of))) == []
    assert seen
    assert seen[-1][0] == seen[-1][1] == len(seen)


def test_an_unfinished_dataset_has_no_breach(tmp_path: Path, dataset: Dataset) -> None:
    prepare(tmp_path / "empty", CONFIG)
    assert check(tmp_path / "empty") == []
    for file in dataset.files("labels", split="test"):
        file.unlink()
    assert found(dataset) == []


def test_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no dataset\.json there"):
        check(tmp_path)
    with pytest.raises(DatasetError, match=r"no dataset\.json there"):
        statistics(tmp_path)


def test_rules_are_queries(dataset: Dataset) -> None:
    assert len(rules()) >= 10
    with dataset.connect(origin=True) as connection:
        for query in rules().values():
            columns = [item[0] for item in connection.execute(query).description or ()]
            assert columns == ["file", "row", "column", "message"]


# files -----------------------------------------------------------------------------------------


def test_truncated_tar(dataset: Dataset) -> None:
    path = dataset.path / IMAGES_FILE
    path.write_bytes(path.read_bytes()[:3000])
    breaches = found(dataset)
    assert [breach.file for breach in breaches] == [IMAGES_FILE]
    assert "truncated: expected" in str(breaches[0])
    assert str(breaches[0]).startswith(f"{IMAGES_FILE}: ")


def test_flipped_bytes(dataset: Dataset) -> None:
    names = [
        "scenes/split=test/shard-000000.parquet",
        PLANS_FILE,
        "labels/predicate=in-front/split=train/shard-000001.parquet",
        "images/split=validation/shard-000000.tar",
    ]
    for name in names:
        content = bytearray((dataset.path / name).read_bytes())
        content[len(content) // 3] ^= 0x10
        (dataset.path / name).write_bytes(content)
    breaches = found(dataset)
    assert {breach.file for breach in breaches} == set(names), [str(b) for b in breaches]


def test_missing_column_and_missing_files(dataset: Dataset) -> None:
    path = dataset.path / PLANS_FILE
    footer = {k.decode(): v.decode() for k, v in pq.read_metadata(path).metadata.items()}
    footer = {k: v for k, v in footer.items() if k.startswith("relevance.")}
    content = pq.read_table(path).drop_columns(["cost"])
    with pq.ParquetWriter(path, content.schema) as writer:
        writer.write_table(content)
        writer.add_key_value_metadata(footer)
    (dataset.path / "images/split=test/shard-000000.tar").unlink()
    (dataset.path / "scenes/split=validation/shard-000000.parquet").unlink()
    breaches = {breach.file: breach for breach in found(dataset)}
    assert breaches[PLANS_FILE].column == "cost"
    assert breaches[PLANS_FILE].message == "expected DOUBLE, found no such column"
    assert "cannot be read" in breaches["images/split=test/shard-000000.tar"].message
    orphan = "plans/predicate=behind/split=validation/shard-000000.parquet"
    assert "expected a scene of this shard" in breaches[orphan].message


def test_other_images_under_the_right_name(dataset: Dataset) -> None:
    """A tar of other scenes, with the right hash in the scenes file."""
    samples = list(dataset.samples("train", [1]))
    rows = dataset.read_rows("scenes", **SCENES)
    made = dataset.write_images(
        "train", 0, [(sample.key, sample, scene_to_json(sample.scene)) for sample in samples]
    )
    dataset.write_rows("scenes", rows, made_by=made, **SCENES)
    assert {breach.file for breach in found(dataset)} == {IMAGES_FILE}


def test_changed_pixels(dataset: Dataset) -> None:
    rows = dataset.read_rows("scenes", **SCENES)
    samples = list(dataset.samples("train", [0]))
    samples[0].image[100, 100, 0] ^= 1
    made = dataset.write_images(
        "train", 0, [(sample.key, sample, scene_to_json(sample.scene)) for sample in samples]
    )
    dataset.write_rows("scenes", rows, made_by=made, **SCENES)
    assert found(dataset) == []
    breaches = found(dataset, render=True)
    assert [breach.file for breach in breaches] == [IMAGES_FILE]
    assert "image: expected equal pixels" in breaches[0].message


def test_a_file_that_is_not_listed(dataset: Dataset) -> None:
    description = dict(dataset.description)
    description["shards"] = description["shards"][1:]
    dataset.describe(description)
    breaches = found(dataset)
    assert SCENES_FILE in {breach.file for breach in breaches}
    assert all("expected a shard that dataset.json lists" in b.message for b in breaches)


def test_copies_of_files_are_named_and_not_read(dataset: Dataset) -> None:
    rows = len(dataset.read_rows("labels"))
    labels, scenes = dataset.path / LABELS_FILE, dataset.path / SCENES_FILE
    shutil.copy(scenes, scenes.with_name("shard-000000 (1).parquet"))
    shutil.copy(labels, dataset.path / "labels/copy.parquet")
    shutil.copy(labels, dataset.path / "labels/shard-000000.parquet")
    shutil.copytree(labels.parent, dataset.path / "labels/split=train")
    assert len(dataset.read_rows("labels")) == rows
    with dataset.connect() as connection:
        assert connection.execute("SELECT count(*) FROM labels").fetchone() == (rows,)
    breaches = found(dataset)
    assert all("expected the name of a shard" in breach.message for breach in breaches)
    names = [breach.file for breach in breaches]
    assert {name.split("/")[0] for name in names} == {"scenes", "labels"}
    assert len(names) == 3 + len(list(labels.parent.parent.rglob("split=train/*.parquet")))
    assert set(beyond_repair(dataset.path, names)) == {*names}
    assert [work.jobs for work in missing(dataset.path, names)] == [(), ()]


def test_a_broken_description(dataset: Dataset) -> None:
    dataset.describe({**dataset.description, "config": {"seed": "x"}})
    assert [(b.file, b.message[:11]) for b in found(dataset)] == [("dataset.json", "config.seed")]


# rows ------------------------------------------------------------------------------------------


def first_held(rows: list[dict]) -> dict:
    return next(row for row in rows if row["holds"])


def _flip(rows: list[dict]) -> None:
    rows[0]["relevant"] = not rows[0]["relevant"]


def _necessary(rows: list[dict]) -> None:
    for row in rows:
        row.update(policy="necessary")
    next(row for row in rows if not row["relevant"])["relevant"] = True


def _move(rows: list[dict]) -> None:
    row = first_held(rows)
    subject = next(pose for pose in row["final"] if pose["name"] == row["subject"])
    subject["position"][0] += 0.5


CHANGES: dict[str, tuple[str, str, str, Callable[[list[dict]], object]]] = {
    "label flipped": ("labels", LABELS_FILE, "relevant", _flip),
    "necessary and not moved": ("labels", LABELS_FILE, "relevant", _necessary),
    "label missing": ("labels", LABELS_FILE, "query", lambda rows: rows.pop()),
    "label twice": ("labels", LABELS_FILE, "query", lambda rows: rows.append(rows[0])),
    "label of nothing": (
        "labels",
        LABELS_FILE,
        "plan_id",
        lambda rows: [row.update(plan_id="x") for row in rows],
    ),
    "other goal": (
        "labels",
        LABELS_FILE,
        "subject",
        lambda rows: rows[0].update(subject=rows[0]["reference"], reference=rows[0]["subject"]),
    ),
    "plan twice": ("plans", PLANS_FILE, "plan_id", lambda rows: rows.append(rows[0])),
    "plan gone": ("plans", LABELS_FILE, "plan_id", lambda rows: rows.remove(first_held(rows))),
    "final poses": ("plans", PLANS_FILE, "final", _move),
    "moved": ("plans", PLANS_FILE, "moved", lambda rows: first_held(rows)["moved"].pop()),
    "unknown object": (
        "plans",
        PLANS_FILE,
        "moved",
        lambda rows: rows[0].update(subject="nobody"),
    ),
    "penetration": (
        "plans",
        PLANS_FILE,
        "max_penetration",
        lambda rows: first_held(rows).update(max_penetration=0.002),
    ),
    "refuted by replay": (
        "plans",
        PLANS_FILE,
        "holds",
        lambda rows: first_held(rows).update(
            replay_ok=False, replay_max_penetration=0.01, replay_reason="x"
        ),
    ),
    "no reason": (
        "plans",
        PLANS_FILE,
        "reason",
        lambda rows: rows[0].update(status="infeasible", reason="", holds=False),
    ),
    "odd status": ("plans", PLANS_FILE, "status", lambda rows: rows[0].update(status="maybe")),
    "other config": (
        "plans",
        PLANS_FILE,
        "config_hash",
        lambda rows: [row.update(config_hash="x") for row in rows],
    ),
    "other planner": (
        "plans",
        PLANS_FILE,
        "planner_version",
        lambda rows: [row.update(planner_version="x") for row in rows],
    ),
    "wrong shard": ("plans", PLANS_FILE, "shard", lambda rows: rows[0].update(shard=1)),
    "no timing": (
        "timings",
        PLANS_FILE,
        "plan_id",
        lambda rows: rows.pop(),
    ),
    "count of objects": (
        "scenes",
        SCENES_FILE,
        "objects",
        lambda rows: rows[0].update(n_objects=99),
    ),
    "visible too much": (
        "scenes",
        SCENES_FILE,
        "objects",
        lambda rows: rows[0]["objects"][0].update(visible_fraction=1.5),
    ),
    "other scene": (
        "scenes",
        SCENES_FILE,
        "scene_id",
        lambda rows: rows[0]["objects"][0].update(yaw=rows[0]["objects"][0]["yaw"] + 1e-9),
    ),
    "floating": (
        "scenes",
        SCENES_FILE,
        "objects",
        lambda rows: rows[0]["objects"][0]["position"].__setitem__(2, 0.5),
    ),
}


BESIDE = [p.name for p in PREDICATES.values() if p is not PREDICATES["on"]]
OF_SCENES = [name for name, change in CHANGES.items() if change[0] == "scenes"]
OF_PLANS = [name for name in CHANGES if name not in OF_SCENES]


@pytest.mark.parametrize("start", range(0, len(OF_PLANS), len(BESIDE)))
def test_wrong_rows_are_found(dataset: Dataset, start: int) -> None:
    """Four wrong rows at a time, each in the files of another predicate."""
    made = dict(zip(BESIDE, OF_PLANS[start : start + len(PREDICATES)], strict=False))
    for predicate, name in made.items():
        table, _, _, change = CHANGES[name]
        rewrite(dataset, table, change, predicate)
    breaches = found(dataset)
    for predicate, name in made.items():
        _, file, column, _ = CHANGES[name]
        expect(breaches, file.replace("behind", predicate), column)
    touched = {f"predicate={predicate}" for predicate in made}
    assert {breach.file.split("/")[1] for breach in breaches} == touched


@pytest.mark.parametrize("name", OF_SCENES)
def test_a_wrong_scene_is_found(dataset: Dataset, name: str) -> None:
    table, file, column, change = CHANGES[name]
    rewrite(dataset, table, change)
    breaches = found(dataset)
    expect(breaches, file, column)


def expect(breaches: list[Breach], file: str, column: str) -> None:
    hits = [b for b in breaches if b.file == file and b.column == column]
    assert hits, [str(b) for b in breaches]
    assert all("\n" not in str(breach) for breach in breaches)
    assert hits[0].row is not None
    assert str(hits[0]).startswith(f"{file}: row {hits[0].row}: column {column}: ")
    assert "expected" in hits[0].message


def test_a_train_scene_in_the_test_split(dataset: Dataset) -> None:
    where = {"split": "test", "shard": 0}
    stored = dataset.metadata(dataset.shard_path("scenes", **where))
    made_by = {k: v for k, v in stored.items() if k.startswith("images_")}
    rows = dataset.read_rows("scenes", **where)
    leaked = {**dataset.read_rows("scenes", **SCENES)[0], **where}
    dataset.write_rows("scenes", [*rows, leaked], made_by=made_by, **where)
    messages = [str(breach) for breach in found(dataset)]
    assert sql(dataset.path, "SELECT splits FROM split_overlap")[1] == [(["test", "train"],)]
    assert any(
        text.startswith(f"{SCENES_FILE}: row 0: column scene_id: scene {leaked['scene_id']}: ")
        and "test, train (2 times)" in text
        for text in messages
    )


def test_predictions_of_unknown_scenes_and_checkpoints(dataset: Dataset) -> None:
    row = {
        "checkpoint_id": "c1",
        "scene_id": "unknown",
        "split": "test",
        "predicate": "on",
        "subject": "a",
        "reference": "b",
        "query": "c",
        "is_goal_object": False,
        "relevant": True,
        "score": 0.5,
    }
    dataset.write_rows("predictions", [row], split="test", shard=0, name="c1")
    assert {breach.column for breach in found(dataset)} == {"scene_id", "checkpoint_id"}


def test_many_breaches_of_one_rule_are_summed_up(dataset: Dataset) -> None:
    def flip_all(rows: list[dict]) -> None:
        rows *= 30

    rewrite(dataset, "plans", flip_all)
    breaches = found(dataset)
    assert len(breaches) < 200
    assert any("more rows: a goal is planned once" in breach.message for breach in breaches)


# tables ----------------------------------------------------------------------------------------


def test_label_distribution_is_a_recount() -> None:
    dataset = Dataset.open(small_dataset())
    plans = {plan["plan_id"]: plan for plan in dataset.read_rows("plans")}
    goals, solved, queries, relevant = Counter(), Counter(), Counter(), Counter()

    def groups(plan: dict) -> list[tuple[str, str, str]]:
        names = [plan["predicate"]] + ["all"] * (plan["predicate"] != "on")
        lengths = ["all"] + [str(plan["n_actions"])] * (plan["status"] == "solved")
        return [(name, plan["split"], length) for name in names for length in lengths]

    for plan in plans.values():
        for group in groups(plan):
            goals[group] += 1
            solved[group] += plan["status"] == "solved"
    for label in dataset.read_rows("labels"):
        if not label["is_goal_object"]:
            for group in groups(plans[label["plan_id"]]):
                queries[group] += 1
                relevant[group] += label["relevant"]
    columns, rows = sql(dataset.path, "FROM paper_label_distribution")
    table = [dict(zip(columns, row, strict=True)) for row in rows]
    assert len(table) == len(goals)
    for row in table:
        group = (row["predicate"], row["split"], row["n_actions"])
        assert row["goals"] == goals[group]
        assert row["solved"] == solved[group]
        assert (row["queries"], row["relevant"]) == (queries[group], relevant[group]), group
        if queries[group]:
            assert row["relevant_share"] == pytest.approx(relevant[group] / queries[group])
        else:
            assert row["relevant_share"] is None
    assert sum(queries.values()) > 50


def test_statistics_are_what_a_recount_gives() -> None:
    dataset = Dataset.open(small_dataset())
    counted = statistics(small_dataset())
    plans = dataset.read_rows("plans")
    labels = dataset.read_rows("labels")
    assert counted.scenes == 8
    assert counted.goals == len(plans)
    assert counted.plans == sum(plan["holds"] for plan in plans)
    assert counted.queries == sum(not label["is_goal_object"] for label in labels)
    assert counted.shards == (len(dataset.description["shards"]),) * 2
    assert counted.labelled[0] == counted.labelled[1]
    sizes = counted["scene_sizes"]
    assert sum(row[sizes.columns.index("scenes")] for row in sizes.rows) == 8
    verdicts = counted["plan_verdicts"]
    replayed = [row for row in verdicts.rows if row[verdicts.columns.index("split")] == "test"]
    for row in replayed:
        values = dict(zip(verdicts.columns, row, strict=True))
        assert values["replayed"] == values["solved"]
    blockers = counted["plan_blockers"]
    moved = Counter(
        (
            plan["predicate"],
            plan["split"],
            len(set(plan["moved"]) - {plan["subject"], plan["reference"]}),
        )
        for plan in plans
        if plan["holds"]
    )
    assert {tuple(row[1:4]): row[4] for row in blockers.rows} == moved
    ambiguity = counted["plan_ambiguity"]
    assert sum(row[ambiguity.columns.index("ambiguous")] for row in ambiguity.rows) == sum(
        plan["ambiguous"] and plan["holds"] for plan in plans
    )
    sizes = counted["by_size"]
    assert sum(row[sizes.columns.index("goals")] for row in sizes.rows) == len(plans)
    tenths = counted["visibility_tenths"]
    objects = sum(len(row["objects"]) for row in dataset.read_rows("scenes"))
    assert sum(row[tenths.columns.index("objects")] for row in tenths.rows) == objects
    origins = {row[0]: row[-1] for row in counted["origins"].rows}
    assert origins == {"scenes": 8, "plans": len(plans), "labels": len(labels)}


def test_the_card_is_one_folder_that_needs_nothing_else(tmp_path: Path) -> None:
    page = write_card(small_dataset(), tmp_path / "card")
    text = page.read_text()
    dataset = Dataset.open(small_dataset())
    plans = dataset.read_rows("plans")
    assert f"8 scenes, {len(plans)} goals" in text
    assert "| predicate | split | n_actions |" in text
    assert dataset.content_hash() in text
    assert dataset.description["hashes"]["scenes"] in text
    assert '"crowding"' in text
    pictures = re.findall(r"!\[.+\]\((.+\.png)\)", text)
    assert {"balance.png", "lengths.png", "sizes.png", "examples.png"} <= set(pictures)
    assert {file.name for file in page.parent.iterdir()} == {"README.md", *pictures}
    for name in pictures:
        picture = cv2.imread(str(page.parent / name))
        assert picture is not None
        assert picture.shape[1] > 600
        assert picture.std() > 5
    assert str(tmp_path) not in text
    again = write_card(small_dataset(), tmp_path / "again")
    assert again.read_text() == text
    for name in pictures:
        assert (again.parent / name).read_bytes() == (page.parent / name).read_bytes()


def test_a_dataset_without_plans_has_a_card(tmp_path: Path) -> None:
    prepare(tmp_path / "empty", CONFIG)
    text = write_card(tmp_path / "empty", tmp_path / "card").read_text()
    assert "0 scenes, 0 goals" in text
    assert "None." in text


def test_failures_are_counted_by_reason(dataset: Dataset) -> None:
    def fail(rows: list[dict]) -> None:
        rows[0].update(status="limit", reason="node limit", holds=False)

    rewrite(dataset, "plans", fail)
    columns, rows = sql(dataset.path, "FROM plan_failures WHERE reason = 'node limit'")
    assert [dict(zip(columns, row, strict=True)) for row in rows] == [
        {
            "family": "same-plane",
            "predicate": "behind",
            "split": "train",
            "status": "limit",
            "reason": "node limit",
            "goals": 1,
        }
    ]


def test_breach_reads_as_one_line() -> None:
    breach = Breach(file="a.parquet", row=3, column="cost", message="expected 1, found 2")
    assert str(breach) == "a.parquet: row 3: column cost: expected 1, found 2"
    assert str(Breach(file="a.tar", message="truncated")) == "a.tar: truncated"
