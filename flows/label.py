"""Flow `label`: plan the goals of stored scenes and read relevance off the plans."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

from flows.head import announce, leave_table, retried, say, stage
from flows.parameters import Cluster, DatasetPath, Overrides, Workers, absolute
from flows.shards import process_pool, run_work

if TYPE_CHECKING:
    from relevance.pipeline import Job, ShardReport


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
    from relevance.store import sql

    root = absolute(dataset)
    work = labels_work(
        root, predicates=predicates, policy=policy, replan=replan, overrides=overrides
    )
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
            "core seconds": round(
                sum(
                    r.seconds for r in reports if (r.predicate, r.spec.split) == (predicate, split)
                ),
                1,
            ),
        }
        for predicate, split, tasks, holds in totals
        if predicate in (predicates or PREDICATES)
    ]
    leave_table("label-shards", rows, f"Plans of `{root}`")
    announce(root, "labels", made.reports)
    say("label: %s", made.summary)
    return {
        "dataset": str(root),
        "shards": work.done + len(work.jobs),
        "written": len(made.reports),
        "tasks": sum(row["tasks"] for row in rows),
        "holds": sum(row["plans that hold"] for row in rows),
    }
