"""Random scenes and goals: pure, within their settings, varied."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relevance.sampling import (
    GRASPABLE_EDGE,
    SceneConfig,
    camera_up,
    project,
    sample_goals,
    sample_scene,
    vertices,
)
from relevance.scene import (
    Box,
    Camera,
    Predicate,
    Scene,
    footprint_gap,
    goal_holds,
    region,
    scene_from_json,
    scene_to_json,
)

BOTH = ("same-plane", "on")


def draw(count: int, family: str = "same-plane", seed: int = 0, **more) -> list[Scene]:
    config = SceneConfig(family=family, **more)
    found = [sample_scene(config, seed=seed, index=i) for i in range(count)]
    return [scene for scene in found if scene is not None]


@pytest.fixture(scope="module")
def plane() -> list[Scene]:
    return draw(150)


@pytest.fixture(scope="module")
def stacked() -> list[Scene]:
    return draw(150, "on")


# ---------------------------------------------------------------- purity


@given(seed=st.integers(0, 2**63), index=st.integers(0, 10**9), family=st.sampled_from(BOTH))
@settings(max_examples=20, deadline=None)
def test_a_scene_depends_on_its_counters_alone(seed, index, family):
    config = SceneConfig(family=family, max_objects=5)
    first = sample_scene(config, seed=seed, index=index)
    sample_scene(config, seed=seed, index=index + 1)
    np.random.default_rng(0).random(10)
    assert sample_scene(config, seed=seed, index=index) == first


def test_every_counter_gives_another_scene():
    config = SceneConfig()
    ids = [
        scene.id
        for seed, index, split, attempt in itertools.product(
            (0, 1), (0, 1), ("train", "validation", "test"), (0, 1)
        )
        if (scene := sample_scene(config, seed=seed, index=index, split=split, attempt=attempt))
    ]
    assert len(set(ids)) == len(ids) == 24


def test_families_do_not_share_draws(plane, stacked):
    """An `on` scene is not the same-plane scene of the same index with a box more."""
    for a, b in zip(plane[:20], stacked[:20], strict=True):
        assert not {box.size for box in a.objects} & {box.size for box in b.objects}


def test_another_process_draws_the_same(plane):
    program = (
        "from relevance.sampling import SceneConfig, sample_scene\n"
        "print(sample_scene(SceneConfig(), seed=0, index=3).id)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == plane[3].id


def test_golden_scene():
    """A stored dataset stays reproducible: this id changes only with the sampler's version."""
    scene = sample_scene(SceneConfig(), seed=0, index=0)
    assert scene is not None
    assert scene.id == "aabc49c86b25f920"


# ---------------------------------------------------------------- settings kept


@pytest.mark.parametrize("family", BOTH)
def test_scenes_keep_their_settings(family, plane, stacked):
    config = SceneConfig(family=family)
    drawn = plane if family == "same-plane" else stacked
    assert len(drawn) > 140
    counts = Counter(len(scene.objects) for scene in drawn)
    extra = int(family == "on")
    assert set(counts) == set(range(3 + extra, 11 + extra))
    for scene in drawn:
        riders = [box for box in scene.objects if box.on is not None]
        assert len(riders) == extra
        for box in scene.objects:
            assert all(0.04 <= edge <= 0.12 for edge in box.size)
            assert min(box.size[:2]) <= GRASPABLE_EDGE
            distance = math.hypot(box.position[0] + 0.48, box.position[1])
            assert 0.30 <= distance <= 0.72
            assert (np.abs(box.corners()) <= (0.38, 0.58)).all()
            pixels, depth = project(scene.camera, vertices(box))
            assert (depth > 0).all()
            assert (pixels >= 2).all()
            assert (pixels <= (318, 190)).all()
        for a, b in itertools.combinations(scene.objects, 2):
            assert math.dist(a.color, b.color) >= config.color_distance
            if a.name not in (b.on, a.on) and b.name != a.on:
                apart = max(footprint_gap(a, b), a.bottom - b.top, b.bottom - a.top)
                assert apart >= 0.005 - 1e-9
        for box in scene.objects:
            assert math.dist(box.color, scene.table.color) >= config.color_distance


