"""Other people's pybullet worlds: what is written is read again, and every body is told of."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relevance.errors import RelevanceWarning
from relevance.sampling import SceneConfig, sample_scene
from relevance.scene import Box, Pose, Robot, Scene, SceneError
from relevance.simulation import WorldError, read_bullet, write_bullet
from relevance.simulation.bullet import pybullet

FLAT = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def client() -> Iterator[int]:
    number = pybullet.connect(pybullet.DIRECT)
    yield number
    pybullet.disconnect(physicsClientId=number)


def turned(roll: float, pitch: float, yaw: float) -> tuple[float, ...]:
    return pybullet.getQuaternionFromEuler((roll, pitch, yaw))


def add(client: int, kind: int, position, turn=FLAT, **shape) -> int:
    """A body of one shape."""
    made = pybullet.createCollisionShape(kind, **shape, physicsClientId=client)
    return pybullet.createMultiBody(0.1, made, -1, position, turn, physicsClientId=client)


def add_box(client: int, size, position, turn=FLAT) -> int:
    half = [edge / 2 for edge in size]
    return add(client, pybullet.GEOM_BOX, position, turn, halfExtents=half)


@cache
def drawn(family: str, index: int) -> Scene:
    config = SceneConfig(family=family, max_objects=6)
    tries = (sample_scene(config, seed=8, index=index, attempt=n) for n in range(1000))
    return next(scene for scene in tries if scene is not None)


def same(found: Scene, scene: Scene) -> None:
    """Equal but for the single floats that pybullet keeps of places metres away."""
    assert found.names == scene.names
    for its, ours in zip(found.objects, scene.objects, strict=True):
        assert its.on == ours.on
        assert its.size == pytest.approx(ours.size, abs=5e-6)
        assert its.position == pytest.approx(ours.position, abs=5e-6)
        assert math.remainder(its.yaw - ours.yaw, math.tau) == pytest.approx(0, abs=5e-6)
        assert its.color == pytest.approx(ours.color, abs=5e-6)
    assert found.table.size == pytest.approx(scene.table.size, abs=5e-6)
    assert found.table.color == pytest.approx(scene.table.color, abs=5e-6)
    assert found.robot.base == pytest.approx(scene.robot.base, abs=5e-6)
    assert found.robot.yaw == pytest.approx(scene.robot.yaw, abs=5e-6)


# --- what is written is read again ------------------------------------------------------------


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from(("same-plane", "on", "stacks")),
    st.integers(0, 3),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.floats(-math.pi, math.pi),
    st.booleans(),
)
def test_a_scene_comes_back_wherever_its_table_stands(family, index, origin, yaw, robot) -> None:
    scene, client = drawn(family, index), pybullet.connect(pybullet.DIRECT)
    try:
        world = write_bullet(scene, client, origin=origin, yaw=yaw, robot=robot)
        before = pybullet.getNumBodies(physicsClientId=client)
        found = read_bullet(client)
        assert pybullet.getNumBodies(physicsClientId=client) == before
        same(found.scene, scene)
        assert found.bodies == world.bodies
        assert found.boxes == scene.names
        assert {note.what for note in found.notes} == {"the table", *["the robot"] * robot}
    finally:
        pybullet.disconnect(physicsClientId=client)


def test_a_scene_at_the_origin_comes_back_equal(client: int) -> None:
    scene = drawn("same-plane", 0)
    write_bullet(scene, client)
    found = read_bullet(client).scene
    assert (found.objects, found.table, found.robot) == (scene.objects, scene.table, scene.robot)


def test_a_turned_robot_comes_back(client: int) -> None:
    scene = Scene(objects=drawn("on", 1).objects, robot=Robot(base=(-0.5, 0.1, 0.0), yaw=2.0))
    write_bullet(scene, client, origin=(1, 2, 0.7), yaw=1.0)
    same(read_bullet(client).scene, scene)


def test_two_clients_are_two_worlds() -> None:
    clients = [pybullet.connect(pybullet.DIRECT) for _ in range(2)]
    try:
        scenes = [drawn("same-plane", 0), drawn("on", 0)]
        for number, scene in zip(clients, scenes, strict=True):
            write_bullet(scene, number, robot=False)
        for number, scene in zip(clients, scenes, strict=True):
            same(read_bullet(number).scene, scene)
    finally:
        for number in clients:
            pybullet.disconnect(physicsClientId=number)


# --- worlds of other people -------------------------------------------------------------------


def usual(client: int) -> int:
    """A world as many begin: floor, table, arm; returns the arm."""
    import pybullet_data

    pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=client)
    pybullet.loadURDF("plane.urdf", physicsClientId=client)
    pybullet.loadURDF(
        "table/table.urdf", [0.5, 0, 0], turned(0, 0, math.pi / 2), physicsClientId=client
    )
    return pybullet.loadURDF(
        "franka_panda/panda.urdf", [0, 0, 0.625], useFixedBase=True, physicsClientId=client
    )


def test_floor_table_and_arm_are_told(client: int) -> None:
    arm = usual(client)
    cube = pybullet.loadURDF("cube_small.urdf", [0.4, 0.2, 0.65], physicsClientId=client)
    other = pybullet.loadURDF("cube_small.urdf", [0.4, -0.2, 0.65], physicsClientId=client)
    world = read_bullet(client)
    assert world.bodies == {"cube": cube, "cube-2": other}
    assert world.scene.table.size == pytest.approx((1.0, 1.5))
    assert world.scene.robot.base == pytest.approx((-0.5, 0, 0))
    assert world.scene.robot.yaw == pytest.approx(0)
    assert world.scene["cube"].size == pytest.approx((0.05, 0.05, 0.05))
    assert world.scene["cube"].position == pytest.approx((-0.1, 0.2, 0.025))
    assert [str(note) for note in world.notes] == [
        "body 0 (plane): a box, left out: it is under the table's top",
        "body 1 (table): the table, its top is the scene's",
        f"body {arm} (panda): the robot, planned with as a Panda",
    ]


def test_no_table_is_the_plane_at_zero(client: int) -> None:
    body = add_box(client, (0.05, 0.06, 0.07), (0.1, 0.2, 0.035), turned(0, 0, 0.3))
    world = read_bullet(client, names={body: "red"})
    [box] = world.scene.objects
    assert (box.name, box.on) == ("red", None)
    assert box.size == pytest.approx((0.05, 0.06, 0.07))
    assert box.yaw == pytest.approx(0.3)
    assert world.scene.robot == Robot()
    assert world.notes == ()


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from([(r, p) for r in range(4) for p in range(4)]),
    st.floats(-math.pi, math.pi),
    st.floats(-0.01, 0.01),
)
def test_a_box_on_any_of_its_faces_is_a_box(quarters, yaw, tilt) -> None:
    """The box that is read fills the same space, and its frame leads back to the body."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        size = (0.04, 0.06, 0.09)
        roll, pitch = (quarter * math.pi / 2 for quarter in quarters)
        turn = pybullet.multiplyTransforms(
            (0, 0, 0), turned(0, 0, yaw), (0, 0, 0), turned(roll + tilt, pitch, 0)
        )[1]
        body = add_box(client, size, (0.1, -0.1, 0.05), turn)
        low, high = pybullet.getAABB(body, physicsClientId=client)
        z = 0.05 - low[2] + 0.0005  # hardly over the table
        pybullet.resetBasePositionAndOrientation(body, (0.1, -0.1, z), turn, physicsClientId=client)
        world = read_bullet(client)
        [box] = world.scene.objects
        assert sorted(box.size) == pytest.approx(sorted(size))
        assert box.bottom == pytest.approx(0, abs=1e-9)
        assert 2 * box.extents[0] == pytest.approx(high[0] - low[0], abs=3e-3)
        assert 2 * box.extents[1] == pytest.approx(high[1] - low[1], abs=3e-3)
        back = world.pose(box.name, Pose(position=box.position, yaw=box.yaw))
        assert back[0] == pytest.approx((0.1, -0.1, z), abs=2e-3)
        same_turn = abs(sum(a * b for a, b in zip(back[1], turn, strict=True)))
        assert same_turn == pytest.approx(1, abs=1e-6)
    finally:
        pybullet.disconnect(physicsClientId=client)


