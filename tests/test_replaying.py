"""Replay of hand-made motions: the good ones hold, the spoilt ones do not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pybullet
import pytest

from relevance.planner import plan
from relevance.robot import panda_urdf
from relevance.scene import (
    PREDICATES,
    Action,
    Box,
    Goal,
    Phase,
    Pose,
    Robot,
    Scene,
    SceneError,
    Table,
    goal_holds,
    read_scenes,
)
from relevance.simulation import replay

CASES = Path(__file__).parent / "cases"

GRASP = 11  # the URDF's grasp target, between the finger pads
REST = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8])


def box(name: str, x: float, y: float, size=(0.05, 0.06, 0.08), **more) -> Box:
    color = {"red": (0.8, 0.1, 0.1), "blue": (0.1, 0.2, 0.8), "green": (0.1, 0.7, 0.2)}
    fields = {"position": (x, y, size[2] / 2), "color": color.get(name, (0.8, 0.6, 0.1))}
    return Box(name=name, size=size, **(fields | more))


class Arm:
    """Inverse kinematics of the Panda for hand-made motions, by pybullet."""

    def __init__(self) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        self.robot = pybullet.loadURDF(
            str(panda_urdf()),
            useFixedBase=True,
            basePosition=(-0.48, 0, 0),
            flags=pybullet.URDF_IGNORE_VISUAL_SHAPES,
            physicsClientId=self.client,
        )

    def set(self, q: np.ndarray) -> None:
        for joint, value in enumerate(q):
            pybullet.resetJointState(self.robot, joint, value, physicsClientId=self.client)

    def at(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position of the grasp point and rotation matrix of the hand."""
        self.set(q)
        state = pybullet.getLinkState(
            self.robot, GRASP, computeForwardKinematics=True, physicsClientId=self.client
        )
        return np.array(state[4]), np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))

    def solve(self, point, yaw: float, start: np.ndarray, tilt: float = 0.0) -> np.ndarray:
        """Joint angles (7,) with the grasp point at `point`, hand down, y axis turned by yaw."""
        turn = pybullet.getQuaternionFromEuler((tilt, 0.0, yaw))
        _, orientation = pybullet.multiplyTransforms((0, 0, 0), turn, (0, 0, 0), (1, 0, 0, 0))
        q = start
        for _ in range(200):
            self.set(q)
            q = np.array(
                pybullet.calculateInverseKinematics(
                    self.robot,
                    GRASP,
                    list(point),
                    orientation,
                    maxNumIterations=50,
                    residualThreshold=1e-9,
                    physicsClientId=self.client,
                )
            )[:7]
            if np.abs(self.at(q)[0] - point).max() < 1e-6:
                return q
        raise AssertionError(f"no arm configuration for {point}")


@pytest.fixture(scope="module")
def arm() -> Iterator[Arm]:
    made = Arm()
    yield made
    pybullet.disconnect(physicsClientId=made.client)


def line(arm: Arm, points, yaws, start: np.ndarray) -> np.ndarray:
    """Rows of joint angles along straight segments between hand points, every 2 cm."""
    rows = [start]
    for (a, b), (p, r) in zip(pairwise(points), pairwise(yaws), strict=True):
        count = max(math.ceil(np.linalg.norm(np.subtract(b, a)) / 0.02), 2)
        for share in np.linspace(0, 1, count + 1)[1:]:
            point = (1 - share) * np.array(a) + share * np.array(b)
            rows.append(arm.solve(point, (1 - share) * p + share * r, rows[-1]))
    return np.array(rows)


def carry(
    arm: Arm,
    subject: Box,
    to: Pose,
    *,
    lift: float = 0.16,
    opening: float | None = None,
    support: str = "table",
) -> list[Phase]:
    """Pick a box by its x edge from above, lift it, carry it, put it down, retreat."""
    half = subject.size[0] / 2 if opening is None else opening
    yaw, end = subject.yaw + math.pi / 2, to.yaw + math.pi / 2
    grasp = np.add(subject.position, (0, 0, subject.size[2] / 2 - 0.025))
    drop = grasp + np.subtract(to.position, subject.position)
    up = np.array([0, 0, lift])
    top = grasp[2] + lift
    above = np.array([drop[0], drop[1], top])
    start = arm.solve(grasp + up, yaw, REST)
    reach = line(arm, [grasp + up, grasp], [yaw, yaw], start)
    move = line(arm, [grasp, grasp + up, above, drop], [yaw, yaw, end, end], reach[-1])
    leave = line(arm, [drop, above], [end, end], move[-1])
    pick = Action(name="pick", object=subject.name)
    place = Action(name="place", object=subject.name, support=support)
    return [
        Phase(action=pick, q=reach, dt=0.2, opening=0.04, carried=None),
        Phase(action=place, q=move, dt=0.2, opening=half, carried=subject.name),
        Phase(action=None, q=leave, dt=0.2, opening=0.04, carried=None),
    ]


