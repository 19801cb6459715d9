"""Shards: which there are, that they are equal bytes however they are made, and resuming."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import CONFIG, contents, make, small_dataset, untouched
from hypothesis import given, settings
from hypothesis import strategies as st

from relevance import simulation
from relevance.labels import stored_scene
from relevance.pipeline import (
    Counts,
    DatasetConfig,
    ShardSpec,
    append,
    generate_shard,
    label_shard,
    labelling,
    load_config,
    prepare,
    scenes,
    shard_specs,
)
from relevance.pipeline.settings import scenes_of
from relevance.report.paper import paper
from relevance.sampling import SceneConfig, sample_goals, sample_scene
from relevance.scene import FAMILIES, PREDICATES, asked_of
from relevance.store import SPLITS, Dataset, DatasetError


@pytest.fixture
def made(tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_dataset(), tmp_path / "dataset"))


# which shards ----------------------------------------------------------------------------------

few = st.integers(0, 9)
counts = st.builds(Counts, same_plane=few, on=few, stacks=few)
configs = st.builds(
    DatasetConfig, train=counts, validation=counts, test=counts, scenes_per_shard=st.integers(1, 5)
)


@given(configs)
def test_shards_cover_every_scene_once(config: DatasetConfig) -> None:
    specs = shard_specs(config)
    for split in SPLITS:
        mine = [spec for spec in specs if spec.split == split]
        assert [spec.shard for spec in mine] == list(range(len(mine)))
        indices = [i for spec in mine for i in range(spec.first, spec.first + spec.count)]
        assert indices == list(range(len(indices)))
        for family in FAMILIES:
            scenes = sum(spec.count for spec in mine if spec.family == family)
            assert scenes == config.counts(split).of(family)
        assert all(1 <= spec.count <= config.scenes_per_shard for spec in mine)


@given(configs, configs)
def test_appending_never_renumbers(first: DatasetConfig, second: DatasetConfig) -> None:
    before = shard_specs(first)
    after = shard_specs(second, before)
    assert [spec for spec in after if spec in before] == before
    for split in SPLITS:
        mine = [spec for spec in after if spec.split == split]
        indices = sorted(i for s in mine for i in range(s.first, s.first + s.count))
        assert indices == list(range(len(indices)))
        for family in FAMILIES:
            have = sum(spec.count for spec in mine if spec.family == family)
            asked = (first.counts(split).of(family), second.counts(split).of(family))
            assert have == max(asked)


@given(configs, configs)
@settings(deadline=None)
def test_each_predicate_may_have_scenes_of_its_own(
    first: DatasetConfig, second: DatasetConfig
) -> None:
    """The paper's way; a predicate that is asked of two families has them in both."""
    first, second = (replace(config, own_scenes=True) for config in (first, second))
    specs = shard_specs(second, shard_specs(first))
    for split in SPLITS:
        mine = [spec for spec in specs if spec.split == split]
        assert all(len(spec.predicates) == 1 for spec in mine)
        wanted = {f: max(c.counts(split).of(f) for c in (first, second)) for f in FAMILIES}
        for family in FAMILIES:
            for predicate in asked_of(family):
                own = [s for s in mine if s.family == family and predicate in s.predicates]
                assert sum(spec.count for spec in own) == wanted[family]
        assert scenes_of(specs, split, each=True) == Counts.by_family(wanted)
        total = {family: n * len(asked_of(family)) for family, n in wanted.items()}
        assert scenes_of(specs, split) == Counts.by_family(total)


def test_whose_scenes_they_are_is_a_setting_of_the_scenes(tmp_path: Path) -> None:
    prepare(tmp_path, CONFIG)
    own = replace(CONFIG, own_scenes=True)
    assert own.scenes_hash != CONFIG.scenes_hash
    with pytest.raises(DatasetError, match=r"config\.own_scenes: the dataset was made with False"):
        prepare(tmp_path, own)
    specs = prepare(tmp_path / "own", own)
    assert prepare(tmp_path / "own", own) == specs
    assert load_config(Dataset.open(tmp_path / "own")) == own
    append(tmp_path / "own", "train", same_plane=1)
    assert load_config(Dataset.open(tmp_path / "own")).train.same_plane == 4


def test_a_shard_knows_its_predicates() -> None:
    spec = ShardSpec(split="train", shard=0, family="on", first=0, count=1)
    assert spec.predicates == (PREDICATES["on"],)
    assert replace(spec, family="stacks").predicates == (PREDICATES["on"],)
    plane = replace(spec, family="same-plane")
    assert len(plane.predicates) == 4
    assert replace(plane, predicate="behind").predicates == (PREDICATES["behind"],)


