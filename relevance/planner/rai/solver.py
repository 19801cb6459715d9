"""Runs rai's own LGP solver on the problem in the current folder; a program of its own.

`planner.py` starts it as a subprocess, since rai never returns when there is no plan. It imports
nothing of this project. Reads `task.g`, `task.lgp`, `task.json`; writes `started.json` (CPU
seconds of loading) and, when there is a plan, `found.json`.

rai decides on the actions and solves the switches in one problem (its `LGP_Tool`); then each
motion between two switches, and the last retreat, is a KOMO problem of its own. A plan with a
motion that cannot be solved is given up and rai is asked for the next, before any motion where
something overlaps at a switch.
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import robotic as ry  # pyright: ignore[reportMissingImports]  (extra [rai])

ARM = 7
ARM_JOINTS = [f"l_panda_joint{i + 1}" for i in range(ARM)]
FINGERS = "l_panda_finger_joint1"
GRIPPER = "l_gripper"
STEPS, STEPS_AWAY = 32, 8
"""Steps of a motion, and of the last retreat."""
VERTICAL = 0.2
"""Share of a motion beside a switch in which the hand only moves along its own axis."""
CLEAR = 0.004
"""Distance asked for between the switches, m, since rai looks at the steps only."""
TOLERANCE = 0.02
"""Largest sum of violations of a motion (rai calls 0.1 feasible); at SCALE, 2 mm."""
SCALE = 10.0
"""Of distances, per m."""
RISE = 0.06
"""How far it moves there, m."""
HOME = np.array([0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398])
"""Over the middle of the table, hand down: what motions bend towards at first."""
BENDS = (0.5, 0.9)
"""How far, in the middle of a motion."""
NEAR = 0.02
"""Distance below which a pair is in the problem of a motion from the start, m."""
JOINING = 5
"""How often pairs may join a problem."""
GRAZE = 5e-4
"""How far a pair that is not in the problem may fall short of what is asked, m."""
START_PENALTY = 10.0
"""muInit; with rai's default of 1 its solver ends in wells between obstacles."""


def main() -> None:
    """Load, solve, write; the limit is on CPU time, after which the system ends the process."""
    task = json.loads(Path("task.json").read_text())
    began = time.process_time()
    Path("started.json").write_text(json.dumps({"seconds": began}))
    limit = math.ceil(began + task["seconds"])
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    ry.params_add({"opt/muInit": START_PENALTY, "opt/verbose": 0})
    ry.rnd_seed(task["seed"])
    C = ry.Config()
    C.addFile("task.g")
    tamp = ry.default_LGP_TAMP_Abstraction(C, "task.lgp")
    lgp = ry.LGP_Tool(C, tamp)
    on_motions = 0.0
    while True:
        try:
            lgp.solve(1)
        except RuntimeError as error:
            if "1D range error" in str(error):  # the last solution, where there was none
                print("NO SEQUENCE", flush=True)
            raise
        skeleton = [list(action) for action in lgp.getSolvedPlan()]
        print("SEQUENCE", skeleton, flush=True)
        before = time.process_time()
        ways = lgp.getSolvedKOMO()
        paths = None
        if clear_switches(ways, skeleton, task["pairs"]):
            paths = motions(ways, skeleton, task["pairs"])
        on_motions += time.process_time() - before
        if paths is not None:
            break
    final = {
        action[1]: list(ways.getFrame(action[1], float(len(skeleton))).getPose())
        for action in skeleton
    }
    seconds = time.process_time() - began
    found = {
        "skeleton": skeleton,
        "paths": [{**path, "rows": path["rows"].tolist()} for path in paths],
        "final": final,
        "seconds": seconds,
        "seconds_switches": seconds - on_motions,
    }
    Path("found.part").write_text(json.dumps(found))
    os.replace("found.part", "found.json")
    sys.stdout.flush()
    os._exit(0)  # rai's destructors may crash, when everything is said


