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
    amortised_costs,
    guided_cost,
    left_out,
    oracle_cost,
    read_evaluations,
    rerun_priors,
    settings,
    shown_as,
    speed_table,
    summarise,
    with_oracle,
)
from relevance.evaluation.pairing import Asked, Pair, Timed, side_by_side
from relevance.evaluation.predictions import policy_of_checkpoint, predict, unjudged
from relevance.evaluation.priors import PRIORS, TRUE, Believing, Prior, prior_name, prior_scorer
from relevance.evaluation.reruns import (
    OWN,
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
from relevance.evaluation.tuning import Patience, Tuned, TuningConfig, is_tuned, tune

__all__ = [
    "BREAKDOWNS",
    "JUDGES",
    "NETWORK",
    "OWN",
    "PRIORS",
    "RULE",
    "TRUE",
    "Asked",
    "Believing",
    "Comparison",
    "EvaluationConfig",
    "EvaluationError",
    "NetworkScorer",
    "Pair",
    "Patience",
    "Predictions",
    "Prior",
    "Task",
    "Timed",
    "Tuned",
    "TuningConfig",
    "accuracy_table",
    "amortised_costs",
    "breakdown_table",
    "checkpoint_id",
    "choose_tasks",
    "compare",
    "evaluate",
    "guided_cost",
    "in_group",
    "is_tuned",
    "left_out",
    "load_guide",
    "load_scorer",
    "oracle_cost",
    "policy_of_checkpoint",
    "predict",
    "prior_name",
    "prior_scorer",
    "read_evaluations",
    "read_predictions",
    "rerun_priors",
    "settings",
    "shown_as",
    "side_by_side",
    "speed_table",
    "summarise",
    "tune",
    "unjudged",
    "with_oracle",
]