def test_what_stands_on_what(client: int) -> None:
    """A tower with the gaps of a world that settled, and a bridge; named from the top down."""
    lid = add_box(client, (0.05, 0.05, 0.05), (0.0, 0.0, 0.1457), turned(0.001, -0.002, 0.2))
    middle = add_box(client, (0.06, 0.06, 0.06), (0.0, 0.0, 0.0904))
    foot = add_box(client, (0.07, 0.07, 0.06), (0.0, 0.0, 0.0302))
    bridge = add_box(client, (0.04, 0.24, 0.04), (0.2, 0.2, 0.0803))
    piers = [add_box(client, (0.05, 0.05, 0.06), (0.2, y, 0.0299)) for y in (0.12, 0.28)]
    named = {lid: "lid", middle: "middle", foot: "foot", bridge: "bridge"}
    scene = read_bullet(
        client, names=named | dict(zip(piers, ("left", "right"), strict=True))
    ).scene
    assert {box.name: box.supports for box in scene.objects} == {
        "lid": ("middle",),
        "middle": ("foot",),
        "foot": (),
        "bridge": ("left", "right"),
        "left": (),
        "right": (),
    }
    assert scene["lid"].position[2] == pytest.approx(0.145)


Make = Callable[[int], int]


@pytest.mark.parametrize(
    ("make", "what", "size"),
    [
        (
            lambda c: add(c, pybullet.GEOM_SPHERE, (0, 0, 0.03), radius=0.03),
            "a sphere",
            (0.06, 0.06, 0.06),
        ),
        (
            lambda c: add(c, pybullet.GEOM_CYLINDER, (0, 0, 0.05), radius=0.03, height=0.1),
            "a cylinder",
            (0.06, 0.06, 0.1),
        ),
        (
            lambda c: add(
                c, pybullet.GEOM_CYLINDER, (0, 0, 0.03), turned(math.pi / 2, 0, 0),
                radius=0.03, height=0.1,
            ),
            "a cylinder",
            (0.06, 0.1, 0.06),
        ),
        (
            lambda c: add(c, pybullet.GEOM_CAPSULE, (0, 0, 0.08), radius=0.03, height=0.1),
            "a capsule",
            (0.06, 0.06, 0.16),
        ),
        (
            lambda c: add_box(
                c, (0.1, 0.05, 0.1), (0, 0, 0.1 / math.sqrt(2)), turned(0, math.pi / 4, 0)
            ),
            "a box tilted by 45 degrees",
            (0.1 * math.sqrt(2), 0.05, 0.1 * math.sqrt(2)),
        ),
    ],
)  # fmt: skip
def test_other_shapes_are_the_box_around_them(client: int, make: Make, what: str, size) -> None:
    body = make(client)
    box = add_box(client, (0.05, 0.05, 0.05), (0.2, 0.2, 0.025))
    with pytest.warns(RelevanceWarning, match=f"{what}, taken as the upright box around it"):
        world = read_bullet(client, names={body: "thing", box: "box"})
    assert world.boxes == ("box",)
    assert world.scene["thing"].size == pytest.approx(size, abs=1e-6)
    assert [note.what for note in world.notes] == [what]


