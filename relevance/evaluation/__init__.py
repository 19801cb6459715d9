"""What a checkpoint is worth: its accuracy, and the planner rerun with and without it.

beta (CONTRIBUTING, The words): an object is kept iff score > -beta; goal objects are always kept.
A checkpoint's offset is part of every score here, so that beta = 0 is what validation chose.
"""

from relevance.evaluation.accuracies import (
    BREAKDOWNS,
    JUDGES,
    NETWORK,
    NEVER,
    RULE,
    Predictions,
    accuracy_table,
    breakdown_table,
    in_group,
    read_predictions,
)
from relevance.evaluation.calibration import LEVELS, Calibration, CalibrationError, Promise
from relevance.evaluation.champion import Trial, TrialConfig, contend, fresh_tasks
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
from relevance.evaluation.coverage import (
    Covered,
    calibrate,
    covered,
    covered_speeds,
    out_of_reach,
    read_calibration,
)
from relevance.evaluation.elsewhere import away
from relevance.evaluation.pairing import Asked, Pair, Timed, beside_another, side_by_side
from relevance.evaluation.pictures import PictureError, Seen, look_at
from relevance.evaluation.predictions import policy_of_checkpoint, predict, unjudged
from relevance.evaluation.priors import PRIORS, TRUE, Believing, Prior, prior_name, prior_scorer
from relevance.evaluation.reruns import (
    OWN,
    EvaluationConfig,
    Task,
    choose_tasks,
    compare,
    evaluate,
    limits,
)
from relevance.evaluation.scorer import (
    EvaluationError,
    NetworkScorer,
    checkpoint_id,
    load_guide,
    load_scorer,
)
from relevance.evaluation.scores import scores
from relevance.evaluation.suites import SUITES, Suite, suite_of
from relevance.evaluation.tuning import Patience, Tuned, TuningConfig, tune, tune_once
from relevance.evaluation.working_points import SweptTask, WorkingPoint, saved, swept, working_point

__all__ = [
    "BREAKDOWNS",
    "JUDGES",
    "LEVELS",
    "NETWORK",
    "NEVER",
    "OWN",
    "PRIORS",
    "RULE",
    "SUITES",
    "TRUE",
    "Asked",
    "Believing",
    "Calibration",
    "CalibrationError",
    "Comparison",
    "Covered",
    "EvaluationConfig",
    "EvaluationError",
    "NetworkScorer",
    "Pair",
    "Patience",
    "PictureError",
    "Predictions",
    "Prior",
    "Promise",
    "Seen",
    "Suite",
    "SweptTask",
    "Task",
    "Timed",
    "Trial",
    "TrialConfig",
    "Tuned",
    "TuningConfig",
    "WorkingPoint",
    "accuracy_table",
    "amortised_costs",
    "away",
    "beside_another",
    "breakdown_table",
    "calibrate",
    "checkpoint_id",
    "choose_tasks",
    "compare",
    "contend",
    "covered",
    "covered_speeds",
    "evaluate",
    "fresh_tasks",
    "guided_cost",
    "in_group",
    "left_out",
    "limits",
    "load_guide",
    "load_scorer",
    "look_at",
    "oracle_cost",
    "out_of_reach",
    "policy_of_checkpoint",
    "predict",
    "prior_name",
    "prior_scorer",
    "read_calibration",
    "read_evaluations",
    "read_predictions",
    "rerun_priors",
    "saved",
    "scores",
    "settings",
    "shown_as",
    "side_by_side",
    "speed_table",
    "suite_of",
    "summarise",
    "swept",
    "tune",
    "tune_once",
    "unjudged",
    "with_oracle",
    "working_point",
]
