"""The reader that trains: its order, its workers, runs that go on, several processes, bad input."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ruled import ruled, shards_of_family
from stored import label_values, pictures, scene, scene_values

from relevance.errors import RelevanceWarning
from relevance.models import RelevanceModel, true_geometry
from relevance.models.geometry import GeometryConfig
from relevance.models.glimpse import GlimpseConfig
from relevance.scene import PREDICATES, Camera, scene_to_json
from relevance.store import Dataset, DatasetError, decode
from relevance.training import (
    Batch,
    Catalogue,
    Example,
    Reader,
    TrainConfig,
    TrainingError,
    batch_of,
    load_checkpoint,
    polling,
    ranks,
    train,
)
from relevance.training.examples import in_the_mirror
from relevance.training.reading import ALIKE

torch.set_num_threads(1)  # threads that wait for each other crawl on a busy machine

SAME_PLANE = tuple(p for p in PREDICATES.values() if p.family == "same-plane")
ON = PREDICATES["on"]
CONFIG = TrainConfig(
    model=GlimpseConfig(width=32, heads=2, layers=1, channels=8),
    steps=12,
    scenes_per_batch=4,
    save_every=2,
    threads=1,
    workers=0,
)
PLAIN = replace(CONFIG, mirror=False, recolor=False)
STRICT = replace(PLAIN, share_encodings=False)


@pytest.fixture(scope="module")
def made() -> Path:
    """Real scenes and images in real shards."""
    return ruled()


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy of its own for a test that writes."""
    return Path(shutil.copytree(made, tmp_path / "dataset"))


def reader(root: Path | str, config: TrainConfig = PLAIN, **more: int) -> Reader:
    catalogue = Catalogue.of(Dataset.open(root), "train", config)
    return Reader(catalogue=catalogue, config=config, **more)


def examples(root: Path, config: TrainConfig = PLAIN) -> list[Example]:
    catalogue = Catalogue.of(Dataset.open(root), "train", config)
    return [e for s in catalogue.shards for e in catalogue.read(s, catalogue.predicates)]


def names(steps: Sequence[list[Batch]]) -> list[list[tuple[str, list[str]]]]:
    """Scenes and predicates of the batches of each step."""
    return [[(" ".join(b.names), [t[0].name for t in b.turns]) for b in step] for step in steps]


def equal(a: Batch, b: Batch) -> bool:
    def tensors(x: Batch) -> list[torch.Tensor]:
        numbers = [tensor for turn in x.turns for tensor in turn[1:]]
        return [x.image, x.views, x.present, x.cells, x.geometry, *numbers]

    return (
        (a.names, a.families) == (b.names, b.families)
        and [turn[0] for turn in a.turns] == [turn[0] for turn in b.turns]
        and all(torch.equal(x, y) for x, y in zip(tensors(a), tensors(b), strict=True))
    )


# --- order --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "config",
    [
        CONFIG,
        replace(STRICT, polling="rounds", steps=5),
        replace(STRICT, polling="one-by-one"),
        replace(STRICT, queries_per_batch=9, goal_objects=False),
    ],
)
def test_the_order_is_the_same_for_any_workers_and_wherever_a_run_goes_on(
    made: Path, config: TrainConfig
) -> None:
    whole = list(reader(made, config).steps())
    assert len(whole) == config.steps
    for first, workers in ((0, 1), (0, 2), (3, 0), (config.steps - 1, 2)):
        again = list(reader(made, config, workers=workers).steps(first))
        assert names(again) == names(whole[first:])
        batches = [[b for step in steps for b in step] for steps in (again, whole[first:])]
        assert all(equal(a, b) for a, b in zip(*batches, strict=True))
    assert names(list(reader(made, replace(config, seed=1)).steps())) != names(whole)


def test_polling_takes_the_predicates_in_turn(made: Path) -> None:
    strict = [step for [step] in reader(made, STRICT).steps()]
    turns = [turn[0] for batch in strict for turn in batch.turns]
    assert turns == [*PREDICATES.values(), *PREDICATES.values(), *list(PREDICATES.values())[:2]]
    assert len({strict[i].names for i in range(4)}) == 1, "decoded once, four take turns on them"
    assert strict[5].names != strict[0].names
    shared = [[turn[0] for turn in batch.turns] for [batch] in reader(made, PLAIN).steps()]
    assert shared == [[*SAME_PLANE], [ON]] * 6


