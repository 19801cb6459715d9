"""Making a dataset: its settings and shards, how they are made, kept, merged and estimated."""

from relevance.generation.estimating import Estimate, Quantities, actual, estimate
from relevance.generation.merging import merge
from relevance.generation.settings import (
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
from relevance.generation.shards import (
    ATTEMPTS,
    draw,
    generate_shard,
    generated,
    label_shard,
    labelled,
)
from relevance.generation.upkeep import finish, integrity, repair

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
