"""Flow `label`: plan the goals of stored scenes and read relevance off the plans."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE

from flows.parameters import DatasetPath, Overrides, ParameterError, Workers, absolute, override
from flows.shards import announce, process_pool, run_shards, worth_retrying

if TYPE_CHECKING:
    from relevance.generation import DatasetConfig, ShardReport, ShardSpec


@task(
    name="label-shard",
    retries=2,
    retry_delay_seconds=[1, 10],
    retry_condition_fn=worth_retrying,
    persist_result=False,
    cache_policy=NO_CACHE,
)
def label_one(root: str, config: DatasetConfig, spec: ShardSpec, predicate: str) -> ShardReport:
    """Plan, replay and label the goals of one predicate in one shard."""
    from relevance.generation import label_shard

    return label_shard(root, config, spec, predicate)


@flow(name="label", task_runner=process_pool(), persist_result=False)
def label(
    dataset: DatasetPath = "data/demo",
    predicates: list[str] | None = None,
    overrides: Overrides | None = None,
    max_workers: Workers | None = None,
) -> dict[str, Any]:
    """Plan and label the goals of a dataset's scenes; nothing is rendered.

    Args:
        dataset: Folder of a dataset whose scenes were generated.
        predicates: Which ones; all of them when empty.
        overrides: Other planning settings than before, e.g. {"planner.max_actions": 4}: then plans
            and labels are made anew, scenes and images stay as they are.
        max_workers: Processes that work at a time; the number of cores when empty.
    """
    from relevance.generation import load_config, prepare
    from relevance.scene import Predicate
    from relevance.store import Dataset

    known = [predicate.value for predicate in Predicate]
    for name in predicates or ():
        if name not in known:
            raise ParameterError(f"predicates: unknown {name!r}, expected {', '.join(known)}")
    root = absolute(dataset)
    there = Dataset.open(root)
    config = override(load_config(there), overrides or {})
    specs = prepare(root, config, replan=bool(overrides))
    jobs = {
        f"{predicate.value}-{spec.split}-{spec.shard:06d}": {
            "root": str(root),
            "config": config,
            "spec": spec,
            "predicate": predicate.value,
        }
        for spec in specs
        if there.has("scenes", split=spec.split, shard=spec.shard)
        for predicate in spec.predicates
        if predicate.value in (predicates or known)
    }
    if not jobs:
        raise ParameterError(f"{root}: no scenes of these predicates, expected `generate` first")
    reports = run_shards(label_one, jobs, stage="label", max_workers=max_workers)
    rows = [
        {
            "predicate": predicate,
            "split": split,
            "shards": len(mine),
            "tasks": sum(report.rows for report in mine),
            "plans that hold": sum(report.holds for report in mine),
            "made now": sum(not report.skipped for report in mine),
            "core seconds": round(sum(r.seconds for r in mine if not r.skipped), 1),
        }
        for predicate, split in dict.fromkeys(
            (report.predicate, report.spec.split) for report in reports.values()
        )
        for mine in [
            [r for r in reports.values() if (r.predicate, r.spec.split) == (predicate, split)]
        ]
    ]
    rows.sort(key=lambda row: (row["predicate"], row["split"]))
    create_table_artifact(rows, key="label-shards", description=f"Plans of `{root}`")
    written = [name for name, report in reports.items() if not report.skipped]
    announce(root, "labels", written)
    done = len(jobs) - len(written)
    get_run_logger().info("label: %d shards made, %d were there", len(written), done)
    return {
        "dataset": str(root),
        "shards": len(jobs),
        "written": len(written),
        "tasks": sum(report.rows for report in reports.values()),
        "holds": sum(report.holds for report in reports.values()),
    }