RED = box("red", 0.0, 0.0)
BLUE = box("blue", 0.02, 0.22, size=(0.08, 0.06, 0.07))
SCENE = Scene(objects=(RED, BLUE, box("green", 0.1, -0.2)))
GOAL = Goal.parse("on-the-right(red, blue)")
TARGET = Pose(position=(0.02, 0.22 - 0.03 - 0.025 - 0.03, 0.04), yaw=0.3)


@pytest.fixture(scope="module")
def good(arm: Arm) -> list[Phase]:
    return carry(arm, RED, TARGET)


def test_replay_confirms_a_good_motion(good):
    verdict = replay(SCENE, GOAL, good)
    assert verdict.ok, verdict
    assert verdict.reason == ""
    assert 0 <= verdict.max_penetration < 1e-4


def test_replay_leaves_no_trace_on_the_next(good, arm):
    first = replay(SCENE, GOAL, good)
    other = Scene(objects=(replace(RED, yaw=0.5), BLUE), robot=Robot(base=(-0.5, 0.01, 0)))
    assert not replay(other, GOAL, good).ok
    assert replay(SCENE, GOAL, good) == first


def test_replay_stacks(arm):
    to = Pose(position=(0.02, 0.22, 0.07 + 0.04), yaw=0.0, on="blue")
    phases = carry(arm, RED, to, support="blue")
    assert replay(SCENE, Goal.parse("on(red, blue)"), phases).ok
    wrong = [phases[0], replace(phases[1], action=replace(phases[1].action, support="green"))]
    verdict = replay(SCENE, Goal.parse("on(red, blue)"), [*wrong, phases[2]])
    assert "over its support" in verdict.reason


def test_replay_moves_a_box_twice(arm):
    first = Pose(position=(-0.05, -0.1, 0.04), yaw=0.0)
    one = carry(arm, RED, first)
    moved = replace(RED, position=first.position, yaw=first.yaw)
    two = carry(arm, moved, TARGET)
    joint = np.vstack([one[2].q, two[0].q])
    approach = replace(two[0], q=joint, dt=1.0)
    assert replay(SCENE, GOAL, [*one[:2], approach, *two[1:]]).ok


def test_replay_from_a_turned_robot(arm, good):
    """The whole world turned and shifted about z: the same verdict."""
    turn, base = 0.7, (-0.3, -0.25, 0.0)
    c, s = math.cos(turn), math.sin(turn)

    def carried_over(p):
        x, y = p[0] + 0.48, p[1]
        return (base[0] + c * x - s * y, base[1] + s * x + c * y, p[2])

    boxes = tuple(
        replace(b, position=carried_over(b.position), yaw=b.yaw + turn) for b in SCENE.objects
    )
    table = Table(size=(3.0, 3.0))
    scene = Scene(objects=boxes, robot=Robot(base=base, yaw=turn), table=table)
    verdict = replay(scene, Goal.parse("on(red, blue)"), good)
    assert verdict.reason == "the goal on(red, blue) is not true at the end"
    assert verdict.max_penetration < 1e-4
    assert replay(scene, GOAL, good).ok


