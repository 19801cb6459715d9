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
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from relevance.configs import config
from relevance.errors import RelevanceError
from relevance.planner.guides import Guide, ask, rounds
from relevance.planner.kernels.rows import SPEED, STEP
from relevance.planner.result import (
    Counts,
    PlanResult,
    Seconds,
    movable_names,
    replayed,
)
from relevance.robot import ARM, HOME, LINKS, panda
from relevance.scene import (
    Action,
    Box,
    Goal,
    Phase,
    Pose,
    Rectangle,
    Region,
    Scene,
    footprint_gap,
    goal_holds,
)

ROUND = 0.01
"""Corner radius of boxes against the hand, m; rai's solver needs it to slide along edges."""
ROUND_BOX = 0.004
"""Corner radius of boxes against each other, m."""
ROOM = 0.0008
"""How far a box's footprint is grown against others beyond its rounded corners, m."""
SKIN = 0.001
"""How far the parts of the hand are grown, m."""
REGION_MARGIN = 0.002
"""How far inside the goal region rai places a subject, m."""
EXHAUSTED = "queue is empty"
"""What rai prints, for ever, once there is no further action sequence."""
NO_SEQUENCE = "NO SEQUENCE"
"""What solver prints when the rules allow no action sequence at all."""
_FRAMES = dict(zip(LINKS, ("l_panda_joint5", "l_panda_joint6", "l_panda_hand_joint"), strict=True))
_FINGERS = {1.0: "l_panda_finger_joint1", -1.0: "l_panda_finger_joint2"}
_FINGER_ROOT = 0.0584  # of both finger frames, along the hand's z, m
_STARTUP = 30.0  # wall seconds for Python and rai to load on a busy machine
_RULES = """\
is_gripper
is_object
is_box
is_sphere
is_capsule
is_blocker
is_subject
is_table
is_target
is_base
partOf
on
busy
clear
done

START_STATE {}

DecisionRule pick_box {
  Obj, From, Hand,
  pre: { (is_gripper Hand) (is_object Obj) (on From Obj) (clear Obj) (busy Hand)! (done Obj)! }
  eff: { (on From Obj)! #deletes
    (on Hand Obj) (busy Hand) (clear From) (done Obj) }
}

DecisionRule place_straightOn {
  Obj, Hand, To,
  pre: { (is_gripper Hand) (is_blocker Obj) (is_table To) (on Hand Obj) }
  eff: { (busy Hand)! (on Hand Obj)! #deletes
    (on To Obj) }
}

DecisionRule place_straightOn {
  Obj, Hand, To, Under,
  pre: { (is_gripper Hand) (is_subject Obj) (is_target To) (on Hand Obj)
    (is_base Under) (clear Under) }
  eff: { (busy Hand)! (on Hand Obj)! #deletes
    (on To Obj) }
}
"""


class PeerError(RelevanceError):
    """The other planner cannot run here: says what is missing and how to get it."""


@config
class RaiConfig:
    """Settings of rai as a planner."""

    seconds: Annotated[float, Field(gt=0)] = 30.0
    """CPU seconds for a goal; then the result is `limit`."""
    rounds: Annotated[int, Field(ge=1)] = 3
    """How often rai starts afresh, with another seed, when it ran out of action sequences."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RaiProblem:
    """One goal as rai reads it: the text of its files, and what the answer is read with."""

    configuration: str
    rules: str
    search: str
    pairs: Mapping[str, list[list[str]]]
    """Collision pairs: [part of the hand, box] under `hand`, [shape, shape, box, box] under
    `boxes`, [part, shape] under `fixed`."""
    names: Mapping[str, str]
    """From rai's names of boxes and places to ours."""
    turn: Mapping[str, float]
    """By our name: how far rai's box is turned about z, since rai takes boxes across their y."""


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
        for there in _region(scene, goal).rectangles
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
    """Squared second differences at rest before and after, as in PlanResult.cost, rad^2."""
    return float((np.diff(np.vstack([q[:1], q, q[-1:]]), n=2, axis=0) ** 2).sum())


