"""Kinematics against pybullet, gradients against finite differences, pose bound against a grid."""

import math
import os
import subprocess
import sys

import numpy as np
import pybullet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from relevance import _kernel_cache
from relevance.planner.grasps import Held, bodies, grasps
from relevance.planner.kernels import motions, native, planar
from relevance.planner.kernels.boxes import (
    banded_solve,
    separation,
)
from relevance.planner.kernels.kinematics import (
    FRAME,
    arm_at,
    finger_way,
    functions,
    hand_down,
    reach_interval,
)
from relevance.planner.kernels.native import call
from relevance.planner.kernels.planar import FOUND, NONE
from relevance.planner.kernels.rows import WIDTH
from relevance.robot import ARM, LINKS, panda, panda_urdf
from relevance.scene import Box
from relevance.scene.geometry import UPRIGHT, rectangle_gap, upright

BASE = np.array([-0.48, 0.0, 0.0, 0.0])


def frames_at(q, base=BASE):
    functions().frames.x[:] = np.r_[q, base]
    call(functions().frames.handle)
    return functions().frames.y.copy().reshape(len(LINKS), FRAME)


def obstacle_rows(numbers):
    """Obstacle rows of (x, y, z, yaw, half extents) rows."""
    rows = np.empty((len(numbers), UPRIGHT))
    for row, given_row in zip(rows, np.asarray(numbers, float), strict=True):
        upright(*given_row, row)
    return rows


def random_q(rng):
    arm = panda()
    return rng.uniform(arm.lower, arm.upper)


def test_forward_kinematics_equals_pybullet():
    client = pybullet.connect(pybullet.DIRECT)
    try:
        base = np.array([-0.4, 0.1, 0.05, 0.7])
        turn = pybullet.getQuaternionFromEuler([0, 0, base[3]])
        robot = pybullet.loadURDF(
            str(panda_urdf()), base[:3].tolist(), turn, useFixedBase=True, physicsClientId=client
        )
        joints = [pybullet.getJointInfo(robot, j, client) for j in range(12)]
        index = {joint[12].decode(): joint[0] for joint in joints}
        rng = np.random.default_rng(0)
        for _ in range(50):
            q = random_q(rng)
            for i in range(ARM):
                pybullet.resetJointState(robot, i, q[i], physicsClientId=client)
            ours = frames_at(q, base)
            for k, link in enumerate(LINKS):
                state = pybullet.getLinkState(
                    robot, index[link], computeForwardKinematics=True, physicsClientId=client
                )
                R = np.array(pybullet.getMatrixFromQuaternion(state[5]))
                np.testing.assert_allclose(ours[k, :3], state[4], atol=1e-6)
                np.testing.assert_allclose(ours[k, 3:12], R, atol=1e-6)
    finally:
        pybullet.disconnect(client)


def test_joint_limits_are_those_of_the_urdf():
    client = pybullet.connect(pybullet.DIRECT)
    try:
        robot = pybullet.loadURDF(str(panda_urdf()), physicsClientId=client)
        joints = [pybullet.getJointInfo(robot, j, client) for j in range(ARM)]
    finally:
        pybullet.disconnect(client)
    arm = panda()
    np.testing.assert_allclose(arm.lower, [joint[8] for joint in joints])
    np.testing.assert_allclose(arm.upper, [joint[9] for joint in joints])
    np.testing.assert_allclose(arm.velocity, [joint[11] for joint in joints])


def test_frame_jacobians_equal_finite_differences():
    rng, h = np.random.default_rng(1), 1e-6
    for _ in range(10):
        q = random_q(rng)
        at = frames_at(q)
        for i in range(ARM):
            step = h * np.eye(ARM)[i]
            change = (frames_at(q + step) - frames_at(q - step)) / (2 * h)
            for k in range(len(LINKS)):
                np.testing.assert_allclose(
                    at[k, 12:33].reshape(3, 7)[:, i], change[k, :3], atol=1e-6
                )
                w = at[k, 33:54].reshape(3, 7)[:, i]
                R = at[k, 3:12].reshape(3, 3)
                spin = np.cross(w, R, axisb=0, axisc=0)
                np.testing.assert_allclose(spin.ravel(), change[k, 3:12], atol=1e-6)