SIDES = {
    "opposite": Robot(base=(0.48, 0.0, 0.0), yaw=math.pi),
    "beside": Robot(base=(0.0, -0.5, 0.0), yaw=math.pi / 2),
    "raised": Robot(base=(-0.45, 0.1, 0.1), yaw=-0.4),
}


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", [p.name for p in PREDICATES.values() if not p.stacked])
def test_plans_of_turned_robots_end_where_the_robot_says(side, name):
    """A goal's direction is the robot's, to the planner and to the referee alike."""
    robot = SIDES[side]
    scene = replace(read_scenes(CASES / "other-side.jsonl")[0], id="", robot=robot)
    goal = scene.goal(f"{name}(a, b)")
    result = plan(scene, goal)
    assert result.status == "solved"
    verdict = replay(scene, goal, result.phases)
    assert verdict.ok
    assert verdict.reason == ""
    a, b = (next(box for box in scene.moved(result.final) if box.name == n) for n in "ab")
    dx, dy = a.position[0] - b.position[0], a.position[1] - b.position[1]
    c, s = math.cos(robot.yaw), math.sin(robot.yaw)
    ahead, left = c * dx + s * dy, c * dy - s * dx
    toward = {"on-the-left": left, "on-the-right": -left, "behind": ahead, "in-front": -ahead}
    assert max(toward, key=lambda way: toward[way]) == name
    # What is left of one robot is not left of a robot that faces it.
    assert not goal_holds([a, b], goal, replace(robot, yaw=robot.yaw + math.pi))


@pytest.mark.parametrize("goal", ["on(plate, c)", "on(a, c)"])
def test_a_bridge_is_lifted_before_its_pillars(goal):
    size = (0.05, 0.22, 0.03)
    pillars = (box("a", 0, -0.07, (0.05,) * 3), box("b", 0, 0.07, (0.05,) * 3))
    plate = box("plate", 0, 0, size, position=(0, 0, 0.065), on=("a", "b"))
    scene = Scene(objects=(*pillars, plate, box("c", 0.1, -0.25, (0.05,) * 3)))
    result = plan(scene, scene.goal(goal))
    assert result.moved[0] == "plate"
    assert replay(scene, scene.goal(goal), result.phases).ok


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("velocity", "times its speed limit"),
        ("limit", "exceeds its limit"),
        ("nan", "finite"),
        ("dt", "dt = 0"),
        ("opening", "opening 0.05 m"),
        ("gap", "does not start where"),
        ("carried", "carries None"),
        ("loose", "off the box's face"),
        ("squeezed", "off the box's face"),
        ("beside", "not between the fingers"),
        ("unknown", "no such box"),
        ("misplaced", "the hand holds 'red'"),
        ("greedy", "the hand holds 'red' already"),
        ("pushed", "expected pick or place"),
        ("tilted", "tilted by 0.030 rad"),
        ("deep", "red penetrates table by 1.5 mm"),
        ("keeps", "ends with 'red' in the hand"),
        ("unfinished", "the plan ends with the hand at the box"),
        ("floats", "over its support"),
        ("goal", "is not true at the end"),
        ("empty", "is not true at the end"),
    ],
)
def test_replay_refuses(name, reason, good, arm):
    pick, place, leave = good
    goal = GOAL
    if name == "velocity":
        pick = replace(pick, dt=0.001)
    elif name == "limit":
        q = leave.q.copy()
        q[-1, 3] = 0.01
        leave = replace(leave, q=q, dt=2.0)
    elif name == "nan":
        q = place.q.copy()
        q[3, 2] = math.nan
        place = replace(place, q=q)
    elif name == "dt":
        place = replace(place, dt=0.0)
    elif name == "opening":
        leave = replace(leave, opening=0.05)
    elif name == "gap":
        place = replace(place, q=place.q[1:])
    elif name == "carried":
        place = replace(place, carried=None)
    elif name in ("loose", "squeezed"):
        place = replace(place, opening=place.opening + (0.004 if name == "loose" else -0.004))
    elif name == "beside":
        pick = replace(pick, action=Action(name="pick", object="green"))
    elif name == "unknown":
        pick = replace(pick, action=Action(name="pick", object="grey"))
    elif name == "misplaced":
        place = replace(place, action=Action(name="place", object="green", support="table"))
    elif name == "greedy":
        place = replace(place, action=Action(name="pick", object="green"))
    elif name == "pushed":
        place = replace(place, action=Action(name="push", object="red"))
    elif name in ("tilted", "deep"):
        end, yaw = arm.at(place.q[-1])[0], TARGET.yaw + math.pi / 2
        lower = 0.0015 if name == "deep" else 0.0
        last = arm.solve(end - (0, 0, lower), yaw, place.q[-1], 0.03 if name == "tilted" else 0.0)
        place = replace(place, q=np.vstack([place.q[:-1], last]))
        leave = replace(leave, q=np.vstack([last, leave.q[1:]]))
    elif name == "keeps":
        place = replace(place, action=None)
        leave = replace(leave, carried="red", opening=place.opening)
    elif name == "floats":
        short = place.q[:-1]
        place = replace(place, q=short)
        leave = replace(leave, q=np.vstack([short[-1:], leave.q]))
    elif name == "goal":
        goal = Goal.parse("on-the-left(red, blue)")
    phases = [pick, place, leave]
    if name == "unfinished":
        phases = phases[:2]
    elif name == "empty":
        phases = []
    verdict = replay(SCENE, goal, phases)
    assert not verdict.ok
    assert reason in verdict.reason


