"""Grasps as a family, and a planner whose `infeasible` means it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from relevance.holding.holds import FARTHEST, GRIP, GROUND, INSET, TILTS
from relevance.planner import PlannerConfig, plan, trajectory
from relevance.planner.checking import broken
from relevance.planner.grasps import (
    bodies,
    carried,
    grasps,
    leaning_grasps,
    other_grasps,
    pick_target,
)
from relevance.planner.kernels.boxes import body_pose
from relevance.planner.kernels.kinematics import FRAME, arm_at, hand_down, look_at_frames
from relevance.planner.kernels.motions import reach_to
from relevance.planner.path import Motion, shoulder_depth
from relevance.planner.problem import Problem
from relevance.robot import HOME, panda
from relevance.scene import Scene, scene_from_json
from tests.planning import BLUE, GREY, OPEN, RED, box

HAND_1 = scene_from_json(
    json.dumps(
        {
            "objects": [
                {"name": "b0", "size": [0.0949, 0.0496, 0.0487], "yaw": -1.886696,
                 "position": [-0.0267, -0.2589, 0.02435], "color": [0.1, 0.45, 0.96]},
                {"name": "b1", "size": [0.1, 0.1139, 0.1045], "yaw": -2.641596,
                 "position": [-0.0747, -0.1506, 0.05225], "color": [0.1, 0.96, 0.45]},
                {"name": "b2", "size": [0.0672, 0.0802, 0.0922], "yaw": -1.276396,
                 "position": [-0.0883, -0.2039, 0.1506], "color": [0.66, 0.84, 0.01], "on": "b1"},
                {"name": "b3", "size": [0.1084, 0.0579, 0.051], "yaw": -2.580596,
                 "position": [0.0025, 0.0741, 0.0255], "color": [0.66, 0.01, 0.84]},
                {"name": "b4", "size": [0.0807, 0.0504, 0.0952], "yaw": -2.353296,
                 "position": [-0.0789, 0.1366, 0.0476], "color": [1.0, 0.25, 0.25]},
            ]
        }
    )
)  # fmt: skip


@pytest.mark.parametrize("search", ["tree", "informed"])
def test_what_one_fixed_grasp_cannot_take_is_solved(search):
    result = plan(HAND_1, "on(b0, b1)", config=PlannerConfig(search=search))
    assert result.status == "solved"
    assert result.moved == ("b2", "b0")


@pytest.mark.parametrize("height", [0.01, 0.012, 0.015, 0.018])
def test_low_boxes_are_taken(height):
    tray = box("tray", 0.0, -0.3, RED, size=(0.05, 0.05, height))
    scene = Scene(objects=(tray, box("block", 0.0, 0.0, BLUE)))
    assert plan(scene, "on(tray, block)").status == "solved"


def test_what_is_too_low_for_the_fingers_is_infeasible():
    tray = box("tray", 0.0, -0.3, RED, size=(0.05, 0.05, 0.005))
    scene = Scene(objects=(tray, box("block", 0.0, 0.0, BLUE)))
    result = plan(scene, "on(tray, block)")
    assert result.status == "infeasible"
    assert result.reason == "tray cannot be grasped: too low for the fingers"


def test_thin_pads_mark_places():
    pad = box("pad", 0.0, 0.0, BLUE, size=(0.12, 0.12, 0.002))
    scene = Scene(objects=(pad, box("cube", 0.0, -0.3, RED)))
    assert plan(scene, "on(cube, pad)").status == "solved"


def test_every_hold_is_sound():
    rng = np.random.default_rng(1)
    count = 0
    for _ in range(200):
        size = tuple(rng.uniform(0.008, 0.12, 3))
        one = box("b", 0.0, 0.0, size=size)
        deep = grasps(one)
        for grasp in (*deep, *other_grasps(one), *leaning_grasps(one)):
            count += 1
            assert GRIP <= grasp.depth <= size[2] - GROUND + 1e-9
            pads = grasp.shift - panda().finger_tip * math.sin(grasp.tilt)
            assert abs(pads) <= max(size[1 - grasp.axis] / 2 - INSET, 0.0) + 1e-9
            assert abs(pads) <= FARTHEST + 1e-9
            assert grasp.price >= 0
            assert (grasp.price == 0) == (grasp in deep)
    assert count > 1000


def test_a_leaning_hand_is_where_its_rectangles_say_and_the_box_is_level():
    one = box("b", 0.1, -0.05, size=(0.05, 0.09, 0.08), yaw=0.4)
    arm, seen = arm_at(np.array([-0.48, 0.0, 0.0, 0.0])), set()
    p, R = np.zeros(3), np.zeros((3, 3))
    for grasp in leaning_grasps(one):
        target = pick_target(one, grasp)
        upright = replace(grasp, shift=grasp.wrist[0], above=grasp.wrist[1], tilt=0.0)
        for way in (1.0, -1.0):
            q = np.zeros(7)
            if not hand_down(pick_target(one, upright), arm.base, arm.lower, arm.upper, q, way):
                continue
            assert reach_to(arm, q, target)
            seen.add((grasp.tilt, way))
            look_at_frames(arm, q)
            body = bodies(grasp.opening, carried(one, grasp, way))
            c, s = math.cos(target[3]), math.sin(target[3])
            ends = []
            for b in range(len(body.link)):
                frame = arm.frames_y[body.link[b] * FRAME :][:FRAME]
                body_pose(frame, body.centre[b], body.turn[b], p, R)
                reach = np.abs(R) @ body.half[b]
                assert b < len(body.link) - 1 or np.isclose(reach[2], one.size[2] / 2)
                corners = p + (np.array(list(np.ndindex(2, 2, 2))) * 2 - 1) * body.half[b] @ R.T
                local = (corners - one.position) @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
                ends.append(np.r_[local.min(0), local.max(0)])
            hand, held = np.array(ends[-7:-1]), ends[-1]
            o, left, along, across, under = grasp.parts.T
            rows = np.column_stack([o - along, left - across, under - one.size[2] / 2, o + along,
                                    left + across])  # fmt: skip
            np.testing.assert_allclose(held[:5], rows[0], atol=1e-6)
            palm = hand[:2]  # its mesh is not quite symmetric, the rectangles are
            np.testing.assert_allclose(palm[:, [1, 2, 4]], rows[-2:, [1, 2, 4]], atol=1e-4)
            assert (palm[:, 0] >= rows[-2:, 0] - 1e-6).all()
            assert (palm[:, 3] <= rows[-2:, 3] + 1e-6).all()
            fingers = np.sort(hand[2:, :5], axis=0)
            np.testing.assert_allclose(fingers, np.sort(rows[1:-2], axis=0), atol=2e-4)
    assert {tilt for tilt, _ in seen} == set(TILTS) - {0.0}
    assert {way for _, way in seen} == {1.0, -1.0}


def test_deep_and_centred_is_preferred():
    result = plan(OPEN, "on(red, blue)")
    hold = grasps(OPEN["red"])[0]
    problem = Problem(OPEN, result.goal)
    q = result.phases[0].q[-1]
    from relevance.planner.checking import _held

    centre, _, turn = _held(problem, "red", q)
    np.testing.assert_allclose([*centre, turn], [0.0, 0.0, hold.above, 0.0], atol=1e-3)


def test_a_full_turn_of_yaw_changes_nothing():
    wall = box("grey", 0.0, -0.06, GREY, size=(0.12, 0.06, 0.08))
    here = Scene(objects=(*OPEN.objects, wall))
    turned = replace(
        here, id="", objects=tuple(replace(b, yaw=b.yaw + 2 * math.pi) for b in here.objects)
    )
    a, b = (plan(scene, "on-the-left(red, blue)", replay=False) for scene in (here, turned))
    assert (a.status, a.moved) == (b.status, b.moved)


def test_a_box_under_the_subject_cannot_leave_first():
    tower = [box(f"t{i}", 0.0, 0.2, RED, size=(0.05,) * 3, bottom=0.05 * i,
                 on=f"t{i - 1}" if i else None) for i in range(3)]  # fmt: skip
    scene = Scene(objects=(*tower, box("x", 0.0, -0.2, BLUE)))
    for search in ("tree", "informed"):
        result = plan(scene, "on(t2, t0)", config=PlannerConfig(search=search))
        assert result.status == "infeasible"
        assert result.blocking == ("t1",)
        assert "t2 stands on t1 and would have to move twice" in result.reason


def test_limits_are_named():
    wall = box("grey", 0.0, -0.06, GREY, size=(0.12, 0.06, 0.08))
    scene = Scene(objects=(*OPEN.objects, wall))
    result = plan(scene, "on-the-left(red, blue)", config=PlannerConfig(max_actions=2))
    assert result.status == "limit"
    assert result.blocking == ("grey",)
    assert "grey would have to leave first; max_actions" in result.reason
    result = plan(scene, "on-the-left(red, blue)", config=PlannerConfig(node_limit=2))
    assert result.status == "limit"
    assert "node limit" in result.reason


def test_the_dense_check_fails_what_breaks_a_limit_or_the_goal():
    result = plan(OPEN, "on(red, blue)", replay=False)
    problem = Problem(OPEN, result.goal)
    motion = Motion(
        order=result.moved, phases=result.phases, final=result.final, cost=result.cost,
        max_penetration=result.max_penetration,
    )  # fmt: skip
    assert broken(problem, motion) == ""
    first = result.phases[0]
    lean = np.zeros(7)
    lean[3] = 4.0
    bent = replace(first, q=first.q + lean)
    assert "joint 4 exceeds" in broken(problem, replace(motion, phases=(bent,)))
    fast = replace(first, dt=first.dt / 20)
    assert "times its speed limit" in broken(problem, replace(motion, phases=(fast,)))
    assert "is not true" in broken(problem, replace(motion, final={}))
    assert "penetrated" in broken(problem, replace(motion, max_penetration=2e-3))
    (where,) = result.final.values()
    beyond = replace(where, position=(0.39, 0.0, 0.03), on=None)
    off = replace(motion, final={"red": beyond})
    assert broken(problem, off) == "red is not put on the table"


def test_a_box_in_the_hand_is_held_against_the_arm_itself():
    """The first link turns with the arm, and so must what is held against it."""
    problem = Problem(OPEN, OPEN.goal("on(red, blue)"))
    box = problem.boxes["red"]
    grasp = grasps(box)[0]
    held = carried(box, grasp, 1.0)
    folded = (-1.2, 0.0, -3.0, 0.0, 1.0, 0.8)
    depths = []
    for turn in (0.0, 1.0, -2.0):
        rows = np.tile([turn, *folded], (2, 1))
        depths.append(shoulder_depth(problem, rows, grasp.opening, held))
    assert depths[0] > 0.005
    assert depths == pytest.approx([depths[0]] * 3)
    assert shoulder_depth(problem, np.tile(HOME, (2, 1)), grasp.opening, held) == 0.0


def test_a_trajectory_is_the_plan():
    result = plan(OPEN, "on(red, blue)")
    arrays = trajectory(result)
    count = sum(len(phase.q) for phase in result.phases)
    assert {name: len(rows) for name, rows in arrays.items()} == dict.fromkeys(
        ("times", "joints", "gripper", "attached"), count
    )
    assert (np.diff(arrays["times"]) > 0).all()
    assert set(arrays["attached"]) == {"", "red"}
    moves = np.abs(np.diff(arrays["joints"], axis=0)).max(axis=1)
    assert moves[np.diff(arrays["gripper"]) != 0].max() == 0  # still while the fingers move
    assert len(trajectory(replace(result, phases=()))["times"]) == 0


@pytest.mark.parametrize(
    ("base", "yaw"),
    [((-0.48, 0.0, 0.0), 0.4), ((0.0, -0.6, 0.0), math.pi / 2), ((0.55, 0.0, 0.0), math.pi),
     ((-0.48, 0.0, 0.1), 0.0)],
)  # fmt: skip
def test_robots_stand_anywhere(base, yaw):
    wall = box("grey", 0.0, -0.02, GREY, size=(0.12, 0.06, 0.08))
    red, blue = box("red", 0.05, 0.15, RED), box("blue", 0.0, -0.12, BLUE)
    robot = replace(OPEN.robot, base=base, yaw=yaw)
    scene = Scene(objects=(red, blue, wall), robot=robot)
    for goal in ("on(red, blue)", "in-front(red, blue)"):
        result = plan(scene, goal)
        assert result.status == "solved", result.reason
        assert result.replay is not None
        assert result.replay.ok
