"""Flow `generate`: random scenes, rendered into shards of images and rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE

from flows.parameters import (
    Cluster,
    DatasetPath,
    Overrides,
    Preset,
    Workers,
    absolute,
    configured,
)
from flows.shards import announce, process_pool, run_shards, worth_retrying

if TYPE_CHECKING:
    from relevance.pipeline import DatasetConfig, ShardReport, ShardSpec


@task(
    name="generate-shard",
    retries=2,
    retry_delay_seconds=[1, 10],
    retry_condition_fn=worth_retrying,
    persist_result=False,
    cache_policy=NO_CACHE,
)
def generate_one(root: str, config: DatasetConfig, spec: ShardSpec) -> ShardReport:
    """Sample, render and write one shard."""
    from relevance.pipeline import generate_shard

    return generate_shard(root, config, spec)


@flow(
    name="generate",
    flow_run_name="generate-{preset}",
    task_runner=process_pool(),
    persist_result=False,
)
def generate(
    dataset: DatasetPath = "data/demo",
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    max_workers: Workers | None = None,
    cluster: Cluster | None = None,
) -> dict[str, Any]:
    """Make the scenes and images of a dataset; shards that are there are skipped.

    Args:
        dataset: Folder of the dataset, or s3://bucket/prefix; made when it is not there, appended
            to when it is smaller.
        preset: Size and settings: smoke, demo, laptop or paper.
        overrides: Settings that differ from the preset, e.g. {"seed": 7}; keys may be dotted.
        max_workers: Processes that work at a time; the number of cores when empty.
        cluster: Address of a Dask scheduler whose workers make the shards instead, each of which
            reaches the dataset (and Prefect's server).
    """
    from relevance.pipeline import DatasetConfig, finish, generated, prepare
    from relevance.store import Dataset

    root = absolute(dataset)
    config = configured(DatasetConfig, preset, overrides)
    specs = prepare(root, config, scenes_only=True)
    there = Dataset.open(root)
    jobs = {
        f"{spec.split}-{spec.shard:06d}": {"root": str(root), "config": config, "spec": spec}
        for spec in specs
        if not generated(there, spec)
    }
    done = len(specs) - len(jobs)
    reports = run_shards(
        generate_one, jobs, stage="generate", done=done, max_workers=max_workers, cluster=cluster
    )
    finish(root)
    rows = [
        {
            "split": split,
            "family": family,
            "shards": len(mine),
            "scenes": sum(spec.count for spec in mine),
            "made now": sum(
                f"{spec.split}-{spec.shard:06d}" in reports
                and not reports[f"{spec.split}-{spec.shard:06d}"].skipped
                for spec in mine
            ),
        }
        for split, family in dict.fromkeys((spec.split, spec.family) for spec in specs)
        for mine in [[s for s in specs if (s.split, s.family) == (split, family)]]
    ]
    create_table_artifact(rows, key="generate-shards", description=f"Scenes of `{root}`")
    written = [name for name, report in reports.items() if not report.skipped]
    announce(root, "scenes", written)
    get_run_logger().info("generate: %d shards made, %d were there", len(written), done)
    return {"dataset": str(root), "shards": len(specs), "written": len(written)}