def clear_switches(ways: Any, skeleton: list[list[str]], pairs: dict[str, Any]) -> bool:
    """Whether nothing overlaps at the switches; rai lets 8 mm pass, and no motion could end there.

    The fingers of a pick are where they open, its box is not in them yet.
    """
    held = None
    for phase, action in enumerate(skeleton):
        C, _, q1 = ways.getSubProblem(phase)
        C.selectJoints([*ARM_JOINTS, FINGERS])
        overlaps = np.maximum(-distances(C, q1[None], collisions(pairs, held)), 0.0)
        if SCALE * overlaps.sum() > TOLERANCE:
            return False
        held = action[1] if action[0].startswith("pick") else None
    return True


def motions(
    ways: Any, skeleton: list[list[str]], pairs: dict[str, Any]
) -> list[dict[str, Any]] | None:
    """Every motion and, after a placement, the retreat; None when one cannot be solved.

    `rows` (steps + 1, 7) rad, finger `opening` in m, `action` at the end (None for a retreat).
    """
    found: list[dict[str, Any]] = []
    held, at = None, None
    for phase, action in enumerate(skeleton):
        C, q0, q1 = ways.getSubProblem(phase)
        opening = float(q1[ARM])
        start = q0[:ARM] if at is None else at
        rows = motion(
            C, start, q1[:ARM], opening, collisions(pairs, held), leaving=held is not None
        )
        if rows is None:
            return None
        found.append({"action": action, "rows": rows, "opening": opening})
        held, at = action[1] if action[0].startswith("pick") else None, rows[-1]
        if held is None:
            C.selectJoints([*ARM_JOINTS, FINGERS])
            C.setJointState(q1)
            C.attach("table", action[1])
            rows = motion(C, at, None, opening, collisions(pairs, None), leaving=True)
            if rows is None:
                return None
            found.append({"action": None, "rows": rows, "opening": opening})
            at = rows[-1]
    return found


def collisions(pairs: dict[str, Any], held: str | None) -> list[list[str]]:
    """The pairs that can change while this box is in the hand, but for the fingers on it."""
    hand = [pair for pair in pairs["hand"] if pair[1] != held]
    boxes = [pair[:2] for pair in pairs["boxes"] if held in pair[2:]]
    return [*hand, *pairs["fixed"], *boxes]


def motion(
    C: Any,
    q0: np.ndarray,
    q1: np.ndarray | None,
    opening: float,
    pairs: list[list[str]],
    *,
    leaving: bool,
) -> np.ndarray | None:
    """Rows from q0 to q1, or straight away from a switch when q1 is None; None where it fails.

    The fingers stay at `opening`; `leaving`: the motion starts at a switch. The first guess
    bends towards HOME, and further where that fails.
    """
    C.selectJoints([*ARM_JOINTS, FINGERS])
    C.setJointState([*q0, opening])
    C.selectJoints(ARM_JOINTS)
    for bend in BENDS if q1 is not None else BENDS[:1]:
        rows = _motion(C, q0, q1, pairs, leaving, bend)
        if rows is not None:
            return rows
    return None


def _motion(
    C: Any,
    q0: np.ndarray,
    q1: np.ndarray | None,
    pairs: list[list[str]],
    leaving: bool,
    bend: float,
) -> np.ndarray | None:
    """One motion that keeps all pairs apart.

    Nearly all time goes into distances, and most pairs are hardly ever near each other: the problem
    has them only at steps at which they are near on the way that it starts from. Where its
    solution brings others together, these join and it is solved on from there.
    """
    steps = STEPS_AWAY if q1 is None else STEPS
    share = np.linspace(0.0, 1.0, steps + 1)[1:, None]
    begin, end = (VERTICAL if leaving else 0.0), 1.0 - VERTICAL
    if q1 is None:
        guess, clear = np.repeat(q0[None], steps, axis=0), 0.0 * share
    else:
        straight = (1 - share) * q0 + share * q1
        guess = straight + bend * np.sin(np.pi * share) * (HOME - straight)
        # what stands close to a switch is further away between them
        clear = np.where((share >= begin) & (share <= end), CLEAR, 0.0)
    near = _widened(distances(C, guess, pairs) < NEAR)
    for _ in range(JOINING):
        path = _solved(C, q0, q1, guess, pairs, near, clear[:, 0], leaving)
        if path is None:
            return None
        apart = distances(C, path, pairs)
        missed = ~near & (apart < clear - GRAZE)
        if not missed.any():
            rows = np.vstack([q0, path])
            if q1 is not None:
                rows[-1] = q1  # met up to rai's tolerance; the next motion starts there
            return rows
        near |= _widened(apart < CLEAR + GRAZE)
        guess = path
    return None