def test_polling_shares_steps_only_among_neighbours_of_a_family() -> None:
    mixed = [PREDICATES[name] for name in ("on-the-left", "on", "behind", "in-front")]
    assert polling(mixed, share=True) == [(mixed[0],), (mixed[1],), (mixed[2], mixed[3])]
    assert polling(mixed, share=False) == [(p,) for p in mixed]


def test_a_predicate_without_labels_is_left_out(root: Path) -> None:
    shutil.rmtree(root / "labels/predicate=behind")
    steps = list(reader(root).steps())[:2]
    found = [turn[0].name for [batch] in steps for turn in batch.turns]
    assert found == ["on-the-left", "on-the-right", "in-front", "on"]


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_every_scene_comes_before_any_comes_again(made: Path, ranks: int) -> None:
    """No process loses or repeats one: together they have what one alone has, in its order."""
    config = replace(PLAIN, scenes_per_batch=3, steps=8 * ALIKE)
    every = [list(reader(made, config, rank=r, ranks=ranks).steps()) for r in range(ranks)]
    for first, group in ((0, SAME_PLANE), (1, (ON,))):
        own = {e.name for e in examples(made) if set(group) & set(e.answers)}
        shown = [
            every[place % ranks][step][0].names[place // ranks]
            for step in range(first, config.steps, 2)
            for place in range(3)
        ]
        alone = [n for [b] in list(reader(made, config).steps())[first::2] for n in b.names]
        assert shown == alone
        windows = [shown[i : i + 3 * ALIKE] for i in range(0, len(shown), 3 * ALIKE)]
        assert len(windows) == 4
        assert windows[0] != windows[1], "each epoch has an order of its own"
        for stop in range(1, len(windows) + 1):
            times = Counter(chain.from_iterable(windows[:stop]))
            assert max(times.values()) - min(times[name] for name in own) <= 1


def test_scenes_of_a_batch_have_like_numbers_of_objects(made: Path) -> None:
    """Each batch is as wide as its largest scene."""

    def padding(batches: Sequence[Batch]) -> int:
        return sum(int((~batch.present).sum()) for batch in batches)

    config = replace(PLAIN, scenes_per_batch=3, steps=4 * ALIKE)
    alike = [batch for [batch] in reader(made, config).steps()]
    stored = list(reader(made, config).whole(scenes=3))
    assert padding(alike) / len(alike) < 0.5 * padding(stored) / len(stored)


def test_most_goals_of_a_scene(made: Path) -> None:
    for [batch] in reader(made, replace(CONFIG, goals_per_scene=1)).steps():
        for _, goals, _, labelled in batch.turns:
            assert goals.shape[1] == 1
            assert labelled.any(-1).all()


# --- batches ------------------------------------------------------------------------------


def test_batches_are_the_stored_scenes_and_labels(made: Path) -> None:
    dataset = Dataset.open(made)
    samples = {sample.scene.id: sample for sample in dataset.samples("train")}
    seen = Counter[str]()
    for batch in reader(made).whole(scenes=3):
        for b, name in enumerate(batch.names):
            sample = samples[name]
            count = len(sample.scene.objects)
            seen[name] += 1
            assert np.array_equal(batch.image[b].permute(1, 2, 0), sample.image)
            assert np.array_equal(batch.views[b, :count].permute(0, 2, 3, 1), sample.views)
            assert batch.present[b].sum() == count
            np.testing.assert_array_equal(batch.geometry[b, :count], true_geometry(sample.scene))
            assert set(np.unique(batch.cells[b])) - {0} == set(range(1, count + 1))
            for predicate, goals, relevant, labelled in batch.turns:
                rows = dataset.read_rows("labels", predicate=predicate.name, scene_id=name)
                expected = {
                    (*(sample.scene.names.index(row[k]) for k in KEYS),): row["relevant"]
                    for row in rows
                }
                found = {
                    (*goals[b, g].tolist(), q): bool(relevant[b, g, q])
                    for g, q in labelled[b].nonzero().tolist()
                }
                assert found == expected
    assert seen == Counter([*samples]), "each once"


KEYS = ("subject", "reference", "query")


def test_a_body_that_is_told_needs_no_pictures(made: Path) -> None:
    torch.manual_seed(0)
    model = RelevanceModel(GeometryConfig.smoke())
    for seen, told in zip(
        reader(made).steps(), reader(made, pictures=False, workers=1).steps(), strict=True
    ):
        a, b = seen[0], told[0]
        assert not b.image.any()
        assert a.image.shape == b.image.shape
        assert a.views.shape == b.views.shape
        scores = [
            model.decode(model.encode(x.image, x.views, x.present, x.geometry), *x.turns[0][:2])
            for x in (a, b)
        ]
        assert torch.equal(*scores)


def test_ambiguous_goals_and_other_policies_can_be_left_out(made: Path) -> None:
    goals = {}
    for ambiguous in (True, False):
        batches = reader(made, replace(PLAIN, ambiguous=ambiguous, predicates=("on",))).whole()
        goals[ambiguous] = sum(int(b.turns[0][3].any(-1).sum()) for b in batches)
        rows = Dataset.open(made).read_rows("labels", split="train", predicate="on")
        kept = [row for row in rows if ambiguous or not row["ambiguous"]]
        assert goals[ambiguous] == len({row["plan_id"] for row in kept})
    assert goals[False] < goals[True]
    with pytest.raises(DatasetError, match="policy 'none': expected one of found"):
        reader(made, replace(PLAIN, policy="none"))


def test_the_mirror_shows_the_mirrored_scene(made: Path) -> None:
    example = next(e for e in examples(made) if set(SAME_PLANE) <= set(e.answers))
    sample = decode(example.members)
    batch = batch_of([example], SAME_PLANE, Camera())
    flipped = in_the_mirror(batch)
    boxes = tuple(
        replace(box, position=(box.position[0], -box.position[1], box.position[2]), yaw=-box.yaw)
        for box in sample.scene.objects
    )
    expected = true_geometry(replace(sample.scene, id="", goals=(), objects=boxes))
    np.testing.assert_allclose(flipped.geometry[0].numpy(), expected, atol=1e-5)
    assert np.array_equal(flipped.image[0].permute(1, 2, 0).numpy(), sample.image[:, ::-1])
    mirrored = [turn[0].name for turn in flipped.turns]
    assert mirrored == ["on-the-right", "on-the-left", "in-front", "behind"]
    assert torch.equal(flipped.turns[0][2], batch.turns[0][2])
    assert torch.equal(in_the_mirror(flipped).geometry, batch.geometry)


# --- several processes --------------------------------------------------------------------

RUN = """
import json, sys
from relevance.training import TrainConfig, train
print(train(sys.argv[1], TrainConfig.from_dict(json.loads(sys.argv[2]))))
"""
"""`train` as a program of its own."""


def torchrun(root: Path, config: TrainConfig, script: Path, processes: int) -> str:
    """What `torchrun` on that many processes says; each writes its weights beside the script."""
    script.write_text(RANKS)
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--local-addr=127.0.0.1",
        f"--nproc-per-node={processes}", str(script), str(root), json.dumps(config.to_dict()),
    ]  # fmt: skip
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    found = subprocess.run(
        command, env=env, capture_output=True, text=True, timeout=300, check=False
    )
    return found.stdout + found.stderr


