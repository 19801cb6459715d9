"""Checkpoints: what names one, a killed run, files that carry their hash, how one is found."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ruled import ruled, shards_of_family

from relevance.errors import RelevanceError
from relevance.models import ModelError, RelevanceModel
from relevance.models.glimpse import GlimpseConfig
from relevance.scene import PREDICATES
from relevance.store import Dataset, DatasetError
from relevance.training import (
    Catalogue,
    CheckpointError,
    Reader,
    TrainConfig,
    checkpoint_id,
    continued,
    find_checkpoint,
    load_checkpoint,
    measure,
    pick_device,
    precision,
    save_checkpoint,
    train,
)
from relevance.training.checkpoints import data_hash, write_file

torch.set_num_threads(1)  # threads that wait for each other crawl on a busy machine

CONFIG = TrainConfig(
    model=GlimpseConfig(width=32, heads=2, layers=1, channels=8),
    steps=6,
    scenes_per_batch=4,
    save_every=2,
    threads=1,
)


@pytest.fixture(scope="module")
def made() -> Path:
    """Real scenes and images in real shards."""
    return ruled()


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy of its own for a test that writes."""
    return Path(shutil.copytree(made, tmp_path / "dataset"))


def weights(path: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(path)[0].state_dict()


def equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_train_writes_a_checkpoint_and_its_row(root: Path) -> None:
    ticks: list[tuple[int, int]] = []
    path = train(root, CONFIG, progress=lambda done, total: ticks.append((done, total)))
    assert ticks == [(i, 6) for i in range(1, 7)]
    dataset = Dataset.open(root)
    (row,) = dataset.read_rows("checkpoints")
    assert root / row["path"] == path
    assert path.stem == row["checkpoint_id"]
    assert sorted(p.name for p in path.parent.iterdir()) == [f"{path.stem}.parquet", path.name]
    model, meta = load_checkpoint(path)
    assert meta["dataset_hash"] == row["dataset_hash"] == data_hash(dataset, CONFIG)
    assert TrainConfig.from_dict(meta["config"]) == CONFIG
    assert meta["metrics"] == json.loads(row["metrics"])
    assert set(meta["metrics"]) == {*(p.name for p in PREDICATES.values()), "same-plane"}
    validation = Reader(catalogue=Catalogue.of(dataset, "validation", CONFIG), config=CONFIG)
    assert measure(model, validation.whole()) == meta["metrics"], (
        "the file holds the trained weights"
    )
    assert [entry["step"] for entry in meta["history"]] == [1, 2, 3, 4, 5, 6]
    stamp = path.stat().st_mtime_ns
    assert train(root, CONFIG) == path
    assert path.stat().st_mtime_ns == stamp, "a finished run is not repeated"
    dataset.shard_path("checkpoints", name=path.stem).unlink()
    train(root, CONFIG)
    assert dataset.read_rows("checkpoints") == [row], "a row lost in a kill comes back"


def test_identity_is_the_config_and_the_data_but_not_the_execution(root: Path) -> None:
    config = replace(CONFIG, steps=1)
    path = train(root, config)
    assert train(root, replace(config, threads=2, save_every=7, workers=0)) == path
    assert train(root, replace(config, seed=1)) != path
    assert not equal(weights(path), weights(train(root, replace(config, seed=1))))
    dataset = Dataset.open(root)
    labels = dataset.read_rows("labels", split="train", shard=0, predicate="behind")
    labels[0]["relevant"] = not labels[0]["relevant"]
    dataset.write_rows("labels", labels, split="train", shard=0, predicate="behind")
    assert train(root, config) != path


def beside(dataset: Dataset, policy: str, predicates: list[str]) -> None:
    """Labels by another policy for some predicates: the opposite of the rule's."""
    current = dataset.labelling
    assert current is not None
    of = replace(current, policy=policy)
    for predicate in predicates:
        for file in dataset.files("labels", split="train", predicate=predicate):
            rows = dataset.read_file(file).to_pylist()
            turned = [row | {"policy": policy, "relevant": not row["relevant"]} for row in rows]
            keys = {"split": "train", "shard": dataset.file_keys(file)["shard"]}
            dataset.write_rows("labels", turned, predicate=predicate, of=of, **keys)


def test_half_finished_and_finished_labels_of_another_policy_are_not_one_id(root: Path) -> None:
    dataset, config = Dataset.open(root), replace(CONFIG, steps=1, policy="necessary")
    own = train(root, replace(CONFIG, steps=1))
    beside(dataset, "necessary", ["behind"])
    half = train(root, config)
    beside(dataset, "necessary", ["on", "in-front"])
    whole = train(root, config)
    assert half != whole
    assert load_checkpoint(half)[1]["predicates"] == ["behind"]
    assert load_checkpoint(whole)[1]["predicates"] == ["in-front", "behind", "on"]
    assert train(root, replace(CONFIG, steps=1)) == own, "labels of others are not its data"


def test_labels_of_other_splits_are_not_its_data(root: Path) -> None:
    dataset = Dataset.open(root)
    before = checkpoint_id(dataset, CONFIG)
    shutil.rmtree(root / "labels/predicate=on/split=validation")
    assert checkpoint_id(dataset, CONFIG) == before
    shutil.rmtree(root / "labels/predicate=on/split=train")
    assert checkpoint_id(dataset, CONFIG) != before


def test_a_half_finished_replan_is_not_trained_on(root: Path) -> None:
    dataset = Dataset.open(root)
    assert dataset.labelling is not None
    now = dataset.labelling.made_by

    def made_by(shard: int, footer: dict[str, str]) -> None:
        keys = {"split": "train", "shard": shard, "predicate": "behind"}
        rows = dataset.read_rows("labels", **keys)
        dataset.write_rows("labels", rows, made_by=footer, **keys)

    shards = shards_of_family(dataset, "train", "same-plane")
    for shard in shards:
        made_by(shard, now)
    train(root, replace(CONFIG, steps=1))
    made_by(shards[-1], now | {"planner": "1"})
    with pytest.raises(
        DatasetError, match=r"made by planner 1, expected \d+ as all labels of"
    ) as e:
        train(root, replace(CONFIG, steps=2))
    assert "\n" not in str(e.value)


def test_files_in_another_folder(root: Path, tmp_path: Path) -> None:
    path = train(root, replace(CONFIG, steps=1), out=tmp_path / "elsewhere")
    assert path.parent == tmp_path / "elsewhere"
    (row,) = Dataset.open(root).read_rows("checkpoints")
    assert Path(row["path"]) == path.resolve()


def test_a_killed_run_ends_with_the_same_weights(root: Path, made: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, steps=24, save_every=3)
    code = (
        "import sys, json; from relevance.training import TrainConfig, train;"
        "train(sys.argv[1], TrainConfig.from_dict(json.loads(sys.argv[2])))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(root), json.dumps(config.to_dict())],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    folder, limit = root / "checkpoints", time.monotonic() + 120
    while not list(folder.glob("*.state")):
        assert process.poll() is None, "training ended before it saved a state"
        assert time.monotonic() < limit, "no state was saved"
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not list(folder.glob("*.pt")), "killed before the end"
    ticks: list[int] = []
    resumed = train(root, config, progress=lambda done, total: ticks.append(done))
    assert ticks[0] > 3, "goes on from the saved state"
    assert ticks[-1] == 24
    assert not list(folder.glob("*.state"))
    whole = train(Path(shutil.copytree(made, tmp_path / "again")), config)
    assert equal(weights(resumed), weights(whole))
    histories = [load_checkpoint(path)[1]["history"] for path in (resumed, whole)]
    assert histories[0] == histories[1]


def test_nothing_to_learn_from(root: Path) -> None:
    shutil.rmtree(root / "labels")
    with pytest.raises(DatasetError, match="no labels with split train and policy found"):
        train(root, CONFIG)
    assert not (root / "checkpoints").exists()
    with pytest.raises(DatasetError, match=r"no dataset\.json there"):
        train(root / "nowhere", CONFIG)


def test_no_validation_labels_means_no_metrics(root: Path) -> None:
    for folder in (root / "labels").glob("predicate=*/split=validation"):
        shutil.rmtree(folder)
    assert load_checkpoint(train(root, replace(CONFIG, steps=1)))[1]["metrics"] == {}


def test_labels_of_a_missing_scene(root: Path) -> None:
    dataset = Dataset.open(root)
    rows = dataset.read_rows("labels", split="train", shard=0, predicate="behind")
    rows = [row | {"scene_id": "0000"} for row in rows]
    dataset.write_rows("labels", rows, split="train", shard=0, predicate="behind")
    with pytest.raises(DatasetError, match="labels of split train name scene 0000, which no image"):
        train(root, CONFIG)


def refused(path: Path) -> str:
    with pytest.raises(CheckpointError) as error:
        load_checkpoint(path)
    message = str(error.value)
    assert str(path) in message
    assert "\n" not in message
    assert "expected a checkpoint of version 3" in message
    return message


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of untrained weights; read only."""
    path = tmp_path_factory.mktemp("checkpoint") / "whole.pt"
    torch.manual_seed(0)
    save_checkpoint(path, RelevanceModel(CONFIG.model), META)
    return path


META = {"checkpoint_id": "glimpse-1", "config": CONFIG.to_dict()}


def test_a_damaged_file_is_refused_wherever_the_damage_is(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    path = tmp_path / "damaged.pt"
    for size in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        refused(path)
    rng = np.random.default_rng(0)
    places = [*range(200), *rng.integers(0, len(content), 200).tolist()]
    for place in places:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        refused(path)
    path.write_bytes(content + b"0")
    assert "truncated or changed" in refused(path)


def test_files_that_are_no_checkpoints(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    assert "no such file" in refused(path)
    assert "cannot be read" in refused(tmp_path), "a folder is no checkpoint"
    for content in (b"red,blue\n1,2\n", b"relevance-checkpoint 7\n", b"relevance-checkpoint {\n"):
        path.write_bytes(content)
        assert "not a checkpoint" in refused(path)
    path.write_bytes(whole.read_bytes().replace(b'"version": 3', b'"version": 4', 1))
    assert "is of version 4" in refused(path)
    torch.save({"version": 1}, path)
    assert "not a checkpoint" in refused(path)
    write_file(path, "state", {"done": 1})
    assert "holds a state" in refused(path)


class Trap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_foreign_pickles_never_execute(tmp_path: Path) -> None:
    trap = Trap(tmp_path / "executed")
    pickled, saved, framed = (tmp_path / name for name in ("a.pt", "b.pt", "c.pt"))
    pickled.write_bytes(pickle.dumps(trap))
    torch.save({"model": trap}, saved)
    write_file(framed, "checkpoint", {"meta": trap, "model": {}})  # even under a right hash
    for path in (pickled, saved, framed):
        refused(path)
    assert not trap.path.exists()
    pickle.loads(pickled.read_bytes())
    assert trap.path.exists(), "the trap works"


def test_weights_and_settings_that_do_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    model = RelevanceModel(CONFIG.model)
    settings = CONFIG.to_dict()
    for config, found in (
        (settings | {"depth": 3}, "TrainConfig.depth: unknown field"),
        (settings | {"model": settings["model"] | {"width": 64}}, "size mismatch"),
        (settings | {"model": settings["model"] | {"body": "cnn"}}, "unknown body 'cnn'"),
    ):
        save_checkpoint(path, model, META | {"config": config})
        assert found in refused(path)
    with torch.no_grad():
        next(model.parameters()).fill_(torch.nan)
    save_checkpoint(path, model, META)
    with pytest.raises(CheckpointError, match="is not finite, expected numbers"):
        load_checkpoint(path)


def test_settings_added_later_do_not_hinder_loading(tmp_path: Path) -> None:
    path, settings = tmp_path / "model.pt", CONFIG.to_dict()
    older = settings | {"model": {k: v for k, v in settings["model"].items() if k != "window"}}
    del older["recolor"], older["device"]
    save_checkpoint(path, RelevanceModel(CONFIG.model), META | {"config": older})
    model, _ = load_checkpoint(path)
    assert model.config == CONFIG.model


def test_a_checkpoint_has_the_heads_that_it_was_trained_with(root: Path) -> None:
    for name in ("on-the-right", "in-front", "behind"):
        shutil.rmtree(root / f"labels/predicate={name}")
    model, meta = load_checkpoint(train(root, replace(CONFIG, steps=1)))
    # the mirror shows it as on-the-right
    assert meta["predicates"] == ["on-the-left", "on-the-right", "on"]
    encoding = model.encode(torch.zeros(1, 3, 192, 320), torch.zeros(1, 2, 3, 32, 32))
    goals = torch.tensor([[[0, 1]]])
    model.decode(encoding, "on", goals)
    with pytest.raises(ModelError, match="no head for behind, was trained on on-the-left, on-the"):
        model.decode(encoding, "behind", goals)


def test_one_network_for_some_predicates(root: Path) -> None:
    """The paper's `on` has a network of its own."""
    meta = load_checkpoint(train(root, replace(CONFIG, steps=1, predicates=("on",))))[1]
    assert meta["predicates"] == ["on"]
    assert set(meta["metrics"]) == {"on"}
    shutil.rmtree(root / "labels/predicate=on")
    for predicates in (("on", "behind"), ("behind", "above")):
        with pytest.raises(
            DatasetError, match=r"no labels of (on|above) with split train"
        ) as error:
            train(root, replace(CONFIG, steps=1, predicates=predicates))
        assert "\n" not in str(error.value)


def test_a_head_that_is_trained_alone_leaves_the_others_as_they_are(root: Path) -> None:
    first = train(root, replace(CONFIG, steps=2, predicates=("in-front", "behind")))
    later = replace(CONFIG, steps=3, predicates=("on",), start=first.stem)
    second = train(root, later)
    models = [load_checkpoint(path)[0] for path in (first, second)]
    assert models[1].predicates == ("in-front", "behind", "on")
    before, after = (model.state_dict() for model in models)
    assert equal(before, {name: after[name] for name in before})
    sample = next(Dataset.open(root).samples("train"))
    image = torch.from_numpy(sample.image).permute(2, 0, 1)[None]
    views = torch.from_numpy(sample.views).permute(0, 3, 1, 2)[None]
    goals = torch.tensor([[[0, 1], [1, 2]]])
    with torch.inference_mode():
        for name in ("in-front", "behind"):
            scores = [m.decode(m.encode(image, views), name, goals) for m in models]
            assert torch.equal(*scores)
    fresh = weights(train(root, replace(later, steps=1)))
    assert not equal(after, fresh), "the new head learns"
    with pytest.raises(CheckpointError, match=r"has a head for behind, expected new --predicates"):
        train(root, replace(later, predicates=("behind",)))


def test_training_goes_on_from_weights_that_fit(root: Path) -> None:
    first = train(root, replace(CONFIG, steps=2))
    onward = continued(root, replace(CONFIG, steps=8), first.stem, 0.25)
    assert (onward.steps, onward.continues) == (2, first.stem)
    assert onward.content_hash != replace(CONFIG, steps=2).content_hash
    # Without a learning rate its weights are those that it began with.
    still = train(root, replace(onward, learning_rate=1e-30))
    assert equal(weights(still), weights(first))
    second = train(root, onward)
    before, after = weights(first), weights(second)
    moved = [name for name in before if not torch.equal(before[name], after[name])]
    assert len(moved) > len(before) / 2, "every part learns on"
    meta = load_checkpoint(second)[1]
    assert meta["config"]["continues"] == first.stem
    assert precision(meta["metrics"]) == pytest.approx(
        np.mean(
            [
                of["queries"]["average_precision"]
                for name, of in meta["metrics"].items()
                if name in PREDICATES
            ]
        )
    )
    other = replace(CONFIG, model=replace(CONFIG.model, width=16))
    for config, message in (
        (other, "has body glimpse of other settings, expected glimpse with those of this train"),
        (replace(CONFIG, predicates=("on",)), "has heads for on-the-left, .*, expected on$"),
    ):
        with pytest.raises(CheckpointError, match=f"continues: {first.stem} {message}"):
            continued(root, config, first.stem, 0.5)
    with pytest.raises(DatasetError, match="unknown checkpoint 'x'"):
        continued(root, CONFIG, "x", 0.5)
    with pytest.raises(RelevanceError, match="start a and continues b: expected one"):
        replace(CONFIG, start="a", continues="b")


def test_the_newest_checkpoint_and_how_one_is_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no checkpoints there, expected `train` first"):
        find_checkpoint(root)
    with pytest.raises(DatasetError, match="expected a file or one of crowd, geometry, glimpse"):
        find_checkpoint(root, "glimpse-1")
    first, second = (train(root, replace(CONFIG, steps=1, seed=seed)) for seed in (0, 1))
    assert find_checkpoint(root) == second
    assert find_checkpoint(root, first.stem) == first
    renamed = tmp_path / "best.pt"
    shutil.copy(first, renamed)
    assert find_checkpoint(root, renamed) == find_checkpoint(root, str(renamed)) == renamed
    assert load_checkpoint(renamed)[1]["checkpoint_id"] == first.stem, "the id is inside"
    with pytest.raises(DatasetError, match=f"unknown checkpoint 'x', .* {first.stem}") as error:
        find_checkpoint(root, "x")
    assert "\n" not in str(error.value)
    shutil.copy(second, first)
    with pytest.raises(CheckpointError, match=f"holds {second.stem}, expected {first.stem}"):
        train(root, replace(CONFIG, steps=1))


def test_a_device_that_is_not_there() -> None:
    for name in ("cuda:99", "abacus"):
        with pytest.raises(RelevanceError, match=f"device '{name}': cannot be used here") as error:
            pick_device(name)
        assert "\n" not in str(error.value)
    assert pick_device("auto") == pick_device(str(pick_device("auto")))
