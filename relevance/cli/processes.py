"""Many units of work on many processes, with one progress bar."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from relevance.cli.terminal import UsageError, bar

Job = tuple[Callable[..., Any], tuple[Any, ...]]
"""A stage and its arguments; it is called as stage(*arguments, progress)."""

_done: Any = None
"""In a worker process: how many units of work the workers have done together."""


def _prepare_worker(counter: Any) -> None:
    global _done
    _done = counter
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _run_job(job: Job, size: int) -> Any:
    stage, arguments = job
    told = 0

    def progress(done: int, total: int) -> None:
        nonlocal told
        with _done.get_lock():
            _done.value += done - told
        told = done

    report = stage(*arguments, progress)
    progress(size, size)
    return report


def in_processes(
    what: str,
    jobs: Sequence[Job],
    sizes: Sequence[int],
    n: int,
) -> list[Any]:
    """Run stage(*arguments, progress) for each job on n processes; results in order."""
    if n < 1:
        raise UsageError(f"--workers {n}: expected at least 1")
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)
    pool = ProcessPoolExecutor(
        min(n, len(jobs)) or 1, context, initializer=_prepare_worker, initargs=(counter,)
    )
    try:
        futures = [pool.submit(_run_job, job, size) for job, size in zip(jobs, sizes, strict=True)]
        with bar(what) as progress:
            left = set(futures)
            while left:
                finished, left = wait(left, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in finished:
                    future.result()
                progress(counter.value, sum(sizes))
        return [future.result() for future in futures]
    except BaseException:
        # Nothing half-made can pass for a shard: a file appears by a rename at the end.
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def make_shards(dataset: Path, jobs: Sequence[Job], sizes: Sequence[int], n: int) -> None:
    """Run jobs that write a dataset's shards; those cut short leave no temporary file."""
    # Here and not above: `relevance --help` reads this file and loads no pyarrow.
    from relevance.store import locate, sweep

    try:
        in_processes("scenes", jobs, sizes, n)
    finally:
        sweep(locate(dataset))
