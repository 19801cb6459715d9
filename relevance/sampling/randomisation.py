"""Domain randomisation: light, table, camera and colours that differ from scene to scene.

The paper's pictures all have one light, one plain table and one camera, and it names that as a
limit. What is drawn here ends up in the scene itself, so a scene with it is stored, replayed
and rendered again to the pixel like any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from relevance.sampling.colors import from_hsv
from relevance.scene import TEXTURES, Camera, Light, Table, Texture


@dataclass(frozen=True, slots=True, kw_only=True)
class Randomisation:
    """From what ranges each scene draws its looks; every draw is uniform.

    Raises ValueError that names the field.
    """

    light_elevation: tuple[float, float] = (35.0, 80.0)
    """Height of the light over the table's plane, from and to, degrees; any compass direction."""
    light_tint: float = 0.15
    """How far each channel of the light's colour may fall short of 1."""
    light_ambient: tuple[float, float] = (0.45, 0.7)
    """Strength of the light that comes from everywhere, from and to."""
    light_diffuse: tuple[float, float] = (0.25, 0.5)
    """Strength of the light that comes from its direction, from and to."""
    table_saturation: float = 0.35
    """Most saturation of the table's colour, any hue."""
    table_value: tuple[float, float] = (0.4, 0.95)
    """Brightness of the table's colour, from and to."""
    texture_share: float = 0.75
    """Share of the tables with a texture (checks, stripes or noise)."""
    texture_contrast: float = 0.25
    """How far each channel of the texture's second colour may differ from the first."""
    texture_scale: tuple[float, float] = (0.02, 0.12)
    """Size of its pattern, from and to, m."""
    camera_shift: float = 0.01
    """How far the eye, and the point that it looks at, may be off along each axis, m. The
    models place what they see with the nominal camera: with 1 cm and 0.5 degrees that is off by
    less than 2 cm on the table, which a network can still learn to forgive."""
    camera_fov: float = 0.5
    """How far the horizontal field of view may be off, degrees."""
    color_delta_e: float = 22.0
    """Least CIE 1976 Delta E of two boxes, and of a box and the table's colours; with n > 11
    boxes it shrinks by (11 / n)^(1/2). It takes the place of `SceneConfig.color_distance`."""

    def __post_init__(self) -> None:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                found = getattr(self, name)
                raise ValueError(f"Randomisation.{name} = {found!r}: expected {expected}")

        def span(name: str, low: float, high: float) -> None:
            first, last = getattr(self, name)
            require(name, low <= first <= last <= high, f"{low:g} <= from <= to <= {high:g}")

        span("light_elevation", 20, 90)
        require("light_tint", 0 <= self.light_tint <= 0.5, "0 to 0.5")
        span("light_ambient", 0.2, 1)
        span("light_diffuse", 0, 1)
        require("table_saturation", 0 <= self.table_saturation <= 0.5, "0 to 0.5")
        span("table_value", 0, 1)
        require("texture_share", 0 <= self.texture_share <= 1, "a probability")
        require("texture_contrast", 0 <= self.texture_contrast <= 0.5, "0 to 0.5")
        span("texture_scale", 0.01, 1)
        require("camera_shift", 0 <= self.camera_shift <= 0.03, "0 to 0.03")
        require("camera_fov", 0 <= self.camera_fov <= 2, "0 to 2")
        require("color_delta_e", 0 < self.color_delta_e <= 30, "in (0, 30]")


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
