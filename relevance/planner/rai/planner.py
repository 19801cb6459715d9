"""rai's own LGP solver (the `robotic` package) behind the same interface: `plan_rai`.

The scene and the goal become rai's files: a configuration (rai's Panda with the same joints,
at the scene's robot base, so that its seven angles are ours), the rules of pick and place, and
the goal region as a place of its own. `solver.py` runs in a subprocess with a limit, since
rai's search never returns where there is no plan; what it prints tells when it has run out of
action sequences.

How the tasks differ from ours: rai takes a box across its narrower edge only, at any tilt; each
box is moved once, blockers go to the table; for goals beside a reference that reference stays.
Boxes are rounded (1 cm) against the hand, and 4 mm against each other with some room added to
their footprints. Two boxes that both stay are no pair that rai looks at, so that a guide makes its
problems smaller, too. Its plans are judged by `simulation.replay`, like ours.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from relevance.configs import config
from relevance.errors import RelevanceError
from relevance.planner.guides import Guide, ask, rounds
from relevance.planner.kernels.rows import SPEED, STEP
from relevance.planner.rai.problem import RaiProblem, goal_region, rai_problem
from relevance.planner.result import (
    Counts,
    PlanResult,
    Seconds,
    movable_names,
    replayed,
)
from relevance.robot import panda
from relevance.scene import (
    Action,
    Goal,
    Phase,
    Pose,
    Scene,
    goal_holds,
)

EXHAUSTED = "queue is empty"
"""What rai prints, for ever, once there is no further action sequence."""
NO_SEQUENCE = "NO SEQUENCE"
"""What solver prints when the rules allow no action sequence at all."""
_STARTUP = 30.0  # wall seconds for Python and rai to load on a busy machine


class PeerError(RelevanceError):
    """The other planner cannot run here: says what is missing and how to get it."""


@config
class RaiConfig:
    """Settings of rai as a planner."""

    seconds: Annotated[float, Field(gt=0)] = 30.0
    """CPU seconds for a goal; then the result is `limit`."""
    rounds: Annotated[int, Field(ge=1)] = 3
    """How often rai starts afresh, with another seed, when it ran out of action sequences."""


def require_rai() -> None:
    """Raise PeerError unless the `robotic` package is installed (it is not imported here)."""
    if importlib.util.find_spec("robotic") is None:
        raise PeerError("planner rai: not installed, expected: pip install 'relevance[rai]'")


def plan_rai(
    scene: Scene,
    goal: Goal | str,
    *,
    config: RaiConfig | None = None,
    guide: Guide | None = None,
    movable: Collection[str] | None = None,
    replay: bool = True,
) -> PlanResult:
    """Plan with rai's LGP solver in a subprocess; the result is of the same type as `plan`'s.

    A guide restricts what rai may move (those that order the search have no effect on it); its
    last round has the whole seconds. `seconds.total` is the CPU time of the subprocess without
    loading Python and rai, and that of the look; counts are rai's waypoint problems (keyframe) and
    how many action sequences they are of (sequences), motif samples (pose), problems of motions
    (path) and sequences whose waypoints were found (nodes). `check_ok` stays False: rai's plans are
    for the replay to judge.
    Raises PeerError where rai is missing, SceneError for an unknown predicate or object.
    """
    require_rai()
    found = _plan(scene, scene.goal(goal), config or RaiConfig(), guide, movable)
    return replayed(scene, found) if replay else found


def _plan(
    scene: Scene,
    goal: Goal,
    config: RaiConfig,
    guide: Guide | None,
    movable: Collection[str] | None,
) -> PlanResult:
    everything = movable_names(scene, movable)
    if goal_holds(scene.objects, goal, scene.robot):
        return PlanResult(
            goal=goal, status="solved", final={}, cost=0.0, counts=Counts(), seconds=Seconds()
        )
    began = time.process_time()
    scores = ask(guide, scene, goal)
    look = time.process_time() - began
    result = _rounds(scene, goal, config, rounds(everything, goal, guide, scores))
    seconds = replace(result.seconds, guide=look, total=result.seconds.total + look)
    return replace(result, seconds=seconds, looked=bool(scores))


def _rounds(
    scene: Scene, goal: Goal, config: RaiConfig, allowed: Sequence[frozenset[str]]
) -> PlanResult:
    """An attempt for each of the sets that may move, until one succeeds."""
    *early, last = allowed
    spent, end = _Spent(), config.seconds
    for some in early:  # these share the seconds, the last round has them whole
        result = _attempt(scene, goal, some, config, spent, end)
        if result.status == "solved":
            return result
        if spent.seconds.total >= end:
            break
    end = spent.seconds.total + config.seconds
    return _attempt(scene, goal, last, config, spent, end)


class Rai:
    """rai, as the registry of planners has it."""

    name = "rai"
    Config = RaiConfig

    def require(self) -> None:
        """Raise PeerError unless the `robotic` package is installed."""
        require_rai()

    def warm_up(self) -> None:
        """Nothing to do: rai's loading is not counted."""

    def plan(
        self,
        scene: Scene,
        goal: Goal | str,
        *,
        config: RaiConfig | None = None,
        guide: Guide | None = None,
        movable: Collection[str] | None = None,
        replay: bool = True,
    ) -> PlanResult:
        """As `plan_rai`."""
        return plan_rai(scene, goal, config=config, guide=guide, movable=movable, replay=replay)


