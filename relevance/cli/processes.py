"""Units of work on the processes of this machine, with one progress bar."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from relevance.cli.arguments import check_workers
from relevance.cli.terminal import bar, say
from relevance.workers import Outcomes, prepare_worker

if TYPE_CHECKING:
    from relevance.pipeline import Made, Work


class Unit(Protocol):
    """A unit of work of that many steps; `run` calls progress(done, total)."""

    @property
    def size(self) -> int: ...

    @property
    def run(self) -> Callable[[Callable[[int, int], None]], Any]: ...


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


@contextmanager
def processes(what: str, total: int, n: int) -> Iterator[Outcomes[Unit]]:
    """Yields what runs units of work on n fresh processes; the bar fills up to `total` steps."""
    check_workers(n)
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)
    with bar(what) as progress:

        def outcomes(units: Mapping[str, Unit]) -> Generator[tuple[str, Any], None, None]:
            most = min(n, len(units))
            pool = ProcessPoolExecutor(most, context, initializer=_prepare, initargs=(counter,))
            try:
                waiting = {pool.submit(_run, unit): name for name, unit in units.items()}
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
                for process in list((pool._processes or {}).values()):
                    process.terminate()
                raise
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

        yield outcomes


def _broke(future: Future[Any]) -> bool:
    return isinstance(future.exception(), BrokenProcessPool)


def make(what: str, work: Work, n: int) -> Made:
    """Do the work on n processes, as the flows do it on theirs."""
    # Here and not above: `relevance --help` reads this file and loads no pyarrow.
    from relevance.pipeline import do

    total = sum(job.size for job in work.jobs)
    with processes(what, total, n) as outcomes:
        return do(work, outcomes, warn=say)