def rai_problem(
    scene: Scene, goal: Goal, *, movable: Collection[str], there: Rectangle | None = None
) -> RaiProblem:
    """Write a goal in rai's formats; boxes outside `movable` stay where they are.

    there: the part of the goal region that is meant (None: its first rectangle).
    """
    ids = {box.name: f"box{i}" for i, box in enumerate(scene.objects)}
    on = goal.predicate.stacked
    # Nothing keeps a subject apart from what carries it: where that stands on the reference, the
    # reference has to be cleared.
    carriers = scene[goal.subject].supports
    beneath = on and any(goal.reference in scene[name].supports for name in carriers)
    parts, lines = _hand()
    lines = [*_world(scene, "is_table, clear" if beneath else "is_table, clear, is_base"), *lines]
    turn = {box.name: math.pi / 2 if box.size[0] < box.size[1] else 0.0 for box in scene.objects}
    places = {"target": goal.reference if on else "table", "table": "table"}
    carrying = {name for box in scene.objects for name in box.supports}
    moves: set[str] = set()
    for box in scene.objects:
        facts = [] if box.name in carrying else ["clear"]
        stays = box.name not in movable or (box.name == goal.reference and not on)
        if not stays and min(box.size[:2]) <= 2 * panda().max_opening:
            facts += ["is_object", "is_subject" if box.name == goal.subject else "is_blocker"]
        if beneath and box.name == goal.reference:
            facts.append("is_base")
        if "is_object" in facts:
            moves.add(box.name)
        lines += _box(box, scene, ids, turn, facts)
    there = there or _region(scene, goal).rectangles[0]
    lines.append(_target(scene, goal, there, ids[goal.reference], turn))
    pairs: dict[str, list[list[str]]] = {"hand": [], "boxes": [], "fixed": []}
    pairs["hand"] = [[part, rai_name] for rai_name in ids.values() for part in parts]
    pairs["fixed"] = [[part, "slab"] for part in parts]
    for i, a in enumerate(scene.objects):
        if a.name in moves:
            pairs["boxes"].append([ids[a.name], "foot", ids[a.name], ids[a.name]])
        for b in scene.objects[:i]:
            if not moves & {a.name, b.name}:
                continue
            if b.name in a.supports or a.name in b.supports:
                continue
            # Boxes that stand closer than their grown shapes allow are kept apart as they are.
            close = footprint_gap(a, b) < 2 * _growth() + 2e-4
            prefix = "" if close else "wide_"
            pair = [ids[a.name], ids[b.name]]
            pairs["boxes"].append([*(f"{prefix}{rai_name}" for rai_name in pair), *pair])
    listed = [pair[:2] for kind in ("hand", "boxes", "fixed") for pair in pairs[kind]]
    search = "\n".join(
        [
            "fol: <task.fol>",
            f'terminal: "(on target {ids[goal.subject]})"',
            "genericCollisions: false",
            f"coll: [{' '.join(name for pair in listed for name in pair)}]",
            "",
        ]
    )
    return RaiProblem(
        configuration="\n".join(lines) + "\n",
        rules=_RULES,
        search=search,
        pairs=pairs,
        names={**{rai_name: name for name, rai_name in ids.items()}, **places},
        turn=turn,
    )


def _models() -> Path:
    """The folder of rai's robot models, found without importing rai."""
    found = importlib.util.find_spec("robotic")
    assert found, "require_rai comes first"
    return Path(found.origin or "").parent / "rai-robotModels"


def _growth() -> float:
    """How far a rounded box is grown to each side to hold the true one, and some room, m."""
    return ROUND_BOX * (1 - 1 / math.sqrt(2)) + ROOM


def _world(scene: Scene, facts: str) -> list[str]:
    """Table, robot base and the robot's foot."""
    x, y = scene.table.size
    # rai keeps a box's centre over its support: the edge is as far away as its widest corner.
    spare = max(math.hypot(*box.size[:2]) for box in scene.objects)
    inner = (max(x - spare, 0.02), max(y - spare, 0.02))
    base, yaw = scene.robot.base, scene.robot.yaw
    centre, half = panda().foot
    table = _shape((0, 0, -0.05), (*inner, 0.1), 0.001, logical=f"{{ {facts} }}")
    return [
        "world: {}",
        f"table (world): {table}",
        f"slab (world): {_shape((0, 0, -0.05), (x, y, 0.1), 0.001)}",
        'Prefix: "l_"',
        f"Include: <{_models() / 'panda' / 'panda.g'}>",
        "Prefix: False",
        f"Edit l_panda_base (world): {{ Q: [{_row((*base, *_turned(yaw)))}] }}",
        *(f"Edit l_panda_joint{i + 1}: {{ q: {HOME[i]:.9f} }}" for i in range(ARM)),
        "Edit l_panda_finger_joint1: { joint_active: True }",
        f"foot (l_panda_base): {_shape(centre, 2 * half, 0.005)}",
    ]


