"""The planner's own check of what it found: dense, and able to fail."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit

from relevance.planner.grasps import Held, bodies
from relevance.planner.kernels.kinematics import FRAME, look_at_frames
from relevance.planner.kernels.motions import ALLOWED, dense_check
from relevance.planner.path import Motion, put_down, shoulder_depth, upper_depth
from relevance.planner.problem import Problem
from relevance.planner.result import PlanResult
from relevance.robot import HAND, panda
from relevance.scene import CONTACT_TOLERANCE, Box, Pose, Scene, goal_holds

SLACK = 1e-6
"""What a limit may be exceeded by, relative to it or in rad: rounding."""


def broken(problem: Problem, motion: Motion) -> str:
    """What does not hold of a motion; empty if all does.

    Joint limits and speeds at every sub-step (joint angles are linear between rows, so the rows
    say it all), penetration as the path bound measured it, boxes put down on the table, and the
    goal at the end.
    """
    arm = panda()
    for number, phase in enumerate(motion.phases):
        joint, over, speed = extremes(phase.q, phase.dt, arm.lower, arm.upper, arm.velocity)
        if over > SLACK:
            return f"phase {number}: joint {joint + 1} exceeds its limit by {over:.4f} rad"
        if speed > 1 + SLACK:
            return f"phase {number}: a joint moves at {speed:.2f} times its speed limit"
    if motion.max_penetration > ALLOWED:
        return f"something is penetrated by {1000 * motion.max_penetration:.1f} mm"
    moved = {name: at_last(problem.boxes[name], pose) for name, pose in motion.final.items()}
    for name, box in moved.items():
        if box.on is None and (abs(box.corners()) > problem.table + CONTACT_TOLERANCE).any():
            return f"{name} is not put on the table"
    ends = {problem.goal.subject, problem.goal.reference}
    boxes = [moved.get(name, problem.boxes[name]) for name in ends]
    if not goal_holds(boxes, problem.goal, problem.scene.robot):
        return f"the goal {problem.goal} is not true at the end"
    return ""


@njit(cache=True)
def extremes(q, dt, lower, upper, velocity):
    """The joint nearest to or farthest beyond its limits in the rows q (T + 1, 7), how far beyond
    (rad), and the highest speed as a share of its limit."""
    joint, over, speed = 0, -math.inf, 0.0
    for t in range(len(q)):
        for i in range(len(lower)):
            beyond = max(lower[i] - q[t, i], q[t, i] - upper[i])
            if beyond > over:
                joint, over = i, beyond
            if t > 0:
                speed = max(speed, abs(q[t, i] - q[t - 1, i]) / velocity[i] / dt)
    return joint, over, speed


def at_last(box: Box, pose: Pose) -> Box:
    """The box where a plan leaves it."""
    return replace(box, position=pose.position, yaw=pose.yaw, on=pose.on)


def penetration(scene: Scene, result: PlanResult) -> float:
    """Worst penetration (m) of a plan by the planner's own dense check, from the plan alone.

    The solver has done the same while it solved; this goes by the plan's phases and poses.
    """
    problem = Problem(scene, result.goal)
    obstacles = problem.obstacles.copy()
    there = np.ones(len(obstacles), np.bool_)
    worst, held = 0.0, None
    for k, phase in enumerate(result.phases):
        name, holding = result.moved[k // 3], k % 3 == 1
        i = problem.index[name]
        if holding:
            held = _held(problem, name, result.phases[k - 1].q[-1])
        there[i] = not holding
        if k % 3 == 2:  # the retreat
            pose = result.final[name]
            put_down(obstacles[i], pose.position, pose.yaw)
        body, around = bodies(phase.opening, held if holding else None), obstacles[there]
        beside = problem.beside(i, obstacles)[there] if holding else around
        margin, over = np.zeros((len(body.link), len(around))), np.zeros((len(phase.q) - 1, 2))
        depth = dense_check(phase.q, problem.arm, body, around, beside, margin, over)
        worst = max(worst, depth, upper_depth(problem, phase.q, around[:-2]))
        if holding and held is not None:
            worst = max(worst, shoulder_depth(problem, phase.q, phase.opening, held))
    return worst


def _held(problem: Problem, name: str, q: np.ndarray) -> Held:
    """The box that the hand takes at q (7,)."""
    box = problem.boxes[name]
    look_at_frames(problem.arm, q)
    frame = problem.arm.frames_y[HAND * FRAME :]
    R = frame[3:12].reshape(3, 3)
    centre = R.T @ (np.array(box.position) - frame[:3])
    along = abs(math.cos(math.atan2(R[1, 1], R[0, 1]) - box.yaw)) > 0.5  # fingers along its x
    sizes = (box.size[1], box.size[0]) if along else box.size[:2]
    return Held(centre, np.array([*sizes, box.size[2]]) / 2, math.atan2(-R[2, 0], -R[2, 2]))
