"""Scene types: what comes in is checked, what goes out comes back."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relevance.hashing import content_hash
from relevance.scene import (
    GAP,
    PREDICATES,
    Box,
    Camera,
    Goal,
    Pose,
    Predicate,
    Robot,
    Scene,
    SceneError,
    Table,
    Texture,
    footprint_gap,
    goal_holds,
    read_scenes,
    scene_from_json,
    scene_to_json,
)

SIDES = [PREDICATES[name] for name in ("on-the-left", "on-the-right", "in-front", "behind")]
ROBOT = Robot()


def region(subject: Box, reference: Box, predicate: Predicate) -> tuple[float, float, float]:
    """Bounds of a same-plane region: nearest and farthest along its side, half width across."""
    there = predicate.region(subject, reference, ROBOT)
    u = predicate.direction(ROBOT)
    middle = (there.x - reference.position[0]) * u[0] + (there.y - reference.position[1]) * u[1]
    depth, width = there.half if abs(u[0]) > 0.5 else there.half[::-1]
    return middle - depth, middle + depth, width


def box(name: str, x: float = 0.0, y: float = 0.0, size=(0.05, 0.06, 0.08), **more) -> Box:
    fields = {"position": (x, y, size[2] / 2), "color": (0.8, 0.1, 0.1)} | more
    return Box(name=name, size=size, **fields)


def raw(**changes) -> dict:
    """A valid scene as JSON data: green stands on red, blue beside."""
    scene = {
        "id": "s1",
        "objects": [
            {
                "name": "red",
                "size": [0.06, 0.05, 0.08],
                "position": [0.02, 0.11, 0.04],
                "yaw": 0.3,
                "color": [0.8, 0.1, 0.1],
                "on": None,
            },
            {
                "name": "blue",
                "size": [0.06, 0.05, 0.1],
                "position": [0.02, -0.1, 0.05],
                "color": [0.1, 0.1, 0.8],
            },
            {
                "name": "green",
                "size": [0.04, 0.04, 0.04],
                "position": [0.02, 0.12, 0.1],
                "color": [0.1, 0.8, 0.1],
                "on": "red",
            },
        ],
        "goals": ["on-the-left(blue, red)"],
    }
    return scene | changes


def changed(index: int, **fields) -> dict:
    scene = raw()
    scene["objects"][index] |= fields
    return scene


def read(data: dict) -> Scene:
    return scene_from_json(json.dumps(data), where="f.jsonl:3")


# ---------------------------------------------------------------- JSON


def test_round_trip():
    scene = read(raw())
    again = scene_from_json(scene_to_json(scene))
    assert again == scene
    assert again.id == "s1"
    assert scene["green"].on == "red"
    assert scene.names == ("red", "blue", "green")
    assert "\n" not in scene_to_json(scene)


numbers = st.floats(-0.2, 0.2, allow_nan=False)
edges = st.floats(0.04, 0.12)


@given(numbers, numbers, st.floats(-4, 4), st.tuples(edges, edges, edges))
def test_round_trip_is_exact(x, y, yaw, size):
    scene = Scene(objects=(box("red", x, y, size, yaw=yaw),))
    again = scene_from_json(scene_to_json(scene))
    assert again == scene
    assert again.id == scene.id


@pytest.mark.parametrize(
    ("data", "culprit", "expected"),
    [
        (raw(colour="red"), "colour", "unknown field"),
        (changed(0, weight=3), "objects.0.weight", "unknown field"),
        (changed(0, strength=3), "objects.0.strength", "unknown field"),
        (changed(0, str=3), "objects.0.str", "unknown field"),
        (raw(objects=[]), "objects", "at least 1 item"),
        (raw(objects=None), "objects", "expected a list"),
        ({"id": "s1"}, "objects", "required"),
        (changed(1, size=[0.06, 0.05]), "objects.1.size.2", "required"),
        (
            changed(1, size=[0.06, 0.05, -0.1]),
            "objects.1.size.2",
            "greater than or equal to 0.0001",
        ),
        (changed(1, position=[math.nan, 0, 0.05]), "objects.1.position.0", "finite number"),
        (changed(1, yaw=math.inf), "objects.1.yaw", "finite number"),
        (changed(1, yaw="north"), "objects.1.yaw", "valid number"),
        (changed(1, color=[0, 0, 255]), "objects.1.color.2", "less than or equal to 1"),
        (changed(1, name="a,b"), "objects.1.name", "none of '(', ')' and ','"),
        (changed(1, name=""), "objects.1.name", "at least 1 character"),
        (changed(1, name="red"), "objects.1 ('red')", "distinct names"),
        (changed(1, name="table"), "objects.1 ('table')", "other than 'table'"),
        (changed(1, position=[0.05, 0.12, 0.05]), "overlaps 'red'", "apart or touching"),
        (changed(1, position=[0.02, -0.1, 0.07]), "floating above the table", "position z 0.05"),
        (changed(1, position=[0.02, -0.1, 0.03]), "sunk into the table", "position z 0.05"),
        (changed(2, position=[0.02, 0.12, 0.11]), "floating above 'red'", "position z 0.1"),
        (changed(2, position=[0.1, 0.12, 0.1]), "floating", "centre over 'red'"),
        (changed(1, position=[0.39, -0.1, 0.05]), "off the table", "within +-0.4, +-0.6"),
        (changed(2, on="grey"), "on = 'grey'", "another object's name"),
        (changed(2, on="green"), "on = 'green'", "another object's name"),
        (raw(goals=["above(blue, red)"]), "'above'", "expected one of on-the-left"),
        (raw(goals=["on(blue, grey)"]), "'grey'", "have red, blue, green"),
        (raw(goals=["on(blue, blue)"]), "on(blue, blue)", "same object"),
        (raw(goals=["on blue red"]), "on blue red", "expected predicate(subject, reference)"),
        (raw(table={"size": [0.8]}), "table.size.1", "required"),
        (raw(robot={"base": [0, 0, 0], "arms": 2}), "robot.arms", "unknown field"),
        (raw(camera={"fov": 200}), "camera.fov", "less than 180"),
        (raw(light={"ambient": 2}), "light.ambient", "less than or equal to 1"),
    ],
)
def test_bad_scene_gives_one_clear_line(data, culprit, expected):
    with pytest.raises(SceneError) as caught:
        read(data)
    message = str(caught.value)
    assert message.startswith("f.jsonl:3: ")
    assert "\n" not in message
    assert culprit in message
    assert expected in message


def test_wrong_types_name_what_was_found():
    with pytest.raises(SceneError, match="found 'north'"):
        read(changed(1, yaw="north"))


@pytest.mark.parametrize("text", ["", "{", "[1, 2", "null", "3", "not json"])
def test_what_is_no_scene_at_all(text):
    with pytest.raises(SceneError, match=r"^f.jsonl:3: "):
        scene_from_json(text, where="f.jsonl:3")


def test_touching_boxes_are_fine():
    Scene(objects=(box("red", 0.0), box("blue", 0.05), box("green", 0.025, 0.06)))


def test_an_out_of_reach_box_is_no_error():
    Scene(objects=(box("red", 0.37, 0.57),))


# ---------------------------------------------------------------- files


def test_read_one_scene_a_list_and_lines(tmp_path):
    path = tmp_path / "scenes.json"
    path.write_text(json.dumps(raw(), indent=2))
    one = read_scenes(path)
    assert [scene.id for scene in one] == ["s1"]
    path.write_text(json.dumps([raw(), raw(id="s2")]))
    assert [scene.id for scene in read_scenes(path)] == ["s1", "s2"]
    path.write_text(json.dumps(raw()) + "\n\n" + json.dumps(raw(id="s2")) + "\n")
    assert [scene.id for scene in read_scenes(path)] == ["s1", "s2"]


def test_bad_files_are_named_with_their_line(tmp_path):
    path = tmp_path / "scenes.jsonl"
    lines = [json.dumps(raw()), json.dumps(raw(id="s2")), json.dumps(changed(1, size=[0, 1, 1]))]
    path.write_text("\n".join(lines))
    with pytest.raises(SceneError, match=r"scenes\.jsonl:3: objects\.1\.size\.0: "):
        read_scenes(path)
    path.write_text(json.dumps([raw(), changed(0, yaw=None)]))
    with pytest.raises(SceneError, match=r"scenes\.jsonl\[1\]: objects\.0\.yaw: "):
        read_scenes(path)
    path.write_text("\n")
    with pytest.raises(SceneError, match="is empty"):
        read_scenes(path)
    with pytest.raises(SceneError, match=r"nothing\.json: cannot be read"):
        read_scenes(tmp_path / "nothing.json")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match="cannot be read as text"):
        read_scenes(path)


# ---------------------------------------------------------------- goals


@pytest.mark.parametrize("predicate", PREDICATES.values())
def test_goal_text_round_trip(predicate):
    goal = Goal(predicate=predicate, subject="dark red", reference="blue-2")
    assert Goal.parse(str(goal)) == goal
    assert Goal.parse(f" {predicate.name} ( dark red ,blue-2 )") == goal


@pytest.mark.parametrize(
    "text", ["", "on", "on(a)", "on(a, b", "on(a, b, c)", "on(, b)", "over(a, b)", "on(a, a)"]
)
def test_bad_goal_text(text):
    with pytest.raises(SceneError, match=r"[Gg]oal") as caught:
        Goal.parse(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("subject", "reference"), [("a", "a"), ("\u00e9", "e\u0301")])
def test_a_goal_is_of_two_objects_however_it_is_made(subject, reference):
    with pytest.raises(SceneError, match=r"^Goal: .*subject and reference are the same object"):
        Goal(predicate="on", subject=subject, reference=reference)


def test_scene_knows_its_objects():
    scene = read(raw())
    with pytest.raises(SceneError, match="unknown object 'grey', expected one of red, blue, green"):
        scene["grey"]
    with pytest.raises(SceneError, match="unknown object 'grey'"):
        scene.goal("behind(red, grey)")


def test_directions_are_the_robots():
    assert PREDICATES["on-the-left"].direction(ROBOT) == (0, 1)
    assert PREDICATES["on-the-right"].direction(ROBOT) == (0, -1)
    assert PREDICATES["in-front"].direction(ROBOT) == (-1, 0)
    assert PREDICATES["behind"].direction(ROBOT) == (1, 0)
    assert PREDICATES["on"].direction(ROBOT) is None
    assert {p.family for p in SIDES} == {"same-plane"}


def test_left_by_hand():
    """H + r = 0.03 + 0.02, W = 0.05: the region's four sides, 2 mm either way."""
    blue = box("blue", 0.1, 0.05, size=(0.1, 0.06, 0.05))
    goal = Goal.parse("on-the-left(red, blue)")

    def holds(x: float, y: float) -> bool:
        return goal_holds([blue, box("red", x, y, size=(0.04, 0.07, 0.08))], goal, ROBOT)

    assert region(box("red", size=(0.04, 0.07, 0.08)), blue, goal.predicate) == pytest.approx(
        (0.05, 0.1, 0.05)
    )
    assert holds(0.1, 0.102)
    assert not holds(0.1, 0.098)
    assert holds(0.1, 0.148)
    assert not holds(0.1, 0.152)
    assert holds(0.148, 0.12)
    assert not holds(0.152, 0.12)
    assert holds(0.052, 0.12)
    assert not holds(0.048, 0.12)


