"""Plans as arrays: run again in pybullet by this file alone, and written by `relevance plan`."""

import json
import math
from pathlib import Path

import numpy as np
import pybullet
import pytest
from planning import OPEN, box

import relevance
from relevance.cli import main
from relevance.planner import write_trajectory
from relevance.robot import panda_urdf
from relevance.scene import Robot, Scene

HAND, FINGERS = 8, (9, 10)
BURDENED = Scene(
    objects=(
        box("red", 0.2, -0.05),
        box("blue", 0.0, -0.15),
        box("grey", 0.0, -0.15, bottom=0.06, on="blue"),
    ),
    robot=Robot(base=(0.0, -0.6, 0.0), yaw=math.pi / 2),
)


def turned(yaw):
    return (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


@pytest.fixture
def world():
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(client)


def run(scene, arrays, client):
    """Where every box is after the trajectory, by nothing but its arrays and the URDF."""
    robot = pybullet.loadURDF(str(panda_urdf()), useFixedBase=True, physicsClientId=client)
    base = (scene.robot.base, turned(scene.robot.yaw))
    inertial = pybullet.getDynamicsInfo(robot, -1, physicsClientId=client)[3:5]
    at = pybullet.multiplyTransforms(*base, *inertial)
    pybullet.resetBasePositionAndOrientation(robot, *at, physicsClientId=client)
    joints = [pybullet.getJointInfo(robot, j, physicsClientId=client) for j in range(7)]
    lower, upper, speed = (np.array([joint[k] for joint in joints]) for k in (8, 9, 11))
    times, q, gripper = arrays["times"], arrays["joints"], arrays["gripper"]
    assert (q >= lower - 1e-6).all()
    assert (q <= upper + 1e-6).all()
    assert times[0] == 0.0
    steps = np.diff(times)
    assert (steps > 0).all()
    assert (np.abs(np.diff(q, axis=0)) <= speed * steps[:, None] * (1 + 1e-6)).all()
    poses = {b.name: (b.position, turned(b.yaw)) for b in scene.objects}
    held, offset, most = "", None, 0.0
    for row, opening, name in zip(q, gripper, arrays["attached"], strict=True):
        for joint, value in [*enumerate(row), *((finger, opening) for finger in FINGERS)]:
            pybullet.resetJointState(robot, joint, value, physicsClientId=client)
        state = pybullet.getLinkState(
            robot, HAND, computeForwardKinematics=True, physicsClientId=client
        )
        hand = state[4:6]
        if name and name != held:
            offset = pybullet.multiplyTransforms(*pybullet.invertTransform(*hand), *poses[name])
            # The pads are about 0.1 m from the hand's origin: the box is between them.
            assert np.linalg.norm(offset[0][:2]) < 0.05
            assert 0.05 < offset[0][2] < 0.2
        held = name
        if held:
            assert offset is not None
            before = poses[held][0]
            poses[held] = pybullet.multiplyTransforms(*hand, *offset)
            most = max(most, float(np.linalg.norm(np.subtract(poses[held][0], before))))
    assert held == ""
    assert 0 < most < 0.2  # a box that is held goes with the hand, without jumps
    return poses


@pytest.mark.parametrize("scene", [OPEN, BURDENED])
def test_a_written_plan_runs_in_another_simulator(scene, world, tmp_path):
    result = relevance.plan(scene, "on(red, blue)")
    assert result.status == "solved"
    write_trajectory(tmp_path / "plan.npz", result)
    with np.load(tmp_path / "plan.npz") as arrays:
        poses = run(scene, dict(arrays), world)
    (x, y, z), blue = poses["red"][0], poses["blue"][0]
    assert abs(x - blue[0]) <= 0.025
    assert abs(y - blue[1]) <= 0.025
    assert z == pytest.approx(0.09, abs=1e-3)
    for name, pose in result.final.items():
        assert poses[name][0] == pytest.approx(pose.position, abs=1e-3)


def test_plan_writes_one_file_a_goal_and_none_without_a_plan(tmp_path, capsys):
    record = {
        "id": "s", "goals": ["on(red, blue)", "on(red, wide)", "on-the-left(red, blue)"],
        "objects": [
            {"name": name, "size": size, "position": [0.0, y, size[2] / 2], "color": [1, 0, 0]}
            for name, y, size in (
                ("red", 0.25, [0.05, 0.05, 0.06]), ("blue", -0.15, [0.05, 0.05, 0.06]),
                ("wide", 3.0, [0.05, 0.05, 0.06]),
            )
        ],
        "table": {"size": [1.0, 8.0]},
    }  # fmt: skip
    (tmp_path / "scenes.jsonl").write_text(json.dumps(record))
    (tmp_path / "plan-2.npz").write_bytes(b"of an older plan")
    asked = [str(tmp_path / "scenes.jsonl"), "--trajectory", str(tmp_path / "plan.npz")]
    assert main(["plan", *asked, "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["status"] for line in lines] == ["solved", "infeasible", "solved"]
    files = [line["trajectory"] and Path(line["trajectory"]).name for line in lines]
    assert files == ["plan-1.npz", None, "plan-3.npz"]
    assert {file.name for file in tmp_path.glob("plan*")} == {"plan-1.npz", "plan-3.npz"}
    with np.load(tmp_path / "plan-3.npz") as arrays:
        assert arrays["joints"].shape == (len(arrays["times"]), 7)
        assert set(arrays["attached"]) == {"", "red"}


def test_a_file_that_cannot_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    result = relevance.plan(OPEN, "on(red, blue)", replay=False)
    file = tmp_path / "plan.npz"
    file.write_bytes(b"old")

    def full(stream, **_):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space"):
        write_trajectory(file, result)
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]