@pytest.mark.parametrize(
    ("preset", "families"),
    [
        ("smoke", {"same-plane", "on"}),
        ("demo", {"same-plane", "on"}),
        ("laptop", {"same-plane", "on", "stacks"}),
        ("crowd", {"same-plane", "stacks"}),
        ("randomised", {"same-plane", "on", "stacks"}),
        ("paper", {"same-plane", "on"}),
    ],
)
def test_presets(preset: str, families: set[str]) -> None:
    config = getattr(DatasetConfig, preset)()
    for split in SPLITS:
        assert {f for f in FAMILIES if config.counts(split).of(f)} == families


def test_the_paper_s_preset_has_the_paper_s_scenes() -> None:
    config = DatasetConfig.paper()
    for split, theirs in (("train", paper().scenes), ("test", paper().test_scenes)):
        mine = Counter()
        for spec in shard_specs(config):
            if spec.split == split:
                (predicate,) = spec.predicates
                mine[predicate.name] += spec.count
        assert mine == theirs
    assert sum(paper().scenes.values()) == 480_000
    assert config.goals_per_scene == 25


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "seed = -1: expected greater than or equal to 0"),
        ({"goals_per_scene": 0}, "goals_per_scene = 0: expected greater than or equal to 1"),
        ({"scenes_per_shard": 0}, "scenes_per_shard = 0"),
        ({"replay_share": 1.5}, "replay_share = 1.5: expected less than or equal to 1"),
        ({"policy": "guess"}, "policy = 'guess': expected one of found"),
    ],
)
def test_impossible_settings(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DatasetConfig(**change)


# dataset.json ----------------------------------------------------------------------------------


def test_prepare_twice_and_more(tmp_path: Path) -> None:
    specs = prepare(tmp_path, CONFIG)
    before = (tmp_path / "dataset.json").read_bytes()
    assert prepare(tmp_path, CONFIG) == specs
    assert (tmp_path / "dataset.json").read_bytes() == before
    assert load_config(Dataset.open(tmp_path)) == CONFIG
    more = replace(CONFIG, train=Counts(same_plane=7, on=2))
    grown = prepare(tmp_path, more)
    assert [spec for spec in grown if spec in specs] == specs
    assert sum(spec.count for spec in grown) == sum(spec.count for spec in specs) + 4
    assert prepare(tmp_path, CONFIG) == grown, "asking for fewer keeps what is there"
    stored = Dataset.open(tmp_path).description
    assert stored["counts"]["train"] == {"same-plane": 7, "on": 2, "stacks": 0}
    assert load_config(Dataset.open(tmp_path)) == more


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 4}, r"dataset.json: config.seed: .* made with 3, found 4; take another folder"),
        ({"scene": SceneConfig(max_objects=7)}, r"config.scene.max_objects: .* with 6, found 7"),
        ({"goals_per_scene": 2}, r"config.goals_per_scene: .* with 1, found 2; plan it anew"),
        ({"replay_share": 0.0}, r"config.replay_share: .* with 0.3, found 0.0; plan it anew"),
    ],
)
def test_other_settings_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    prepare(tmp_path, CONFIG)
    with pytest.raises(DatasetError, match=message):
        prepare(tmp_path, replace(CONFIG, **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": {"seed": "x"}}, r"dataset.json: config.seed = "),
        ({"shards": [{"split": "train"}]}, r"dataset.json: shards.0.shard: "),
    ],
)
def test_a_broken_description(tmp_path: Path, change: dict, message: str) -> None:
    prepare(tmp_path, CONFIG)
    file = tmp_path / "dataset.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(DatasetError, match=message):
        prepare(tmp_path, CONFIG)
    file.write_text("{}")
    with pytest.raises(DatasetError, match=r"dataset.json: config: expected there, found no such"):
        prepare(tmp_path, CONFIG)


# scenes and images -----------------------------------------------------------------------------


def test_rows_say_how_to_draw_the_scene_again() -> None:
    rows = Dataset.open(small_dataset()).read_rows("scenes")
    assert len(rows) == 8
    for row in rows:
        settings = replace(CONFIG.scene, family=row["family"])
        again = sample_scene(
            settings,
            seed=row["seed"],
            index=row["index"],
            split=row["split"],
            attempt=row["attempt"],
        )
        assert again == stored_scene(row)
        assert row["scene_id"] == stored_scene(row).id
        assert row["n_objects"] == len(row["objects"])
        assert all(0.25 <= box["visible_fraction"] <= 1 for box in row["objects"])
        assert all(box["visible_pixels"] >= 60 for box in row["objects"])


