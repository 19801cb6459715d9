"""Path bound: motions through the keyframes of an order of moves, densely checked."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from relevance.planner.grasps import (
    Bodies,
    Held,
    bodies,
    carried,
    hand_target,
    pick_target,
    upper_bodies,
)
from relevance.planner.kernels.kinematics import TARGET, finger_turn, finger_way
from relevance.planner.kernels.motions import (
    ALLOWED,
    ROWS,
    VERTICAL,
    dense_check,
    motion,
    retreat,
)
from relevance.planner.logic import actions
from relevance.planner.pose import Placement
from relevance.planner.problem import Problem
from relevance.robot import ARM, HOME, panda
from relevance.scene import Phase, Pose
from relevance.scene.geometry import upright


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A solved sequence."""

    order: tuple[str, ...]
    phases: tuple[Phase, ...]
    final: dict[str, Pose]
    cost: float
    """Squared joint accelerations (second differences of rows), summed over the rows of all phases,
    and the prices of the holds, rad^2."""
    max_penetration: float
    """Deepest penetration at the sub-steps of the dense check, m."""


_NONE = (-1.0, 0.0, 0.0)
"""Of a leg that has no motion."""


class _Leg(NamedTuple):
    """A motion to one switch; its rows X are filled in by the solver between first and last."""

    name: str
    """The box that is taken or put there."""
    holding: bool
    """Whether it is in the hand."""
    X: np.ndarray
    leave: np.ndarray
    leaving: bool
    arrive: np.ndarray
    opening: float
    held: Held | None
    obstacles: np.ndarray
    beside: np.ndarray
    """The same as what is held meets them while it rises."""


