"""Learning from failure: what is mined, that it is whole, and that selection stays honest."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import complete, contents, done, untouched

from relevance.cli import main
from relevance.evaluation import predict
from relevance.labels import stored_scene
from relevance.models import RelevanceModel
from relevance.pipeline import (
    Counts,
    DatasetConfig,
    MiningConfig,
    append,
    labels_work,
    load_config,
    merge,
    minable,
    mine,
    mined_of,
    missing,
    scenes_work,
    shards_of,
)
from relevance.pipeline.checking import check
from relevance.sampling import SceneConfig
from relevance.scene import PREDICATES, goal_holds
from relevance.store import Dataset, DatasetError, sql
from relevance.training import Catalogue, TrainConfig, save_checkpoint, train

BASE = DatasetConfig(
    seed=4,
    train=Counts(same_plane=1, on=1),
    validation=Counts(same_plane=4, on=4),
    test=Counts(on=1),
    scenes_per_shard=2,
    goals_per_scene=2,
    scene=SceneConfig(max_objects=6),
    replay_share=0.0,
    test_replay_share=0.0,
)
TRAINING = replace(TrainConfig.smoke().with_body("geometry"), steps=2, threads=1)
HOW = MiningConfig(copies=2)


def judge(folder: Path, offset: float) -> Path:
    """A checkpoint that learned nothing and says of everything the same."""
    name = f"says{offset:g}".replace("-", "minus")
    torch.manual_seed(0)
    offsets = dict.fromkeys(PREDICATES, offset)
    meta = {
        **dict.fromkeys(("dataset_hash", "config_hash"), ""),
        **{"checkpoint_id": name, "config": TRAINING.to_dict(), "offsets": offsets},
        **{"created": "2026-01-01T00:00:00", "train_seconds": 0.0, "metrics": {}},
    }
    save_checkpoint(folder / f"{name}.pt", RelevanceModel(TRAINING.model), meta)
    return folder / f"{name}.pt"


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return complete(tmp_path_factory.mktemp("mining") / "base", BASE)


@pytest.fixture(scope="module")
def blind(base: Path) -> Path:
    """To it nothing is relevant."""
    return judge(base.parent, -1000.0)


def begin(base: Path, out: Path, checkpoint: Path, how: MiningConfig = HOW) -> DatasetConfig:
    def score(shards: Sequence[int]) -> None:
        predict(base, checkpoint, split="validation", shards=shards)

    return mine(base, out, checkpoint.stem, how, score=score)


def whole(base: Path, out: Path, checkpoint: Path, how: MiningConfig = HOW) -> Path:
    config = begin(base, out, checkpoint, how)
    done(scenes_work(out, config))
    done(labels_work(out))
    return out


@pytest.fixture(scope="module")
def mined(base: Path, blind: Path) -> Path:
    with untouched(*(f for f in base.rglob("*") if f.is_file() and "predictions" not in f.parts)):
        return whole(base, base.parent / "mined", blind)


@pytest.fixture(scope="module")
def fresh(base: Path, blind: Path, mined: Path) -> Path:
    return whole(base, base.parent / "random", blind, replace(HOW, random=True))


def asked(root: Path) -> Counter[str]:
    _, rows = sql(root, "select predicate, count(*) from plans group by all")
    return Counter(dict(rows))


def test_half_of_each_kind_is_mined_and_stays_so_when_a_dataset_grows(base: Path) -> None:
    kinds = {(spec.family, spec.shard) for spec in minable(Dataset.open(base))}
    assert kinds == {("same-plane", 1), ("on", 3)}


def test_what_failed_is_copied_labelled_and_whole(base: Path, mined: Path) -> None:
    assert check(mined) == []
    dataset, source = Dataset.open(mined), Dataset.open(base)
    found = mined_of(dataset)
    assert found is not None
    looked = [r for s in (1, 3) for r in source.read_rows("scenes", split="validation", shard=s)]
    assert found.looked_at == tuple(row["scene_id"] for row in looked)
    # a blind one fails exactly where something but the goal's objects has to move
    query = """
        select distinct scene_id, predicate || '(' || subject || ', ' || reference || ')'
        from labels where split = 'validation' and relevant and not is_goal_object
            and not ambiguous and scene_id in (select unnest($looked_at::varchar[]))
    """
    with source.connect() as connection:
        rows = connection.execute(query, {"looked_at": list(found.looked_at)}).fetchall()
    assert rows
    assert {(f.scene["id"], goal) for f in found.failed for goal in f.scene["goals"]} == {*rows}
    # all copies are there, all of them to train on, asked what failed and nothing else
    scenes = dataset.read_rows("scenes")
    assert {row["split"] for row in scenes} == {"train"}
    assert Counter(r["index"] // HOW.copies for r in scenes) == Counter(
        dict.fromkeys(range(len(found.failed)), HOW.copies)
    )
    plans = {
        (r["scene_id"], f"{r['predicate']}({r['subject']}, {r['reference']})")
        for r in dataset.read_rows("plans")
    }
    wanted = set()
    for row in scenes:
        scene, original = stored_scene(row), found.source(row["index"])
        assert scene.names == original.names
        assert scene.id not in found.looked_at
        goals = [scene.goal(text) for text in original.goals]
        wanted |= {
            (scene.id, str(g)) for g in goals if not goal_holds(scene.objects, g, scene.robot)
        }
    assert plans == wanted


def test_a_killed_one_goes_on_to_equal_bytes(
    base: Path, blind: Path, mined: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mined"
    config = begin(base, out, blind)
    scenes_work(out, config).jobs[0].run()

    def never(shards: Sequence[int]) -> None:
        raise AssertionError(f"{shards} were scored before")

    config = mine(base, out, blind.stem, HOW, score=never)
    done(scenes_work(out, config))
    done(labels_work(out))
    assert contents(out) == contents(mined)
    # and what is broken later is made anew, from mined.json alone
    dataset = Dataset.open(out)
    dataset.images_path("train", 0).unlink()
    dataset.files("plans")[0].unlink()
    for work in missing(out, [breach.file for breach in check(out)]):
        done(work)
    assert contents(out) == contents(mined)


def test_as_many_random_scenes_are_asked_as_many_goals(
    base: Path, mined: Path, fresh: Path
) -> None:
    assert check(fresh) == []
    kinds = "select family, split, count(*) from scenes group by all order by all"
    assert sql(fresh, kinds) == sql(mined, kinds)
    more, fewer = asked(fresh), asked(mined)
    # a scene may have fewer goals than are drawn, and what is true of a copy is not asked of it
    assert more.total() > 0.8 * fewer.total() > 0.6 * more.total()
    assert set(more) <= set(fewer)
    there = {
        row["scene_id"] for root in (base, mined) for row in Dataset.open(root).read_rows("scenes")
    }
    assert there.isdisjoint(row["scene_id"] for row in Dataset.open(fresh).read_rows("scenes"))


def test_what_was_looked_at_is_not_selected_by(
    base: Path, mined: Path, fresh: Path, tmp_path: Path
) -> None:
    splits = {}
    for name, other in (("mined", mined), ("random", fresh)):
        both = merge([base, other], tmp_path / name)
        assert name != "mined" or check(both.path) == []
        found = mined_of(Dataset.open(other))
        assert found is not None
        seen = {*found.looked_at}
        by_rows = {row["scene_id"] for row in both.read_rows("scenes", split="validation")}
        _, by_views = sql(
            both.path, "select distinct scene_id from labels where split = 'validation'"
        )
        validation = Catalogue.of(both, "validation", TRAINING)
        read = {
            example.name
            for shard in validation.shards
            for example in validation.read(shard, validation.predicates)
        }
        assert len(by_rows) == 4
        assert seen.isdisjoint(by_rows)
        assert read == {scene for (scene,) in by_views} <= by_rows
        assert load_config(both).validation == Counts(same_plane=2, on=2)
        train_scenes = {row["scene_id"] for row in both.read_rows("scenes", split="train")}
        assert train_scenes > {row["scene_id"] for row in Dataset.open(other).read_rows("scenes")}
        assert [row["scene_id"] for row in both.read_rows("scenes", split="test")] == [
            row["scene_id"] for row in Dataset.open(base).read_rows("scenes", split="test")
        ]
        splits[name] = by_rows
    assert splits["mined"] == splits["random"]
    # a model learns from it as from any other
    assert train(tmp_path / "mined", TRAINING).is_file()
    # a merge of the merged one leaves the same out
    again = merge([tmp_path / "random", mined], tmp_path / "three")
    assert {r["scene_id"] for r in again.read_rows("scenes", split="validation")} == splits["mined"]
    # and whoever takes them in by hand is found out
    file = again.path / "dataset.json"
    said = json.loads(file.read_text())
    del said["sources"][0]["without"]
    file.write_text(json.dumps(said))
    assert {breach.message.partition(",")[0] for breach in check(again.path)} == {
        "expected no scene that the training split may have copies of"
    }


def test_what_cannot_be_mined_is_one_line(
    base: Path, blind: Path, mined: Path, tmp_path: Path
) -> None:
    sees = judge(tmp_path, 1000.0)
    with pytest.raises(ValueError, match=r"says1000 leaves out nothing relevant in the 4 valid"):
        begin(base, tmp_path / "none", sees)
    assert not (tmp_path / "none").exists()
    with pytest.raises(DatasetError, match=r"copies: was mined with 2, found 3; take another"):
        begin(base, mined, blind, MiningConfig(copies=3))
    with pytest.raises(
        DatasetError, match=r"checkpoint: was mined with saysminus1000, found says1"
    ):
        begin(base, mined, sees)
    with pytest.raises(DatasetError, match="is a dataset that was not mined"):
        begin(base, base, blind)
    lonely = tmp_path / "lonely"
    shutil.copytree(base, lonely)
    said = json.loads((lonely / "dataset.json").read_text())
    said["shards"] = [
        s for s in said["shards"] if (s["split"], s["shard"] % 2) != ("validation", 1)
    ]
    (lonely / "dataset.json").write_text(json.dumps(said))
    with pytest.raises(DatasetError, match="no kind of scene has two validation shards"):
        begin(lonely, tmp_path / "none", blind)
    said = json.loads((base / "dataset.json").read_text())
    (lonely / "dataset.json").write_text(json.dumps({**said, "planner_version": "1"}))
    with pytest.raises(DatasetError, match=r"planner_version: expected .*, found 1; .*--replan"):
        begin(lonely, tmp_path / "none", blind)


def test_the_command_says_so(base: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    wrong = (
        ([str(base), str(tmp_path / "a"), "--checkpoint", "nobody"], "unknown checkpoint 'nobody'"),
        ([str(tmp_path), str(tmp_path / "a")], "no dataset.json there"),
        ([str(base), str(tmp_path / "a"), "--copies", "0"], "MiningConfig.copies = 0: expected"),
    )
    for arguments, expected in wrong:
        assert main(["mine", *arguments]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert line.startswith("relevance mine: ")
        assert expected in line
    assert not (tmp_path / "a").exists()


def test_a_mined_dataset_stays_what_it_is(base: Path, mined: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="holds what was mined and no more"):
        append(mined, "train", on=1)
    with pytest.raises(ValueError, match="is asked the goals that were mined"):
        labels_work(mined, goals_per_scene=3)
    with pytest.raises(DatasetError, match="mined: expected none, found 0123"):
        scenes_work(tmp_path / "own", replace(BASE, mined="0123"))
    assert not (tmp_path / "own").exists()
    assert [s.split for s in shards_of(Dataset.open(mined))] == ["train"] * len(
        shards_of(Dataset.open(mined))
    )
    copy = Path(shutil.copytree(mined, tmp_path / "copy"))
    text = (copy / "mined.json").read_text()
    for broken, expected in (
        (text.replace('"copies": 2', '"copies": 3'), "content hash: expected "),
        (text[:-40], "expected what was mined"),
        (None, "cannot be read"),
    ):
        (copy / "mined.json").unlink(missing_ok=True)
        if broken is not None:
            (copy / "mined.json").write_text(broken)
        [breach] = [breach for breach in check(copy) if breach.file == "dataset.json"]
        assert expected in breach.message
