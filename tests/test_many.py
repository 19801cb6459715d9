"""Many machines: the flows on a Dask cluster, and a dataset in an object store."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ruled import ruled

from relevance.cli import main
from relevance.pipeline import (
    Counts,
    DatasetConfig,
    finish,
    generate_shard,
    label_shard,
    load_config,
    prepare,
)
from relevance.pipeline.checking import check
from relevance.store import Dataset, DatasetError, locate, replacing, sql
from relevance.training import Catalogue, Reader, TrainConfig, find_checkpoint, train

FEW = {
    "train.same_plane": 0,
    "train.on": 4,
    "validation.same_plane": 0,
    "validation.on": 0,
    "test.same_plane": 0,
    "test.on": 2,
    "scenes_per_shard": 2,
    "goals_per_scene": 1,
}
CONFIG = DatasetConfig(train=Counts(on=4), test=Counts(on=2), scenes_per_shard=2, goals_per_scene=1)
CLOCKS = ("timings", "durations")


def complete(root: str | Path) -> None:
    for spec in prepare(root, CONFIG):
        generate_shard(root, CONFIG, spec)
        for predicate in spec.predicates:
            label_shard(root, CONFIG, spec, predicate)
    finish(root)


def hashes(root: str | Path) -> dict[str, str]:
    there = locate(root)
    return {
        name: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in there.rglob("*")
        if file.is_file()
        for name in [str(file).removeprefix(f"{there}/")]
        if name.split("/")[0] not in CLOCKS
    }


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset as this process makes it, in a folder."""
    root = tmp_path_factory.mktemp("many") / "calm"
    complete(root)
    return root


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """A bucket of a local object store; its address and keys are in the environment alone."""
    moto = pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    given = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "somebody",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    before = {name: os.environ.get(name) for name in given}
    os.environ.update(given)
    try:
        files = locate("s3://datasets/x").fs  # type: ignore[attr-defined]
        files.mkdir("datasets")
        yield "s3://datasets"
    finally:
        server.stop()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@pytest.mark.slow  # a server of objects, and a whole dataset in it
def test_an_object_store_holds_the_same_bytes(bucket: str, calm: Path) -> None:
    root = f"{bucket}/one"
    complete(root)
    assert hashes(root) == hashes(calm)
    assert check(root) == []
    query = "from label_balance"
    assert sql(root, query) == sql(calm, query)
    there, here = Dataset.open(root), Dataset.open(calm)
    for split in ("train", "test"):
        for a, b in zip(
            there.samples(split, shuffle_seed=3), here.samples(split, shuffle_seed=3), strict=True
        ):
            assert a.scene == b.scene
            assert (a.image == b.image).all()
    assert there.content_hash() == here.content_hash()
    # another policy lies beside, there too
    for spec in prepare(root, CONFIG):
        label_shard(root, CONFIG, spec, "on", policy="any-minimal")
    assert [of.policy for of in Dataset.open(root).labellings()] == ["any-minimal"]
    _, [(n, m)] = sql(root, "select (select count(*) from labels), count(*) from beside_labels")
    assert n == m > 0


