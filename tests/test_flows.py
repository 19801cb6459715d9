"""The flows: their pool, the pipeline through them, a killed run."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from served import FEW, ROOT, ended, environment, wait_for

from flows.parameters import ParameterError, configured
from relevance.benchmarks.crashes import members
from relevance.errors import RelevanceError

# --- the pool ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def prefect_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A temporary server with its own database for flows that run in this process."""
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=180):
        yield


def _shards(
    task: Any, jobs: dict[str, dict[str, Any]], workers: int = 1, dataset: Path = Path("/nowhere")
) -> dict[str, Any]:
    from prefect import flow

    from flows.shards import process_pool, run_shards

    @flow(name="shards", task_runner=process_pool(), persist_result=False)
    def run() -> dict[str, Any]:
        return run_shards(task, jobs, stage="shards", dataset=dataset, max_workers=workers)

    return run()


def _die_once(value: int, folder: str) -> int:
    mark = Path(folder) / f"{value}"
    if value == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * value


def _fail(value: int, folder: str) -> int:
    tries = Path(folder) / f"{value}"
    tries.write_text(tries.read_text() + "x" if tries.exists() else "x")
    if value == 1:
        raise OSError("no room")
    if value == 2:
        raise ValueError("bad input")
    return value


def _task(function: Callable[..., Any]) -> Any:
    from prefect import task
    from prefect.cache_policies import NO_CACHE

    from flows.head import worth_retrying

    return task(function, retries=1, retry_condition_fn=worth_retrying, cache_policy=NO_CACHE)


@pytest.mark.slow  # three pools of processes start
def test_results_come_by_name_and_a_dead_worker_costs_a_new_pool(
    prefect_server: None, tmp_path: Path
) -> None:
    # More than are under way at a time.
    jobs = {str(n): {"value": n, "folder": str(tmp_path)} for n in range(10)}
    assert _shards(_task(_die_once), jobs, workers=2) == {str(n): 2 * n for n in range(10)}
    assert (tmp_path / "3").exists()


@pytest.mark.slow  # a server of its own, and waits between tries
def test_a_failing_shard_is_retried_and_does_not_stop_the_others(
    prefect_server: None, tmp_path: Path
) -> None:
    from relevance.workers import ShardsFailed

    jobs = {str(n): {"value": n, "folder": str(tmp_path)} for n in (1, 4, 5, 6)}
    with pytest.raises(
        ShardsFailed, match=r"1 of 4 shards failed, 3 were made; .*OSError: no room"
    ):
        _shards(_task(_fail), jobs, dataset=tmp_path)
    [event] = wait_for(lambda: _events("shard.failed", tmp_path), 30, "an event")
    assert event["resource"]["prefect.resource.id"] == f"relevance.dataset.{tmp_path}"
    assert event["payload"]["said"].startswith("shards: 1 of 4 shards failed, 3 were made")
    assert event["payload"]["shards"] == ["shards: shard 1: OSError: no room"]
    assert "- shards: shard 1: OSError: no room" in _artifacts()["shard-failed"]["data"]
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {
        "1": "xx",
        "4": "x",
        "5": "x",
        "6": "x",
    }


