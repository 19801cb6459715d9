"""Training: polling over the predicates' datasets, checkpoints that survive a kill, metrics.

What is unusual here:

- The batch of a step is a pure function of (seed, step), so a run that was killed and started
  again ends with the same weights as one that was not; there is no sampler state to save.
- Polling is strict: the predicates take turns p0, p1, ... as in the paper. The same-plane
  predicates label the same scenes, so their consecutive turns may share one encoding
  (`share_encodings`); the order of turns is the same either way.
- Two exact symmetries of the task enlarge a small dataset: a scene in the mirror swaps
  `on-the-left` and `on-the-right`, and exchanging colour channels changes no geometry.
"""

from relevance.training.checkpoints import (
    CHECKPOINT_VERSION,
    CheckpointError,
    age,
    checkpoint_id,
    find_checkpoint,
    load_checkpoint,
    newest_checkpoint,
    pick_device,
    save_checkpoint,
    shipped,
    write_row,
)
from relevance.training.examples import (
    Batch,
    Examples,
    draw_batch,
    draw_batches,
    load_examples,
    polling,
)
from relevance.training.losses import batch_loss, relevance_loss
from relevance.training.settings import TRAINER_VERSION, TrainConfig
from relevance.training.shipping import ship
from relevance.training.speed import Speed, measure_speed
from relevance.training.trainer import Trainer, TrainingError, measure, train, use_bfloat16

__all__ = [
    "CHECKPOINT_VERSION",
    "TRAINER_VERSION",
    "Batch",
    "CheckpointError",
    "Examples",
    "Speed",
    "TrainConfig",
    "Trainer",
    "TrainingError",
    "age",
    "batch_loss",
    "checkpoint_id",
    "draw_batch",
    "draw_batches",
    "find_checkpoint",
    "load_checkpoint",
    "load_examples",
    "measure",
    "measure_speed",
    "newest_checkpoint",
    "pick_device",
    "polling",
    "relevance_loss",
    "save_checkpoint",
    "ship",
    "shipped",
    "train",
    "use_bfloat16",
    "write_row",
]