RANKS = """
import json, os, pathlib, sys, torch
from relevance.training import TrainConfig, train, trainer
own = pathlib.Path(__file__).with_name(os.environ["RANK"])
take = trainer.Trainer.take
def saving(self, steps):
    found = take(self, steps)
    torch.save([self.model.state_dict(), found], own)
    return found
trainer.Trainer.take = saving
train(sys.argv[1], TrainConfig.from_dict(json.loads(sys.argv[2])))
"""


@pytest.mark.slow
def test_two_processes_train_as_one(made: Path, root: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, steps=6, recolor=True, mirror=True)
    said = torchrun(root, config, tmp_path / "run.py", 2)
    [path] = (root / "checkpoints").glob("*.pt")
    (one, _), (other, _) = (torch.load(tmp_path / name) for name in ("0", "1"))
    assert all(torch.equal(one[name], other[name]) for name in one), said
    model, meta = load_checkpoint(path)
    assert all(torch.equal(one[name], weight) for name, weight in model.state_dict().items())
    assert len(Dataset.open(root).read_rows("checkpoints")) == 1, "the first one writes, alone"
    single = train(Path(shutil.copytree(made, tmp_path / "single")), config)
    assert single.name == path.name
    alone = load_checkpoint(single)[1]
    for a, b in zip(meta["history"], alone["history"], strict=True):
        assert a["loss"] == pytest.approx(b["loss"], rel=0.1)
    assert [meta["scenes"], meta["asked"]] == [alone["scenes"], alone["asked"]]


