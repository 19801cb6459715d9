"""A Prefect server with our deployments, a worker, and processes that end with the test."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from relevance.benchmarks.crashes import kill_all

ROOT = Path(__file__).parent.parent
BIN = Path(sys.executable).parent
FEW = {
    "train.same_plane": 2,
    "train.on": 2,
    "validation.same_plane": 2,
    "validation.on": 2,
    "test.same_plane": 2,
    "test.on": 2,
    "scenes_per_shard": 2,
    "goals_per_scene": 1,
}
"""Overrides of the smoke preset: 6 shards of 2 scenes."""


def wait_for(what: Callable[[], Any], seconds: float, why: str) -> Any:
    """What it returns as soon as that is something."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end, f"not within {seconds:.0f} s: {why}"
        time.sleep(0.2)
    return found


def environment(home: Path) -> dict[str, str]:
    """That of a process with a Prefect home of its own."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT")}
    return kept | {"PREFECT_HOME": str(home), "OMP_NUM_THREADS": "1"}


def running(mark: str) -> list[int]:
    """The living processes whose environment holds a mark, which their children inherit."""
    found = []
    for file in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):  # it ended while we looked, or is somebody else's
            if mark.encode() in file.read_bytes():
                found.append(int(file.parent.name))
    return found


@contextmanager
def ended(process: subprocess.Popen[Any]) -> Iterator[subprocess.Popen[Any]]:
    """Whatever happens, nothing of the process's session is left."""
    try:
        yield process
    finally:
        kill_all(process.pid)
        process.wait(30)


@dataclass(frozen=True, slots=True, kw_only=True)
class Server:
    """A running server that knows our deployments."""

    folder: Path
    """Where logs lie."""
    env: dict[str, str]
    """The environment in which `prefect` talks to it."""

    def post(self, path: str, **body: Any) -> Any:
        """What the server answers."""
        answer = httpx.post(f"{self.env['PREFECT_API_URL']}{path}", json=body, timeout=30)
        answer.raise_for_status()
        return answer.json()

    def call(self, *arguments: str, timeout: float = 240) -> subprocess.CompletedProcess[str]:
        """`prefect ...`, to its end."""
        return subprocess.run(
            [BIN / "prefect", *arguments],
            cwd=ROOT,
            env=self.env,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    def done(self, *arguments: str, timeout: float = 240) -> str:
        """What a `prefect ...` prints that succeeds."""
        done = self.call(*arguments, timeout=timeout)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    @contextmanager
    def background(self, name: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
        """A `prefect ...` that lasts as long as the block; its output is in NAME.log."""
        with (self.folder / f"{name}.log").open("wb") as stream:
            process = subprocess.Popen(
                [BIN / "prefect", *arguments],
                cwd=ROOT,
                env=self.env,
                start_new_session=True,
                stdout=stream,
                stderr=subprocess.STDOUT,
            )
        with ended(process):
            yield process


@contextmanager
def served(folder: Path) -> Iterator[Server]:
    """A server with its own database, a work pool and the deployments of prefect.yaml."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    api = f"http://127.0.0.1:{port}/api"
    server = Server(folder=folder, env=environment(folder / "home") | {"PREFECT_API_URL": api})

    def healthy() -> bool:
        with suppress(httpx.TransportError):
            return httpx.get(f"{api}/health", timeout=5).status_code == 200
        return False

    start = ("server", "start", "--host", "127.0.0.1", "--port", str(port))
    with server.background("server", *start):
        wait_for(healthy, 180, "a healthy server")
        server.done("work-pool", "create", "relevance", "--type", "process")
        server.done("--no-prompt", "deploy", "--all")
        try:
            yield server
        finally:
            for process in running(f"PREFECT_API_URL={api}"):  # runs have sessions of their own
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