def test_grasp_jacobians_equal_finite_differences():
    rng, h = np.random.default_rng(2), 1e-6

    def residual(x):
        functions().grasp.x[:] = x
        call(functions().grasp.handle)
        return functions().grasp.y.copy()

    for _ in range(10):
        x = np.r_[random_q(rng), BASE, rng.uniform(-0.5, 0.5, 5)]
        y = residual(x)
        J = np.hstack([y[6:48].reshape(6, 7), y[48:72].reshape(6, 4)])
        for column, i in enumerate([*range(7), *range(11, 15)]):
            step = h * np.eye(len(x))[i]
            change = (residual(x + step)[:6] - residual(x - step)[:6]) / (2 * h)
            np.testing.assert_allclose(J[:, column], change, atol=1e-6)


def test_hand_down_solves_the_grasp_exactly():
    arm, rng, q, reached = panda(), np.random.default_rng(3), np.zeros(7), 0
    for _ in range(300):
        target = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.5, 0.5), rng.uniform(0.1, 0.4),
                           rng.uniform(-4, 4)])  # fmt: skip
        if not hand_down(target, BASE, arm.lower, arm.upper, q):
            continue
        reached += 1
        functions().grasp.x[:] = np.r_[q, BASE, target, 0.0]
        call(functions().grasp.handle)
        assert np.abs(functions().grasp.y[:6]).max() < 1e-9
        assert frames_at(q)[2, 3:12].reshape(3, 3)[2, 2] < -0.999, "the hand points down"
    assert reached > 200


def test_hand_down_turns_the_hand_the_way_it_is_asked():
    arm, at, rng, q, seen = panda(), arm_at(BASE), np.random.default_rng(4), np.zeros(7), set()
    for _ in range(200):
        target = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.4, 0.4), rng.uniform(0.1, 0.3),
                           rng.uniform(-4, 4)])  # fmt: skip
        for way in (1.0, -1.0):
            if hand_down(target, BASE, arm.lower, arm.upper, q, way):
                seen.add(way)
                assert finger_way(at, q, target[3]) == way, "what it holds off centre lies so"
    assert seen == {1.0, -1.0}


def test_reach_interval_is_what_hand_down_reaches():
    arm, q = panda(), np.zeros(7)
    near, far = reach_interval(0.15)
    assert 0.15 < near < 0.35 < 0.7 < far < 0.9
    for r, expected in ((far - 0.003, True), (far + 0.003, False), (near + 0.003, True)):
        target = np.array([BASE[0] + r, 0.0, 0.15, 0.3])
        assert hand_down(target, BASE, arm.lower, arm.upper, q) is expected


def test_interpreted_kinematics_equal_compiled(monkeypatch):
    compiled = frames_at(np.linspace(-1, 1, 7))
    monkeypatch.setattr(native.shutil, "which", lambda name: None)
    functions.cache_clear()
    try:
        with pytest.warns(UserWarning, match="no C compiler"):
            interpreted = frames_at(np.linspace(-1, 1, 7))
    finally:
        functions.cache_clear()
    np.testing.assert_allclose(interpreted, compiled, atol=1e-12)


angle = st.floats(-3.2, 3.2)
small = st.floats(0.01, 0.1)
near_zero = st.floats(-0.2, 0.2)


@given(near_zero, near_zero, angle, small, small, angle, small, small)
@settings(max_examples=100, deadline=None)
def test_rectangle_gap_bounds_sampled_distance(x, y, a, hx, hy, b, gx, gy):
    def boundary(cx, cy, yaw, sx, sy):
        t = np.linspace(-1, 1, 41)
        one = np.ones_like(t)
        edge = np.vstack([np.c_[t * sx, one * sy], np.c_[t * sx, -one * sy],
                          np.c_[one * sx, t * sy], np.c_[-one * sx, t * sy]])  # fmt: skip
        c, s = math.cos(yaw), math.sin(yaw)
        return edge @ np.array([[c, s], [-s, c]]) + [cx, cy]

    ca, sa, cb, sb = math.cos(a), math.sin(a), math.cos(b), math.sin(b)
    gap = rectangle_gap(0.0, 0.0, ca, sa, hx, hy, x, y, cb, sb, gx, gy)
    P, Q = boundary(0, 0, a, hx, hy), boundary(x, y, b, gx, gy)
    distance = np.linalg.norm(P[:, None] - Q[None], axis=2).min()
    if gap > 0:
        assert gap <= distance + 1e-9
    else:  # overlapping: one has a boundary point inside the other
        c, s = math.cos(b), math.sin(b)
        local = (P - [x, y]) @ np.array([[c, -s], [s, c]])
        inside = (np.abs(local) <= [gx + 0.01, gy + 0.01]).all(1).any()
        c, s = math.cos(a), math.sin(a)
        local = Q @ np.array([[c, -s], [s, c]])
        assert inside or (np.abs(local) <= [hx + 0.01, hy + 0.01]).all(1).any()