def test_processes_count_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """One met `stacks` first, another never met `on`."""
    counts = [{"on": 1, "stacks": 2}, {"stacks": 30, "on": 40}, {"stacks": 500}]

    def gather(found: list[Any], own: Any) -> None:
        assert own == counts[0]
        found[:] = counts

    monkeypatch.setattr(ranks.distributed, "all_gather_object", gather)
    assert ranks.Ranks(count=3).totals(counts[0]) == {"on": 41, "stacks": 532}
    assert ranks.ALONE.totals(counts[0]) == counts[0]


# --- memory -------------------------------------------------------------------------------


def many(root: Path, shards: int, each: int = 200) -> Path:
    """A dataset of that many shards of scenes whose pictures are plain."""
    dataset, count = Dataset.create(root, {}), shards * each
    plain = pictures(scene())
    plain.image[:], plain.views[:], plain.mask[:] = 90, 160, 1
    for shard in range(shards):
        scenes = [scene(-0.3 + 0.6 * (shard * each + i) / count) for i in range(each)]
        samples = ((own.id, plain, scene_to_json(own)) for own in scenes)
        made = dataset.write_images("train", shard, samples)
        rows = [scene_values(own, i, shard=shard) for i, own in enumerate(scenes)]
        dataset.write_rows("scenes", rows, split="train", shard=shard, made_by=made)
        rows = [label_values(s, q, q == "red", shard=shard) for s in scenes for q in s.names]
        dataset.write_rows("labels", rows, split="train", shard=shard, predicate="behind")
    return root


@pytest.mark.slow
def test_memory_does_not_grow_with_the_dataset(tmp_path: Path) -> None:
    """The peak of the process that trains and of its worker, over an epoch of N and of 4 N."""
    peaks = []
    for shards in (5, 20):
        root = many(tmp_path / str(shards), shards)
        config = replace(CONFIG, model=GlimpseConfig.smoke(), save_every=1000, workers=1)
        config = replace(config, steps=shards * 200 // 16, scenes_per_batch=16)
        code = RUN + "import resource as r\nprint(*(r.getrusage(w).ru_maxrss for w in (0, -1)))"
        told = [sys.executable, "-c", code, str(root), json.dumps(config.to_dict())]
        said = subprocess.run(told, capture_output=True, text=True, check=True, timeout=500).stdout
        peaks.append([int(n) / 1024 for n in said.split()[-2:]])
    few, more = peaks
    print("MB, trainer and worker:", peaks)
    assert all(b < 1.05 * a for a, b in zip(few, more, strict=True)), peaks
    assert sum(more) < 2000


# --- bad input ----------------------------------------------------------------------------


def refused(root: Path, config: TrainConfig, match: str) -> str:
    with pytest.raises((DatasetError, TrainingError), match=match) as error:
        train(root, config)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("workers", [0, 2])
def test_what_is_broken_is_one_line_from_a_worker_too(root: Path, workers: int) -> None:
    config = replace(CONFIG, workers=workers)
    path = Dataset.open(root).images_path("train", 0)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    before = sorted((root / "checkpoints").glob("*.pt"))
    said = refused(root, config, r"shard-000000\.tar: content hash: expected")
    assert str(path) in said
    assert sorted((root / "checkpoints").glob("*.pt")) == before


def test_labels_that_are_made_anew_meanwhile(root: Path) -> None:
    dataset = Dataset.open(root)
    own = reader(root)
    rows = dataset.read_rows("labels", split="train", shard=0, predicate="behind")
    dataset.write_rows("labels", rows[1:], split="train", shard=0, predicate="behind")
    with pytest.raises(DatasetError, match=r"as when training began, found .* made anew meanwhile"):
        list(own.steps())


def test_a_dataset_that_grew_while_a_run_was_down(root: Path) -> None:
    dataset = Dataset.open(root)

    def stop(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(root, CONFIG, progress=stop)
    [state] = (root / "checkpoints").glob("*.state")
    more = 1 + max(dataset.shards("train"))
    of = shards_of_family(dataset, "train", "on")[0]
    shutil.copy(dataset.images_path("train", of), dataset.images_path("train", more))
    for table, keys in (("scenes", {}), ("labels", {"predicate": "on"})):
        source = dataset.shard_path(table, split="train", shard=of, **keys)
        rows = [row | {"shard": more} for row in dataset.read_file(source).to_pylist()]
        dataset.write_rows(
            table, rows, split="train", shard=more, **keys,
            made_by={k: v for k, v in dataset.metadata(source).items() if k.startswith("images")},
        )  # fmt: skip
    kept = state.read_bytes()
    with pytest.warns(RelevanceWarning, match=r"\.state: an unfinished run of these settings, on"):
        path = train(root, CONFIG)
    assert state.read_bytes() == kept, "nothing is lost"
    assert load_checkpoint(path)[1]["history"][0]["step"] == 1.0


def test_a_loss_that_is_no_number_keeps_the_state_before_it(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import relevance.training.trainer as module

    real, calls = module.batch_loss, []

    def broken(*given):
        calls.append(given)
        found = real(*given)
        return {k: v * float("nan") for k, v in found.items()} if len(calls) == 4 else found

    monkeypatch.setattr(module, "batch_loss", broken)
    said = refused(root, CONFIG, "step 3: the loss is nan on scenes ")
    batch = calls[-1][1]
    assert all(name in said for name in batch.names)
    monkeypatch.undo()
    ticks: list[int] = []
    train(root, CONFIG, progress=lambda done, total: ticks.append(done))
    assert ticks[0] == 4, "goes on from the step before"


def test_labels_of_a_younger_version(root: Path) -> None:
    file = Dataset.open(root).shard_path("labels", split="train", shard=0, predicate="behind")
    content = file.read_bytes()
    key = b"relevance.version"
    at = content.rindex(key) + len(key)
    old = content[at : at + 8]
    digit = next(i for i, c in enumerate(old) if 48 <= c <= 57)
    file.write_bytes(content[: at + digit] + b"9" + content[at + digit + 1 :])
    refused(root, CONFIG, r"version of the schema: expected 1 to \d+, found 9; it was made by a yo")


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"width": 64, "height": 64}, "image is 320x192, expected 64x64"),
        ({"fov": 60.0}, r"seen from .*fov 47, expected .*fov 60"),
    ],
)
def test_another_camera(root: Path, camera: dict, message: str) -> None:
    model = replace(CONFIG.model, camera=replace(Camera(), **camera))
    refused(root, replace(CONFIG, model=model), message)


