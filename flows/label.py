"""Flow `label`: plan the goals of stored scenes and read relevance off the plans."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE

from flows.parameters import (
    Cluster,
    DatasetPath,
    Overrides,
    ParameterError,
    Workers,
    absolute,
    override,
)
from flows.shards import announce, process_pool, run_shards, worth_retrying

if TYPE_CHECKING:
    from relevance.pipeline import DatasetConfig, ShardReport, ShardSpec


@task(
    name="label-shard",
    retries=2,
    retry_delay_seconds=[1, 10],
    retry_condition_fn=worth_retrying,
    persist_result=False,
    cache_policy=NO_CACHE,
)
def label_one(
    root: str, config: DatasetConfig, spec: ShardSpec, predicate: str, policy: str | None
) -> ShardReport:
    """Plan, replay and label the goals of one predicate in one shard."""
    from relevance.pipeline import label_shard

    return label_shard(root, config, spec, predicate, policy=policy)


@flow(name="label", task_runner=process_pool(), persist_result=False)
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
    from relevance.labels import POLICIES
    from relevance.pipeline import finish, labelled, load_config, prepare
    from relevance.scene import PREDICATES
    from relevance.store import Dataset, sql

    known = list(PREDICATES)
    for name in predicates or ():
        if name not in known:
            raise ParameterError(f"predicates: unknown {name!r}, expected {', '.join(known)}")
    if policy is not None and policy not in POLICIES:
        raise ParameterError(f"policy: unknown {policy!r}, expected {', '.join(POLICIES)}")
    root = absolute(dataset)
    there = Dataset.open(root)
    config = override(load_config(there), overrides or {})
    specs = prepare(root, config, replan=replan or bool(overrides))
    jobs = {
        f"{predicate.name}-{spec.split}-{spec.shard:06d}": {
            "root": str(root),
            "config": config,
            "spec": spec,
            "predicate": predicate.name,
            "policy": policy,
        }
        for spec in specs
        if there.has("scenes", split=spec.split, shard=spec.shard)
        for predicate in spec.predicates
        if predicate.name in (predicates or known)
    }
    if not jobs:
        raise ParameterError(f"{root}: no scenes of these predicates, expected `generate` first")
    missing = {
        name: job
        for name, job in jobs.items()
        if not labelled(there, config, job["spec"], job["predicate"], policy)
    }
    done = len(jobs) - len(missing)
    reports = run_shards(
        label_one, missing, stage="label", done=done, max_workers=max_workers, cluster=cluster
    )
    finish(root)
    _, totals = sql(
        root,
        "select predicate, split, count(*), count_if(holds) from plans group by all order by all",
    )
    rows = [
        {
            "predicate": predicate,
            "split": split,
            "tasks": tasks,
            "plans that hold": holds,
            "shards": sum((j["predicate"], j["spec"].split) == mine for j in jobs.values()),
            "made now": sum((r.predicate, r.spec.split) == mine for r in reports.values()),
            "core seconds": round(
                sum(r.seconds for r in reports.values() if (r.predicate, r.spec.split) == mine), 1
            ),
        }
        for predicate, split, tasks, holds in totals
        for mine in [(predicate, split)]
        if predicate in (predicates or known)
    ]
    create_table_artifact(rows, key="label-shards", description=f"Plans of `{root}`")
    announce(root, "labels", reports)
    get_run_logger().info("label: %d shards made, %d were there", len(reports), done)
    return {
        "dataset": str(root),
        "shards": len(jobs),
        "written": len(reports),
        "tasks": sum(row["tasks"] for row in rows),
        "holds": sum(row["plans that hold"] for row in rows),
    }