def test_separation_gradient_equals_finite_differences():
    rng, h, checked = np.random.default_rng(4), 1e-7, 0
    n, x, scratch = np.zeros(3), np.zeros(3), np.zeros(3)

    def turned(R, w):
        K = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return R + K @ R

    for _ in range(200):
        p, half = rng.uniform(-0.15, 0.15, 3), rng.uniform(0.01, 0.05, 3)
        R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        obstacle = np.r_[rng.uniform(-0.1, 0.1, 3), rng.uniform(-3, 3), rng.uniform(0.02, 0.06, 3)]
        row = obstacle_rows([obstacle])[0]
        d = separation(p, R, half, row, n, x)
        grad_v, grad_w = n.copy(), np.cross(x - p, n)
        o_v, o_w = -n.copy(), -np.cross(x - obstacle[:3], n)[2]
        unused = scratch.copy()
        numeric_v = [
            (separation(p + h * e, R, half, row, scratch, unused) - d) / h for e in np.eye(3)
        ]
        numeric_w = [
            (separation(p, turned(R, h * e), half, row, scratch, unused) - d) / h for e in np.eye(3)
        ]
        moved = obstacle_rows([obstacle + h * np.eye(7)[i] for i in range(4)])
        numeric_o = [(separation(p, R, half, o, scratch, unused) - d) / h for o in moved]
        np.testing.assert_allclose(numeric_v, grad_v, atol=1e-5)
        np.testing.assert_allclose(numeric_w, grad_w, atol=1e-4)
        np.testing.assert_allclose(numeric_o, [*o_v, o_w], atol=1e-4)
        checked += 1
    assert checked == 200


def test_two_boxes_are_apart_exactly_where_no_point_is_in_both():
    rng, n, x, apart = np.random.default_rng(11), np.zeros(3), np.zeros(3), 0
    for _ in range(300):
        p, half = rng.uniform(-0.09, 0.09, 3), rng.uniform(0.01, 0.05, 3)
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        obstacle = np.r_[
            rng.uniform(-0.05, 0.05, 3), rng.uniform(-3, 3), rng.uniform(0.02, 0.06, 3)
        ]
        d = separation(p, R, half, obstacle_rows([obstacle])[0], n, x)
        c, s = math.cos(obstacle[3]), math.sin(obstacle[3])
        U = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        A = np.vstack([R.T, -R.T, U.T, -U.T])
        b = np.r_[R.T @ p + half, half - R.T @ p, U.T @ obstacle[:3] + obstacle[4:],
                  obstacle[4:] - U.T @ obstacle[:3]]  # fmt: skip
        shared = linprog(np.zeros(3), A_ub=A, b_ub=b, bounds=(None, None)).status == 0
        assert shared == (d <= 0)
        apart += not shared
    assert 100 < apart < 200


def test_banded_solve_equals_dense():
    rng, n, width = np.random.default_rng(5), 30, 5
    L = np.tril(rng.normal(size=(n, n)))
    L[np.subtract.outer(np.arange(n), np.arange(n)) >= width] = 0
    A, b = L @ L.T + np.eye(n), rng.normal(size=n)
    band = np.array([[A[j + d, j] if j + d < n else 0.0 for d in range(width)] for j in range(n)])
    x = b.copy()
    assert banded_solve(band, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), atol=1e-9)
    assert not banded_solve(-np.ones((3, 2)), np.ones(3))


