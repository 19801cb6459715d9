"""Worker processes: how one starts and ends, and how many units of work become one result.

The command line and the flows have pools of their own; what a failed unit or a dead process
means is said here for both.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Generator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from multiprocessing import connection, parent_process
from typing import Any, TypeVar

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


def gather(
    stage: str,
    jobs: Mapping[str, J],
    outcomes: Outcomes[J],
    *,
    made: Callable[[int], None],
    warn: Callable[[str], None],
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
                    warn(f"{stage}: shard {name}: {type(outcome).__name__}: {outcome}")
                    if len(failures) >= MOST_FAILURES:
                        break
        except BrokenProcessPool:
            warn(f"{stage}: a worker process died; pool {pool}")
            if pool == MOST_POOLS:
                raise ShardsFailed(
                    f"{stage}: worker processes died {pool} times (out of memory?) with "
                    f"{len(results)} of {len(jobs)} shards made; try fewer at a time"
                ) from None
    if failures:
        raise _failure(stage, failures, made=len(results), of=len(jobs))
    return results


def _failure(
    stage: str, failures: Mapping[str, BaseException], *, made: int, of: int
) -> BaseException:
    summary = f"{stage}: {len(failures)} of {of} shards failed, {made} were made"
    for name, error in failures.items():
        if not isinstance(error, OSError | RelevanceError):
            error.add_note(f"{summary}; this is {name}")
            return error
    name, first = next(iter(failures.items()))
    kind = "" if isinstance(first, RelevanceError) else f"{type(first).__name__}: "
    failed = ShardsFailed(f"{summary}; first {name}: {kind}{first}")
    failed.__cause__ = first
    return failed
