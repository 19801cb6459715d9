"""A dataset over time: labelled anew, grown, merged, broken and repaired, gathered, exported."""

from __future__ import annotations

import json
import os
import shutil
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pytest
from conftest import GROWN, complete, contents, done, grown_dataset, untouched

from relevance import labels
from relevance.cli import main
from relevance.labels import POLICIES, label_rows, necessary, stored_scene
from relevance.pipeline import (
    Counts,
    actual,
    append,
    beyond_repair,
    estimate,
    integrity,
    label_shard,
    labelled,
    labelling,
    load_config,
    merge,
    missing,
    prepare,
    preparing,
    settings,
    shards_of,
)
from relevance.pipeline.checking import check
from relevance.pipeline.estimating import Estimate
from relevance.planner import PlannerConfig, plan
from relevance.store import SCHEMAS, Dataset, DatasetError, compact, export, sql


@pytest.fixture
def made(tmp_path: Path) -> Path:
    return Path(shutil.copytree(grown_dataset(), tmp_path / "dataset"))


def images(root: Path) -> list[Path]:
    return [*root.rglob("*.tar"), *(root / "scenes").rglob("*.parquet")]


# labelled anew ---------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["necessary", "any-minimal"])
def test_another_policy_lies_beside(made: Path, policy: str) -> None:
    before = contents(made)
    with untouched(*(file for file in made.rglob("*") if file.is_file())):
        complete(made, policy=policy)
    dataset = Dataset.open(made)
    [there] = dataset.labellings()
    assert there.policy == policy
    assert len(dataset.files("labels", of=there)) == len(dataset.files("labels")) == 4 + 2 + 1
    own = {(r["plan_id"], r["query"]): r["relevant"] for r in dataset.read_rows("labels")}
    rows = dataset.read_rows("labels", of=there)
    other = {(r["plan_id"], r["query"]): r for r in rows}
    assert own.keys() == other.keys()
    assert {r["policy"] for r in rows} == {policy}
    assert all(r["because"] for r in rows)
    for key, row in other.items():
        # what is necessary every plan moves; what this plan moves some plan moves
        if policy == "necessary":
            assert own[key] >= row["relevant"]
        else:
            assert own[key] <= row["relevant"]
    # chosen by name, every view is about them
    _, [(named,)] = sql(made, "select any_value(policy) from label_balance", policy=policy)
    assert named == policy
    _, [(count,)] = sql(made, "select count(*) from beside_labels", policy=policy)
    assert count == len(own)
    _, changes = sql(made, "select relevant_before, relevant_now, why from label_changes")
    different = sum(own[key] != row["relevant"] for key, row in other.items())
    assert len(changes) == different
    assert all(f"{policy}: " in why and "; found: " in why for _, _, why in changes)
    assert check(made) == []
    kept = {name: content for name, content in contents(made).items() if name in before}
    assert kept == before


@pytest.mark.parametrize(
    ("moved", "policy", "why"),
    [
        (["b"], "found", "the plan moves a, b instead of b"),
        (["b"], "any-minimal", "the plan moves a, b instead of b; found instead of any-minimal"),
        (["b", "a"], "any-minimal", "any-minimal: not a; found: the plan moves it"),
    ],
)
def test_changes_say_what_is_otherwise(moved: list[str], policy: str, why: str) -> None:
    """Of the plan, of the policy, or of both."""
    with duckdb.connect() as plain:
        for name, plan_id, boxes in (("plans", "n", ["a", "b"]), ("beside_plans", "o", moved)):
            plain.execute(
                f"""create table {name} as select $1 as plan_id, $2 as moved, 's' as scene_id,
                'test' as split, 0 as shard, 'on' as predicate, 'b' as subject, 'c' as reference,
                4 as n_actions, false as ambiguous, true as holds, '' as reason,
                '' as replay_reason, 'solved' as status, '1' as planner_version, $1 as config_hash
                """,
                [plan_id, boxes],
            )
        for name, plan_id, of, said in (
            ("labels", "n", "found", None),
            ("beside_labels", "o", policy, None if policy == "found" else "not a"),
        ):
            plain.execute(
                f"""create table {name} as select plan_id, scene_id, split, shard, predicate,
                subject, reference, 'a' as query, false as is_goal_object, planner_version,
                config_hash, $2 as policy, plan_id = 'n' as relevant, $3::varchar as because
                from (from plans union all from beside_plans) where plan_id = $1
                """,
                [plan_id, of, said],
            )
        plain.execute("create table shard_families (split text, shard int, family text)")
        plain.execute((SCHEMAS / "changes.sql").read_text())
        assert plain.sql("select why from label_changes").fetchall() == [(why,)]