def test_images_belong_to_their_rows() -> None:
    dataset = Dataset.open(small_dataset())
    for split in SPLITS:
        rows = dataset.read_rows("scenes", split=split)
        samples = list(dataset.samples(split))
        assert [sample.key for sample in samples] == [row["scene_id"] for row in rows]
        for sample, row in zip(samples, rows, strict=True):
            assert sample.scene == stored_scene(row)
            pixels = [int((sample.mask == i + 1).sum()) for i in range(row["n_objects"])]
            assert pixels == [box["visible_pixels"] for box in row["objects"]]
            assert sample.views.shape == (row["n_objects"], 32, 32, 3)


def test_settings_without_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "ATTEMPTS", 3)
    tight = replace(CONFIG, scene=SceneConfig(min_objects=10, reach=(0.30, 0.34), tries=2))
    spec = prepare(tmp_path, tight)[0]
    with pytest.raises(DatasetError, match=r"scene 0 of train: no draw in 3 was accepted"):
        generate_shard(tmp_path, tight, spec)
    assert list(tmp_path.rglob("*.tar")) == list(tmp_path.rglob("*.tmp")) == []


# equal bytes -----------------------------------------------------------------------------------


def _one(arguments: tuple[Path, ShardSpec]) -> None:
    root, spec = arguments
    generate_shard(root, CONFIG, spec)
    for predicate in reversed(spec.predicates):
        label_shard(root, CONFIG, spec, predicate)


@pytest.mark.slow  # tests/test_flows.py compares the bytes of two workers, too
def test_two_workers_give_the_bytes_of_one(tmp_path: Path) -> None:
    specs = prepare(tmp_path, CONFIG)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=2, mp_context=spawn) as pool:
        list(pool.map(_one, [(tmp_path, spec) for spec in reversed(specs)]))
    one, two = contents(small_dataset()), contents(tmp_path)
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []
    assert len([name for name in one if name.startswith("labels/")]) == sum(
        len(spec.predicates) for spec in specs
    )


def test_another_seed_gives_other_bytes(tmp_path: Path) -> None:
    other = replace(CONFIG, seed=4)
    spec = prepare(tmp_path, other)[0]
    generate_shard(tmp_path, other, spec)
    name = "scenes/split=train/shard-000000.parquet"
    assert (tmp_path / name).read_bytes() != (small_dataset() / name).read_bytes()


# resuming --------------------------------------------------------------------------------------


def test_finished_shards_are_skipped(made: Path) -> None:
    files = [file for file in made.rglob("*") if file.is_file()]
    with untouched(*files):
        for spec in prepare(made, CONFIG):
            assert generate_shard(made, CONFIG, spec).skipped
            for predicate in spec.predicates:
                report = label_shard(made, CONFIG, spec, predicate)
                assert report.skipped
                assert report.rows > 0


def test_labels_are_made_anew_from_stored_plans(made: Path) -> None:
    dataset = Dataset.open(made)
    before = contents(made)
    labels = dataset.files("labels")
    for file in labels:
        file.unlink()
    kept = [file for table in ("scenes", "plans", "timings") for file in dataset.files(table)]
    with untouched(*kept):
        make(made)
    assert contents(made) == before


def test_a_lost_shard_is_made_again(made: Path) -> None:
    before = contents(made)
    lost = ["scenes/split=train/shard-000001.parquet", "images/split=test/shard-000000.tar"]
    lost.append("plans/predicate=on/split=test/shard-000001.parquet")
    for name in lost:
        (made / name).unlink()
    make(made)
    assert contents(made) == before


