"""The planner's own dense check, of a plan alone."""

from __future__ import annotations

import numpy as np

from relevance.planner.grasps import bodies, carried, grasps
from relevance.planner.path import dense_check, put_down
from relevance.planner.problem import Problem
from relevance.planner.result import PlanResult
from relevance.scene import Scene


def penetration(scene: Scene, result: PlanResult) -> float:
    """Worst penetration (m) of a plan by the planner's own dense check, from the plan alone.

    The solver has done the same while it solved; this goes by the plan's phases and poses.
    """
    problem = Problem(scene, result.goal)
    obstacles = problem.obstacles.copy()
    there = np.ones(len(obstacles), np.bool_)
    worst = 0.0
    for k, phase in enumerate(result.phases):
        name, holding = result.moved[k // 3], k % 3 == 1
        box, i = problem.boxes[name], problem.index[name]
        opening = "closed" if holding else "opening"
        grasp = next(g for g in grasps(box) if getattr(g, opening) == phase.opening)
        there[i] = not holding
        if k % 3 == 2:  # the retreat
            pose = result.final[name]
            put_down(obstacles[i], pose.position, pose.yaw)
        body = bodies(phase.opening, carried(box, grasp) if holding else None)
        margin, broken = np.zeros((len(body.link), there.sum())), np.zeros((len(phase.q) - 1, 2))
        depth = dense_check(phase.q, problem.arm, body, obstacles[there], margin, broken)
        worst = max(worst, depth)
    return worst
