"""What shows across the edges where boxes are expected, against pictures, projection and torch."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import torch
from planning import BLUE, RED, box
from torch.nn import functional as F

from relevance.models.edges import Edges
from relevance.networks import DECIMETRE, true_geometry
from relevance.networks.edges import EDGES, LINES, SAMPLES, STEP, expected_edges
from relevance.scene import Camera, Scene, project
from relevance.simulation import Renderer

CAMERA = Camera()
LEFT, RIGHT = 2, 3


def scene(yaw: float = 0.3) -> Scene:
    return Scene(objects=(box("red", 0.05, -0.04, RED, size=(0.08, 0.05, 0.06), yaw=yaw),))


def seen(image: np.ndarray, geometry: np.ndarray) -> np.ndarray:
    """Lines (N, EDGES, LINES, SAMPLES, 3) of a picture (H, W, 3)."""
    there = np.ones((1, len(geometry)), bool)
    found = expected_edges(image.transpose(2, 0, 1)[None], geometry[None], there, CAMERA)
    return found.lines[0].reshape(-1, EDGES, LINES, SAMPLES, 3)


@pytest.mark.parametrize("yaw", [0.0, 0.3, -0.7, 1.2, 3.0])
def test_boxes_are_expected_as_they_stand(yaw: float) -> None:
    image = np.zeros((1, 3, 192, 320), np.uint8)
    found = expected_edges(image, true_geometry(scene(yaw))[None], np.ones((1, 1), bool), CAMERA)
    turn, half = float(found.turn[0, 0]), found.half[0, 0] * DECIMETRE
    quarters = (yaw - turn) / (math.pi / 2)
    assert abs(turn) < math.radians(50)
    assert quarters == pytest.approx(round(quarters), abs=1e-3)
    sizes = (0.025, 0.04) if round(quarters) % 2 else (0.04, 0.025)
    assert half.tolist() == pytest.approx(sizes, abs=1e-5)


def test_lines_lie_across_the_edges_as_the_camera_sees_them() -> None:
    """Samples are torch's, where `project` puts points that lie across the edges."""
    one = scene().objects[0]
    cos, sin, half = math.cos(one.yaw), math.sin(one.yaw), np.array(one.size) / 2
    across, points = (np.arange(SAMPLES) - (SAMPLES - 1) / 2)[:, None] * STEP, []
    for height, (x, y) in product((half[2], -half[2]), ((1, 0), (-1, 0), (0, 1), (0, -1))):
        normal = np.array([x, y])
        for line in range(LINES):
            share = 0.85 * (2 * line / (LINES - 1) - 1)
            local = half[:2] * (normal + share * (1 - abs(normal))) + normal * across
            turned = local @ np.array([[cos, sin], [-sin, cos]])
            points.append(np.hstack([turned, np.full((SAMPLES, 1), height)]) + one.position)
    at = torch.from_numpy(project(CAMERA, np.array(points))[0] / [160, 96] - 1)
    image = np.random.default_rng(0).integers(0, 256, (192, 320, 3), np.uint8)
    picture = torch.from_numpy(image).permute(2, 0, 1)[None] / 255
    due = F.grid_sample(picture.double(), at[None], padding_mode="border", align_corners=False)
    due = (due - due.mean(-1, keepdim=True))[0].permute(1, 2, 0)
    found = seen(image, true_geometry(scene())).reshape(due.shape)
    np.testing.assert_allclose(found, due.numpy(), atol=1e-3)


def test_a_box_that_is_off_shows_it_by_as_much() -> None:
    """In a real picture colours change at the middle of lines across edges that are seen, and as
    far from there as the box is expected wrongly."""
    with Renderer() as renderer:
        image = renderer.render(scene(0.0)).image
    true = true_geometry(scene(0.0))
    for off in (0.0, 0.004, -0.004):
        geometry = true.copy()
        geometry[0, 1] += off / DECIMETRE  # towards the left
        lines = seen(image, geometry)[0]
        for edge, sign in ((LEFT, -1), (RIGHT, 1)):
            change = np.abs(np.diff(lines[edge], axis=1)).sum(-1)[2:-2]
            at = (change.argmax(1) - (SAMPLES - 2) / 2) * STEP
            assert np.median(at) == pytest.approx(sign * off, abs=1.5 * STEP)


def test_what_is_expected_nowhere_shows_nothing() -> None:
    geometry = np.repeat(true_geometry(scene()), 4, axis=0)
    geometry[0, 0], geometry[1, 9], geometry[2, :3] = np.nan, np.inf, 1e30
    lines = seen(np.random.default_rng(0).integers(0, 256, (192, 320, 3), np.uint8), geometry)
    assert not lines[:2].any()
    assert np.isfinite(lines).all()
    assert lines[3].any()


def test_nobody_moves_a_box_before_it_has_learned() -> None:
    """What is put right is the box itself then, and what is not there is nothing."""
    edges = Edges(width=8, hidden=16)
    both = Scene(objects=(*scene().objects, box("blue", 0.2, 0.1, BLUE, yaw=-1.4)))
    geometry = torch.from_numpy(true_geometry(both))[None]
    present = np.array([[True, True, False]])
    padded = F.pad(geometry, (0, 0, 0, 1))
    image = np.random.default_rng(0).random((1, 3, 192, 320), np.float32)
    found = expected_edges(image, padded.numpy(), present, CAMERA)
    assert not found.lines[0, 2].any()
    assert found.lines[0, :2].any()
    expected = [torch.from_numpy(array) for array in found]
    moved, shown = edges(torch.zeros(1, 3, 8), padded, *expected)
    assert shown.shape == (1, 3, 16)
    torch.testing.assert_close(moved[:, :2], geometry, atol=2e-4, rtol=0)
