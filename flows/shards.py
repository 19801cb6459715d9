"""One task per shard: the worker pool, what happens when it breaks, progress and the event.

The shard files say what is finished, so a flow submits only what is missing and a second run
after any kind of death goes on where the first one stopped.
"""

from __future__ import annotations

import atexit
import itertools
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from multiprocessing import connection, parent_process
from pathlib import Path
from typing import Any
from uuid import UUID

from prefect import Task, get_run_logger
from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.context import FlowRunContext
from prefect.events import emit_event
from prefect.futures import PrefectFuture, as_completed
from prefect.server.api.server import SubprocessASGIServer
from prefect.settings import PREFECT_API_URL, get_current_settings, temporary_settings
from prefect.task_runners import ProcessPoolTaskRunner, TaskRunner, ThreadPoolTaskRunner

EVENT = "shards.written"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

MOST_FAILURES = 5
"""A flow stops handing out shards once this many have failed for good."""
MOST_POOLS = 3
"""How often a pool whose worker died (out of memory, say) is replaced."""

MOST_FLYING = 256
"""Workers of a cluster that are kept busy: four shards each are handed out ahead."""

Listener = Callable[[str, int, int], None]
listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
"""Hears (stage, done, total) in the flow's own process; the command line draws bars with it."""


class ShardsFailed(RuntimeError):
    """Some shards could not be made; the finished ones stay."""


