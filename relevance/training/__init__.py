"""Training: polling over the predicates' datasets, checkpoints that survive a kill, metrics.

What is unusual here:

- What a step learns from is a pure function of (seed, step), so a run that was killed and started
  again ends with the same weights as one that was not; there is no sampler state to save.
- Scenes come from the shards when they are needed and are decoded by worker processes; no more of
  a dataset is in memory than what is shuffled.
- Polling is strict: the predicates take turns p0, p1, ... as in the paper. The same-plane
  predicates label the same scenes: these are decoded once for all their turns, which may share
  one encoding, too (`share_encodings`); the order of turns is the same either way.
- Two exact symmetries of the task enlarge a small dataset: a scene in the mirror swaps
  `on-the-left` and `on-the-right`, and exchanging colour channels changes no geometry.
"""

from relevance.networks import (
    CHECKPOINT_VERSION,
    CheckpointError,
    age,
    find_checkpoint,
    shipped,
)
from relevance.training.budget import one_core, steps_within
from relevance.training.catalogue import Catalogue
from relevance.training.checkpoints import (
    checkpoint_id,
    load_checkpoint,
    pick_device,
    save_checkpoint,
    write_row,
)
from relevance.training.examples import Answer, Batch, Example, batch_of
from relevance.training.looking import Looks, compare_looks, graphs_of
from relevance.training.losses import batch_loss, relevance_loss
from relevance.training.polling import polling
from relevance.training.ranks import Ranks
from relevance.training.reading import Reader, TrainingError
from relevance.training.settings import TRAINER_VERSION, TrainConfig
from relevance.training.shipping import ship
from relevance.training.speed import Speed, measure_speed
from relevance.training.studies import RECIPES, STUDIES, Run, Study
from relevance.training.studying import Plan, run_study
from relevance.training.trainer import (
    Judged,
    Trainer,
    continued,
    judged,
    measure,
    metrics_of,
    precision,
    train,
    use_bfloat16,
)

__all__ = [
    "CHECKPOINT_VERSION",
    "RECIPES",
    "STUDIES",
    "TRAINER_VERSION",
    "Answer",
    "Batch",
    "Catalogue",
    "CheckpointError",
    "Example",
    "Judged",
    "Looks",
    "Plan",
    "Ranks",
    "Reader",
    "Run",
    "Speed",
    "Study",
    "TrainConfig",
    "Trainer",
    "TrainingError",
    "age",
    "batch_loss",
    "batch_of",
    "checkpoint_id",
    "compare_looks",
    "continued",
    "find_checkpoint",
    "graphs_of",
    "judged",
    "load_checkpoint",
    "measure",
    "measure_speed",
    "metrics_of",
    "one_core",
    "pick_device",
    "polling",
    "precision",
    "relevance_loss",
    "run_study",
    "save_checkpoint",
    "ship",
    "shipped",
    "steps_within",
    "train",
    "use_bfloat16",
    "write_row",
]