def test_path_gradient_equals_finite_differences():
    arm, rng = panda(), np.random.default_rng(6)
    body = bodies(0.03)
    obstacles = obstacle_rows(
        [[0.1, 0.0, 0.06, 0.3, 0.05, 0.04, 0.06], [0, 0, -0.05, 0, 0.4, 0.6, 0.05]]
    )
    X = np.zeros((7, ARM))
    for t in range(7):
        hand_down(np.array([0.0 + 0.03 * t, 0.02, 0.2, 0.4]), BASE, arm.lower, arm.upper, X[t])
    X += rng.normal(scale=0.01, size=X.shape)
    targets = np.zeros((7, 6))
    targets[5] = 0.15, 0.02, 0.21, 0.4, 0.3, 1.0
    samples = np.array([[t, s] for t in range(6) for s in (0.0, 0.5) if t or s])
    shape = (len(samples), len(body.link), len(obstacles))
    multipliers = rng.uniform(0, 0.1, (7, 6)), rng.uniform(0, 0.1, shape), np.zeros((7, ARM, 2))
    margin = np.full(shape[1:], 0.05)
    band, g = np.zeros((5 * ARM, WIDTH)), np.zeros(5 * ARM)
    at, smooth = arm_at(BASE), motions.smoothness(6)
    seen, room = np.zeros((*shape[:2], ARM)), np.zeros(shape[:2])

    def merit(rows):
        return motions.assemble(
            rows, at, body, obstacles, obstacles, margin, samples, targets, seen, room, smooth,
            *multipliers, 7.0, 0.0, band, g,
        )[0]  # fmt: skip

    merit(X)
    gradient, h = g.copy(), 1e-6
    numeric = np.zeros_like(gradient)
    for i in range(len(gradient)):
        step = np.zeros_like(X)
        step[1 + i // ARM, i % ARM] = h
        numeric[i] = (merit(X + step) - merit(X - step)) / (2 * h)
    assert np.abs(gradient).max() > 0.01
    np.testing.assert_allclose(gradient, numeric, atol=2e-4)

    # What is not looked at anew, as it cannot have come near, changes nothing.
    multipliers[1][:] = 0.0
    merit(X)
    for scale in (1e-3, 1e-2, 1e-1):
        rows = X + rng.normal(scale=scale, size=X.shape)
        kept, gradient = merit(rows), g.copy()
        assert (room > 0).any()
        seen_then, room_then = seen.copy(), room.copy()
        room[:] = 0.0
        assert merit(rows) == kept
        np.testing.assert_array_equal(g, gradient)
        seen[:], room[:] = seen_then, room_then


def test_smoothness_is_the_hessian_of_the_cost():
    T = 6
    n = (T - 1) * ARM
    second = np.kron(np.diff(np.eye(T + 3), n=2, axis=0)[:, 2:-2], np.eye(ARM))
    expected = second.T @ second + 1e-6 * np.eye(n)
    band = motions.smoothness(T)
    found = np.zeros((n, n))
    for j in range(n):
        for d in range(min(WIDTH, n - j)):
            found[j + d, j] = found[j, j + d] = band[j, d]
    np.testing.assert_allclose(found, expected)


def test_pairs_called_clear_are_clear_at_every_substep():
    """The dense check skips pairs by a bound on the motion; sampled finely, none comes close."""
    arm, at, rng = panda(), arm_at(BASE), np.random.default_rng(8)
    body = bodies(0.03, Held(np.array([0, 0, 0.12]), np.array([0.03, 0.02, 0.05]), 0.3))
    obstacles = obstacle_rows(
        [[0.1, 0.0, 0.06, 0.3, 0.05, 0.04, 0.06], [0, 0, -0.05, 0, 0.4, 0.6, 0.05]]
    )
    out, clear, q = np.zeros((len(body.link), len(obstacles))), 0, np.zeros(ARM)
    pairs, skipped = np.zeros((out.size, 2), np.int64), 0
    while clear < 100 or skipped < 1000:
        target = np.r_[rng.uniform(-0.2, 0.2, 2), rng.uniform(0.15, 0.4), rng.uniform(-3, 3)]
        if not hand_down(target, BASE, arm.lower, arm.upper, q):
            continue
        step = rng.normal(scale=0.08, size=ARM)
        n = motions.close_pairs(at, q, q + step, body, obstacles, obstacles, pairs)
        clear, skipped = clear + (n == 0), skipped + out.size - n
        for share in np.linspace(0, 1, 21):
            motions.distances(at, q + share * step, body, obstacles, obstacles, out)
            out[tuple(pairs[:n].T)] = 1.0
            assert out.min() >= motions.CLEARANCE


@pytest.mark.parametrize("seed", range(4))
def test_pose_bound_never_refuses_what_a_grid_finds(seed):
    rng = np.random.default_rng(seed)
    table, refused, found = np.array([0.4, 0.6]), 0, 0
    for _ in range(60):
        size = rng.uniform(0.04, 0.07, 3)
        box = Box(name="b", size=tuple(size), position=(0, 0, size[2] / 2), color=(1, 0, 0))
        grasp = grasps(box)[0]
        count = rng.integers(3, 9)
        obstacles = obstacle_rows(
            np.c_[
                rng.uniform(-0.12, 0.12, (count, 2)),
                np.full(count, 0.04),
                rng.uniform(-3, 3, count),
                rng.uniform(0.02, 0.05, (count, 2)),
                np.full(count, 0.04),
            ]
        )
        region = np.array([0.0, 0.0, 0.2, 0.05, 0.03])
        near, far = reach_interval(0.15)
        at = np.zeros(4)
        reach = np.array([[0.0, near, far, 0.0, planar.ANY_TURN]])
        common = (0.0, grasp.parts[None], obstacles, table, BASE, reach)
        status, _ = planar.find_pose(region, np.zeros(2), *common, 0.0, 0.0, at)
        c, s = math.cos(0.2), math.sin(0.2)
        grid = max(
            planar.slack(c * x - s * y, s * x + c * y, angle, *common, 0.0)[0]
            for x in np.linspace(-0.05, 0.05, 15)
            for y in np.linspace(-0.03, 0.03, 9)
            for angle in np.linspace(0, math.pi, 24, endpoint=False)
        )
        if status == NONE:
            refused += 1
            assert grid < 0
        if status == FOUND:
            found += 1
            assert planar.slack(*at[:3], *common, 0.0)[0] >= 0
            local = np.array([[c, s], [-s, c]]) @ at[:2]
            assert (np.abs(local) <= [0.05, 0.03]).all()
    assert refused > 3
    assert found > 3


def test_only_what_the_arm_could_reach_of_a_region_is_looked_at():
    base, table = np.array([-0.48, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.3, 0.25, 0.5])
    np.testing.assert_array_equal(planar.near_base(table, base), table)
    np.testing.assert_allclose(
        planar.near_base(np.array([0.0, 0.0, math.pi / 2, 1e5, 0.5]), base),
        [0.0, 0.0, math.pi / 2, planar.FARTHEST, 0.5],
        atol=1e-9,
    )
    np.testing.assert_allclose(
        planar.near_base(np.array([1.0, 0.0, 0.0, 0.5, 0.5]), base), [0.61, 0, 0, 0.11, 0.5]
    )
    assert planar.near_base(np.array([3.0, 0.0, 0.0, 0.5, 0.5]), base)[3] < 0


def test_compiled_kernels_are_kept_by_the_content_of_all_their_sources(tmp_path):
    (tmp_path / "inner").mkdir()
    for name in ("a.py", "inner/b.py"):
        (tmp_path / name).write_text("@njit\ndef f(x): return x\n")
    (tmp_path / "plain.py").write_text("def f(x): return x\n")
    before = _kernel_cache(tmp_path)
    (tmp_path / "plain.py").write_text("def f(x): return 2 * x\n")
    assert _kernel_cache(tmp_path) == before
    (tmp_path / "inner/b.py").write_text("@njit\ndef f(x): return 2 * x\n")
    assert _kernel_cache(tmp_path) != before
    (tmp_path / "a.py").write_text("from relevance.plain import ROOM\n@njit\ndef f(x): return x\n")
    before = _kernel_cache(tmp_path)
    (tmp_path / "plain.py").write_text("ROOM = 0.002\n")
    assert _kernel_cache(tmp_path) != before, "numbers are compiled in"


def test_another_checkouts_kernels_are_not_inherited_but_the_users_folder_is(tmp_path):
    script = "import os, relevance; print(os.environ['NUMBA_CACHE_DIR'])"
    own = str(tmp_path / "relevance")
    for folder, kept in ((f"{own}/kernels-of-before", False), (str(tmp_path / "mine"), True)):
        env = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-c", script]
        out = subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
        assert (out.strip() == folder) == kept
        assert out.startswith(str(tmp_path))