def test_scenes_vary(plane):
    boxes = [box for scene in plane for box in scene.objects]
    for axis in range(3):
        edges = np.array([box.size[axis] for box in boxes])
        assert edges.min() < 0.045
        assert edges.max() > 0.115
    y = np.array([box.position[1] for box in boxes])
    assert y.min() < -0.25
    assert y.max() > 0.25
    assert abs(np.mean(y)) < 0.05
    yaw = np.array([box.yaw for box in boxes])
    assert np.histogram(yaw, bins=6, range=(-math.pi / 2, math.pi / 2))[0].min() > 5
    hues = {box.name.split("-")[0] for box in boxes}
    assert len(hues) >= 15


def test_object_order_tells_nothing(stacked):
    """The stacked box is drawn last; in the scene it stands anywhere."""
    places = [
        next(i for i, box in enumerate(scene.objects) if box.on) / (len(scene.objects) - 1)
        for scene in stacked
    ]
    assert 0.4 < np.mean(places) < 0.6


def test_crowding_puts_boxes_into_goal_regions():
    """How often the middle of a goal region is taken: the reason why the setting exists."""

    def taken(crowding: float) -> float:
        hits = total = 0
        for scene in draw(60, crowding=crowding, min_objects=4, max_objects=6):
            for reference, predicate in itertools.product(scene.objects, list(Predicate)[:4]):
                probe = replace(reference, size=(0.05, 0.05, 0.05))
                low, high, _ = region(probe, reference, predicate)
                u = predicate.direction
                assert u is not None
                at = np.array(reference.position[:2]) + (low + high) / 2 * np.array(u)
                others = [box for box in scene.objects if box is not reference]
                hits += any(box.covers(*at) for box in others)
                total += 1
        return hits / total

    assert taken(0.0) < 0.06
    assert taken(0.9) > 2 * taken(0.0) + 0.05


def test_obstacles_are_too_wide_for_the_hand():
    wide = [
        min(box.size[:2]) > GRASPABLE_EDGE
        for scene in draw(40, obstacle_share=0.5)
        for box in scene.objects
    ]
    assert 0.3 < np.mean(wide) < 0.6


def test_impossible_draws_fail_quietly():
    crowd = SceneConfig(min_objects=10, max_objects=10, spacing=0.2, tries=5)
    assert sample_scene(crowd, seed=0, index=0) is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("family", "piles"),
        ("min_objects", 1),
        ("max_objects", 2),
        ("max_objects", 40),
        ("crowding", 1.5),
        ("crowding", math.nan),
        ("obstacle_share", -0.1),
        ("min_edge", 0.08),
        ("min_edge", 0.0),
        ("max_edge", 0.05),
        ("spacing", -0.01),
        ("reach", (0.7, 0.3)),
        ("table_margin", -1.0),
        ("color_distance", 0.9),
        ("tries", 0),
    ],
)
def test_bad_settings_are_named(field, value):
    assert field in {f.name for f in fields(SceneConfig)}
    with pytest.raises(ValueError, match=rf"SceneConfig\.{field} = .*expected"):
        SceneConfig(**{field: value})


def test_config_hash_sees_every_setting():
    base = SceneConfig()
    assert base.content_hash == SceneConfig().content_hash
    others = [
        replace(base, family="on"),
        replace(base, crowding=0.5),
        replace(base, reach=(0.31, 0.72)),
        replace(base, camera=Camera(fov=48)),
    ]
    assert len({base.content_hash, *(other.content_hash for other in others)}) == 5


# ---------------------------------------------------------------- goals