yaws = st.floats(-math.pi, math.pi)
boxes = st.builds(
    lambda x, y, yaw, size: box("blue", x, y, size, yaw=yaw),
    numbers,
    numbers,
    yaws,
    st.tuples(edges, edges, edges),
)
subjects = st.builds(
    lambda yaw, size: box("red", 0, 0, size, yaw=yaw), yaws, st.tuples(edges, edges, edges)
)
shares = st.floats(0, 1)


@given(boxes, subjects, st.sampled_from(SIDES), shares, shares)
def test_goal_holds_exactly_in_its_region(reference, subject, predicate, along, across):
    low, high, half_width = region(subject, reference, predicate)
    assert high - low == pytest.approx(GAP)
    u = np.array(predicate.direction(ROBOT))
    sideways = np.array([-u[1], u[0]])
    goal = Goal(predicate=predicate, subject="red", reference="blue")

    def holds(a: float, b: float) -> bool:
        x, y = np.array(reference.position[:2]) + a * u + b * sideways
        moved = replace(subject, position=(x, y, subject.size[2] / 2))
        return goal_holds([reference, moved], goal, ROBOT)

    a, b = low + along * GAP, (2 * across - 1) * half_width
    assert holds(a, b)
    assert not holds(low - 0.002, b)
    assert not holds(high + 0.002, b)
    assert not holds(a, half_width + 0.002)
    assert not holds(a, -half_width - 0.002)
    assert not holds(-a, b)


