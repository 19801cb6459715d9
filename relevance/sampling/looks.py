"""Draws of what a scene looks like: light, table and camera (domain randomisation).

The paper's pictures all have one light, one plain table and one camera, and it names that as a
limit. What is drawn here ends up in the scene itself, so a scene with it is stored, replayed
and rendered again to the pixel like any other.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relevance.sampling.colors import from_hsv
from relevance.sampling.settings import Randomisation
from relevance.scene import TEXTURES, Camera, Color, Light, Table, Texture


def draw_light(rng: np.random.Generator, light: Light, ranges: Randomisation) -> Light:
    """A light from another direction, of another colour and strength."""
    elevation = math.radians(rng.uniform(*ranges.light_elevation))
    azimuth = rng.uniform(-math.pi, math.pi)
    flat = math.cos(elevation)
    direction = flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)
    return replace(
        light,
        direction=_rounded(direction),
        color=_rounded(1 - rng.uniform(0, ranges.light_tint, 3)),
        ambient=round(rng.uniform(*ranges.light_ambient), 4),
        diffuse=round(rng.uniform(*ranges.light_diffuse), 4),
    )


def nudged_light(rng: np.random.Generator, light: Light, most: float) -> Light:
    """Nearly the same light: see `Jitter.light`."""
    direction = np.array(light.direction)
    direction = direction + rng.uniform(-most, most, 3) * np.linalg.norm(direction)
    strengths = np.array([light.ambient, light.diffuse]) + rng.uniform(-most, most, 2)
    ambient, diffuse = (round(float(value), 4) for value in np.clip(strengths, 0, 1))
    return replace(
        light,
        direction=_rounded(direction),
        color=nudged_color(rng, light.color, most),
        ambient=ambient,
        diffuse=diffuse,
    )


def nudged_color(rng: np.random.Generator, color: Color, most: float) -> Color:
    """Nearly the same colour."""
    return _rounded(np.clip(np.array(color) + rng.uniform(-most, most, 3), 0, 1))


def draw_table(rng: np.random.Generator, table: Table, ranges: Randomisation) -> Table:
    """A table of another colour, with or without a texture."""
    saturation, value = rng.uniform(0, ranges.table_saturation), rng.uniform(*ranges.table_value)
    color = from_hsv(rng.uniform(0, 1), saturation, value)
    second = np.clip(color + rng.uniform(-1, 1, 3) * ranges.texture_contrast, 0, 1)
    texture = Texture(
        kind=TEXTURES[int(rng.integers(len(TEXTURES)))],
        color=_rounded(second),
        scale=round(rng.uniform(*ranges.texture_scale), 4),
        angle=round(rng.uniform(-math.pi / 2, math.pi / 2), 4),
        seed=int(rng.integers(2**31)),
    )
    textured = rng.random() < ranges.texture_share
    return replace(table, color=_rounded(color), texture=texture if textured else None)


def draw_camera(rng: np.random.Generator, camera: Camera, ranges: Randomisation) -> Camera:
    """A camera that stands and looks a little off."""
    eye, target = rng.uniform(-1, 1, (2, 3)) * ranges.camera_shift
    return replace(
        camera,
        eye=_rounded(np.array(camera.eye) + eye),
        target=_rounded(np.array(camera.target) + target),
        fov=round(camera.fov + rng.uniform(-1, 1) * ranges.camera_fov, 4),
    )


def _rounded(values: np.ndarray | tuple[float, float, float]) -> tuple[float, float, float]:
    """Four digits, so that files stay readable and survive any round trip."""
    x, y, z = (round(float(value), 4) for value in values)
    return x, y, z


def same_view(a: Camera, b: Camera, allowed: Randomisation = Randomisation()) -> bool:  # noqa: B008
    """Whether two cameras differ by no more than what randomised scenes teach to forgive."""
    rounding = 1e-4
    shift = max(
        abs(one - other)
        for one, other in zip((*a.eye, *a.target), (*b.eye, *b.target), strict=True)
    )
    return (
        shift <= allowed.camera_shift + rounding
        and abs(a.fov - b.fov) <= allowed.camera_fov + rounding
    )


def view_of(camera: Camera) -> str:
    """Where a camera looks, in words."""
    eye, target = (", ".join(f"{v:g}" for v in at) for at in (camera.eye, camera.target))
    return f"eye {eye}; target {target}; fov {camera.fov:g}"