@pytest.mark.parametrize("predicate", Predicate)
def test_goals_are_distinct_false_and_graspable(predicate, plane, stacked):
    for scene in (stacked if predicate is Predicate.ON else plane)[:40]:
        goals = sample_goals(scene, predicate, 4, seed=1)
        assert len(set(goals)) == len(goals) == 4
        for goal in goals:
            assert goal.predicate is predicate
            assert goal.subject != goal.reference
            assert not goal_holds(scene.objects, goal)
            assert min(scene[goal.subject].size[:2]) <= GRASPABLE_EDGE
            assert scene[goal.reference].on != goal.subject


def test_goals_depend_on_seed_scene_and_predicate(plane):
    scene = plane[0]
    left = Predicate.ON_THE_LEFT
    goals = sample_goals(scene, left, 3, seed=1)
    assert sample_goals(scene, left, 3, seed=1) == goals
    assert sample_goals(scene, left, 6, seed=1)[:3] == goals
    assert sample_goals(scene, left, 3, seed=2) != goals
    pairs = {(g.subject, g.reference) for g in goals}
    behind = sample_goals(scene, Predicate.BEHIND, 3, seed=1)
    assert {(g.subject, g.reference) for g in behind} != pairs


def test_all_goals_come_out_when_asked_for(plane):
    scene = next(scene for scene in plane if len(scene.objects) == 3)
    goals = sample_goals(scene, Predicate.ON, 100, seed=0)
    assert len(goals) == 6


def test_ungraspable_boxes_are_no_subjects():
    wide = Box(name="wide", size=(0.1, 0.1, 0.05), position=(0, 0, 0.025), color=(1, 0, 0))
    slim = Box(name="slim", size=(0.05, 0.1, 0.05), position=(0, 0.3, 0.025), color=(0, 1, 0))
    goals = sample_goals(Scene(objects=(wide, slim)), Predicate.ON, 10, seed=0)
    assert [str(goal) for goal in goals] == ["on(slim, wide)"]
    assert sample_goals(Scene(objects=(wide,)), Predicate.ON, 10, seed=0) == ()


def test_on_goals_prefer_a_reference_that_carries(stacked):
    """About three in four first goals name the carrier; subjects seldom carry."""
    carried = loaded = 0
    for scene in stacked:
        carriers = {box.on for box in scene.objects if box.on}
        goal = sample_goals(scene, Predicate.ON, 1, seed=3)[0]
        carried += goal.reference in carriers
        loaded += goal.subject in carriers
    assert 0.6 < carried / len(stacked) < 0.9
    assert loaded / len(stacked) < 0.1


def test_scenes_survive_json(stacked):
    for scene in stacked[:20]:
        assert scene_from_json(scene_to_json(scene)) == scene


# ---------------------------------------------------------------- projection


def test_projection_by_hand():
    camera = Camera(eye=(0, 0, 1), target=(1, 0, 1), width=200, height=100, fov=90)
    pixels, depth = project(camera, np.array([[2.0, 0, 1], [2.0, 2, 1], [2.0, -1, 2]]))
    assert depth == pytest.approx([2, 2, 2])
    assert pixels == pytest.approx(np.array([[100, 50], [0, 50], [150, 0]]))


def test_a_camera_that_looks_straight_down():
    camera = Camera(eye=(0, 0, 1), target=(0, 0, 0))
    assert camera_up(camera) == (1.0, 0.0, 0.0)
    pixels, _ = project(camera, np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]))
    assert pixels[0, 1] < camera.height / 2
    assert pixels[1, 0] < camera.width / 2


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3, 3))
def test_vertices_are_the_corners_at_both_heights(x, y, yaw):
    box = Box(name="a", size=(0.05, 0.07, 0.1), position=(x, y, 0.05), yaw=yaw, color=(1, 0, 0))
    points = vertices(box)
    assert points.shape == (8, 3)
    assert points.mean(axis=0) == pytest.approx((x, y, 0.05))
    assert np.linalg.norm(points - (x, y, 0.05), axis=1) == pytest.approx(
        np.full(8, math.sqrt(0.05**2 + 0.07**2 + 0.1**2) / 2)
    )
