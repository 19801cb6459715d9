"""Making a dataset: its settings and shards, how they are made, kept, merged and estimated."""

from relevance.pipeline.doing import Made, do
from relevance.pipeline.estimating import Estimate, Quantities, actual, estimate
from relevance.pipeline.labelling import label_shard, labelled
from relevance.pipeline.merging import merge
from relevance.pipeline.mining import Mined, MiningConfig, minable, mine, mined_of
from relevance.pipeline.preparing import append, describe, pending, prepare
from relevance.pipeline.scenes import ATTEMPTS, draw, generate_shard, generated
from relevance.pipeline.settings import (
    Counts,
    DatasetConfig,
    ShardReport,
    ShardSpec,
    fitting_preset,
    load_config,
    shard_specs,
    shards_of,
)
from relevance.pipeline.shifting import Balance, balances, balances_between
from relevance.pipeline.upkeep import REFUSED_LEAST, REFUSED_SHARE, finish, integrity
from relevance.pipeline.work import (
    Job,
    PlansRefused,
    Work,
    beyond_repair,
    labels_work,
    missing,
    scenes_work,
)

__all__ = [
    "ATTEMPTS",
    "REFUSED_LEAST",
    "REFUSED_SHARE",
    "Balance",
    "Counts",
    "DatasetConfig",
    "Estimate",
    "Job",
    "Made",
    "Mined",
    "MiningConfig",
    "PlansRefused",
    "Quantities",
    "ShardReport",
    "ShardSpec",
    "Work",
    "actual",
    "append",
    "balances",
    "balances_between",
    "beyond_repair",
    "describe",
    "do",
    "draw",
    "estimate",
    "finish",
    "fitting_preset",
    "generate_shard",
    "generated",
    "integrity",
    "label_shard",
    "labelled",
    "labels_work",
    "load_config",
    "merge",
    "minable",
    "mine",
    "mined_of",
    "missing",
    "pending",
    "prepare",
    "scenes_work",
    "shard_specs",
    "shards_of",
]