@pytest.mark.parametrize(
    ("make", "why", "warned"),
    [
        (lambda c: add_box(c, (0.1, 0.1, 0.1), (0, 0, -0.05)), "under the table's top", False),
        (lambda c: add_box(c, (9, 9, 0.01), (0, 0, -0.0043)), "under the table's top", False),
        (lambda c: add_box(c, (0.1, 0.1, 5e-5), (0, 0, 3e-5)), "thinner than 0.1 mm", True),
        (lambda c: add_box(c, (0.1, 0.1, 0.1), (0, 0.9, 0.05)), "beside the table", False),
        (lambda c: add_box(c, (0.1, 0.1, 0.1), (0, 0.59, 0.05)), "over the table's edge", True),
        (lambda c: add_box(c, (0.1, 0.1, 0.1), (0, 0, 0.3)), "floats 250 mm over", True),
        (lambda c: add_box(c, (0.3, 0.05, 0.05), (0.1, 0.2, 0.075)), "centre is not over", True),
    ],
)
def test_what_is_left_out_and_why(client: int, make: Make, why: str, warned: bool) -> None:
    box = add_box(client, (0.05, 0.05, 0.05), (0.2, 0.2, 0.025))
    body = make(client)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        world = read_bullet(client)
    assert list(world.bodies.values()) == [box]
    [note] = world.notes
    assert note.body == body
    assert why in note.done
    assert [str(one.message) for one in told] == ([str(note)] if warned else [])


