"""Measurements of planner, guides, networks and datasets: nothing prints, the command line does.

Each part is one function that does the work and returns a `Measured`: rows for a file, tables
for a person, and what its plots need. Times are CPU seconds of this process (all its threads)
unless a name says wall; intervals are 95%: bootstrap for times, Wilson for shares.
"""

from relevance.benchmarks.against import find_unsolved, measure_against
from relevance.benchmarks.completeness import measure_completeness
from relevance.benchmarks.guides import LIMITS, OURS, Rerun, Settings, read_reruns, rerun_guides
from relevance.benchmarks.peers import measured_peer
from relevance.benchmarks.plots import save
from relevance.benchmarks.runs import Measured
from relevance.benchmarks.savings import Figures, figures, measured_guides
from relevance.benchmarks.searches import (
    CAPPED,
    MAX_EDGE,
    SIZES,
    measure_scaling,
    measure_searches,
)
from relevance.benchmarks.speed import measure_planning
from relevance.benchmarks.stability import measure_stability
from relevance.benchmarks.tasks import BenchmarkError, Scenes, Task, draw
from relevance.benchmarks.versus import measure_versus

__all__ = [
    "CAPPED",
    "LIMITS",
    "MAX_EDGE",
    "OURS",
    "SIZES",
    "BenchmarkError",
    "Figures",
    "Measured",
    "Rerun",
    "Scenes",
    "Settings",
    "Task",
    "draw",
    "figures",
    "find_unsolved",
    "measure_against",
    "measure_completeness",
    "measure_planning",
    "measure_scaling",
    "measure_searches",
    "measure_stability",
    "measure_versus",
    "measured_guides",
    "measured_peer",
    "read_reruns",
    "rerun_guides",
    "save",
]