@pytest.mark.slow  # a server of objects
def test_queries_do_not_ask_again_what_is_there(
    bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, asked = f"{bucket}/asked", Counter[str]()
    locate(root).fs.put(str(ruled()), root, recursive=True)  # type: ignore[attr-defined]
    store = pytest.importorskip("s3fs").S3FileSystem
    plain = store._call_s3

    async def counted(self: Any, method: str, *args: Any, **named: Any) -> Any:
        asked[method] += 1
        return await plain(self, method, *args, **named)

    with Dataset.open(root).connect(names=("labels",)) as connection:
        monkeypatch.setattr(store, "_call_s3", counted)
        first = connection.execute("select count(*), count(distinct query) from labels").fetchall()
        assert first == sql(ruled(), "select count(*), count(distinct query) from labels")[1]
    assert asked["get_object"] > 0
    assert set(asked) == {"get_object"}, "no file is asked about again"


@pytest.mark.slow  # a server of objects
@pytest.mark.parametrize("workers", [0, 2])
def test_a_trainer_reads_there_what_it_reads_here(bucket: str, workers: int) -> None:
    here, there = ruled(), f"{bucket}/trained-{workers}"
    locate(there).fs.put(str(here), there, recursive=True)  # type: ignore[attr-defined]
    config = TrainConfig(steps=8, scenes_per_batch=3)
    read = [
        Reader(
            catalogue=Catalogue.of(Dataset.open(root), "train", config),
            config=config,
            workers=workers,
        )
        for root in (here, there)
    ]
    steps = list(zip(*(own.steps(first=2) for own in read), strict=True))
    assert len(steps) == 6
    for [a], [b] in steps:
        assert a.names == b.names
        assert (a.image == b.image).all()
        for (p, *mine), (q, *its) in zip(a.turns, b.turns, strict=True):
            assert p == q
            assert all((x == y).all() for x, y in zip(mine, its, strict=True))


@pytest.mark.slow
def test_what_is_broken_there_is_named_and_repaired(
    bucket: str, calm: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    root = f"{bucket}/broken"
    complete(root)
    file = Dataset.open(root).images_path("train", 1)
    files: Any = file
    files.fs.pipe_file(files.path, file.read_bytes()[:5000])
    gone: Any = Dataset.open(root).shard_path("labels", split="test", shard=0, predicate="on")
    gone.unlink()
    assert main(["check", root, "--no-render"]) == 1
    named = capfd.readouterr().out
    assert "images/split=train/shard-000001.tar: truncated" in named
    assert "labels/predicate=on/split=test/shard-000000.parquet: expected there" in named
    assert main(["repair", root, "--workers", "1"]) == 0
    assert hashes(root) == hashes(calm)


@pytest.mark.slow  # a server of objects
def test_a_killed_training_goes_on_there_from_its_state(bucket: str) -> None:
    root = f"{bucket}/killed"
    locate(root).fs.put(str(ruled()), root, recursive=True)  # type: ignore[attr-defined]
    config = replace(TrainConfig.smoke(), steps=5, save_every=2, threads=1, workers=0)

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(root, config, progress=stop)
    [state] = locate(f"{root}/checkpoints").iterdir()
    assert state.suffix == ".state"
    steps: list[int] = []
    path = train(root, config, progress=lambda done, total: steps.append(done))
    assert steps == [3, 4, 5]
    assert sorted(file.suffix for file in path.parent.iterdir()) == [".parquet", ".pt"]
    [row] = Dataset.open(root).read_rows("checkpoints")
    assert find_checkpoint(root, row["checkpoint_id"]) == path
    # A folder here may hold what was learned there, and the other way about.
    elsewhere = train(root, replace(config, seed=1), out=f"{bucket}/models")
    assert str(find_checkpoint(root, elsewhere.stem)) == f"{bucket}/models/{elsewhere.name}"


def test_an_object_appears_whole_or_not_at_all(bucket: str) -> None:
    path = locate(f"{bucket}/atomic/file.bin")

    def stop_midway() -> None:
        with replacing(path) as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError("midway")

    with pytest.raises(RuntimeError, match="midway"):
        stop_midway()
    assert not path.exists()
    with replacing(path) as temporary:
        temporary.write_bytes(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    assert [item.name for item in path.parent.iterdir()] == ["file.bin"]


def test_one_of_two_writers_makes_a_dataset_there(
    bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = f"{bucket}/race"
    files: Any = locate(root)
    write = files.fs.pipe_file

    def late(*args: Any, **more: Any) -> Any:
        """The other writer comes between this one's look and its writing."""
        monkeypatch.setattr(files.fs, "pipe_file", write)
        prepare(root, replace(CONFIG, seed=1))
        return write(*args, **more)

    monkeypatch.setattr(files.fs, "pipe_file", late)
    with pytest.raises(DatasetError, match=r"config\.seed: the dataset was made with 1, found 0"):
        prepare(root, CONFIG)
    assert load_config(Dataset.open(root)).seed == 1
    assert prepare(root, replace(CONFIG, seed=1)) == prepare(root, replace(CONFIG, seed=1))


def test_a_bucket_without_a_dataset_is_named(bucket: str) -> None:
    with pytest.raises(DatasetError, match=r"s3://datasets/none: no dataset\.json there"):
        Dataset.open(f"{bucket}/none")


def test_slashes_that_a_path_has_folded() -> None:
    for given in ("s3://datasets/a", Path("s3://datasets/a")):
        assert str(locate(given)) == "s3://datasets/a"
    assert locate("data/a") == Path("data/a")


FLOWS = """
import os, sys
from dask.distributed import LocalCluster

if __name__ == "__main__":
    root, overrides = sys.argv[1], eval(sys.argv[2])
    from flows.evaluate import evaluate
    from flows.generate import generate
    from flows.label import label
    from flows.train import train
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        made = generate(
            dataset=root, preset="smoke", overrides=overrides, cluster=cluster.scheduler_address
        )
        labelled = label(dataset=root, cluster=cluster.scheduler_address)
        again = label(dataset=root, cluster=cluster.scheduler_address)
        checkpoint = train(dataset=root, preset="smoke", overrides={"steps": 2})
        report = evaluate(
            dataset=root, preset="smoke", overrides={"tasks": 1}, cluster=cluster.scheduler_address
        )
    print("trained", checkpoint)
    print("report", report)
    print("made", made["written"], labelled["written"], again["written"])
"""


@pytest.mark.parametrize("where", ["folder", "bucket"])
@pytest.mark.slow
def test_the_flows_on_a_dask_cluster(where: str, bucket: str, calm: Path, tmp_path: Path) -> None:
    pytest.importorskip("prefect_dask")
    root = f"{bucket}/dask" if where == "bucket" else str(tmp_path / "dataset")
    script = tmp_path / "run.py"
    script.write_text(FLOWS)
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT")}
    done = subprocess.run(
        [sys.executable, str(script), root, repr(FEW)],
        env=kept | {"PREFECT_HOME": str(tmp_path / "home"), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "made 3 3 0" in done.stdout
    found, expected = hashes(root), hashes(calm)
    assert {name: found.get(name) for name in expected} == expected
    assert check(root) == []
    there = Dataset.open(root)
    [row] = there.read_rows("checkpoints")
    assert row["path"] == f"checkpoints/{row['checkpoint_id']}.pt"
    assert f"trained {root}/{row['path']}\n" in done.stdout
    assert f"report {root}/report.html\n" in done.stdout
    assert "<html" in locate(f"{root}/report.html").read_text()
    assert find_checkpoint(root) == locate(f"{root}/{row['path']}")
    assert len(there.read_rows("evaluations")) > 0
    assert train(root, replace(TrainConfig.smoke(), steps=2)) == find_checkpoint(root), "once"
