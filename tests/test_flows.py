"""The flows: their parameters, their pool, a killed run, a real server with a worker."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import flows
from flows.parameters import ParameterError, configured, override
from flows.plugin import FLOWS, full_name, wrap_read_deployment

ROOT = Path(__file__).parent.parent
BIN = Path(sys.executable).parent
FEW = {
    "train.same_plane": 6,
    "train.on": 2,
    "validation.same_plane": 2,
    "validation.on": 2,
    "test.same_plane": 2,
    "test.on": 2,
    "scenes_per_shard": 2,
    "goals_per_scene": 1,
}
"""Overrides of the smoke preset: 8 shards of 2 scenes."""


# --- parameters --------------------------------------------------------------------------


def test_overrides_reach_nested_settings() -> None:
    from relevance.generation import DatasetConfig

    config = configured(DatasetConfig, "smoke", {"seed": 7, "train.on": 3, "train.same_plane": 5})
    assert (config.seed, config.train.on, config.train.same_plane) == (7, 3, 5)
    assert config.validation == DatasetConfig.smoke().validation
    assert override(config, {}) == config
    assert override(config, {"train": {"on": 4}}).train.same_plane == 5


@pytest.mark.parametrize(
    ("preset", "overrides", "culprit"),
    [
        ("smoke", {"sede": 1}, "sede: unknown setting"),
        ("smoke", {"train.of": 1}, "train.of: unknown setting, expected one of on, same_plane"),
        ("smoke", {"seed": "many"}, "seed: Input should be a valid integer"),
        ("smoke", {"seed.low": 1}, "seed has no settings of its own"),
        ("smoke", {"seed": -1}, "seed"),
        ("huge", {}, "preset 'huge'"),
        ("__init__", {}, "preset '__init__'"),
    ],
)
def test_bad_parameters_are_named(preset: str, overrides: dict[str, Any], culprit: str) -> None:
    from relevance.generation import DatasetConfig

    with pytest.raises(ValueError, match="") as error:
        configured(DatasetConfig, preset, overrides)
    assert culprit in str(error.value)


def test_flows_refuse_bad_parameters_before_any_work(tmp_path: Path) -> None:
    from prefect.exceptions import ParameterTypeError

    from flows.generate import generate

    (tmp_path / "file").write_text("")
    for wrong in (
        {"preset": "huge"},
        {"max_workers": 0},
        {"overrides": 3},
        {"dataset": str(tmp_path / "file")},
        {"dataset": " "},
    ):
        parameters = {"dataset": str(tmp_path / "new"), "preset": "smoke"} | wrong
        with pytest.raises(ParameterTypeError, match=next(iter(wrong))):
            generate.validate_parameters(parameters)
    assert not (tmp_path / "new").exists()


# --- the plugin --------------------------------------------------------------------------


def test_short_names_are_only_ours() -> None:
    assert [full_name(name) for name in FLOWS] == [f"{name}/{name}" for name in FLOWS]
    assert full_name("generate/other") == "generate/other"
    assert full_name("somebody") == "somebody"


def test_a_client_is_wrapped_once() -> None:
    class Client:
        def read_deployment_by_name(self, name: str) -> str:
            return name

    wrap_read_deployment(Client)
    once = Client.read_deployment_by_name
    wrap_read_deployment(Client)
    assert Client.read_deployment_by_name is once
    assert Client().read_deployment_by_name("train") == "train/train"


# --- the pool ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def prefect_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A temporary server with its own database for flows that run in this process."""
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=180):
        yield


def _shards(task: Any, jobs: dict[str, dict[str, Any]]) -> dict[str, Any]:
    from prefect import flow

    from flows.shards import process_pool, run_shards

    @flow(name="shards", task_runner=process_pool(), persist_result=False)
    def run() -> dict[str, Any]:
        return run_shards(task, jobs, stage="shards", max_workers=2)

    return run()


def _double(value: int) -> int:
    return 2 * value


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

    from flows.shards import worth_retrying

    return task(function, retries=1, retry_condition_fn=worth_retrying, cache_policy=NO_CACHE)


def test_results_come_by_name(prefect_server: None) -> None:
    jobs = {str(n): {"value": n} for n in range(20)}  # more than are under way at a time
    assert _shards(_task(_double), jobs) == {str(n): 2 * n for n in range(20)}


def test_a_dead_worker_costs_a_new_pool(prefect_server: None, tmp_path: Path) -> None:
    jobs = {str(n): {"value": n, "folder": str(tmp_path)} for n in range(6)}
    assert _shards(_task(_die_once), jobs) == {str(n): 2 * n for n in range(6)}
    assert (tmp_path / "3").exists()


def test_a_failing_shard_is_retried_and_does_not_stop_the_others(
    prefect_server: None, tmp_path: Path
) -> None:
    from flows.shards import ShardsFailed

    jobs = {str(n): {"value": n, "folder": str(tmp_path)} for n in (1, 4, 5, 6)}
    with pytest.raises(
        ShardsFailed, match=r"1 of 4 shards failed, 3 were made; .*OSError: no room"
    ):
        _shards(_task(_fail), jobs)
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {
        "1": "xx",
        "4": "x",
        "5": "x",
        "6": "x",
    }


def test_bad_input_is_not_retried(prefect_server: None, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bad input"):
        _shards(_task(_fail), {"2": {"value": 2, "folder": str(tmp_path)}})
    assert (tmp_path / "2").read_text() == "x"