class PathBound:
    """Finds the motions through the keyframes of an order of moves, densely checked."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._suspect: tuple[str, bool] | None = None
        """The leg that failed last, which is tried first: it mostly fails again."""

    @cached_property
    def in_the_arm(self) -> tuple[str, ...]:
        """Boxes that the arm is in where every plan begins, its hand open or shut."""
        problem, X, found = self.problem, np.tile(HOME, (2, 1)), []
        for name in problem.boxes if problem.tall else ():
            box = problem.obstacles[problem.index[name]][None]
            depths = []
            for opening in (0.0, panda().max_opening):
                body = bodies(opening)
                margin, over = np.zeros((len(body.link), 1)), np.zeros((1, 2))
                depths.append(dense_check(X, problem.arm, body, box, box, margin, over))
            if max(min(depths), upper_depth(problem, X, box)) > ALLOWED:
                found.append(name)
        return tuple(found)

    def solve(
        self,
        order: tuple[str, ...],
        placements: list[Placement],
        q: np.ndarray,
        poses: np.ndarray,
    ) -> Motion | None:
        """Motions through configurations q (2m, 7) and poses (m, 3); None where one fails."""
        began = time.process_time()
        found = self._solve(order, placements, q, poses)
        self.problem.seconds.path += time.process_time() - began
        return found

    def _solve(
        self,
        order: tuple[str, ...],
        placements: list[Placement],
        q: np.ndarray,
        poses: np.ndarray,
    ) -> Motion | None:
        problem, arm = self.problem, self.problem.arm
        obstacles = problem.obstacles.copy()
        there = np.ones(len(obstacles), np.bool_)
        legs: list[_Leg] = []
        releases: list[tuple[np.ndarray, tuple[float, float, float]]] = []
        final: dict[str, Pose] = {}
        at, leave, leaving = HOME, np.zeros(TARGET), False
        for j, (name, place) in enumerate(zip(order, placements, strict=True)):
            box, grasp, i = problem.boxes[name], place.grasp, problem.index[name]
            last = name == problem.goal.subject
            on = problem.goal.reference if last and problem.goal.predicate.stacked else None
            bottom = 0.0
            if on is not None:
                bottom = obstacles[problem.index[on], 2] + obstacles[problem.index[on], 6]
            take = pick_target(box, grasp)
            z = bottom + box.size[2] / 2 + grasp.above
            put = hand_target(poses[j, 0], poses[j, 1], z, poses[j, 2], grasp)
            in_hand = carried(box, grasp, finger_way(arm, q[2 * j], take[3]))
            for k, (arrive, held, opening) in enumerate(
                ((take, None, grasp.opening), (put, in_hand, grasp.closed))
            ):
                there[i] = k == 0
                X = np.empty((ROWS + 1, ARM))
                X[0], X[-1] = at, q[2 * j + k]
                standing = obstacles[there]
                beside = problem.beside(i, obstacles)[there] if k else standing
                legs.append(
                    _Leg(name, k == 1, X, leave, leaving, arrive, opening, held, standing, beside)
                )
                at, leave, leaving = X[-1], arrive, True
            there[i] = True
            turned = finger_turn(arm, q[2 * j], q[2 * j + 1])
            yaw = (box.yaw + turned + math.pi) % (2 * math.pi) - math.pi
            position = (float(poses[j, 0]), float(poses[j, 1]), bottom + box.size[2] / 2)
            put_down(obstacles[i], position, yaw)
            final[name] = Pose(position=position, yaw=yaw, on=on)
            X = np.empty((2 * VERTICAL + 1, ARM))
            X[0] = at
            found = self._retreat(X, put, grasp.opening, obstacles)
            if not 0 <= found[0] <= ALLOWED:
                return None
            releases.append((X, found))
            at, leaving = X[-1], False
        moved = self._motions(legs)
        if moved is None:
            return None
        phases, sequence = list[Phase](), actions(problem.goal, order)
        for number, (leg, (_, _, dt)) in enumerate(zip(legs, moved, strict=True)):
            held = leg.name if leg.holding else None
            phases.append(
                Phase(
                    action=sequence[number], q=leg.X, dt=dt, opening=leg.opening, carried=held
                )
            )  # fmt: skip
            if leg.holding:
                X, (_, _, dt) = releases[number // 2]
                opening = placements[number // 2].grasp.opening
                phases.append(Phase(action=None, q=X, dt=dt, opening=opening, carried=None))
        done = [*moved, *(found for _, found in releases)]
        prices = sum(place.grasp.price for place in placements)
        return Motion(
            order=order,
            phases=tuple(phases),
            final=final,
            cost=sum(effort for _, effort, _ in done) + prices,
            max_penetration=max(depth for depth, _, _ in done),
        )

    def _motions(self, legs: list[_Leg]) -> list[tuple[float, float, float]] | None:
        """Depth (m), cost (rad^2) and time between rows (s) of each leg; None where one fails."""
        found = [(0.0, 0.0, 0.0)] * len(legs)
        suspect = self._suspect
        for n in sorted(range(len(legs)), key=lambda n: (legs[n].name, legs[n].holding) != suspect):
            self.problem.counts.path += 1
            found[n] = self._motion(legs[n])
            if found[n][0] < 0:
                self._suspect = legs[n].name, legs[n].holding
                return None
        return found

    def _motion(self, leg: _Leg) -> tuple[float, float, float]:
        """`motion`; once more around the robot's shoulder, where what is carried meets it."""
        found = self._clear(leg, leg.obstacles, leg.beside)
        if leg.held is None or found[0] < 0:
            return found
        depth = shoulder_depth(self.problem, leg.X, leg.opening, leg.held)
        if depth > ALLOWED:
            pillar = self.problem.pillar
            around = (np.concatenate([pillar, rows]) for rows in (leg.obstacles, leg.beside))
            found = self._clear(leg, *around)
            depth = shoulder_depth(self.problem, leg.X, leg.opening, leg.held)
        return (max(found[0], depth), *found[1:]) if found[0] >= 0 and depth <= ALLOWED else _NONE

    def _clear(
        self, leg: _Leg, obstacles: np.ndarray, beside: np.ndarray
    ) -> tuple[float, float, float]:
        """`motion`; among tall things once more with every link, where it brings one too near."""
        problem, ends = self.problem, (leg.leave, leg.leaving, leg.arrive)
        found = motion(leg.X, problem.arm, *ends, bodies(leg.opening, leg.held), obstacles, beside)
        if found[0] < 0:
            return found
        upper = upper_depth(problem, leg.X, leg.obstacles[:-2])
        if upper <= ALLOWED:
            return max(found[0], upper), *found[1:]
        # The foot is under the links near the base: they are not asked to keep clear of it.
        every = bodies(leg.opening, leg.held, upper=True)
        boxes, beside = leg.obstacles[:-1], leg.beside[:-1]
        return motion(leg.X, problem.whole_arm, *ends, every, boxes, beside)

    def _retreat(
        self, X: np.ndarray, put: np.ndarray, opening: float, obstacles: np.ndarray
    ) -> tuple[float, float, float]:
        """`retreat`, with every link among tall things: it is straight up, there is no other."""
        depth, effort, dt = retreat(X, self.problem.arm, put, bodies(opening), obstacles)
        if depth >= 0:
            depth = max(depth, upper_depth(self.problem, X, obstacles[:-2]))
        return depth, effort, dt


def upper_depth(problem: Problem, X: np.ndarray, boxes: np.ndarray) -> float:
    """How deep the links near the base are in boxes (W, UPRIGHT) along the rows X, m; 0 where none
    is so tall that they could be."""
    if not problem.tall or not len(boxes):
        return 0.0
    upper = upper_bodies()
    margin, broken = np.zeros((len(upper.link), len(boxes))), np.zeros((len(X) - 1, 2))
    return dense_check(X, problem.whole_arm, upper, boxes, boxes, margin, broken)


def shoulder_depth(problem: Problem, X: np.ndarray, opening: float, held: Held) -> float:
    """How deep what is carried is in the robot's shoulder along the rows X, m.

    Both turn with joint 1: where that is left at 0, the shoulder stands still.
    """
    body = Bodies(*(part[-1:] for part in bodies(opening, held)))
    still = X.copy()
    still[:, 0] = 0.0
    margin, over = np.zeros((1, 1)), np.zeros((len(X) - 1, 2))
    return dense_check(still, problem.arm, body, problem.shoulder, problem.shoulder, margin, over)


def put_down(row: np.ndarray, position: tuple[float, float, float], yaw: float) -> None:
    """Stand the box of an obstacle row (UPRIGHT,) elsewhere."""
    x, y, z = position
    hx, hy, hz = row[4:7]
    upright(x, y, z, yaw, hx, hy, hz, row)
