"""Flow `generate`: random scenes, rendered into shards of images and rows."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from flows.head import leave_table, retried, say, stage
from flows.parameters import (
    Cluster,
    DatasetPath,
    DatasetPreset,
    Overrides,
    Workers,
    absolute,
    configured,
)
from flows.shards import process_pool, run_work
from flows.telling import announce

if TYPE_CHECKING:
    from relevance.pipeline import Job, ShardReport


@retried(name="generate-shard")
def generate_one(job: Job) -> ShardReport:
    """Sample, render and write one shard."""
    return job.run()


@stage(process_pool())
def generate(
    dataset: DatasetPath = "data/demo",
    preset: DatasetPreset = "demo",
    overrides: Overrides | None = None,
    max_workers: Workers | None = None,
    cluster: Cluster | None = None,
) -> dict[str, Any]:
    """Make the scenes and images of a dataset; shards that are there are skipped.

    Args:
        dataset: Folder of the dataset, or s3://bucket/prefix; made when it is not there, appended
            to when it is smaller.
        preset: Size and settings: smoke, demo, laptop, crowd, randomised or paper.
        overrides: Settings that differ from the preset, e.g. {"seed": 7}; keys may be dotted.
        max_workers: Processes that work at a time; the number of cores when empty.
        cluster: Address of a Dask scheduler whose workers make the shards instead, each of which
            reaches the dataset (and Prefect's server).
    """
    from relevance.pipeline import DatasetConfig, scenes_work, shards_of
    from relevance.store import Dataset

    root = absolute(dataset)
    work = scenes_work(root, configured(DatasetConfig, preset, overrides))
    made = run_work(generate_one, work, stage="generate", max_workers=max_workers, cluster=cluster)
    specs = shards_of(Dataset.open(root))
    written = {name: report for name, report in made.reports.items() if not report.skipped}
    shards = Counter((spec.split, spec.family) for spec in specs)
    now = Counter((report.spec.split, report.spec.family) for report in written.values())
    rows = [
        {
            "split": split,
            "family": family,
            "shards": count,
            "scenes": sum(s.count for s in specs if (s.split, s.family) == (split, family)),
            "made now": now[split, family],
        }
        for (split, family), count in shards.items()
    ]
    leave_table("generate-shards", rows, f"Scenes of `{root}`")
    announce(root, "scenes", written)
    say("generate: %s", made.summary)
    return {"dataset": str(root), "shards": len(specs), "written": len(written)}