def test_necessary_is_what_the_planner_cannot_do_without() -> None:
    dataset = Dataset.open(grown_dataset())
    scenes = {row["scene_id"]: row for row in dataset.read_rows("scenes")}
    blocked = [p for p in dataset.read_rows("plans") if p["holds"] and len(p["moved"]) > 1]
    assert blocked, "expected plans that move a blocker"
    for row in blocked[:4]:
        scene = stored_scene(scenes[row["scene_id"]])
        verdicts = necessary(scene, row, GROWN.planner)
        goal = f"{row['predicate']}({row['subject']}, {row['reference']})"
        for name, verdict in verdicts.items():
            others = frozenset(scene.names) - {name}
            without = plan(scene, goal, config=GROWN.planner, movable=others)
            assert verdict.relevant == (without.status != "solved")
        made = label_rows(scenes[row["scene_id"]], row, "necessary", GROWN.planner)
        assert {r["query"]: r["because"] for r in made} == {
            name: verdict.because for name, verdict in verdicts.items()
        }


def test_any_minimal_is_the_union_of_the_alternatives() -> None:
    scene = {
        "scene_id": "s",
        "objects": [{"name": name, "visible_fraction": 1.0} for name in ("a", "b", "c", "d")],
    }
    row = {
        **dict.fromkeys(labels._FROM_PLAN, ""),
        "scene_id": "s",
        "subject": "a",
        "reference": "b",
        "holds": True,
        "moved": ["c", "a"],
        "alternatives": [["c", "a"], ["d", "a"]],
    }
    found = {r["query"]: r for r in label_rows(scene, row, "any-minimal")}
    assert {name for name, r in found.items() if r["relevant"]} == {"a", "c", "d"}
    assert found["d"]["because"] == "a plan as short moves d, a"
    alone = {r["query"] for r in label_rows(scene, row, "found") if r["relevant"]}
    assert alone == {"a", "c"}


def test_other_plans_take_the_place_and_the_old_ones_lie_beside(made: Path) -> None:
    before, config = contents(made), replace(GROWN, planner=PlannerConfig(max_actions=2))
    with pytest.raises(DatasetError, match=r"config\.planner\.max_actions: .* plan it anew"):
        prepare(made, config)
    prepare(made, config, replan=True)
    assert list(integrity(Dataset.open(made))) == [], "nothing changes until all is made"
    with untouched(*images(made)):
        complete(made, config)
    assert check(made) == []
    dataset = Dataset.open(made)
    [old] = dataset.labellings()
    assert old == GROWN.labelling
    for table in ("plans", "labels"):
        for file in dataset.files(table, of=old):
            name = str(file.relative_to(made)).partition(f"/{table}/")[2]
            name = name.removeprefix("policy=found/")
            assert file.read_bytes() == before[f"{table}/{name}"]
    _, changes = sql(
        made, "select relevant_before, relevant_now, policy_now, why from label_changes"
    )
    assert changes, "a plan of two actions moves no blocker"
    for _, now, policy, why in changes:
        assert policy in (None, "found"), why
        assert now is None or "; " not in why, "both are of the same policy"
    gone = [why for _, now, _, why in changes if now is None]
    assert gone
    assert all(why.startswith("no plan that holds now: ") for why in gone)
    # and back: nothing is planned again
    prepare(made, GROWN, replan=True)
    timings = {file: file.read_bytes() for file in dataset.files("timings", of=old)}
    complete(made, GROWN)
    assert {name: c for name, c in contents(made).items() if name in before} == before
    again = {file: file.read_bytes() for file in dataset.files("timings")}
    assert sorted(again.values()) == sorted(timings.values())
    assert check(made) == []