def test_a_thin_sheet_stands_on_the_table(client: int) -> None:
    sheet = add_box(client, (0.1, 0.1, 8e-4), (0.0, 0.2, 4e-4))
    box = add_box(client, (0.05, 0.05, 0.05), (0.0, 0.2, 0.0258))
    world = read_bullet(client, names={sheet: "sheet", box: "box"})
    assert world.notes == ()
    assert world.scene["sheet"].size[2] == pytest.approx(8e-4)
    assert world.scene["box"].on == "sheet"


@pytest.mark.parametrize(
    ("z", "turn", "done"),
    [
        (0.0, FLAT, "left out: it is not over the table's top"),
        (-0.6, FLAT, "left out: it is not over the table's top"),
        (0.3, FLAT, "left out: it lies 300 mm over the table's top, expected it no higher"),
        (0.0, turned(0.5, 0, 0), "left out: it is not level, expected ground"),
    ],
)
def test_the_ground_may_be_a_plane(client: int, z: float, turn, done: str) -> None:
    ground = add(client, pybullet.GEOM_PLANE, (0, 0, z), turn)
    add_box(client, (0.05, 0.05, 0.05), (0.2, 0.2, 0.025))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        world = read_bullet(client)
    assert len(world.scene.objects) == 1
    [note] = world.notes
    assert note.what == "a plane"
    assert note.done == done
    assert [str(one.message) for one in told] == ([str(note)] if "expected" in done else [])
    with pytest.raises(WorldError, match="table 0: is a plane without edges"):
        read_bullet(client, table=ground)


def test_bodies_with_joints_are_left_out(client: int) -> None:
    usual(client)
    add_box(client, (0.05, 0.05, 0.05), (0.5, 0.2, 0.65))
    drawer = pybullet.loadURDF("kuka_iiwa/model.urdf", [0.5, -0.3, 0.63], physicsClientId=client)
    with pytest.warns(RelevanceWarning, match="a body with joints, left out"):
        world = read_bullet(client)
    assert drawer in [note.body for note in world.notes]


# --- errors ---------------------------------------------------------------------------------


def test_errors_name_what_is_wrong(client: int) -> None:
    with pytest.raises(WorldError, match="nothing stands on the table, expected a box there"):
        read_bullet(client)
    with pytest.raises(WorldError, match="table 3: no such body, expected one of none: the world"):
        read_bullet(client, table=3)
    with pytest.raises(WorldError, match="ignore 99: no such body, expected one of none: the"):
        read_bullet(client, ignore=[99])
    with pytest.raises(WorldError, match="client 19: not connected"):
        read_bullet(19)
    box = add_box(client, (0.05, 0.05, 0.05), (0.2, 0.2, 0.025))
    with pytest.raises(WorldError, match="names: no body 7, expected some of"):
        read_bullet(client, names={7: "red"})
    with pytest.raises(SceneError, match="expected none of"):
        read_bullet(client, names={box: "a, b"})
    add_box(client, (0.05, 0.05, 0.05), (0.21, 0.2, 0.025))
    with pytest.raises(SceneError, match="overlaps"):
        read_bullet(client)


def test_a_tilted_robot_or_table_is_refused(client: int) -> None:
    arm = usual(client)
    add_box(client, (0.05, 0.05, 0.05), (0.5, 0.2, 0.65))
    pybullet.resetBasePositionAndOrientation(
        arm, (0, 0, 0.6), turned(0.3, 0, 0), physicsClientId=client
    )
    with pytest.raises(WorldError, match="is tilted by 17 degrees, expected it upright"):
        read_bullet(client)
    pybullet.resetBasePositionAndOrientation(
        1, (0, 0, 0), turned(0.3, 0, 0), physicsClientId=client
    )
    with pytest.raises(WorldError, match="table 1: is tilted, expected its top level"):
        read_bullet(client)


def test_a_box_may_be_called_as_the_robot_is(client: int) -> None:
    box = Box(name="panda", size=(0.05,) * 3, position=(0, 0, 0.025), color=(1, 0, 0))
    write_bullet(Scene(objects=(box,)), client)
    assert read_bullet(client).scene.names == ("panda",)
