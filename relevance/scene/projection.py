"""The pinhole camera: where points of the world fall in the image."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from relevance.scene.boxes import Box, Camera


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pinhole projection of world points (..., 3), m: pixels (..., 2) x, y and depths (...), m.

    Pixel (0, 0) is the outer corner of the top-left pixel; depth is along the optical axis.
    """
    eye, axes, focal = pinhole(camera)
    relative = (points - eye) @ axes
    depth = relative[..., 2]
    pixels = relative[..., :2] / depth[..., None] * focal
    return pixels + np.array([camera.width / 2, camera.height / 2]), depth


def camera_up(camera: Camera) -> tuple[float, float, float]:
    """The world direction that is up in the image: +z, or +x for a camera looking straight down."""
    dx, dy = camera.target[0] - camera.eye[0], camera.target[1] - camera.eye[1]
    return (0.0, 0.0, 1.0) if math.hypot(dx, dy) > 1e-9 else (1.0, 0.0, 0.0)


@lru_cache(maxsize=16)
def pinhole(camera: Camera) -> tuple[np.ndarray, np.ndarray, float]:
    """Eye (3,), image axes right, down and forward as columns (3, 3), focal length in pixels."""
    eye, target = np.array(camera.eye), np.array(camera.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, camera_up(camera))
    right /= np.linalg.norm(right)
    focal = camera.width / 2 / math.tan(math.radians(camera.fov) / 2)
    return eye, np.stack([right, np.cross(forward, right), forward], axis=1), focal


def vertices(box: Box) -> np.ndarray:
    """The eight corners of a box in the world frame, (8, 3), m: the lower four first."""
    footprint = box.corners()
    heights = np.repeat([box.bottom, box.top], 4)[:, None]
    return np.hstack([np.vstack([footprint, footprint]), heights])
