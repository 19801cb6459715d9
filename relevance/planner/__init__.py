"""Logic-Geometric Programming over pick and place: `plan(scene, goal)`."""

from relevance.planner.problem import Counts, Seconds
from relevance.planner.rai.planner import RaiConfig
from relevance.planner.search import (
    GUIDES,
    PLANNER_VERSION,
    PLANNERS,
    Guide,
    PlannerConfig,
    PlanResult,
    Scorer,
    penetration,
    plan,
    warm_up,
)

__all__ = [
    "GUIDES",
    "PLANNERS",
    "PLANNER_VERSION",
    "Counts",
    "Guide",
    "PlanResult",
    "PlannerConfig",
    "RaiConfig",
    "Scorer",
    "Seconds",
    "penetration",
    "plan",
    "warm_up",
]
