"""What a checkpoint is worth: its accuracy, and the planner rerun with and without it.

beta (CONTRIBUTING, The words): an object is kept iff score > -beta; goal objects are always kept.
"""

from relevance.evaluation.comparisons import (
    Comparison,
    guided_cost,
    left_out,
    read_evaluations,
    settings,
    shown_as,
    speed_table,
    summarise,
)
from relevance.evaluation.predictions import (
    Predictions,
    in_group,
    policy_of_checkpoint,
    predict,
    read_predictions,
    unjudged,
)
from relevance.evaluation.reruns import (
    EvaluationConfig,
    Task,
    choose_tasks,
    compare,
    evaluate,
)
from relevance.evaluation.scorer import (
    EvaluationError,
    NetworkScorer,
    checkpoint_id,
    load_guide,
    load_scorer,
)

__all__ = [
    "Comparison",
    "EvaluationConfig",
    "EvaluationError",
    "NetworkScorer",
    "Predictions",
    "Task",
    "checkpoint_id",
    "choose_tasks",
    "compare",
    "evaluate",
    "guided_cost",
    "in_group",
    "left_out",
    "load_guide",
    "load_scorer",
    "policy_of_checkpoint",
    "predict",
    "read_evaluations",
    "read_predictions",
    "settings",
    "shown_as",
    "speed_table",
    "summarise",
    "unjudged",
]
