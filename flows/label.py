"""Flow `label`: plan the goals of stored scenes and read relevance off the plans."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

from flows.head import leave_table, retried, say, stage
from flows.parameters import Cluster, DatasetPath, Overrides, Workers, absolute
from flows.shards import process_pool, run_work
from flows.telling import LABELS_SHIFTED, announce, trouble

if TYPE_CHECKING:
    from collections.abc import Collection

    from relevance.pipeline import Job, ShardReport
    from relevance.store import Dataset, Labelling


@retried(name="label-shard")
def label_one(job: Job) -> ShardReport:
    """Plan, replay and label the goals of one predicate in one shard."""
    return job.run()


@stage(process_pool())
def label(
    dataset: DatasetPath = "data/demo",
    predicates: list[str] | None = None,
    overrides: Overrides | None = None,
    policy: str | None = None,
    replan: bool = False,
    max_workers: Workers | None = None,
    cluster: Cluster | None = None,
) -> dict[str, Any]:
    """Plan and label the goals of a dataset's scenes; nothing is rendered.

    Args:
        dataset: Folder of a dataset whose scenes were generated, or s3://bucket/prefix.
        predicates: Which ones; all of them when empty.
        overrides: Other planning settings than before, e.g. {"planner.max_actions": 4} or
            {"goals_seed": 1}: then plans and labels are made anew, the old ones stay beside them,
            scenes and images stay as they are.
        policy: found, necessary or any-minimal; labels of another policy than the dataset's own
            lie beside those.
        replan: Plan anew with the planner of today, if that is another one.
        max_workers: Processes that work at a time; the number of cores when empty.
        cluster: Address of a Dask scheduler whose workers make the shards instead, each of which
            reaches the dataset (and Prefect's server).
    """
    from relevance.pipeline import labels_work
    from relevance.scene import PREDICATES
    from relevance.store import Dataset, sql

    root = absolute(dataset)
    work = labels_work(
        root, predicates=predicates, policy=policy, replan=replan, overrides=overrides
    )
    before = Dataset.open(root).labelling
    made = run_work(label_one, work, stage="label", max_workers=max_workers, cluster=cluster)
    _, totals = sql(
        root,
        "select predicate, split, count(*), count_if(holds) from plans group by all order by all",
    )
    reports = made.reports.values()
    now = Counter((report.predicate, report.spec.split) for report in reports)
    seconds = defaultdict[tuple[str | None, str], float](float)
    for report in reports:
        seconds[report.predicate, report.spec.split] += report.seconds
    rows = [
        {
            "predicate": predicate,
            "split": split,
            "tasks": tasks,
            "plans that hold": holds,
            "made now": now[predicate, split],
            "seconds of a worker": round(seconds[predicate, split], 1),
        }
        for predicate, split, tasks, holds in totals
        if predicate in (predicates or PREDICATES)
    ]
    leave_table("label-shards", rows, f"Plans of `{root}`")
    shifts = shifted(Dataset.open(root), before, reports, policy) if made.reports else []
    if shifts:
        lines = [f"- {line}" for line in shifts]
        trouble(root, LABELS_SHIFTED, shifts[0], "\n".join(lines), shifts=shifts)
    announce(root, "labels", made.reports)
    say("label: %s", made.summary)
    return {
        "dataset": str(root),
        "shards": work.done + len(work.jobs),
        "written": len(made.reports),
        "tasks": sum(row["tasks"] for row in rows),
        "holds": sum(row["plans that hold"] for row in rows),
    }


def shifted(
    dataset: Dataset,
    before: Labelling | None,
    reports: Collection[ShardReport],
    policy: str | None,
) -> list[str]:
    """A line for each predicate whose share of relevant objects shifted with these shards.

    What was planned anew is held against its scenes' plans before, once it has taken their place;
    else it is held against the other shards.
    """
    from relevance.pipeline import balances, balances_between, pending

    if pending(dataset) is not None and policy is None:
        return []
    if before is not None and policy is None and dataset.labelling != before:
        found = balances_between(dataset, before)
    else:
        new = [(str(report.predicate), report.spec.split, report.spec.shard) for report in reports]
        found = balances(dataset, new, policy)
    return [str(balance) for balance in found if balance.shifted]