def test_replay_refuses_overlap_with_a_neighbour(good, arm):
    """Boxes put into the way of fingers, carried box and hand: seen, and how deep."""
    beside = box("grey", 0.0, 0.0, position=(0.0 + 0.025 + 0.03 + 0.02, 0.0, 0.04))
    verdict = replay(Scene(objects=(*SCENE.objects, beside)), GOAL, good)
    # A finger's outer face is at 0.0664 from the middle, the neighbour's near face at 0.05.
    assert "finger penetrates grey" in verdict.reason
    assert 0.01 < verdict.max_penetration < 0.017

    wall = box("grey", 0.01, 0.075, size=(0.2, 0.02, 0.2))
    verdict = replay(Scene(objects=(*SCENE.objects, wall)), GOAL, good)
    assert "penetrates grey" in verdict.reason
    assert "phase 1" in verdict.reason


def test_replay_refuses_to_put_a_box_over_an_edge(arm):
    to = Pose(position=(-0.05, -0.13, 0.04), yaw=0.0)
    narrow = Scene(objects=(RED, box("blue", 0.15, 0.08)), table=Table(size=(0.8, 0.28)))
    verdict = replay(narrow, Goal.parse("on(red, blue)"), carry(arm, RED, to))
    assert "the box is not on the table" in verdict.reason

    on_blue = Goal.parse("on(red, blue)")
    to = Pose(position=(0.02 - 0.045, 0.22, 0.07 + 0.04), yaw=0.0, on="blue")
    verdict = replay(SCENE, on_blue, carry(arm, RED, to, support="blue"))
    assert "centre is not over 'blue'" in verdict.reason


def test_replay_measures_a_corner_exactly(arm):
    """Red comes down with a corner 1.3 mm deep in the face of its neighbour."""
    depth = 0.0013
    reach = (RED.size[0] + RED.size[1]) / 2 * math.sqrt(0.5)
    y = BLUE.position[1] - BLUE.extents[1] - reach + depth
    to = Pose(position=(0.02, y, 0.04), yaw=math.pi / 4)
    verdict = replay(SCENE, GOAL, carry(arm, RED, to))
    assert "red penetrates blue by 1.3 mm" in verdict.reason


def test_replay_sees_fingers_close_on_something_else(arm):
    """A plate that open and closed fingers both clear is hit on the way."""
    slim = box("red", 0.0, 0.0, size=(0.012, 0.06, 0.08))
    plate = box("grey", 0.0365, 0.0, size=(0.005, 0.02, 0.08))
    to = replace(TARGET, position=(0.02, 0.22 - 0.03 - 0.006 - 0.03, 0.04))
    phases = carry(arm, slim, to)
    assert replay(Scene(objects=(slim, BLUE)), GOAL, phases).ok
    verdict = replay(Scene(objects=(slim, BLUE, plate)), GOAL, phases)
    assert "pick red: panda_" in verdict.reason
    assert "finger penetrates grey" in verdict.reason


def test_replay_sees_the_carried_box(good):
    """A wall that is lower than the finger tips: only the box in the hand meets it."""
    wall = box("grey", 0.01, 0.075, size=(0.2, 0.02, 0.18))
    verdict = replay(Scene(objects=(*SCENE.objects, wall)), GOAL, good)
    assert "red penetrates grey" in verdict.reason
    assert verdict.max_penetration == pytest.approx(0.02, abs=2e-3)