def test_another_planner_version_asks_first(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(made)
    for module in (settings, labels, preparing):
        monkeypatch.setattr(module, "PLANNER_VERSION", "next")
    with pytest.raises(DatasetError, match=r"planner_version: .* found 'next'; plan it anew"):
        prepare(made, GROWN)
    assert prepare(made, GROWN, scenes_only=True), "scenes do not ask for the planner"
    prepare(made, GROWN, replan=True)
    complete(made)
    _, rows = sql(made, "select planner_version = 'next', current from labellings")
    assert sorted(rows) == [(False, False), (True, True)]
    assert check(made) == []
    assert {name: c for name, c in contents(made).items() if name.startswith("images")} == {
        name: c for name, c in before.items() if name.startswith("images")
    }


def test_another_goal_set(made: Path) -> None:
    other = replace(GROWN, goals_seed=77, goals_per_scene=1)
    prepare(made, other, replan=True)
    complete(made, other)
    _, [(now, before)] = sql(
        made, "select (select count(*) from plans), (select count(*) from beside_plans)"
    )
    assert 0 < now < before
    assert load_config(Dataset.open(made)) == other
    assert check(made) == []


def test_unknown_policies_are_named(made: Path) -> None:
    spec = shards_of(Dataset.open(made))[0]
    with pytest.raises(
        ValueError, match=f"unknown policy 'x', expected one of {', '.join(POLICIES)}"
    ):
        label_shard(made, GROWN, spec, spec.predicates[0], policy="x")


# grown and merged ------------------------------------------------------------------------------


def test_appending(made: Path) -> None:
    before = contents(made)
    append(made, "test", same_plane=1, on=1)
    config = load_config(Dataset.open(made))
    assert (config.test.same_plane, config.test.on) == (1, 3)
    assert config.train == GROWN.train
    complete(made, config)
    after = contents(made)
    assert [n for n in before if n != "dataset.json" and after[n] != before[n]] == []
    assert check(made) == []
    with pytest.raises(DatasetError, match="expected at least 1 scene in all"):
        append(made, "train")
    with pytest.raises(DatasetError, match="split 'dev': expected one of train"):
        append(made, "dev", on=1)


def test_merging_by_reference(made: Path, tmp_path: Path) -> None:
    other = complete(tmp_path / "other", replace(GROWN, seed=6, train=Counts(on=3)))
    files = [file for root in (made, other) for file in root.rglob("*") if file.is_file()]
    with untouched(*files):
        merged = merge([made, other], tmp_path / "both")
        assert check(merged.path) == []
    assert [str(f.relative_to(merged.path)) for f in merged.path.rglob("*")] == ["dataset.json"]
    parts = [Dataset.open(made), Dataset.open(other)]
    for split in ("train", "test"):
        numbers = [part.shards(split) for part in parts]
        assert merged.shards(split) == [*range(sum(map(len, numbers)))]
        keys = [sample.key for part in parts for sample in part.samples(split)]
        assert [sample.key for sample in merged.samples(split)] == keys
        for table in ("scenes", "plans", "labels"):
            rows = merged.read_rows(table, split=split)
            assert len(rows) == sum(len(part.read_rows(table, split=split)) for part in parts)
            assert {row["shard"] for row in rows} <= {*merged.shards(split)}
    shard = merged.shards("train")[-1]
    from_view = "select distinct scene_id from labels where split = 'train' and shard = "
    assert {row["scene_id"] for row in merged.read_rows("labels", split="train", shard=shard)} == {
        name for (name,) in sql(merged.path, from_view + str(shard))[1]
    }
    # what a source gets later under another policy is seen
    for root in (made, other):
        complete(root, load_config(Dataset.open(root)), policy="any-minimal")
    _, [(count, policy)] = sql(
        merged.path, "select count(*), any_value(policy) from labels", policy="any-minimal"
    )
    assert (count, policy) == (len(merged.read_rows("labels")), "any-minimal")
    with pytest.raises(DatasetError, match="is merged by reference; make shards in "):
        label_shard(merged.path, GROWN, shards_of(merged)[0], "behind")
    # three: a merged one counts as its sources
    third = complete(tmp_path / "third", replace(GROWN, seed=7, train=Counts(on=1)))
    assert len(merge([merged.path, third], tmp_path / "three").sources) == 3


def test_merging_refuses(made: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="expected at least two"):
        merge([made], tmp_path / "c")
    twin = Path(shutil.copytree(made, tmp_path / "twin"))
    with pytest.raises(DatasetError, match=r"scene \w+ of train: expected in one dataset only"):
        merge([made, twin], tmp_path / "c")
    file = twin / "dataset.json"
    said = json.loads(file.read_text())
    file.write_text(json.dumps({**said, "planner_version": "1"}))
    with pytest.raises(DatasetError, match=r"planner_version: expected .* found 1"):
        merge([made, twin], tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_a_merged_dataset_names_what_is_broken_in_a_source(made: Path, tmp_path: Path) -> None:
    other = complete(tmp_path / "other", replace(GROWN, seed=6, train=Counts(on=1)))
    merged = merge([made, other], tmp_path / "both")
    next(iter(Dataset.open(other).files("labels"))).unlink()
    assert {b.file for b in check(merged.path)} == {
        "../other/labels/predicate=on/split=test/shard-000000.parquet"
    }


# broken and repaired ---------------------------------------------------------------------------


def _flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 1
    file.write_bytes(content)


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: -file.stat().st_size // 2])


def _another_split(root: Path) -> None:
    for kind, end in (("scenes", "parquet"), ("images", "tar")):
        shutil.copy(
            root / f"{kind}/split=train/shard-000001.{end}",
            root / f"{kind}/split=test/shard-000000.{end}",
        )


def _stale_labels(root: Path) -> None:
    """A labels file of another planner version, as it was written."""
    dataset = Dataset.open(root)
    where = {"split": "train", "shard": 1, "predicate": "on"}
    rows = [{**row, "planner_version": "0"} for row in dataset.read_rows("labels", **where)]
    made_by = {**GROWN.labelling.made_by, "planner": "0"}
    dataset.write_rows("labels", rows, made_by=made_by, **where)


ON = "predicate=on/split=train/shard-000001.parquet"
BREAKAGES: dict[str, tuple[Any, str]] = {
    "flipped scenes": (lambda r: _flip(r / f"scenes/{ON[13:]}"), f"scenes/{ON[13:]}"),
    "flipped plans": (lambda r: _flip(r / f"plans/{ON}"), f"plans/{ON}"),
    "flipped labels": (lambda r: _flip(r / f"labels/{ON}"), f"labels/{ON}"),
    "flipped tar": (
        lambda r: _flip(r / "images/split=train/shard-000001.tar"),
        "images/split=train/shard-000001.tar",
    ),
    "truncated tar": (
        lambda r: _cut(r / "images/split=test/shard-000000.tar"),
        "images/split=test/shard-000000.tar",
    ),
    "truncated plans": (lambda r: _cut(r / f"plans/{ON}"), f"plans/{ON}"),
    "deleted scenes": (lambda r: (r / f"scenes/{ON[13:]}").unlink(), f"scenes/{ON[13:]}"),
    "deleted tar": (
        lambda r: (r / "images/split=train/shard-000001.tar").unlink(),
        "images/split=train/shard-000001.tar",
    ),
    "deleted plans": (lambda r: (r / f"plans/{ON}").unlink(), f"plans/{ON}"),
    "deleted timings": (lambda r: (r / f"timings/{ON}").unlink(), f"timings/{ON}"),
    "deleted labels": (lambda r: (r / f"labels/{ON}").unlink(), f"labels/{ON}"),
    "stale labels": (_stale_labels, f"labels/{ON}"),
    "a scene in two splits": (_another_split, "scenes/split=test/shard-000000.parquet"),
}


USUAL = ("flipped labels", "truncated tar", "deleted plans", "stale labels")
USUAL += ("a scene in two splits",)


@pytest.mark.parametrize(
    "breakage",
    [pytest.param(b, marks=() if b in USUAL else pytest.mark.slow) for b in BREAKAGES],
)
def test_every_breakage_is_named_and_made_good(made: Path, breakage: str) -> None:
    before = contents(made)
    break_it, name = BREAKAGES[breakage]
    break_it(made)
    named = [breach.file for breach in check(made, render=False)]
    assert name in named
    assert beyond_repair(made, named) == {}
    for work in missing(made, named):
        done(work)
    after = contents(made)
    assert {name: after.get(name) for name in before} == before
    assert [n for n in after if n not in before and "planner=0" not in n] == []
    assert check(made, render=False) == []


def test_labels_beside_are_checked_too(made: Path) -> None:
    complete(made, policy="any-minimal")
    dataset = Dataset.open(made)
    [of] = dataset.labellings()
    file = dataset.files("labels", of=of)[0]
    whole = file.read_bytes()
    _flip(file)
    assert str(file.relative_to(made)) in {breach.file for breach in check(made, render=False)}
    file.write_bytes(whole)
    assert check(made, render=False) == []
    # one of another policy in its place
    keys = {key: dataset.file_keys(file)[key] for key in ("predicate", "split", "shard")}
    other, made_by = dataset.read_rows("labels", **keys), GROWN.labelling.made_by
    dataset.write_rows("labels", other, of=of, made_by=made_by, **keys)
    [breach] = check(made, render=False)
    assert breach.message == "stale: expected policy any-minimal as its folder says, found found"


def test_the_command_repairs(made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = contents(made)
    (made / f"labels/{ON}").unlink()
    _flip(made / "images/split=test/shard-000000.tar")
    assert main(["check", str(made)]) == 1
    assert main(["repair", str(made), "--workers", "1"]) == 0
    assert contents(made) == before
    said = capfd.readouterr().err
    assert "broken: images/split=test/shard-000000.tar" in said
    assert main(["check", str(made)]) == 0


def test_a_dead_writers_file_is_swept_and_a_living_ones_is_not(made: Path) -> None:
    host, folder = socket.gethostname(), made / "scenes/split=train"
    dead = folder / f".shard-000009.parquet.{host}-4194999-abcdef.tmp"
    alive = folder / f".shard-000009.parquet.{host}-{os.getpid()}-abcdef.tmp"
    elsewhere = folder / ".shard-000009.parquet.another-1-abcdef.tmp"
    for file in (dead, alive, elsewhere):
        file.write_bytes(b"half")
    prepare(made, GROWN)
    assert [dead.exists(), alive.exists(), elsewhere.exists()] == [False, True, True]
    os.utime(elsewhere, (0, 0))
    prepare(made, GROWN)
    assert not elsewhere.exists()


# gathered, exported, estimated -----------------------------------------------------------------


def test_gathered_labels_answer_the_same_until_the_shards_change(made: Path) -> None:
    queries = ("from label_balance", "select * from labels order by all")
    before = [sql(made, query) for query in queries]
    assert compact(Dataset.open(made)) == {"labels": len(before[1][1])}
    gathered = sorted((made / "compacted").rglob("*.parquet"))
    assert {file.parts[-7] for file in gathered} == {"policy=found"}
    assert [sql(made, query) for query in queries] == before
    assert check(made, render=False) == []
    # a byte that changed, size and time as before
    whole, times = gathered[0].read_bytes(), gathered[0].stat()
    middle = len(whole) // 2
    gathered[0].write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    os.utime(gathered[0], ns=(times.st_atime_ns, times.st_mtime_ns))
    [breach] = check(made, render=False)
    assert breach.file == str(gathered[0].relative_to(made))
    assert "the file was changed after it was written" in breach.message
    done(*missing(made, [breach.file]))
    assert check(made, render=False) == []
    assert [sql(made, query) for query in queries] == before
    # what is not whole is not read, and is named
    gathered = sorted((made / "compacted").rglob("*.parquet"))
    gathered[0].unlink()
    assert [sql(made, query) for query in queries] == before
    assert [breach.file for breach in check(made, render=False)] == [
        str(gathered[0].relative_to(made))
    ]


def test_export_loads_with_datasets(made: Path, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets")
    out = export(Dataset.open(made), tmp_path / "out")
    stored = Dataset.open(made)
    for split in ("train", "test"):
        scenes = datasets.load_dataset(
            str(out), "scenes", split=split, cache_dir=str(tmp_path / "cache")
        )
        samples = list(stored.samples(split))
        assert [row["scene_id"] for row in scenes] == [sample.key for sample in samples]
        for row, sample in zip(scenes, samples, strict=True):
            assert (np.asarray(row["image"].convert("RGB")) == sample.image).all()
            assert (np.asarray(row["mask"]) == sample.mask).all()
            assert row["views"].size == (32 * len(sample.views), 32)
            assert [box["name"] for box in row["objects"]] == list(sample.scene.names)
        rows = datasets.load_dataset(
            str(out), "labels", split=split, cache_dir=str(tmp_path / "cache")
        )
        assert rows.num_rows == len(stored.read_rows("labels", split=split))
        assert sum(rows["relevant"]) == sum(
            row["relevant"] for row in stored.read_rows("labels", split=split)
        )
    again = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    export(stored, out)
    assert {file: file.read_bytes() for file in again} == again
    (out / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="expected a folder outside the dataset"):
        export(Dataset.open(made), made / "out")
    assert not (made / "out").exists()
    with pytest.raises(DatasetError, match="expected an empty folder or an earlier export"):
        export(stored, out)


def test_an_estimate_is_close_and_kept(made: Path, tmp_path: Path) -> None:
    many = replace(GROWN, train=Counts(same_plane=20, on=40), test=Counts(on=20))
    found = estimate(many, sample=4)
    assert found.quantities.scenes == 80
    real = actual(made)
    assert real.scenes == 8
    assert real.goals == len(Dataset.open(made).read_rows("plans"))
    per_scene = found.quantities.gigabytes / 80, real.gigabytes / 8
    assert 0.4 < per_scene[0] / per_scene[1] < 1.6
    assert 0.4 < found.quantities.goals / (10 * real.goals) < 1.6
    asked = sum(q.relevant + q.irrelevant for q in found.queries)
    expected = found.quantities.labels - 2 * found.quantities.plans
    assert asked == pytest.approx(expected, rel=0.5)  # rates by split there, of all splits here
    assert {(q.group, q.split): q.scenes for q in found.queries}["on", "train"] == 40
    assert "stacks" not in {q.group for q in found.queries}
    assert found.quantities.hours_labels > 0
    assert found.quantities.hours_scenes > 0
    found.write(tmp_path / "new")
    assert Estimate.read(tmp_path / "new") == found
    assert Estimate.read(made) is None


@pytest.mark.slow
def test_estimate_command_before_and_after(
    made: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--preset", "smoke", "--sample", "4", "--workers", "1", "--format", "json"]
    new = tmp_path / "new"
    few = ["--train.same-plane", "0", "--test.same-plane", "0", "--validation.same-plane", "0"]
    assert main(["estimate", str(new), *arguments, *few]) == 0
    rows = {row["quantity"]: row for row in json.loads(capfd.readouterr().out)}
    assert rows["scenes"]["estimate"] == 20
    assert rows["hours"]["estimate"] > 0
    assert [file.name for file in new.iterdir()] == ["estimate.json"]
    shutil.copy(new / "estimate.json", made)  # of other settings: it is measured anew
    there = ["estimate", str(made), "--sample", "4", "--workers", "1", "--format", "json"]
    assert main(there) == 0
    rows = {row["quantity"]: row for row in json.loads(capfd.readouterr().out)}
    assert rows["scenes"]["actual"] == 8
    assert rows["scenes"]["actual / estimate"] == 1
    kept = (made / "estimate.json").read_text()
    assert main(there) == 0
    assert (made / "estimate.json").read_text() == kept
    assert check(made, render=False) == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"queries": []}', '{"queries": [{"x": 1}]}'])
def test_a_broken_estimate_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "estimate.json").write_text(text)
    with pytest.raises(DatasetError, match=r"estimate\.json: expected an estimate .* delete it"):
        Estimate.read(tmp_path)


def test_plain_duckdb_sees_what_changed(made: Path) -> None:
    complete(made, policy="any-minimal")
    config = replace(GROWN, planner=PlannerConfig(max_actions=2))
    prepare(made, config, replan=True)
    complete(made, config)
    with duckdb.connect() as plain:
        plain.execute(f"SET VARIABLE dataset = '{made}'")
        for statement in duckdb.extract_statements((SCHEMAS / "tables.sql").read_text()):
            name = statement.query.split("VIEW ")[1].split()[0]
            if name not in ("checkpoints", "predictions", "evaluations"):
                plain.execute(statement)
        for file in ("views.sql", "changes.sql"):
            plain.execute((SCHEMAS / file).read_text())
        count = "select count(*) from label_changes"
        assert plain.execute(count).fetchall() == sql(made, count)[1]
        assert sql(made, count)[1][0][0] > 0


def test_finished_labels_need_no_worker(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_work(*_: Any, **__: Any) -> None:
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(labelling, "compiled", no_work)
    monkeypatch.setattr(labelling, "plan", no_work)
    dataset = Dataset.open(made)
    for spec in prepare(made, GROWN):
        assert all(labelled(dataset, GROWN, spec, p) for p in spec.predicates)
    with untouched(*(file for file in made.rglob("*") if file.is_file())):
        assert main(["label", str(made), "--workers", "1"]) == 0