@dataclass(slots=True, kw_only=True)
class _Spent:
    """What rai has used up for one goal."""

    counts: Counts = field(default_factory=Counts)
    seconds: Seconds = field(default_factory=Seconds)
    sequences: set[str] = field(default_factory=set)
    """Those whose switches were sought."""


def _attempt(
    scene: Scene,
    goal: Goal,
    movable: frozenset[str],
    config: RaiConfig,
    spent: _Spent,
    end: float,
) -> PlanResult:
    """Run rai until it finds a plan, or has used `end` seconds in all.

    It looks into the rectangles of the goal region in turn, each with its share of what is left.
    """
    problems = [
        rai_problem(scene, goal, movable=movable, there=there)
        for there in goal_region(scene, goal).rectangles
    ]
    ended = {number: ("", False) for number in range(len(problems))}
    for seed in range(config.rounds):
        for number, problem in enumerate(problems):
            left = (end - spent.seconds.total) / (len(problems) - number)
            if left <= 0 or ended[number][0] == NO_SEQUENCE:
                continue
            found, reason, exhausted = _run(problem, seed, left, spent)
            if found is not None:
                return _solved(scene, goal, problem, found, spent)
            ended[number] = reason, exhausted
    reason = next((why for why, _ in ended.values() if why), "")
    if reason == NO_SEQUENCE:
        reason = "the rules allow rai no action sequence"
    exhausted = all(exhausted for _, exhausted in ended.values())
    status = "infeasible" if exhausted else "limit"
    reason = reason or f"rai found no plan in {config.seconds:g} s"
    return PlanResult(
        goal=goal, status=status, reason=reason, final={}, counts=spent.counts,
        seconds=spent.seconds,
    )  # fmt: skip