@given(boxes, subjects, st.sampled_from(SIDES), shares, shares, st.integers(1, 3))
def test_regions_turn_with_the_world(reference, subject, predicate, along, across, quarters):
    """A quarter turn of the world turns left into in-front into right into behind."""
    order = [
        PREDICATES["on-the-left"],
        PREDICATES["in-front"],
        PREDICATES["on-the-right"],
        PREDICATES["behind"],
    ]
    turned = order[(order.index(predicate) + quarters) % 4]
    yaw = quarters * math.pi / 2
    rotated = replace(reference, yaw=reference.yaw + yaw)
    assert region(subject, rotated, turned) == pytest.approx(region(subject, reference, predicate))


@given(boxes, subjects)
def test_a_subject_in_its_region_clears_the_reference_when_aligned(reference, subject):
    """H + r leaves no overlap when the subject's short side faces the reference."""
    short_first = subject.size[0] <= subject.size[1]
    for predicate in SIDES:
        u = np.array(predicate.direction(ROBOT))
        low, _, _ = region(subject, reference, predicate)
        aligned = 0.0 if (u[0] != 0) == short_first else math.pi / 2
        x, y = np.array(reference.position[:2]) + low * u
        moved = replace(subject, position=(x, y, 0.05), yaw=aligned)
        # Extents of a rotated reference are never less than its width along u.
        assert footprint_gap(moved, reference) >= -1e-9


