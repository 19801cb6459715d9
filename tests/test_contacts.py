"""What is physically possible, and what a scene says of itself."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pybullet
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from relevance.robot import panda_urdf
from relevance.scene import (
    PREDICATES,
    Box,
    Camera,
    Goal,
    Light,
    Robot,
    Scene,
    SceneError,
    Table,
    goal_holds,
    lookalikes,
    read_scenes,
)
from relevance.scene.contacts import robot_depth
from relevance.simulation import Renderer

CASES = Path(__file__).parent / "cases"


def box(name: str, x: float = 0.0, y: float = 0.0, size=(0.05, 0.05, 0.05), z=0.0, **more) -> Box:
    """A box with its underside at z."""
    fields = {"position": (x, y, z + size[2] / 2), "color": (0.8, 0.1, 0.1)} | more
    return Box(name=name, size=size, **fields)


def refused(*objects: Box, **more) -> str:
    with pytest.raises(SceneError) as caught:
        Scene(objects=objects, **more)
    return str(caught.value)


# ---------------------------------------------------------------- several supports

PILLARS = (box("a", 0, -0.1), box("b", 0, 0.1), box("c", 0.2, 0.0))


def plate(x: float, y: float, on, size=(0.3, 0.3, 0.02), **more) -> Box:
    return box("plate", x, y, size, z=0.05, on=on, **more)


def test_a_plate_stands_on_pillars_while_its_centre_is_between_them():
    scene = Scene(objects=(*PILLARS, plate(0.1, 0.0, ["a", "b", "c"])))
    assert scene["plate"].supports == ("a", "b", "c")
    assert scene["a"].supports == ()
    bridge = Scene(objects=(*PILLARS[:2], plate(0.0, 0.0, ("a", "b"))))
    assert goal_holds(bridge.objects, Goal.parse("on(plate, a)"), Robot()) is False
    # Beyond the outer faces of the pillars it falls.
    Scene(objects=(*PILLARS[:2], plate(0.024, 0.0, ("a", "b"))))
    assert "falls over" in refused(*PILLARS[:2], plate(0.026, 0.0, ("a", "b")))
    assert "falls over" in refused(*PILLARS[:2], plate(-0.026, 0.0, ("a", "b")))


def test_a_support_must_be_under_it_and_touch():
    low = box("low", 0.2, 0.0, (0.05, 0.05, 0.04))
    assert "floating above 'low'" in refused(*PILLARS[:2], low, plate(0.05, 0, ["a", "b", "low"]))
    assert "is not over 'far'" in refused(
        *PILLARS[:2], box("far", 0.35), plate(0.0, 0.0, ["a", "b", "far"])
    )
    assert "on = 'd'" in refused(*PILLARS[:2], plate(0.0, 0.0, ["a", "d"]))
    for bad in ([], ["a", "a"], ["\u00e9", "e\u0301"]):
        with pytest.raises(SceneError, match="a list of distinct names"):
            plate(0.0, 0.0, bad)
    for bad in ([[]], [None], [["a"]]):
        with pytest.raises(SceneError, match="valid string"):
            plate(0.0, 0.0, bad)


def test_one_name_is_as_it_was_and_a_list_of_one_is_that_name():
    tower = (box("a"), box("b", 0.02, z=0.05, on=["a"]), box("c", 0.04, z=0.1, on="b"))
    scene = Scene(objects=tower)
    assert scene["b"].on == "a"
    assert scene == Scene(objects=(tower[0], replace(tower[1], on="a"), tower[2]))
    # A plate on one pillar of two: the error says how to name both.
    # one of them named, as other tools do: the others are found
    assert Scene(objects=(*PILLARS[:2], plate(0.0, 0.0, "a")))["plate"].supports == ("a", "b")
    assert "falling over" in refused(PILLARS[0], plate(0.0, 0.0, "a"))


shares = st.floats(-1, 1)


@given(
    st.lists(st.tuples(shares, shares), min_size=2, max_size=4), shares, shares, st.floats(-3, 3)
)
@settings(deadline=None)
def test_a_plate_stands_where_the_hull_of_its_supports_says(places, x, y, yaw):
    """By brute force: it falls where some line has its centre on one side, all supports beyond."""
    supports = [box(f"s{i}", 0.15 * a, 0.15 * b, (0.02, 0.02, 0.05)) for i, (a, b) in
                enumerate(places)]  # fmt: skip
    top = plate(0.1 * x, 0.1 * y, [b.name for b in supports], (0.6, 0.6, 0.02), yaw=yaw)
    corners = np.concatenate([b.corners() for b in supports]) - top.position[:2]
    angles = np.linspace(0, math.tau, 3600)
    reach = (corners @ np.stack([np.cos(angles), np.sin(angles)])).max(axis=0).min()
    try:
        Scene(objects=(*supports, top), table=Table(size=(2, 2)), robot=Robot(base=(-0.9, 0, 0)))
    except SceneError as error:
        message = str(error)
    else:
        message = ""
    assume("overlaps" not in message and "is not over" not in message)
    assert ("falls over" in message) == bool(message)
    assert reach < 1e-4 if message else reach > -1e-4


# ---------------------------------------------------------------- thin, tall, touching


def test_flat_tall_and_touching_boxes_are_fine():
    sheet = box("sheet", size=(0.2, 0.2, 0.0004))
    pole = box("pole", 0.125, 0.0, (0.05, 0.05, 1.5))
    stack = [box(f"b{i}", 0, 0, (0.05, 0.05, 0.03), z=0.0004 + 0.03 * i,
                 on="sheet" if i == 0 else f"b{i - 1}") for i in range(6)]  # fmt: skip
    Scene(objects=(sheet, pole, *stack))


def test_more_boxes_than_a_mask_can_name_are_refused():
    many = [box(f"b{i}", 0.002 * (i % 16), 0.002 * (i // 16), (0.001,) * 3) for i in range(256)]
    Scene(objects=tuple(many[:254]))
    assert "at most 254 items" in refused(*many)
    with pytest.raises(SceneError, match=r"size\.0"):
        box("dust", size=(1e-300, 0.05, 0.05))


def test_thin_boxes_do_not_vanish_in_others():
    assert "overlaps" in refused(box("cube"), box("card", size=(0.04, 0.04, 0.0008)))
    cards = [box(n, size=(0.05, 0.05, 0.0004), z=z, on=on) for n, z, on in
             (("a", 0.0002, "b"), ("b", 0.0, "a"))]  # fmt: skip
    refused(*cards)


@pytest.mark.parametrize("millimetres", [0.5, 0.6, 0.8])
def test_boxes_sunk_up_to_the_tolerance_are_accepted(millimetres):
    scene = read_scenes(CASES / f"sunk-{millimetres}mm.jsonl")[0]
    a, b = scene["a"], scene["b"]
    assert b.position[0] - a.position[0] == pytest.approx(0.05 - millimetres / 1000)


# ---------------------------------------------------------------- the robot


def test_what_stands_in_the_robot_is_in_its_meshes():
    """The outlines of the base lie within pybullet's meshes of links 0 and 1, nearly filling them
    at the foot; at any turn of the first joint and wherever the robot stands."""
    client = pybullet.connect(pybullet.DIRECT)
    robot = Robot(base=(0.1, -0.2, 0.05), yaw=0.7)
    turn = (0, 0, math.sin(robot.yaw / 2), math.cos(robot.yaw / 2))
    body = pybullet.loadURDF(str(panda_urdf()), useFixedBase=True, physicsClientId=client)
    local = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
    base = pybullet.multiplyTransforms(robot.base, turn, *local)
    pybullet.resetBasePositionAndOrientation(body, *base, physicsClientId=client)
    rng = np.random.default_rng(0)
    deep = 0
    for i in range(400):
        heading, distance = rng.uniform(-math.pi, math.pi), rng.uniform(0, 0.22)
        x = robot.base[0] + distance * math.cos(heading)
        y = robot.base[1] + distance * math.sin(heading)
        z = robot.base[2] + (0.0 if i % 2 else rng.uniform(0, 0.4))
        item = box("x", x, y, tuple(rng.uniform(0.02, 0.1, 3)), z, yaw=rng.uniform(-3, 3))
        half = [edge / 2 for edge in item.size]
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client
        )
        yaw = (0, 0, math.sin(item.yaw / 2), math.cos(item.yaw / 2))
        its = pybullet.createMultiBody(0, shape, -1, item.position, yaw, physicsClientId=client)
        pybullet.resetJointState(body, 0, rng.uniform(-2.9, 2.9), physicsClientId=client)
        depth = max(
            -min((p[8] for p in pybullet.getClosestPoints(
                body, its, 0.01, linkIndexA=link, physicsClientId=client)), default=1.0)
            for link in (-1, 0)
        )  # fmt: skip
        pybullet.removeBody(its, physicsClientId=client)
        mine = robot_depth(item, robot)
        if mine > 0.001:
            assert depth > 0
        if i % 2 and depth > 0.01:
            deep += 1
            assert mine > 0.001
    pybullet.disconnect(client)
    assert deep > 50


def test_the_robot_stands_beside_boxes_and_on_the_table():
    assert "stands in the robot" in refused(box("a"), robot=Robot(base=(0.1, 0.0, 0.0)))
    assert "stands in the robot" in refused(box("a"), robot=Robot(base=(-0.08, 0, 0)))
    # Its long side is behind it: turned, the same place is free.
    Scene(objects=(box("a"),), robot=Robot(base=(-0.11, 0, 0)))
    Scene(objects=(box("a"),), robot=Robot(base=(0, -0.13, 0), yaw=math.pi))
    Scene(objects=(box("a"),), robot=Robot(base=(0, -0.08, 0.2)))  # raised over it
    with pytest.raises(SceneError, match="is in the table"):
        Scene(objects=(box("a"),), robot=Robot(base=(0.3, 0, -0.05)))
    Scene(objects=(box("a"),), robot=Robot(base=(-0.6, 0, -0.05)))  # beside the table


# ---------------------------------------------------------------- directions


def test_directions_are_the_robots_wherever_it_stands():
    scene = read_scenes(CASES / "other-side.jsonl")[0]
    a, b = scene["a"], scene["b"]
    goal = scene.goal(scene.goals[0])
    # From the far side, facing back, +y is the right: `a` has to come to the other side of `b`.
    assert goal.predicate.direction(scene.robot) == pytest.approx((0, -1))
    assert not goal_holds(scene.objects, goal, scene.robot)
    moved = replace(a, position=(0.0, b.position[1] - 0.075, 0.025))
    assert goal_holds([moved, b], goal, scene.robot)
    assert not goal_holds([moved, b], goal, Robot())


@given(
    st.sampled_from([p for p in PREDICATES.values() if not p.stacked]),
    st.floats(-3, 3), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3, 3),
)  # fmt: skip
def test_what_holds_of_a_scene_holds_when_all_of_it_turns(predicate, turn, x, y, yaw):
    reference, subject = box("r", 0.05, 0.02, (0.09, 0.05, 0.06), yaw=0.4), box("s", x, y, yaw=yaw)
    goal = Goal(predicate=predicate, subject="s", reference="r")
    c, s = math.cos(turn), math.sin(turn)

    def turned(item: Box) -> Box:
        x, y, z = item.position
        return replace(item, position=(c * x - s * y, s * x + c * y, z), yaw=item.yaw + turn)

    robot = Robot(base=(-0.48 * c, -0.48 * s, 0.0), yaw=turn)
    # 1e-9 more or less: a tie at the border may fall either way.
    before = {goal_holds([reference, subject], goal, Robot(), 1e-3 + e) for e in (-1e-9, 1e-9)}
    assert goal_holds([turned(reference), turned(subject)], goal, robot) in before


# ---------------------------------------------------------------- turns, keys, looks


def test_a_full_turn_is_no_turn():
    turned, plain = (read_scenes(CASES / f"{n}.jsonl")[0] for n in ("turned", "not-turned"))
    assert [b.yaw for b in turned.objects] == [b.yaw for b in plain.objects]
    assert turned == plain
    one = Scene(objects=(box("a", yaw=0.3), box("b", 0.2, yaw=-0.2)))
    for turns in (-3, -1, 1, 7):
        yaws = [yaw + turns * math.tau for yaw in (0.3, -0.2)]
        again = Scene(objects=(box("a", yaw=yaws[0]), box("b", 0.2, yaw=yaws[1])))
        assert again == one
        assert again.id == one.id


@given(st.floats(-1000, 1000))
def test_turns_are_kept_within_half_a_turn(yaw):
    kept = Scene(objects=(box("a", yaw=yaw),)).objects[0].yaw
    assert -math.pi < kept <= math.pi
    assert math.cos(kept - yaw) == pytest.approx(1)
    assert Scene(objects=(box("a", yaw=kept),)).objects[0].yaw == kept


def test_scenes_are_keys_by_their_content():
    one = Scene(id="s", objects=(box("a"), box("b", 0.2)))
    same = Scene(id="s", objects=(box("a"), box("b", 0.2)))
    moved = Scene(id="s", objects=(box("a"), box("b", 0.21)))
    cache = {one: 1}
    assert cache[same] == 1
    assert moved not in cache
    assert replace(one, camera=Camera(fov=46)) not in cache
    bridge = Scene(objects=(*PILLARS[:2], plate(0, 0, ["a", "b"])))
    assert hash(bridge) == hash(replace(bridge))


def test_lookalikes_are_named():
    assert lookalikes(read_scenes(CASES / "same.json")[0]) == (
        ("o0", "o1", "o2", "o3", "o4", "o5", "o6"),
    )
    red, nearly, green = (0.8, 0.1, 0.1), (0.805, 0.1, 0.1), (0.1, 0.8, 0.1)
    long = (0.05, 0.08, 0.05)
    scene = Scene(
        objects=(
            box("a", 0, 0, long, color=red),
            box("b", 0.1, 0, long[1::-1] + long[2:], color=nearly),  # turned by a quarter
            box("c", 0.2, 0, (0.05, 0.05, 0.08), color=red),
            box("d", 0, 0.2, long, color=green),
            box("e", 0.1, 0.2, (0.051, 0.08, 0.05), color=green),
        )
    )
    assert lookalikes(scene) == (("a", "b"), ("d", "e"))


# ---------------------------------------------------------------- cameras and lights


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        ({"near": 2.0, "far": 1.0}, "near 2 m"),
        ({"near": 1.0, "far": 1.0}, "near 1 m"),
        ({"eye": (0, 0, 0)}, "where the eye is"),
        ({"fov": 0.0}, "fov"),
        ({"width": 100_000}, "width"),
    ],
)
def test_cameras_that_see_nothing_are_refused(camera, expected):
    with pytest.raises(SceneError, match=expected):
        Camera(**camera)


def test_a_camera_must_not_cut_everything_off():
    for camera in (Camera(far=0.3), Camera(near=3.0)):
        assert "sees nothing" in refused(box("a"), box("b", 0.2), camera=camera)
    Scene(objects=(box("a"), box("b", 0.2)), camera=Camera(near=0.9, far=1.0))


@pytest.mark.parametrize(
    "light",
    [
        {"direction": (0, 0, 0)},
        {"direction": (0, 1e-200, 0)},
        {"ambient": 0, "diffuse": 0},
        {"color": (0, 0, 0)},
        {"distance": 0},
    ],
)
def test_lights_that_light_nothing_are_refused(light):
    with pytest.raises(SceneError, match=r"direction|dark|distance"):
        Light(**light)


def test_an_unknown_object_is_named_safely():
    scene = Scene(objects=(box("a"), box("b", 0.2)))
    with pytest.raises(SceneError) as caught:
        scene["\x1b" + "x" * 500]
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 120


@pytest.mark.filterwarnings("error")
def test_a_box_level_with_the_camera_is_read_and_drawn():
    """A face of it is in the plane of the lens: its corners are nowhere in the picture."""
    level = Camera(eye=(0.0, 0.0, 0.5), target=(0.3, 0.0, 0.5))
    scene = Scene(objects=(box("a", 0.3), box("b", -0.025, 0.2)), camera=level)
    mask = Renderer().render(scene).mask
    assert set(np.unique(mask)) <= {0, 1}
