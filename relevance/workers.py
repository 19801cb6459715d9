"""Worker processes: how one starts and ends, and how many units of work become one result.

The flows have a pool of their own; what a failed unit or a dead process means is said here for
all.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import threading
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from multiprocessing import connection, parent_process
from typing import Any, Protocol, TypeVar

from relevance.errors import RelevanceError

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
MOST_FAILURES = 5
"""No more units of work are handed out once this many have failed for good."""
MOST_POOLS = 3
"""How often a pool whose worker died (out of memory, say) is replaced."""

J = TypeVar("J")
Outcomes = Callable[[Mapping[str, J]], Generator[tuple[str, Any], None, None]]
"""Runs units of work in a fresh pool; yields each one's name and its result or exception."""


class ShardsFailed(RelevanceError):
    """Some shards could not be made, for want of space, memory or right input; the others stay."""


def prepare_worker() -> None:
    """Run first in each worker process: one thread for arrays, and no life without the parent.

    A worker holds both ends of its queue, so it would wait for ever when its parent is killed.
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


class Unit(Protocol):
    """A unit of work of that many steps; `run` calls progress(done, total)."""

    @property
    def size(self) -> int: ...

    @property
    def run(self) -> Callable[[Callable[[int, int], None]], Any]: ...


def pool(
    n: int, total: int = 0, progress: Callable[[int, int], None] = lambda done, total: None
) -> Outcomes[Unit]:
    """What runs units of work on n fresh processes; `progress` hears how many steps of `total`
    they did together."""
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)

    def outcomes(units: Mapping[str, Unit]) -> Generator[tuple[str, Any], None, None]:
        most = min(n, len(units))
        executor = ProcessPoolExecutor(most, context, initializer=_prepare, initargs=(counter,))
        try:
            waiting = {executor.submit(_run, unit): name for name, unit in units.items()}
            while waiting:
                ended, _ = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
                progress(counter.value, total)
                for future in sorted(ended, key=_broke):
                    if _broke(future):
                        future.result()
                    yield waiting.pop(future), future.exception() or future.result()
        except GeneratorExit:
            raise  # enough have failed; what is under way may finish
        except BaseException:
            # Nothing half-made can pass for a shard: a file appears by a rename at the end.
            for process in list((executor._processes or {}).values()):
                process.terminate()
            raise
        finally:
            executor.shutdown(wait=True, cancel_futures=True)

    return outcomes


_done: Any = None
"""In a worker process: how many steps the workers have done together."""


def _prepare(counter: Any) -> None:
    global _done
    _done = counter
    prepare_worker()


def _run(unit: Unit) -> Any:
    told = 0

    def progress(done: int, total: int) -> None:
        nonlocal told
        with _done.get_lock():
            _done.value += done - told
        told = done

    report = unit.run(progress)
    progress(unit.size, unit.size)
    return report


def _broke(future: Future[Any]) -> bool:
    return isinstance(future.exception(), BrokenProcessPool)


def gather(
    stage: str,
    jobs: Mapping[str, J],
    outcomes: Outcomes[J],
    *,
    made: Callable[[int], None],
    warn: Callable[[str], None],
    unit: str = "shard",
) -> dict[str, Any]:
    """Results of all units of work by name; `made` hears how many there are so far.

    One that fails does not stop the others. A dead worker process costs a new pool and what was
    under way. Raises ShardsFailed when a user can mend what failed, else the error itself.
    """
    results: dict[str, Any] = {}
    failures: dict[str, BaseException] = {}
    for pool in itertools.count(1):
        left = {
            name: job for name, job in jobs.items() if name not in results and name not in failures
        }
        if not left or len(failures) >= MOST_FAILURES:
            break
        try:
            with closing(outcomes(left)) as coming:
                for name, outcome in coming:
                    if not isinstance(outcome, BaseException):
                        results[name] = outcome
                        made(len(results))
                        continue
                    failures[name] = outcome
                    warn(f"{stage}: {unit} {name}: {type(outcome).__name__}: {outcome}")
                    if len(failures) >= MOST_FAILURES:
                        break
        except BrokenProcessPool:
            warn(f"{stage}: a worker process died; pool {pool}")
            if pool == MOST_POOLS:
                raise ShardsFailed(
                    f"{stage}: worker processes died {pool} times (out of memory?) with "
                    f"{len(results)} of {len(jobs)} {unit}s made; try fewer at a time"
                ) from None
    if failures:
        raise _failure(stage, failures, f"{len(failures)} of {len(jobs)} {unit}s", len(results))
    return results


def _failure(
    stage: str, failures: Mapping[str, BaseException], failed: str, made: int
) -> BaseException:
    summary = f"{stage}: {failed} failed, {made} were made"
    for name, error in failures.items():
        if not isinstance(error, OSError | RelevanceError):
            error.add_note(f"{summary}; this is {name}")
            return error
    name, first = next(iter(failures.items()))
    kind = "" if isinstance(first, RelevanceError) else f"{type(first).__name__}: "
    error = ShardsFailed(f"{summary}; first {name}: {kind}{first}")
    error.__cause__ = first
    return error