@pytest.mark.parametrize(
    ("member", "pictures"), [("scene.json", True), ("scene.json", False), ("views.webp", True)]
)
def test_a_sample_that_lacks_a_member(made: Path, member: str, pictures: bool) -> None:
    whole = examples(made)[0]
    kept = {name: content for name, content in whole.members.items() if name != member}
    with pytest.raises(DatasetError, match=f"{whole.name}: expected member {member}, found none"):
        batch_of([replace(whole, members=kept)], SAME_PLANE, Camera(), pictures=pictures)


def test_more_objects_than_a_mask_tells_apart(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("relevance.training.catalogue.MOST_OBJECTS", 2)
    refused(root, CONFIG, r"shard 0 of split train has a scene of \d objects, expected at most 2")


def test_an_empty_dataset_of_a_predicate(root: Path) -> None:
    dataset = Dataset.open(root)
    for file in dataset.files("labels", split="train", predicate="on"):
        keys = dataset.file_keys(file)
        dataset.write_rows("labels", [], **keys)
    refused(root, replace(CONFIG, predicates=("on",)), "no labels of on with split train")


def test_a_batch_has_a_share_for_every_process(made: Path) -> None:
    with pytest.raises(TrainingError, match="4 scenes a batch for 5 processes, expected at least"):
        reader(made, CONFIG, ranks=5)


TOLD_TWICE = """
import os, signal, threading, time
from contextlib import closing
from relevance.store import polled

class Stop(BaseException):
    pass

told = []
def stop(*_):
    told.append(time.monotonic())
    raise Stop

signal.signal(signal.SIGTERM, stop)
def slow(number):
    time.sleep(1.5 if number else 0)
    return number

try:
    with closing(polled([iter(range(3))], slow, count=None, workers=1)) as numbers:
        assert next(numbers) == 0
        for wait in (0.3, 0.6):
            threading.Timer(wait, os.kill, (os.getpid(), signal.SIGTERM)).start()
        time.sleep(5)
except Stop:
    print("told", len(told))
"""


def test_who_is_told_twice_to_end_says_nothing_of_generators() -> None:
    done = subprocess.run(
        [sys.executable, "-c", TOLD_TWICE], capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.stderr) == ("told 2\n", "")