@given(boxes, st.floats(-0.49, 0.49), st.floats(-0.49, 0.49), yaws)
def test_on_holds_over_the_face(reference, fx, fy, yaw):
    c, s = math.cos(reference.yaw), math.sin(reference.yaw)
    dx, dy = fx * reference.size[0], fy * reference.size[1]
    x, y = reference.position[0] + c * dx - s * dy, reference.position[1] + s * dx + c * dy
    size = (0.05, 0.06, 0.08)
    goal = Goal.parse("on(red, blue)")
    top = box("red", size=size, position=(x, y, reference.top + 0.04), yaw=yaw, on="blue")
    assert goal_holds([reference, top], goal, ROBOT)
    assert not goal_holds([reference, replace(top, on=None)], goal, ROBOT)
    high = replace(top, position=(x, y, reference.top + 0.045))
    assert not goal_holds([reference, high], goal, ROBOT)
    off = (reference.position[0] + c * 0.13, reference.position[1] + s * 0.13)
    assert not goal_holds([reference, replace(top, position=(*off, top.position[2]))], goal, ROBOT)


def test_a_subject_on_a_box_is_not_beside_one():
    scene = read(raw())
    assert not goal_holds(scene.objects, Goal.parse("behind(green, blue)"), ROBOT)
    moved = scene.moved({"blue": Pose(position=(0.02, 0.12, 0.17), yaw=0.0, on="green")})
    assert goal_holds(moved, Goal.parse("on(blue, green)"), ROBOT)
    assert not goal_holds(moved, Goal.parse("on(blue, red)"), ROBOT)
    assert [b.name for b in moved] == ["red", "blue", "green"]
    assert moved[0] == scene["red"]


# ---------------------------------------------------------------- geometry


