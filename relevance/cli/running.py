"""Subcommands that run other programs: demo (the flows), dashboard (streamlit)."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from relevance.cli.arguments import (
    CORES,
    Command,
    DatasetArg,
    Preset,
    Workers,
    at_least,
    check_workers,
)
from relevance.cli.terminal import UsageError, bars, say


def _demo(preset: Preset) -> Callable[..., int]:
    def demo(
        dataset: Path = Path("data/demo"),
        preset: Preset = preset,
        workers: Workers = CORES,
    ) -> int:
        """Run the whole pipeline through the Prefect flows, from scenes to the report.

        Stopped half-way, the same command goes on; run again, it repeats nothing.

        Args:
            dataset: Folder of the dataset.
            preset: Size of everything.
            workers: Processes that work at a time.
        """
        check_workers(workers)
        from flows import demo, shards

        with bars() as drawn:
            rows: dict[str, Any] = {}

            def hear(stage: str, done: int, total: int) -> None:
                if stage not in rows:
                    rows[stage] = drawn.add_task(stage, total=total)
                drawn.update(rows[stage], completed=done)

            shards.listener.set(hear)
            result = demo.run(str(dataset), preset=preset, max_workers=workers)
        minutes = ", ".join(f"{name} {took / 60:.1f}" for name, took in result.seconds.items())
        say(f"minutes: {minutes}")
        print(f"dataset     {result.dataset}")
        print(f"checkpoint  {result.checkpoint}")
        print(f"report      {result.report}")
        return 0

    return demo


def _dashboard(_: Preset) -> Callable[..., int]:
    def dashboard(
        dataset: DatasetArg = Path("data/demo"), port: int = 8501, address: str = "127.0.0.1"
    ) -> int:
        """Open the dashboard in a browser.

        Args:
            dataset: Folder of the dataset.
            port: Where it listens.
            address: For whom it listens; this machine only, unless changed.
        """
        at_least("--port", port, 1, 65535)
        from dashboards.serving import serve
        from relevance.store import Dataset

        Dataset.open(dataset)
        _free(address, port)
        serve(dataset, address=address, port=port)
        return 0

    return dashboard


def _free(address: str, port: int) -> None:
    """UsageError when nobody can listen there."""
    try:
        family = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((address, port))
            listener.listen()
    except OSError as error:
        raise UsageError(
            f"--address {address} --port {port}: {error.strerror}, expected a free port"
        ) from None


COMMANDS = {
    "demo": Command(
        make=_demo,
        about="the whole pipeline, from scenes to the report",
        examples=("relevance demo", "relevance demo --preset smoke --dataset data/smoke"),
    ),
    "dashboard": Command(
        make=_dashboard,
        about="look around in a browser",
        examples=("relevance dashboard data/demo",),
    ),
}