def test_a_killed_run_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    program = (
        "import sys, time\nfrom pathlib import Path\nsys.path.insert(0, sys.argv[2])\n"
        "from conftest import CONFIG\n"
        "from relevance.pipeline import prepare, generate_shard\n"
        "root = Path(sys.argv[1])\n"
        "def wait(done, of):\n"
        "    print('half made', flush=True)\n"
        "    time.sleep(60)\n"
        "specs = prepare(root, CONFIG)\n"
        "generate_shard(root, CONFIG, specs[0])\n"
        "generate_shard(root, CONFIG, specs[1], wait)\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert "half made\n" in run.stdout
        run.send_signal(signal.SIGKILL)
    dataset = Dataset.open(tmp_path)
    assert dataset.shards("train") == [0]
    assert len(list(tmp_path.rglob("*.tmp"))) == 1, "it was killed while writing"
    assert not dataset.images_path("train", 1).exists()
    for spec in prepare(tmp_path, CONFIG):
        generate_shard(tmp_path, CONFIG, spec)
    expected = contents(small_dataset())
    for name, content in contents(tmp_path).items():
        if not name.endswith(".tmp"):
            assert content == expected[name], name
    assert len(dataset.files("scenes")) == len(Dataset.open(small_dataset()).files("scenes"))


def test_planning_anew_leaves_the_images(made: Path) -> None:
    before = contents(made)
    more = replace(CONFIG, goals_per_scene=2)
    with pytest.raises(DatasetError, match="plan it anew"):
        prepare(made, more)
    spec = prepare(made, more, replan=True)[0]
    dataset = Dataset.open(made)
    with untouched(*dataset.files("scenes"), *made.rglob("*.tar")):
        assert generate_shard(made, more, spec).skipped
        report = label_shard(made, more, spec, "behind")
    assert not report.skipped
    assert report.rows > spec.count
    name = f"predicate=behind/split=train/shard-{spec.shard:06d}.parquet"
    assert (made / "plans" / name).read_bytes() == before[f"plans/{name}"], "until all are made"
    beside = dataset.shard_path(
        "plans", split="train", shard=spec.shard, predicate="behind", of=more.labelling
    )
    assert beside.read_bytes() != before[f"plans/{name}"]


# labels ----------------------------------------------------------------------------------------


def test_plans_are_of_the_drawn_goals() -> None:
    dataset = Dataset.open(small_dataset())
    scenes = {row["scene_id"]: stored_scene(row) for row in dataset.read_rows("scenes")}
    plans = dataset.read_rows("plans")
    found = {(p["scene_id"], p["predicate"], p["subject"], p["reference"]) for p in plans}
    expected = {
        (scene.id, goal.predicate.name, goal.subject, goal.reference)
        for scene in scenes.values()
        for predicate in PREDICATES.values()
        if (predicate.family == "on") == any(box.on for box in scene.objects)
        for goal in sample_goals(scene, predicate, CONFIG.goals_per_scene, seed=CONFIG.seed)
    }
    assert found == expected
    assert len(plans) == len(expected)
    assert {plan["status"] for plan in plans} <= {"solved", "infeasible", "limit"}
    assert sum(plan["holds"] for plan in plans) >= len(plans) / 2
    timed = {row["plan_id"] for row in dataset.read_rows("timings")}
    assert timed == {plan["plan_id"] for plan in plans}


def test_every_solved_test_plan_is_replayed() -> None:
    plans = Dataset.open(small_dataset()).read_rows("plans", split="test", status="solved")
    assert plans
    assert all(plan["replay_ok"] is not None for plan in plans)
    assert all(plan["replay_max_penetration"] is not None for plan in plans)


def test_only_the_drawn_share_is_replayed(monkeypatch: pytest.MonkeyPatch) -> None:
    def replay(*_: object) -> None:
        raise AssertionError("a plan was replayed that was not drawn")

    monkeypatch.setattr(simulation, "replay", replay)
    monkeypatch.setattr(labelling, "replay", replay)
    rows = Dataset.open(small_dataset()).read_rows("scenes", split="train", shard=0)
    config = replace(CONFIG, replay_share=0.0)
    plans, _ = labelling._plans(config, PREDICATES["behind"], rows, None)
    assert any(plan["status"] == "solved" for plan in plans)
    assert all(plan["replay_ok"] is None for plan in plans)


def test_the_replayed_share_is_a_share() -> None:
    ids = [f"scene{i}" for i in range(4000)]
    drawn = sum(labelling._chosen(name, "on(a, b)", 0.1) for name in ids)
    assert 330 < drawn < 470
    assert not any(labelling._chosen(name, "on(a, b)", 0.0) for name in ids)
    assert all(labelling._chosen(name, "on(a, b)", 1.0) for name in ids)


def test_labels_need_scenes_and_a_fitting_predicate(tmp_path: Path) -> None:
    spec = prepare(tmp_path, CONFIG)[0]
    with pytest.raises(DatasetError, match=r"shard-000000.parquet: does not exist, expected its"):
        label_shard(tmp_path, CONFIG, spec, "behind")
    with pytest.raises(ValueError, match="on: expected one that is asked there, on-the-left, "):
        label_shard(tmp_path, CONFIG, spec, "on")
    with pytest.raises(DatasetError, match=r"no dataset\.json there"):
        label_shard(tmp_path / "nowhere", CONFIG, spec, "behind")
    assert not (tmp_path / "nowhere").exists()


def test_progress_counts_to_the_end(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    spec = prepare(tmp_path, CONFIG)[0]
    generate_shard(tmp_path, CONFIG, spec, lambda done, of: seen.append((done, of)))
    assert seen == [(1, 2), (2, 2)]
    assert os.listdir(tmp_path / "images/split=train") == ["shard-000000.tar"]
