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
    [automation] = server.post("/automations/filter")
    assert automation["trigger"]["expect"] == ["shards.written"]

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
        # That run trains for minutes; it has been started, which is what we wanted to see.
        cancelled = {"type": "CANCELLED"}
        server.post(f"/flow_runs/{run['id']}/set_state", state=cancelled, force=True)


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
