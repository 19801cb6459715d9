"""Plans as arrays that other programs can run."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from relevance.planner.result import PlanResult
from relevance.robot import ARM

GRIP_SECONDS = 0.5
"""How long the fingers take to close on a box or to let it go, s."""


def trajectory(result: PlanResult) -> dict[str, np.ndarray]:
    """A plan's motion, as `numpy.savez` takes it; T = 0 where nothing moves.

    times (T,): s, ascending from 0. joints (T, 7): rad, linear between rows. gripper (T,): the
    value of each of the two finger joints, half the width between the pads, m; the arm stands
    still while it changes. attached (T,): name of the box in the hand from this row on, rigid to
    it, empty if none. Whatever the plan's status is, these are its motions.
    """
    times, joints, gripper, attached = [], [], [], []
    now, phases = 0.0, result.phases
    for number, phase in enumerate(phases):
        q = np.asarray(phase.q)
        # The first row repeats the last row of the phase before, with the fingers moved.
        times.append(now + phase.dt * np.arange(len(q)))
        joints.append(q)
        gripper.append(np.full(len(q), phase.opening))
        attached.append(np.full(len(q), phase.carried or "", dtype=object))
        now = times[-1][-1]
        follows = number + 1 < len(phases) and phases[number + 1].opening != phase.opening
        now += GRIP_SECONDS if follows else phase.dt
    if not phases:
        return {
            "times": np.zeros(0), "joints": np.zeros((0, ARM)), "gripper": np.zeros(0),
            "attached": np.zeros(0, dtype="<U1"),
        }  # fmt: skip
    return {
        "times": np.concatenate(times),
        "joints": np.vstack(joints),
        "gripper": np.concatenate(gripper),
        "attached": np.concatenate(attached).astype(str),
    }


def write_trajectory(file: Path, result: PlanResult) -> None:
    """Write a plan's arrays as .npz: the whole file or, where that fails, what was there before."""
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}-")
    half = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, **trajectory(result))  # pyright: ignore[reportArgumentType]
        half.chmod(0o644)
        half.replace(file)
    finally:
        half.unlink(missing_ok=True)