def test_replay_sees_the_arm_in_itself(good):
    """The arm folded until its hand is inside its own lower links."""
    start = good[2].q[-1]
    folded = np.array([0.0, -1.7, 0.0, -3.1, 0.0, 0.2, 0.8])
    q = np.linspace(start, folded, 30)
    verdict = replay(SCENE, GOAL, [*good[:2], replace(good[2], q=np.vstack([good[2].q, q[1:]]))])
    assert "panda_" in verdict.reason
    assert "penetrates" in verdict.reason


def test_replay_sees_between_rows(arm):
    """A thin wall that every row misses is hit between two rows."""
    lift = carry(arm, RED, TARGET, lift=0.1)
    ends = lift[1].q
    # Keep the row at the lifted pose and the row above the target, drop what lies between.
    high = [arm.at(q)[0] for q in ends]
    top = max(p[2] for p in high)
    keep = [i for i, p in enumerate(high) if p[2] < top - 1e-4]
    first = max(i for i in keep if i < len(ends) // 2) + 1
    last = min(i for i in keep if i > len(ends) // 2) - 1
    rows = np.vstack([ends[: first + 1], ends[last:]])
    thin = replace(lift[1], q=rows, dt=1.0)
    wall = box("grey", 0.01, 0.0675, size=(0.3, 0.002, 0.12))
    scene = Scene(objects=(*SCENE.objects, wall))
    phases = [lift[0], thin, lift[2]]
    sides = [arm.at(q)[0][1] for q in (rows[first], rows[first + 1])]
    assert sides[0] < 0.0675 < sides[1]
    assert "penetrates grey" in replay(scene, GOAL, phases).reason


def test_replay_sees_the_table(arm):
    """A box with its grasp too deep: the fingers go into the table."""
    flat = box("red", 0.0, 0.0, size=(0.05, 0.06, 0.02))
    scene = Scene(objects=(flat, BLUE))
    low = replace(TARGET, position=(*TARGET.position[:2], 0.01))
    verdict = replay(scene, GOAL, carry(arm, flat, low))
    assert "penetrates table" in verdict.reason
    # Grasp point 25 mm under the box's top at 20 mm, finger tips 7.25 mm lower.
    assert verdict.max_penetration == pytest.approx(0.005 + 0.00725, abs=2e-4)


def test_replay_refuses_a_loaded_box(good):
    rider = box("grey", 0.0, 0.0, size=(0.04, 0.04, 0.012), position=(0, 0, 0.086), on="red")
    verdict = replay(Scene(objects=(*SCENE.objects, rider)), GOAL, good)
    assert "'grey' stands on it" in verdict.reason


def test_replay_agrees_with_itself_at_finer_steps(good):
    coarse, fine = replay(SCENE, GOAL, good, substeps=1), replay(SCENE, GOAL, good, substeps=20)
    assert coarse.ok
    assert fine.ok
    with pytest.raises(ValueError, match="substeps = 0"):
        replay(SCENE, GOAL, good, substeps=0)


def test_replay_refuses_a_goal_about_nothing(good):
    with pytest.raises(SceneError, match="unknown object 'grey'"):
        replay(SCENE, Goal.parse("behind(red, grey)"), good)


def test_replay_outlives_many_worlds(good, arm):
    """The arena is made anew after 200 scenes; the verdict stays."""
    short = [replace(good[2], q=good[2].q[:1])]
    verdicts = {replay(SCENE, GOAL, short) for _ in range(205)}
    assert len(verdicts) == 1
    assert replay(SCENE, GOAL, good).ok


def test_replay_penetration_is_the_true_overlap(arm):
    """The palm lowered onto a box by a known depth."""
    tall = box("green", 0.05, 0.0, size=(0.04, 0.04, 0.12))
    scene = Scene(objects=(tall, BLUE))
    # Palm's face at 0.06596 from the hand's origin, grasp point at 0.105.
    depth = 0.004
    low = np.array([0.05, 0.0, 0.12 - (0.105 - 0.06596) - depth])
    high = np.add(low, (0, 0, 0.1))
    q = line(arm, [high, low], [0.0, 0.0], arm.solve(high, 0.0, REST))
    phase = Phase(action=None, q=q, dt=0.5, opening=0.04, carried=None)
    verdict = replay(scene, Goal.parse("behind(green, blue)"), [phase])
    assert verdict.max_penetration == pytest.approx(depth, abs=2e-4)
