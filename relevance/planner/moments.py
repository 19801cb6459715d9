"""A plan as it runs: where the arm and every box are at any time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from relevance.planner.result import PlanResult
from relevance.planner.trajectories import trajectory
from relevance.robot import HOME, panda
from relevance.scene import Action, Scene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """Where everything is at one time."""

    joints: np.ndarray
    """(7,), rad."""
    gripper: float
    """Value of each of the two finger joints, m."""
    poses: Mapping[str, np.ndarray]
    """T_world_box (4, 4) of every box, m."""
    step: int
    """How many actions are done: the number of the one that is under way."""


class Motion:
    """The motion of a result's plan; the scene stands still where it has none."""

    def __init__(self, scene: Scene, result: PlanResult) -> None:
        self.actions: tuple[Action, ...] = result.actions
        self._base = _upright(scene.robot.base, scene.robot.yaw)
        arrays: dict[str, Any] = trajectory(result)
        if not len(arrays["times"]):
            hand = panda().max_opening
            arrays = {
                "times": np.zeros(1), "joints": HOME[None], "gripper": np.array([hand]),
                "attached": np.array([""]),
            }  # fmt: skip
        self._times, self._joints = arrays["times"], arrays["joints"]
        self._gripper, self._held = arrays["gripper"], arrays["attached"]
        rows = np.cumsum([len(phase.q) for phase in result.phases])
        ends = [row for row, phase in zip(rows, result.phases, strict=True) if phase.action]
        self._ends = np.array(ends, dtype=int)
        """For each action, the row after its last."""
        self._standing: list[Mapping[str, np.ndarray]] = []
        """For each row, where the boxes that are not held stand."""
        self._offsets: list[np.ndarray] = []
        """For each row, T_hand_box of what is held."""
        standing = {box.name: _upright(box.position, box.yaw) for box in scene.objects}
        offset, before = np.eye(4), ""
        for row, held in enumerate(self._held):
            if held != before:
                hand = self._hand(self._joints[row])
                if before:
                    standing = {**standing, before: hand @ offset}
                if held:
                    offset = np.linalg.inv(hand) @ standing[held]
            self._standing.append(standing)
            self._offsets.append(offset)
            before = held

    @property
    def seconds(self) -> float:
        """How long it lasts, s."""
        return float(self._times[-1])

    @property
    def starts(self) -> tuple[float, ...]:
        """When the motion that leads to each action begins, s."""
        return tuple(float(self._times[row]) for row in [0, *self._ends[:-1]][: len(self.actions)])

    def at(self, seconds: float) -> Moment:
        """Where everything is; before its start and after its end, as it is then."""
        seconds = min(max(seconds, 0.0), self.seconds)
        row = int(np.searchsorted(self._times, seconds, side="right")) - 1
        after = min(row + 1, len(self._times) - 1)
        span = self._times[after] - self._times[row]
        share = (seconds - self._times[row]) / span if span > 0 else 0.0
        joints = self._joints[row] + share * (self._joints[after] - self._joints[row])
        gripper = self._gripper[row] + share * (self._gripper[after] - self._gripper[row])
        poses = dict(self._standing[row])
        if held := str(self._held[row]):
            poses[held] = self._hand(joints) @ self._offsets[row]
        step = int(np.searchsorted(self._ends, row, side="right"))
        return Moment(joints=joints, gripper=float(gripper), poses=poses, step=step)

    def _hand(self, joints: np.ndarray) -> np.ndarray:
        """T_world_hand (4, 4)."""
        T, angles = self._base, iter(joints)
        for joint in panda().chain:
            T = T @ joint.origin
            if joint.revolute:
                T = T @ _upright((0.0, 0.0, 0.0), next(angles))
        return T


def _upright(position: tuple[float, float, float], yaw: float) -> np.ndarray:
    """A pose that is turned about z alone, (4, 4)."""
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = position
    return T
