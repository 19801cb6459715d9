"""Logic-Geometric Programming over pick and place: `plan(scene, goal)`."""

from relevance.planner.problem import Counts, Seconds
from relevance.planner.search import (
    GUIDES,
    PLANNER_VERSION,
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
    "PLANNER_VERSION",
    "Counts",
    "Guide",
    "PlanResult",
    "PlannerConfig",
    "Scorer",
    "Seconds",
    "penetration",
    "plan",
    "warm_up",
]