def _widened(steps: np.ndarray) -> np.ndarray:
    """The same flags (steps, pairs), and those of one step before and after."""
    wide = steps.copy()
    wide[1:] |= steps[:-1]
    wide[:-1] |= steps[1:]
    return wide


def distances(C: Any, path: np.ndarray, pairs: list[list[str]]) -> np.ndarray:
    """How far apart the pairs are (steps, pairs), m; the arm is left where it was."""
    at = C.getJointState()
    found = np.empty((len(path), len(pairs)))
    for row, q in zip(found, path, strict=True):
        C.setJointState(q)
        row[:] = [-C.eval(ry.FS.negDistance, pair)[0][0] for pair in pairs]
    C.setJointState(at)
    return found


def _solved(
    C: Any,
    q0: np.ndarray,
    q1: np.ndarray | None,
    guess: np.ndarray,
    pairs: list[list[str]],
    near: np.ndarray,
    clear: np.ndarray,
    leaving: bool,
) -> np.ndarray | None:
    """The rows after q0 of a motion, sought from a first guess; None where rai finds none.

    Where `near` (steps, pairs) says so a pair is kept as far apart as `clear` (steps,) asks, m.
    """
    helper = ry.KOMO_ManipulationHelper()  # pyright: ignore[reportAttributeAccessIssue]
    komo = helper.komo
    steps = len(guess)
    komo.setTiming(1.0, steps, 1.0, 2)
    komo.setConfig(C, False)
    komo.addControlObjective([], 2, 1e-1)
    komo.addObjective([], ry.FS.jointLimits, [], ry.OT.ineq, [1e0])
    komo.addObjective([1.0], ry.FS.qItself, [], ry.OT.eq, [1e0], [], 1)
    for pair, its in zip(pairs, near.T, strict=True):
        for first, last in _runs(np.where(its, clear, np.nan)):
            times = [(first + 1) / steps, (last + 1) / steps]
            komo.addObjective(
                times, ry.FS.negDistance, pair, ry.OT.ineq, [SCALE], [-float(clear[first])]
            )
    if q1 is not None:
        komo.addObjective([1.0], ry.FS.qItself, [], ry.OT.eq, [1e1], q1)
        komo.initWithPath(guess)
        helper.approach([1.0 - VERTICAL, 1.0], GRIPPER, RISE)
    if leaving:
        helper.retract([0.0, VERTICAL if q1 is not None else 1.0], GRIPPER, RISE)
    solver = ry.NLP_Solver()
    solver.setProblem(komo.nlp())
    solver.setOptions(
        verbose=0, damping=1e-1, stopTolerance=1e-3, lambdaMax=100.0, muInit=START_PENALTY
    )
    found = solver.solve()
    print("MOTION", found, flush=True)
    if found.eq > TOLERANCE or found.ineq > TOLERANCE:
        return None
    return komo.getPath()


def _runs(values: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of every run of equal numbers."""
    runs: list[tuple[int, int]] = []
    for i in np.flatnonzero(~np.isnan(values)).tolist():
        if runs and runs[-1][1] == i - 1 and values[i] == values[i - 1]:
            runs[-1] = runs[-1][0], i
        else:
            runs.append((i, i))
    return runs


if __name__ == "__main__":
    main()
