"""Deployments on a real server with a worker: schedules, triggers, a run that is cancelled."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import small_dataset
from served import FEW, Server, running, served, wait_for

from flows.plugin import deployments
from relevance.networks import read_record
from relevance.store import Dataset
from relevance.training.checkpoints import read_file, write_file

pytestmark = pytest.mark.slow  # a server and its database, a worker, deployments

WORKER = ("worker", "start", "--pool", "relevance")
ENDED = ("CANCELLED", "COMPLETED", "CRASHED", "FAILED")
WATCH = ("--watch", "--watch-timeout", "480")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with served(tmp_path_factory.mktemp("server")) as server:
        yield server


def test_deployments_schedule_and_trigger_on_a_real_server(server: Server, tmp_path: Path) -> None:
    data = tmp_path / "dataset"
    there = {item["name"]: item for item in server.post("/deployments/filter")}
    assert set(there) == set(deployments())
    assert [s["schedule"]["cron"] for s in there["retrain"]["schedules"]] == ["0 3 * * *"]
    triggers = {item["name"]: item["trigger"] for item in server.post("/automations/filter")}
    assert {name: trigger["expect"] for name, trigger in triggers.items()} == {
        "retrain-on-new-shards": ["shards.written"],
        "check-on-failed-shard": ["shard.failed"],
    }

    refused = server.call("deployment", "run", "generate", "-p", "preset=huge")
    assert refused.returncode != 0
    assert "huge" in refused.stdout + refused.stderr

    with server.background("worker", *WORKER):
        out = server.done(
            *("deployment", "run", "generate", *WATCH, "-p", f"dataset={data}"),
            *("-p", "preset=smoke", "-p", f"overrides={json.dumps(FEW)}"),
            timeout=500,
        )
        assert "finished successfully" in out
        assert len([*data.glob("scenes/*/*.parquet")]) == 6
        # Scenes alone do not train; labels do, and the full name works too.
        name = {"deployments": {"name": {"any_": ["retrain"]}}}
        runs = {"flow_runs": {"state": {"type": {"any_": ["SCHEDULED"]}}}}
        planned = len(server.post("/flow_runs/filter", **name, **runs))
        server.done(
            *("deployment", "run", "label/label", *WATCH, "-p", f"dataset={data}"), timeout=500
        )

        def triggered() -> list[dict[str, Any]]:
            found = server.post("/flow_runs/filter", **name, sort="EXPECTED_START_TIME_ASC")
            return [run for run in found if run["parameters"].get("dataset") == str(data)]

        [run] = wait_for(triggered, 120, "a run of retrain")
        assert planned >= 1, "the cron schedule plans runs ahead"
        # Nobody is there: it trains, evaluates, promotes or refuses, and tells.
        last = wait_for(lambda: ended_run(server, run["id"]), 500, "the end of that run")
        assert last["state"]["type"] == "COMPLETED", last["state"]
    dataset = Dataset.open(data)
    [row] = dataset.read_rows("checkpoints")
    [event] = read_record(dataset).history
    assert event.checkpoint_id == row["checkpoint_id"]
    assert (data / "report.html").is_file()
    names = [f"checkpoint.{event.what}"]
    asked = {"filter": {"event": {"name": names}}}
    [told] = wait_for(lambda: server.post("/events/filter", **asked)["events"], 60, "its event")
    assert told["payload"]["dataset"] == str(data)
    [page] = server.post("/artifacts/latest/filter", artifacts={"key": {"any_": ["champion"]}})
    assert event.why in page["data"]


def ended_run(server: Server, identity: str) -> dict[str, Any] | None:
    """A run that is over."""
    [run] = server.post("/flow_runs/filter", flow_runs={"id": {"any_": [identity]}})
    return run if run["state"]["type"] in ENDED else None


def test_a_shard_that_fails_starts_a_check(server: Server, tmp_path: Path) -> None:
    data = tmp_path / "dataset"
    shutil.copytree(small_dataset(), data)
    for file in (*data.glob("labels/**/*.parquet"), *data.glob("plans/**/*.parquet")):
        file.unlink()
    images = next(data.glob("images/split=train/*.tar"))
    images.write_bytes(images.read_bytes()[:700])
    scenes = data / "scenes/split=train" / f"{images.stem}.parquet"
    scenes.write_bytes(scenes.read_bytes()[:-50])
    with server.background("failing", *WORKER):
        failed = server.call(*("deployment", "run", "label", *WATCH, "-p", f"dataset={data}"))
        assert failed.returncode != 0

        def checked() -> dict[str, Any] | None:
            names = {"deployments": {"name": {"any_": ["check"]}}}
            found = server.post("/flow_runs/filter", **names)
            mine = [run for run in found if run["parameters"].get("dataset") == str(data)]
            return ended_run(server, mine[0]["id"]) if mine else None

        run = wait_for(checked, 300, "the end of a check")
    assert run["state"]["type"] == "FAILED"
    assert "breaches of contract" in run["state"]["message"]
    name = {"filter": {"event": {"name": ["check.failed"]}}}

    def told() -> bool:
        events = server.post("/events/filter", **name)["events"]
        return str(data) in {event["payload"]["dataset"] for event in events}

    wait_for(told, 60, "its event")


def test_a_cancelled_run_ends_its_pool(server: Server, tmp_path: Path) -> None:
    data = tmp_path / "dataset"
    many = FEW | {"train.same_plane": 4000, "scenes_per_shard": 5}

    def runs() -> list[dict[str, Any]]:
        found = server.post("/flow_runs/filter", sort="EXPECTED_START_TIME_ASC")
        return [run for run in found if run["parameters"].get("dataset") == str(data)]

    def shards() -> list[Path]:
        return sorted(data.glob("scenes/*/*.parquet"))

    with server.background("pool", *WORKER):
        server.done(
            *("deployment", "run", "generate", "-p", f"dataset={data}", "-p", "preset=smoke"),
            *("-p", "max_workers=2", "-p", f"overrides={json.dumps(many)}"),
        )
        wait_for(shards, 240, "a first shard")
        [run] = runs()
        mark = f"PREFECT__FLOW_RUN_ID={run['id']}"
        assert len(running(mark)) >= 3, "the flow and two processes of its pool"
        server.post(f"/flow_runs/{run['id']}/set_state", state={"type": "CANCELLING"})
        wait_for(lambda: ended_run(server, run["id"]), 240, "the end of the run")
        assert runs()[0]["state"]["type"] == "CANCELLED"
        wait_for(lambda: not running(mark), 60, "the end of its processes")
        made = shards()
        assert len(made) < 800
    assert shards() == made
    assert not list(data.rglob(".*.tmp")), "nothing half-written"


def test_a_cancelled_run_leaves_nothing_behind_and_is_taken_up(
    server: Server, tmp_path: Path
) -> None:
    data = tmp_path / "dataset"
    shutil.copytree(small_dataset(), data)
    overrides = {"steps": 300, "save_every": 2, "threads": 1}
    train = ("deployment", "run", "train", "-p", f"dataset={data}", "-p", "preset=smoke")
    train = (*train, "-p", f"overrides={json.dumps(overrides)}")

    def runs() -> list[dict[str, Any]]:
        found = server.post("/flow_runs/filter", sort="EXPECTED_START_TIME_ASC")
        return [run for run in found if run["parameters"].get("dataset") == str(data)]

    def saved() -> list[str]:
        return sorted(file.suffix for file in (data / "checkpoints").glob("*"))

    with server.background("cancelled", *WORKER):
        server.done(*train)
        wait_for(lambda: ".state" in saved(), 240, "a saved state")
        [run] = runs()
        mark = f"PREFECT__FLOW_RUN_ID={run['id']}"
        assert running(mark)
        server.post(f"/flow_runs/{run['id']}/set_state", state={"type": "CANCELLING"})
        wait_for(lambda: runs()[0]["state"]["type"] in ENDED, 240, "the end of the run")
        assert runs()[0]["state"]["type"] == "CANCELLED"
        wait_for(lambda: not running(mark), 60, "the end of its processes")
        assert saved() == [".state"]
        [file] = (data / "checkpoints").iterdir()
        state = read_file(file, "state", torch.device("cpu"))
        assert 0 < state["done"] < overrides["steps"]
        assert "Traceback" not in (server.folder / "cancelled.log").read_text()
        told = server.post("/logs/filter", logs={"flow_run_id": {"any_": [run["id"]]}})
        assert told
        assert not [line for line in told if "Traceback" in line["message"]]

        # The next run adds its time to that of the first: a mark on it shows that it was read.
        write_file(file, "state", {**state, "seconds": 1e6})
        server.done(*train, *WATCH, timeout=500)
    assert saved() == [".parquet", ".pt"]
    [row] = Dataset.open(data).read_rows("checkpoints")
    assert row["train_seconds"] > 1e6
