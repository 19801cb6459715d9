"""Units of work on the processes of this machine, with one progress bar."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from relevance.cli.arguments import check_workers
from relevance.cli.terminal import bar, say
from relevance.workers import Outcomes, Unit, pool

if TYPE_CHECKING:
    from relevance.pipeline import Made, Work


@contextmanager
def processes(what: str, total: int, n: int) -> Iterator[Outcomes[Unit]]:
    """Yields what runs units of work on n fresh processes; the bar fills up to `total` steps."""
    check_workers(n)
    with bar(what) as progress:
        yield pool(n, total, progress)


def pools(n: int) -> Callable[[str, int], Outcomes[Unit]]:
    """Makes pools of n processes, of what is done and how many steps it has."""
    check_workers(n)

    def made(what: str, total: int) -> Outcomes[Unit]:
        def outcomes(units: Mapping[str, Unit]) -> Generator[tuple[str, Any], None, None]:
            with processes(what, total, n) as own:
                yield from own(units)

        return outcomes

    return made


def make(what: str, work: Work, n: int) -> Made:
    """Do the work on n processes, as the flows do it on theirs."""
    # Here and not above: `relevance --help` reads this file and loads no pyarrow.
    from relevance.pipeline import do

    total = sum(job.size for job in work.jobs)
    with processes(what, total, n) as outcomes:
        return do(work, outcomes, warn=say)