def _run(
    problem: RaiProblem, seed: int, seconds: float, spent: _Spent
) -> tuple[dict[str, Any] | None, str, bool]:
    """One run of the subprocess: what it found, else why not, and whether it was exhausted.

    No reason: its time was up.
    """
    with tempfile.TemporaryDirectory(prefix="rai-") as name:
        folder = Path(name)
        (folder / "task.g").write_text(problem.configuration)
        (folder / "task.fol").write_text(problem.rules)
        (folder / "task.lgp").write_text(problem.search)
        task = {"pairs": problem.pairs, "seconds": seconds, "seed": seed}
        (folder / "task.json").write_text(json.dumps(task))
        before = _children()
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("solver.py"))],
            cwd=folder, env={**os.environ, "OMP_NUM_THREADS": "1"}, text=True, errors="replace",
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert process.stdout is not None
        # The CPU limit is the subprocess's own; this one is for a process that only waits.
        watch = threading.Timer(10 * seconds + _STARTUP, process.kill)
        watch.start()
        ended, last = "", ""
        try:
            for line in process.stdout:
                _count(line, spent)
                ended = next((w for w in (EXHAUSTED, NO_SEQUENCE) if w in line), "")
                if ended:
                    process.kill()
                    break
                if not line.startswith("STACK"):
                    last = line.strip() or last
        finally:
            watch.cancel()
            process.stdout.close()
            process.wait()
        started = folder / "started.json"
        if not started.exists():
            if "liblapack" in last:
                raise PeerError(f"planner rai: {last}; expected: apt-get install liblapack3")
            raise PeerError(f"planner rai does not start: {last}")
        loading = json.loads(started.read_text())["seconds"]
        spent.seconds.total += max(_children() - before - loading, 0.0)
        file = folder / "found.json"
        if file.exists():
            return json.loads(file.read_text()), "", False
        if ended == NO_SEQUENCE:
            return None, NO_SEQUENCE, True
        if ended:
            return None, "rai ran out of action sequences", True
        if process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
            return None, "", False
        return None, f"rai stopped: {last}", False


def _children() -> float:
    """CPU seconds of all subprocesses that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _count(line: str, spent: _Spent) -> None:
    counts = spent.counts
    if line.startswith("+++ solving motif"):
        counts.pose += 1
    elif line.startswith("+++ solving sub-plan"):
        counts.keyframe += 1
        spent.sequences.add(line)
        counts.sequences = len(spent.sequences)
    elif line.startswith("MOTION"):
        counts.path += 1
    elif line.startswith("SEQUENCE"):
        counts.nodes += 1


def _solved(
    scene: Scene, goal: Goal, problem: RaiProblem, found: dict[str, Any], spent: _Spent
) -> PlanResult:
    arm = panda()
    actions, phases = [], []
    held: str | None = None
    for path in found["paths"]:
        q, step = np.array(path["rows"]), path["action"]
        opening = path["opening"] if held is None else min(scene[held].size[:2]) / 2
        opening = min(max(opening, 0.0), arm.max_opening)
        action, carried = None, held
        if step is not None:
            name = problem.names[step[1]]
            if step[0].startswith("pick"):
                action, held = Action(name="pick", object=name), name
            else:
                support = problem.names[step[3]]
                action, held = Action(name="place", object=name, support=support), None
            actions.append(action)
        slowest = float((np.abs(np.diff(q, axis=0)) / arm.velocity).max())
        phases.append(
            Phase(
                action=action, q=q, dt=max(STEP, slowest / SPEED), opening=opening, carried=carried
            )
        )
    supports = {action.object: action.support for action in actions if action.name == "place"}
    final = {}
    for rai_name, (x, y, z, w, _, _, c) in found["final"].items():
        name = problem.names[rai_name]
        yaw = 2 * math.atan2(c, w) - problem.turn[name]
        on = None if supports[name] == "table" else supports[name]
        yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
        final[name] = Pose(position=(x, y, z), yaw=yaw, on=on)
    moved = tuple(action.object for action in actions[::2])
    spent.seconds.keyframe += found["seconds_switches"]
    spent.seconds.path += found["seconds"] - found["seconds_switches"]
    return PlanResult(
        goal=goal,
        status="solved",
        actions=tuple(actions),
        moved=moved,
        alternatives=(moved,),
        final=final,
        cost=sum(_acceleration(phase.q) for phase in phases),
        counts=spent.counts,
        max_penetration=math.nan,
        phases=tuple(phases),
        seconds=spent.seconds,
    )


def _acceleration(q: np.ndarray) -> float:
    """Squared second differences at rest before and after, rad^2."""
    return float((np.diff(np.vstack([q[:1], q, q[-1:]]), n=2, axis=0) ** 2).sum())