def _hand() -> tuple[list[str], list[str]]:
    """Names and lines of the boxes around wrist, hand and fingers."""
    arm = panda()
    boxes = [(_FRAMES[LINKS[link]], centre, half) for link, centre, half in arm.arm]
    low = np.min([low for low, _ in arm.finger], axis=0)
    high = np.max([high for _, high in arm.finger], axis=0)
    x, y, z = (low + high) / 2
    for side, frame in _FINGERS.items():
        boxes.append((frame, np.array([x, side * y, z - _FINGER_ROOT]), (high - low) / 2))
    names = [f"part{i}" for i in range(len(boxes))]
    return names, [
        f"{name} ({frame}): {_shape(centre, 2 * (half + SKIN), 0.005)}"
        for name, (frame, centre, half) in zip(names, boxes, strict=True)
    ]


def _box(
    box: Box, scene: Scene, ids: Mapping[str, str], turn: Mapping[str, float], facts: list[str]
) -> list[str]:
    x, y, z = box.size
    size = (y, x, z) if turn[box.name] else (x, y, z)
    yaw, position = box.yaw + turn[box.name], np.array(box.position)
    support = next(iter(box.supports), None)
    parent = "table" if support is None else ids[support]
    if support is None:
        position = position + np.array([0, 0, 0.05])
    else:
        below = scene[support]
        angle = below.yaw + turn[support]
        dx, dy, dz = position - np.array(below.position)
        c, s = math.cos(angle), math.sin(angle)
        position, yaw = np.array([c * dx + s * dy, c * dy - s * dx, dz]), yaw - angle
    logical = f"{{ {', '.join(facts)} }}"
    shape = _shape(position, size, ROUND, yaw=yaw, logical=logical)
    wide = (size[0] + 2 * _growth(), size[1] + 2 * _growth(), size[2])
    name = ids[box.name]
    return [
        f"{name} ({parent}): {shape[:-2]}, joint: rigid }}",
        f"wide_{name} ({name}): {_shape((0, 0, 0), wide, ROUND_BOX)}",
    ]


def _region(scene: Scene, goal: Goal) -> Region:
    return goal.predicate.region(scene[goal.subject], scene[goal.reference], scene.robot)


def _target(
    scene: Scene, goal: Goal, there: Rectangle, reference_id: str, turn: Mapping[str, float]
) -> str:
    """A part of the goal region as a thin plate in its support; the subject's centre must be over
    it."""
    thick = 0.002
    extent = 2 * np.array(there.half) - 2 * REGION_MARGIN
    if goal.predicate.stacked:
        reference = scene[goal.reference]
        yaw = reference.yaw + turn[reference.name]
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = there.x - reference.position[0], there.y - reference.position[1]
        parent, angle = reference_id, there.angle - yaw
        centre = (c * dx + s * dy, c * dy - s * dx, (reference.size[2] - thick) / 2)
    else:
        parent, centre, angle = "table", (there.x, there.y, 0.05 - thick / 2), there.angle
    size = (*np.maximum(extent, 2 * REGION_MARGIN), thick)
    return f"target ({parent}): {_shape(centre, size, 0.0005, yaw=angle, logical='{ is_target }')}"


def _shape(centre, size, radius: float, *, yaw: float = 0.0, logical: str = "") -> str:
    """A rounded box in rai's words."""
    radius = min(radius, 0.45 * float(min(size)))
    text = f"{{ Q: [{_row((*centre, *_turned(yaw)))}], shape: ssBox"
    text += f", size: [{_row((*size, radius))}]"
    return f"{text}, logical: {logical} }}" if logical else f"{text} }}"


def _turned(yaw: float) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of a turn about z."""
    return math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)


def _row(values) -> str:
    return ", ".join(f"{value:.9f}" for value in values)
