"""Making a dataset: its settings and shards, how they are made, kept, merged and estimated."""

from relevance.pipeline.doing import Made, do
from relevance.pipeline.estimating import Estimate, Quantities, actual, estimate
from relevance.pipeline.merging import merge
from relevance.pipeline.settings import (
    LAYOUT,
    Counts,
    DatasetConfig,
    ShardReport,
    ShardSpec,
    append,
    describe,
    load_config,
    prepare,
    shard_specs,
    shards_of,
)
from relevance.pipeline.shards import (
    ATTEMPTS,
    draw,
    generate_shard,
    generated,
    label_shard,
    labelled,
)
from relevance.pipeline.upkeep import finish, integrity, repair
from relevance.pipeline.work import Job, Work, labels_work, missing, scenes_work

__all__ = [
    "ATTEMPTS",
    "LAYOUT",
    "Counts",
    "DatasetConfig",
    "Estimate",
    "Job",
    "Made",
    "Quantities",
    "ShardReport",
    "ShardSpec",
    "Work",
    "actual",
    "append",
    "describe",
    "do",
    "draw",
    "estimate",
    "finish",
    "generate_shard",
    "generated",
    "integrity",
    "label_shard",
    "labelled",
    "labels_work",
    "load_config",
    "merge",
    "missing",
    "prepare",
    "repair",
    "scenes_work",
    "shard_specs",
    "shards_of",
]
