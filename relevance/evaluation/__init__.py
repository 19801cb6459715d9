"""What a checkpoint is worth: its accuracy, and the planner rerun with and without it.

beta (CONTRIBUTING, The words): an object is kept iff score > -beta; goal objects are always kept.
A checkpoint's offset is part of every score here, so that beta = 0 is what validation chose.
"""

from relevance.evaluation.accuracies import (
    BREAKDOWNS,
    JUDGES,
    NETWORK,
    RULE,
    Predictions,
    accuracy_table,
    breakdown_table,
    in_group,
    read_predictions,
)
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
from relevance.evaluation.predictions import policy_of_checkpoint, predict, unjudged
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
from relevance.evaluation.working_points import SweptTask, WorkingPoint, saved, swept, working_point

__all__ = [
    "BREAKDOWNS",
    "JUDGES",
    "NETWORK",
    "RULE",
    "Comparison",
    "EvaluationConfig",
    "EvaluationError",
    "NetworkScorer",
    "Predictions",
    "SweptTask",
    "Task",
    "WorkingPoint",
    "accuracy_table",
    "breakdown_table",
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
    "saved",
    "settings",
    "shown_as",
    "speed_table",
    "summarise",
    "swept",
    "unjudged",
    "working_point",
]
