"""Making a dataset: its settings and shards, how they are made, kept, merged and estimated."""

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
    shards_of,
    work,
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

__all__ = [
    "ATTEMPTS",
    "LAYOUT",
    "Counts",
    "DatasetConfig",
    "Estimate",
    "Quantities",
    "ShardReport",
    "ShardSpec",
    "actual",
    "append",
    "describe",
    "draw",
    "estimate",
    "finish",
    "generate_shard",
    "generated",
    "integrity",
    "label_shard",
    "labelled",
    "load_config",
    "merge",
    "prepare",
    "repair",
    "shards_of",
    "work",
]