@pytest.mark.slow  # flows of a server of its own
def test_bad_input_is_not_retried(prefect_server: None, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bad input"):
        _shards(_task(_fail), {"2": {"value": 2, "folder": str(tmp_path)}})
    assert (tmp_path / "2").read_text() == "x"


# --- the pipeline through the flows --------------------------------------------------------


def _bytes(root: Path, but: tuple[str, ...] = ("timings", "durations")) -> dict[str, str]:
    """Hash of every file of a dataset, apart from the tables that hold a clock."""
    return {
        str(file.relative_to(root)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(root.rglob("*"))
        if file.is_file() and file.relative_to(root).parts[0] not in but
    }


def _api(method: str, path: str, **body: Any) -> Any:
    import httpx
    from prefect.settings import get_current_settings

    url = f"{get_current_settings().api.url}{path}"
    answer = httpx.request(method, url, json=body, timeout=30)
    answer.raise_for_status()
    return answer.json()


def _artifacts() -> dict[str, dict[str, Any]]:
    found = _api("POST", "/artifacts/filter", sort="CREATED_DESC", limit=200)
    return {item["key"]: item for item in reversed(found) if item["key"]}


def _events(name: str, dataset: Path) -> list[dict[str, Any]]:
    """Those about a dataset; flows of other datasets tell of theirs."""
    found = _api("POST", "/events/filter", filter={"event": {"name": [name]}})["events"]
    return [event for event in found if event["payload"]["dataset"] == str(dataset)]


@pytest.fixture(scope="module")
def dataset(prefect_server: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset, generated and labelled by the flows on two processes."""
    from flows.generate import generate
    from flows.label import label

    root = tmp_path_factory.mktemp("flows") / "dataset"
    made = generate(dataset=str(root), preset="smoke", overrides=FEW, max_workers=2)
    assert made == {"dataset": str(root), "shards": 6, "written": 6}
    labelled = label(dataset=str(root), max_workers=2)
    assert labelled["written"] == labelled["shards"] == 5 * 3
    assert labelled["holds"] > labelled["tasks"] / 2
    return root


def test_flows_make_the_same_bytes_as_the_plain_functions(dataset: Path, tmp_path: Path) -> None:
    from relevance.pipeline import (
        DatasetConfig,
        finish,
        generate_shard,
        label_shard,
        prepare,
    )

    config = configured(DatasetConfig, "smoke", FEW)
    for spec in reversed(prepare(tmp_path, config)):
        generate_shard(tmp_path, config, spec)
        for predicate in spec.predicates:
            label_shard(tmp_path, config, spec, predicate)
    finish(tmp_path)
    plain = _bytes(tmp_path)
    assert {name: made for name, made in _bytes(dataset).items() if name in plain} == plain
    assert len(plain) == 1 + 2 * 6 + 2 * (5 * 3)


def test_flows_leave_artifacts_and_events(dataset: Path) -> None:
    artifacts = _artifacts()
    rows = json.loads(artifacts["generate-shards"]["data"])
    assert sum(row["scenes"] for row in rows) == 12
    assert sum(row["made now"] for row in rows) == 6
    rows = json.loads(artifacts["label-shards"]["data"])
    assert {row["predicate"] for row in rows} == {
        "on",
        "on-the-left",
        "on-the-right",
        "in-front",
        "behind",
    }
    assert artifacts["generate-progress"]["data"] == 100.0
    assert artifacts["label-progress"]["data"] == 100.0

    def ours() -> dict[str, Any]:
        found = _events("shards.written", dataset)
        return {e["resource"]["relevance.table"]: e["payload"]["shards"] for e in found}

    wait_for(lambda: len(ours()) == 2, 30, "two events")
    assert ours() == {"scenes": 6, "labels": 15}


def test_a_second_run_makes_nothing_and_tells_nobody(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flows import telling
    from flows.generate import generate
    from flows.label import label

    told: list[Any] = []
    monkeypatch.setattr(telling, "emit_event", lambda *args, **more: told.append(args))
    before = {file: file.stat().st_mtime_ns for file in dataset.rglob("*") if file.is_file()}
    assert generate(dataset=str(dataset), preset="smoke", overrides=FEW)["written"] == 0
    assert label(dataset=str(dataset), predicates=["on"], max_workers=1)["written"] == 0
    now = {file: file.stat().st_mtime_ns for file in dataset.rglob("*") if file.is_file()}
    assert {file: time for file, time in now.items() if file in before} == before
    assert told == []


def test_flows_refuse_what_is_not_there(prefect_server: None, tmp_path: Path) -> None:
    from flows.evaluate import evaluate
    from flows.generate import generate
    from flows.label import label
    from flows.train import train
    from relevance.pipeline import DatasetConfig, prepare

    for flow in (label, train):
        with pytest.raises(ValueError, match=r"no dataset\.json there"):
            flow(dataset=str(tmp_path / "none"))
    with pytest.raises(RelevanceError, match=r"train\.sum_plane: unknown setting"):
        generate(dataset=str(tmp_path / "a"), preset="smoke", overrides={"train.sum_plane": 1})
    assert list(tmp_path.iterdir()) == []
    prepare(tmp_path, DatasetConfig.smoke())
    with pytest.raises(RelevanceError, match="no checkpoints there, expected `train` first"):
        evaluate(dataset=str(tmp_path))
    with pytest.raises(RelevanceError, match="no scenes of these predicates"):
        label(dataset=str(tmp_path))
    with pytest.raises(RelevanceError, match="unknown predicate 'above', expected one of"):
        label(dataset=str(tmp_path), predicates=["above"])


@pytest.mark.slow  # a pool of processes plans anew
def test_another_policy_is_a_parameter(dataset: Path) -> None:
    from flows.label import label
    from relevance.store import Dataset

    before = _bytes(dataset)
    made = label(dataset=str(dataset), predicates=["on"], policy="any-minimal", max_workers=1)
    assert (made["shards"], made["written"]) == (3, 3)
    assert [of.policy for of in Dataset.open(dataset).labellings()] == ["any-minimal"]
    assert {name: c for name, c in _bytes(dataset).items() if name in before} == before
    with pytest.raises(RelevanceError, match="unknown policy 'guess', expected one of found, nec"):
        label(dataset=str(dataset), policy="guess")


def test_parameters_that_cannot_be_are_one_line(prefect_server: None, tmp_path: Path) -> None:
    from flows.generate import generate

    with pytest.raises(ParameterError) as wrong:
        generate(dataset=str(tmp_path / "new"), preset="smoke", cluster="x", max_workers=0)
    assert str(wrong.value) == (
        "max_workers: Input should be greater than or equal to 1; "
        "cluster: expected the address of a Dask scheduler, like tcp://10.0.0.1:8786"
    )
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    with pytest.raises(ParameterError, match=r"^dataset: \S+/file is a file, expected the path"):
        generate(dataset=str(tmp_path / "file"), preset="smoke")


def test_a_server_that_does_not_answer_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect.settings import PREFECT_API_URL, PREFECT_HOME, temporary_settings

    from flows.generate import generate
    from flows.head import NoServer

    dead = "http://127.0.0.1:9/api"
    with (
        temporary_settings({PREFECT_API_URL: dead}),
        pytest.raises(NoServer, match=f"PREFECT_API_URL {dead}: no Prefect server answers"),
    ):
        generate(dataset=str(tmp_path / "new"), preset="smoke")
    with (
        temporary_settings({PREFECT_HOME: "/dev/null/x"}, restore_defaults={PREFECT_API_URL}),
        pytest.raises(NoServer, match="PREFECT_HOME /dev/null/x: Not a directory, expected"),
    ):
        generate(dataset=str(tmp_path / "new"), preset="smoke")
    assert not (tmp_path / "new").exists()


# --- no server, and a violent end ----------------------------------------------------------

MORE = FEW | {"train.same_plane": 60, "train.on": 20, "scenes_per_shard": 5}
"""20 shards: enough that a kill falls among them."""


@pytest.fixture
def home(prefect_server: None, tmp_path: Path) -> Path:
    """A Prefect home for processes with servers of their own.

    Its database is a copy of the server's here: to make one takes half a minute.
    """
    from prefect.settings import get_current_settings

    url = get_current_settings().server.database.connection_url
    assert url is not None
    source = sqlite3.connect(url.get_secret_value().partition(":///")[2])
    (tmp_path / "home").mkdir()
    copy = sqlite3.connect(tmp_path / "home" / "prefect.db")
    with contextlib.closing(source), contextlib.closing(copy):
        source.backup(copy)
    return tmp_path / "home"


def _generate(root: Path, home: Path) -> subprocess.Popen[bytes]:
    call = f"generate(dataset={str(root)!r}, preset='smoke', overrides={MORE}, max_workers=2)"
    return subprocess.Popen(
        [sys.executable, "-c", f"from flows.generate import generate\n{call}"],
        cwd=ROOT,
        env=environment(home),
        start_new_session=True,
    )


@pytest.mark.slow  # two servers and two runs, one of them killed
def test_a_killed_flow_leaves_nobody_behind_and_resumes_to_the_same_bytes(
    home: Path, tmp_path: Path
) -> None:
    from flows.generate import generate
    from relevance.pipeline import DatasetConfig, finish, generate_shard, prepare

    calm, killed = tmp_path / "calm", tmp_path / "killed"
    with ended(_generate(killed, home)) as process:
        wait_for(lambda: [*killed.glob("scenes/*/*.parquet")], 240, "a first shard")
        process.kill()
        process.wait(30)
        wait_for(lambda: not members(process.pid), 60, "the end of its workers and server")
    before = {file: file.stat().st_mtime_ns for file in killed.glob("scenes/*/*.parquet")}
    assert 0 < len(before) < 20

    made = generate(dataset=str(killed), preset="smoke", overrides=MORE, max_workers=2)
    assert (made["shards"], made["written"]) == (20, 20 - len(before))
    config = configured(DatasetConfig, "smoke", MORE)
    for spec in prepare(calm, config):
        generate_shard(calm, config, spec)
    finish(calm)
    assert _bytes(killed) == _bytes(calm)
    assert {file: file.stat().st_mtime_ns for file in before} == before


@pytest.mark.slow  # a server starts and ends
def test_a_flow_ends_with_its_server(home: Path) -> None:
    program = (
        "import os, signal\n"
        "from prefect import flow\n"
        "from prefect.server.api.server import SubprocessASGIServer\n"
        "from flows.shards import one_server\n"
        "@flow\n"
        "def ending():\n"
        "    with one_server():\n"
        "        pass\n"
        "    os.kill(SubprocessASGIServer().server_process.pid, signal.SIGKILL)\n"
        "ending()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=environment(home),
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    with ended(process):
        _, errors = process.communicate(timeout=120)  # Prefect alone takes four minutes
        assert process.returncode == 1
        assert "the flow's Prefect server died; start the flow again" in errors


@pytest.mark.slow  # trains, and reruns the planner in a process of its own
def test_reproduce_makes_what_is_missing(prefect_server: None, tmp_path: Path) -> None:
    from evaluated import evaluated

    from flows.reproduce import reproduce
    from relevance.report.paper import paper
    from relevance.store import Dataset

    data = tmp_path / "data"
    shutil.copytree(evaluated()[0], data)
    shutil.rmtree(data / "predictions")
    few = {"tasks": 1, "sweep_tasks": 1, "betas": [], "guides": ["prune"], "priors": []}
    page = Path(reproduce(dataset=str(data), preset="smoke", overrides=few, max_workers=1))
    assert page == data / "paper" / "index.html"
    assert {file.suffix for file in page.parent.rglob("figure-8-*")} == {".png", ".svg"}
    rows = Dataset.open(data).read_rows("evaluations")
    assert {row["beta"] for row in rows} >= {*paper().curves["beta"]}