@given(boxes, st.floats(0.0, 0.3), yaws, yaws)
def test_footprint_gap_against_points(reference, distance, heading, yaw):
    """Negative exactly when a dense grid of one footprint has a point in the other."""
    x = reference.position[0] + distance * math.cos(heading)
    y = reference.position[1] + distance * math.sin(heading)
    other = box("red", x, y, size=(0.07, 0.09, 0.05), yaw=yaw)
    gap = footprint_gap(reference, other)
    assert gap == pytest.approx(footprint_gap(other, reference))
    corners = other.corners()
    grid = np.linspace(0, 1, 29)
    points = [
        corners[2] + a * (corners[1] - corners[2]) + b * (corners[3] - corners[2])
        for a in grid
        for b in grid
    ]
    inside = any(reference.covers(*p) for p in points)
    if inside:
        assert gap <= 1e-9
    # The grid is 3.2 mm wide: what overlaps by more than twice that has a point inside.
    if gap < -0.0065:
        assert inside


@given(boxes)
def test_extents_bound_the_corners(item):
    corners = item.corners() - np.array(item.position[:2])
    assert np.abs(corners).max(axis=0) == pytest.approx(item.extents)
    assert item.top - item.bottom == pytest.approx(item.size[2])


# ---------------------------------------------------------------- hashes


def test_id_is_a_hash_of_the_content():
    one = Scene(objects=(box("red"), box("blue", 0.2)))
    assert one.id == Scene(objects=(box("red"), box("blue", 0.2))).id
    assert len(one.id) == 16
    int(one.id, 16)
    assert one.id != Scene(objects=(box("red"), box("blue", 0.201))).id
    assert one.id != Scene(objects=(box("blue", 0.2), box("red"))).id
    # Goals are asked of a scene; they do not make it another one.
    asked = Scene(objects=one.objects, goals=("on(red, blue)",))
    assert asked.id == one.id
    assert Scene(objects=one.objects, id="mine").id == "mine"


def test_content_hash_depends_on_the_json_form_alone():
    assert content_hash({"a": 1, "b": [1.5, None]}) == content_hash({"b": (1.5, None), "a": 1})
    assert content_hash({"a": 1}) != content_hash({"a": 2})
    assert content_hash({}) == "44136fa355b3678a"


def test_python_construction_is_checked_too():
    with pytest.raises(SceneError, match="overlaps 'red'"):
        Scene(objects=(box("red"), box("blue", 0.01)))
    with pytest.raises(SceneError, match=r"^Box: position\.0: .*finite") as caught:
        box("red", math.nan)
    assert str(caught.value).isprintable()
    with pytest.raises(SceneError, match=r"^Camera: near 3 m, expected less than far, 1 m$"):
        Camera(near=3.0, far=1.0)


# ---------------------------------------------------------------- textures


def textured(**more) -> Scene:
    texture = Texture(**({"kind": "checks", "color": (0.2, 0.3, 0.4), "scale": 0.05} | more))
    box = Box(name="red", size=(0.06, 0.05, 0.08), position=(0.02, 0.11, 0.04), color=(1, 0, 0))
    return Scene(objects=(box,), table=Table(texture=texture))


def test_a_plain_table_hashes_as_before_there_were_textures():
    """Stored scenes keep their ids."""
    box = Box(
        name="red",
        size=(0.06, 0.05, 0.08),
        position=(0.02, 0.11, 0.04),
        yaw=0.3,
        color=(0.8, 0.1, 0.1),
    )
    assert Scene(objects=(box,)).id == "0bd464dbcaff7bf5"


def test_every_parameter_of_a_texture_is_in_the_id_and_survives_json():
    scenes = [
        textured(),
        textured(kind="stripes"),
        textured(color=(0.2, 0.3, 0.5)),
        textured(scale=0.06),
        textured(angle=0.1),
        textured(seed=1),
    ]
    assert len({scene.id for scene in scenes}) == len(scenes)
    for scene in scenes:
        assert scene_from_json(scene_to_json(scene)) == scene


@pytest.mark.parametrize(
    ("field", "value"),
    [("kind", "fur"), ("scale", 0), ("seed", -1), ("color", (2, 0, 0)), ("angle", math.nan)],
)
def test_impossible_textures_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        textured(**{field: value})
