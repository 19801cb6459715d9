"""One task per shard: the worker pool, and the progress.

The shard files say what is finished, so a flow submits only what is missing and a second run
after any kind of death goes on where the first one stopped. What a failed shard or a dead worker
means is `relevance.workers`' to say, for the command line too.
"""

from __future__ import annotations

import atexit
import functools
import itertools
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import UUID

from prefect import Task, get_run_logger
from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.context import FlowRunContext
from prefect.futures import PrefectFuture, as_completed
from prefect.server.api.server import SubprocessASGIServer
from prefect.settings import PREFECT_API_URL, get_current_settings, temporary_settings
from prefect.task_runners import ProcessPoolTaskRunner, TaskRunner, ThreadPoolTaskRunner

from flows.telling import CHECK_FAILED, SHARD_FAILED, trouble
from relevance.pipeline import PlansRefused, do
from relevance.workers import ShardsFailed, gather, prepare_worker

if TYPE_CHECKING:
    from relevance.pipeline import Made, Work

MOST_FLYING = 256
"""Workers of a cluster that are kept busy: four shards each are handed out ahead."""

Listener = Callable[[str, int, int], None]
listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
"""Hears (stage, done, total) in the flow's own process; the command line draws bars with it."""


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
    dataset: Path,
    done: int = 0,
    max_workers: int | None = None,
    cluster: str | None = None,
) -> dict[str, Any]:
    """Run the task once a job (name -> parameters), in any order; results by name.

    `done` shards of the dataset were finished before and count as progress. See
    `relevance.workers.gather` for those that fail.
    """
    outcomes = functools.partial(
        _outcomes, task=task, parameters=dict, max_workers=max_workers, cluster=cluster
    )
    with (
        progress(stage, done + len(jobs), done=done) as advance,
        failures_told(stage, dataset) as warn,
    ):
        return gather(
            stage,
            jobs,
            outcomes,
            made=lambda made: advance(done + made),
            warn=warn,
        )


def run_work(
    task: Task[Any, Any],
    work: Work,
    *,
    stage: str,
    max_workers: int | None,
    cluster: str | None,
) -> Made:
    """Do what is left of a dataset, one task run a job (`job`, its only parameter)."""
    outcomes = functools.partial(
        _outcomes,
        task=task,
        parameters=lambda job: {"job": job},
        max_workers=max_workers,
        cluster=cluster,
    )
    total = work.done + len(work.jobs)
    with (
        progress(stage, total, done=work.done) as advance,
        failures_told(stage, work.root) as warn,
    ):
        return do(
            work,
            outcomes,
            made=lambda made: advance(work.done + made),
            warn=warn,
        )


def _outcomes(
    jobs: Mapping[str, Any],
    *,
    task: Task[Any, Any],
    parameters: Callable[[Any], dict[str, Any]],
    max_workers: int | None,
    cluster: str | None,
) -> Generator[tuple[str, Any], None, None]:
    """(name, result or the exception) as they come; a bounded number is under way at a time."""
    window = 4 * (max_workers or (MOST_FLYING if cluster else os.cpu_count()) or 1)
    waiting, flying = iter(jobs.items()), dict[PrefectFuture[Any], str]()
    with _runner(max_workers, cluster) as runner:
        while True:
            for name, job in itertools.islice(waiting, window - len(flying)):
                named = task.with_options(task_run_name=name)
                flying[runner.submit(named, parameters(job))] = name
            if not flying:
                return
            future = next(iter(as_completed(list(flying))))
            name = flying.pop(future)
            future.wait()
            yield name, future.result(raise_on_failure=False)


@contextmanager
def failures_told(stage: str, dataset: Path) -> Iterator[Callable[[str], None]]:
    """Yields who takes a line about a failed shard; tells of trouble where the block fails."""
    lines = list[str]()

    def warn(line: str) -> None:
        lines.append(line)
        get_run_logger().warning(line)

    try:
        yield warn
    except Exception as error:
        if lines:
            trouble(dataset, SHARD_FAILED, str(error), _listed(lines), stage=stage, shards=lines)
        elif isinstance(error, PlansRefused):  # its shards were made
            trouble(dataset, CHECK_FAILED, str(error), stage=stage)
        raise


def _listed(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


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