def prepare_worker() -> None:
    """Run first in each worker process: one thread for arrays, and no life without the flow.

    A worker holds both ends of its queue, so it would wait for ever when its flow is killed.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    parent = parent_process()
    if parent is None:
        return

    def watch(sentinel: int = parent.sentinel) -> None:
        connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


def process_pool(max_workers: int | None = None) -> TaskRunner[Any]:
    """A pool of that many processes; None is the number of cores."""
    workers = max_workers or len(os.sched_getaffinity(0))
    return ProcessPoolTaskRunner(max_workers=workers, initializer=prepare_worker)


def dask_cluster(address: str) -> TaskRunner[Any]:
    """The workers of a running Dask cluster; raises ShardsFailed when they cannot be had."""
    try:
        from prefect_dask.task_runners import DaskTaskRunner
    except ImportError:
        raise ShardsFailed("a Dask cluster needs prefect-dask: install relevance[dask]") from None
    return DaskTaskRunner(address=address)


def worth_retrying(task: Task[Any, Any], run: Any, state: Any) -> bool:
    """Whether another try could help: bad input (a ValueError) stays bad."""
    return not isinstance(state.result(raise_on_failure=False), ValueError)


def one_by_one() -> TaskRunner[Any]:
    """The runner of flows that do one thing after another, in their own process."""
    return ThreadPoolTaskRunner(max_workers=1)


@contextmanager
def one_server() -> Iterator[None]:
    """Let worker processes talk to the server that this process has.

    Without a server each process would start one of its own: seconds and memory for nothing.
    """
    if get_current_settings().api.url:
        yield
        return
    server = SubprocessASGIServer()  # one object a process: the one that the flow itself uses
    server.start()
    _end_with(server)
    with temporary_settings({PREFECT_API_URL: server.api_url}):
        yield


@cache
def _end_with(server: SubprocessASGIServer) -> None:
    """From now on end this process when its server dies; else it would try to reach it for minutes.

    Finished shards stay, and the workers end with this process. Somebody's open session (a
    notebook) is not ended.
    """
    process, over = server.server_process, threading.Event()
    if process is None or hasattr(sys, "ps1"):
        return
    atexit.register(over.set)  # last in, first out: before the server's own stop

    def watch() -> None:
        while not over.wait(0.5):
            if process.poll() is not None and not over.is_set():
                print("the flow's Prefect server died; start the flow again", file=sys.stderr)
                sys.stderr.flush()
                os._exit(1)

    threading.Thread(target=watch, name="end-with-server", daemon=True).start()


@contextmanager
def _runner(max_workers: int | None, cluster: str | None) -> Iterator[TaskRunner[Any]]:
    """A fresh process pool, a Dask cluster, or the runner that the flow was given instead."""
    context = FlowRunContext.get()
    assert context is not None, "shards are run inside a flow"
    if cluster is not None:
        with one_server(), dask_cluster(cluster) as workers:
            yield workers
    elif isinstance(context.task_runner, ProcessPoolTaskRunner):
        with one_server(), process_pool(max_workers) as pool:
            yield pool
    else:
        yield context.task_runner


def run_shards(
    task: Task[Any, Any],
    jobs: Mapping[str, dict[str, Any]],
    *,
    stage: str,
    done: int = 0,
    max_workers: int | None = None,
    cluster: str | None = None,
) -> dict[str, Any]:
    """Run the task once a job (name -> parameters), in any order; results by name.

    `done` shards were finished before and count as progress. A shard that fails does not stop
    the others; raises ShardsFailed at the end. A dead worker process costs a new pool and the
    shards that were under way.
    """
    results: dict[str, Any] = {}
    failures: dict[str, BaseException] = {}
    with progress(stage, done + len(jobs), done=done) as advance:
        for pool in itertools.count(1):
            left = {
                name: parameters
                for name, parameters in jobs.items()
                if name not in results and name not in failures
            }
            if not left or len(failures) >= MOST_FAILURES:
                break
            try:
                with _runner(max_workers, cluster) as runner:
                    under_way = max_workers or (MOST_FLYING if cluster else None)
                    for name, outcome in _outcomes(runner, task, left, under_way):
                        if isinstance(outcome, BaseException):
                            failures[name] = outcome
                            get_run_logger().error("%s: shard %s: %s", stage, name, outcome)
                            if len(failures) >= MOST_FAILURES:
                                break
                        else:
                            results[name] = outcome
                            advance(done + len(results))
            except BrokenProcessPool:
                get_run_logger().warning("%s: a worker process died; pool %d", stage, pool)
                if pool == MOST_POOLS:
                    raise ShardsFailed(
                        f"{stage}: worker processes died {pool} times (out of memory?) with "
                        f"{len(results)} of {len(jobs)} shards made; try fewer max_workers"
                    ) from None
    if failures:
        name, first = next(iter(failures.items()))
        if isinstance(first, ValueError):
            raise first
        raise ShardsFailed(
            f"{stage}: {len(failures)} of {len(jobs)} shards failed, {len(results)} were made; "
            f"first {name}: {type(first).__name__}: {first}"
        ) from first
    return results


def _outcomes(
    runner: TaskRunner[Any],
    task: Task[Any, Any],
    jobs: Mapping[str, dict[str, Any]],
    max_workers: int | None,
) -> Iterator[tuple[str, Any]]:
    """(name, result or the exception) as they come; a bounded number is under way at a time."""
    window = 4 * (max_workers or os.cpu_count() or 1)
    waiting, flying = iter(jobs.items()), dict[PrefectFuture[Any], str]()
    while True:
        for name, parameters in itertools.islice(waiting, window - len(flying)):
            named = task.with_options(task_run_name=name)
            flying[runner.submit(named, parameters)] = name
        if not flying:
            return
        future = next(iter(as_completed(list(flying))))
        name = flying.pop(future)
        future.wait()
        yield name, future.result(raise_on_failure=False)


@contextmanager
def progress(stage: str, total: int, *, done: int = 0) -> Iterator[Callable[[int], None]]:
    """A Prefect progress artifact, log lines and the listener; yields advance(done)."""
    log, start, tell = get_run_logger(), time.monotonic(), listener.get()
    artifact = create_progress_artifact(
        100.0 * done / total if total else 100.0,
        key=f"{stage}-progress",
        description=f"{stage}: {done} of {total} were finished before",
    )
    assert isinstance(artifact, UUID)  # it would be awaitable in an asynchronous flow
    told = start

    def advance(now: int) -> None:
        nonlocal told
        if tell:
            tell(stage, now, total)
        # Each update is a request: often enough to watch, rare enough to cost nothing.
        if now == total or time.monotonic() - told > 5.0:
            told = time.monotonic()
            update_progress_artifact(artifact, 100.0 * now / total)
            log.info("%s: %d of %d (%.0f s)", stage, now, total, told - start)

    if tell:
        tell(stage, done, total)
    yield advance


def announce(dataset: Path, table: str, written: Iterable[str]) -> None:
    """Emit `shards.written` with the names of the new shards; nothing when there are none."""
    names = sorted(written)
    if names:
        emit_event(
            EVENT,
            resource={
                "prefect.resource.id": f"relevance.dataset.{dataset}",
                "prefect.resource.name": dataset.name,
                "relevance.table": table,
            },
            payload={"dataset": str(dataset), "table": table, "shards": len(names)},
        )
