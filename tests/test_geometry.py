"""Cameras, colours and boxes as rows: compiled loops agree with what people read."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relevance.scene import (
    Box,
    Camera,
    camera_up,
    footprint_gap,
    lab,
    pinhole,
    project,
    vertices,
)
from relevance.scene.geometry import (
    corners,
    covers,
    crossing,
    extents,
    flat_gap,
    packed,
    projected,
    uprights,
)

# ---------------------------------------------------------------- colours


def test_lab_of_known_colours():
    """The usual published values for D65 (to the digits that the 4-digit matrix gives)."""
    known = {
        (1, 1, 1): (100, 0, 0),
        (0, 0, 0): (0, 0, 0),
        (1, 0, 0): (53.24, 80.09, 67.20),
        (0, 1, 0): (87.73, -86.18, 83.18),
        (0, 0, 1): (32.30, 79.19, -107.86),
        (0.5, 0.5, 0.5): (53.39, 0, 0),
    }
    for color, expected in known.items():
        assert lab(np.array(color, dtype=float)) == pytest.approx(expected, abs=0.05)


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


# ---------------------------------------------------------------- boxes as rows


def some_box(x: float, y: float, yaw: float) -> Box:
    return Box(name="a", size=(0.05, 0.11, 0.08), position=(x, y, 0.04), yaw=yaw, color=(1, 0, 0))


@given(x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2), yaw=st.floats(-3, 3), other=st.floats(-3, 3))
@settings(deadline=None)
def test_rows_agree_with_boxes(x, y, yaw, other):
    a, b = some_box(0.02, 0.01, other), some_box(x, y, yaw)
    one, two = uprights((a, b))
    assert corners(two) == pytest.approx(vertices(b))
    assert (packed(b.size, b.position, b.yaw) == two).all()
    assert extents(two, 1.0, 0.0) == pytest.approx(b.extents)
    turned = math.cos(other), math.sin(other)
    assert extents(two, *turned) == pytest.approx(b.extents_at(other))
    assert flat_gap(one, two) == pytest.approx(footprint_gap(a, b))
    camera = Camera()
    seen = projected(corners(two), *pinhole(camera))
    pixels, depth = project(camera, vertices(b))
    assert seen[:, :2] + (camera.width / 2, camera.height / 2) == pytest.approx(pixels)
    assert seen[:, 2] == pytest.approx(depth)
    # A ray through the middle comes and goes at points of the surface, and only there.
    start, middle = np.array([-0.5, 0.1, 0.4]), np.array(b.position)
    enter, leave = crossing(two, *start, *(middle - start))
    assert enter + leave == pytest.approx(2)
    for share, inside in ((enter - 1e-6, False), (enter + 1e-6, True), (leave + 1e-6, False)):
        at = start + share * (middle - start)
        within = abs(at[2] - middle[2]) <= b.size[2] / 2
        assert (covers(two, *at[:2]) and within) == inside
        assert covers(two, *at[:2]) == b.covers(*at[:2])
