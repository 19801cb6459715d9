"""Doing the work that is left of a dataset: one way for the command line and the flows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from relevance.pipeline.settings import ShardReport
from relevance.pipeline.work import Job, Work
from relevance.store import sweep
from relevance.workers import Outcomes, gather


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """What became of the work."""

    work: Work
    reports: dict[str, ShardReport]
    """By the name of the job."""

    @property
    def summary(self) -> str:
        """One line for people."""
        waiting = self.work.waiting
        text = f"{len(self.reports)} shards made, {self.work.done} were there"
        return f"{text}, {waiting} wait for their scenes" if waiting else text


def do(
    work: Work,
    outcomes: Outcomes[Job],
    *,
    made: Callable[[int], None] = lambda _: None,
    warn: Callable[[str], None],
) -> Made:
    """Run the jobs (see `relevance.workers.gather`), sweep up, note what is finished."""
    jobs = {job.name: job for job in work.jobs}
    try:
        stage = work.jobs[0].stage if work.jobs else ""
        reports = gather(stage, jobs, outcomes, made=made, warn=warn)
    finally:
        sweep(work.root)
    work.finish()
    return Made(work=work, reports=reports)
