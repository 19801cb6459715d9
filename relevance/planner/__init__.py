"""Logic-Geometric Programming over pick and place: `plan(scene, goal)`."""

from relevance.planner.checking import penetration
from relevance.planner.guides import GUIDES, PATIENCE, Guide, GuideError, Mode, Scorer, ask
from relevance.planner.moments import Moment, Motion
from relevance.planner.rai.planner import Rai, RaiConfig
from relevance.planner.result import (
    PLANNER_VERSION,
    PLANNERS,
    Counts,
    Planner,
    PlannerConfig,
    PlanResult,
    Seconds,
    Status,
)
from relevance.planner.search import Ours, plan, warm_up
from relevance.planner.trajectories import trajectory, write_trajectory

for _planner in (Ours(), Rai()):
    PLANNERS.register(_planner.name, _planner)

__all__ = [
    "GUIDES",
    "PATIENCE",
    "PLANNERS",
    "PLANNER_VERSION",
    "Counts",
    "Guide",
    "GuideError",
    "Mode",
    "Moment",
    "Motion",
    "PlanResult",
    "Planner",
    "PlannerConfig",
    "RaiConfig",
    "Scorer",
    "Seconds",
    "Status",
    "ask",
    "penetration",
    "plan",
    "trajectory",
    "warm_up",
    "write_trajectory",
]
