"""Pictures of scenes: image, mask, canonical views and how much of each object shows.

Boxes are drawn by pybullet's TinyRenderer (no GPU, no display), in the part of the picture that
holds them: it takes as long for an empty pixel. The table is a plane under one light, so its
pixels (and the pattern on it, if any) are filled in closed form, far faster; the mask stays that
of a full render. Shadows are closed form too, on the table and on the boxes: TinyRenderer's
shadow map speckles faces that the light grazes. So is the number of pixels that a box would show
alone (a convex silhouette); nothing is rendered twice. The loops over pixels are compiled
(`painting`). Canonical views are taken before anybody knows a scene: under one nominal light.
Light arguments persist in pybullet from one call to the next, so every call passes all of them;
each scene starts from `resetSimulation`, which leaks least. The arm is left out: its meshes cost
more than the rest of the picture.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from relevance.scene import Box, Camera, Color, Light, Scene, Table, pinhole
from relevance.scene.geometry import packed, uprights
from relevance.simulation.bullet import Client, lens, pybullet
from relevance.simulation.painting import SHADOWED, ground, halved, paint, pattern, silhouettes

RENDERER_VERSION = "1"
"""Raised when an equal scene comes to give other pixels, masks, views or visible shares."""
VIEW_PIXELS = 32
"""Edge of a canonical view, pixels."""
MIN_VISIBLE_FRACTION = 0.25
"""A scene is rejected when an object shows less of itself than this."""
MIN_VISIBLE_PIXELS = 60
"""A scene is rejected when an object shows fewer pixels than this."""


_FLOOR = (176, 180, 188)
_VIEW_BACKGROUND = (128, 128, 128)
# Canonical view: from the robot's side, 45 degrees down like the scene camera, turned so that
# three faces show; 13 degrees at 1 m hold every box of up to 12 cm.
_VIEW_CAMERA = Camera(
    eye=(-math.sqrt(0.5), 0.0, math.sqrt(0.5)),
    width=2 * VIEW_PIXELS,
    height=2 * VIEW_PIXELS,
    fov=13.0,
    near=0.5,
    far=2.0,
)
_VIEW_LIGHT = Light()
_VIEW_YAW = 0.5
_CACHED_VIEWS = 1024
_CACHED_SHADES = 64
_PARKED = (0.0, 0.0, -1000.0)  # behind the far plane of every view


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendering:
    """What the camera sees of a scene with N objects, H x W pixels."""

    image: np.ndarray
    """(H, W, 3) uint8, RGB."""
    mask: np.ndarray
    """(H, W) uint8: 0 for table and background, i + 1 for `objects[i]`."""
    views: np.ndarray
    """(N, 32, 32, 3) uint8, RGB: each object alone, at one scale, in one pose."""
    visible_pixels: np.ndarray
    """(N,) int64: pixels of each object in the mask."""
    visible_fraction: np.ndarray
    """(N,) float64: those, as a share of the pixels that it would show if it were alone."""


class Renderer(Client):
    """Renders scenes in a pybullet client of its own; use as a context manager.

    Equal scenes give equal pixels, whatever was rendered before and in which process.
    """

    def __init__(self) -> None:
        super().__init__()
        self._views: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._table_colors: OrderedDict[tuple, np.ndarray] = OrderedDict()

    def render(self, scene: Scene) -> Rendering:
        """Scene image, mask, canonical views and visibility of every object."""
        camera, light = scene.camera, scene.light
        shades = self._shades(scene)
        pybullet.resetSimulation(physicsClientId=self.client)
        views = []
        for box in scene.objects:
            body = self._create(box)
            assert body == len(views), "ids count up from 0 after a reset"
            views.append(self._view(body, box))
            self._put(body, _PARKED, 0.0)
        for body, box in enumerate(scene.objects):
            self._put(body, box.position, box.yaw)
        boxes = uprights(scene.objects)
        alone, part = _silhouettes(boxes, camera)
        image, mask, visible = paint(
            *self._picture(camera, light, part),
            boxes,
            255 * light.ambient * np.array([box.color for box in scene.objects]),
            _ground(camera, scene.table),
            *pinhole(camera),
            _source(light) if light.shadow else np.empty(0),
            shades,
            _FLOOR,
        )
        for i in np.flatnonzero(alone < 0):
            alone[i] = self._pixels_alone(int(i), scene)
        return Rendering(
            image=image,
            mask=mask,
            views=np.stack(views),
            visible_pixels=visible,
            # `alone` is computed, not rendered: a pixel of rounding may make it the smaller one.
            visible_fraction=np.minimum(visible / np.maximum(alone, 1), 1.0),
        )

    def _create(self, box: Box) -> int:
        shape = pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[edge / 2 for edge in box.size],
            rgbaColor=[*box.color, 1.0],
            specularColor=[0.0, 0.0, 0.0],
            physicsClientId=self.client,
        )
        return pybullet.createMultiBody(
            baseMass=0.0,
            baseVisualShapeIndex=shape,
            useMaximalCoordinates=True,  # one rigid body without links, quicker to make
            physicsClientId=self.client,
        )

    def _put(self, body: int, position: Sequence[float], yaw: float) -> None:
        pybullet.resetBasePositionAndOrientation(
            body,
            position,
            (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
            physicsClientId=self.client,
        )

    def _picture(
        self, camera: Camera, light: Light, part: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """RGBA pixels (H, W, 4) uint8 and body ids (H, W) int32, -1 for nothing.

        part (4,): of `silhouettes`; no box is outside it, and the colours there mean nothing. A
        pixel costs the same with or without a box on it.
        """
        width, height = camera.width, camera.height
        left, upper, right, lower = (0, 0, width, height) if part is None else part.tolist()
        if left >= right:  # no box is in the picture
            left, upper, right, lower = 0, 0, 1, 1
        wide, high = right - left, lower - upper
        view, frustum = lens(camera)
        frustum = [*frustum]  # of the whole picture, cut down to the part
        frustum[0] *= width / wide
        frustum[5] *= height / high
        frustum[8] = (left + right - width) / wide
        frustum[9] = (height - upper - lower) / high
        _, _, rgba, _, bodies = pybullet.getCameraImage(
            wide,
            high,
            view,
            frustum,
            lightDirection=light.direction,
            lightColor=light.color,
            lightDistance=light.distance,
            shadow=0,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        window = np.s_[upper:lower, left:right]
        whole = np.zeros((height, width, 4), dtype=np.uint8)
        whole[window] = np.asarray(rgba, dtype=np.uint8).reshape(high, wide, 4)
        ids = np.full((height, width), -1, dtype=np.int32)
        ids[window] = np.reshape(np.asarray(bodies), (high, wide))
        return whole, ids

    def _view(self, body: int, box: Box) -> np.ndarray:
        """Canonical view of a box, alone in front of the camera, (32, 32, 3) uint8."""
        key = (box.size, box.color)
        if key in self._views:
            self._views.move_to_end(key)
            return self._views[key]
        self._put(body, (0.0, 0.0, 0.0), _VIEW_YAW)
        posed = packed(box.size, (0.0, 0.0, 0.0), _VIEW_YAW)
        part = _silhouettes(posed[None], _VIEW_CAMERA)[1]
        pixels, bodies = self._picture(_VIEW_CAMERA, _VIEW_LIGHT, part)
        view = halved(pixels, bodies, body, _VIEW_BACKGROUND)
        self._views[key] = view
        if len(self._views) > _CACHED_VIEWS:
            self._views.popitem(last=False)
        return view

    def _shades(self, scene: Scene) -> np.ndarray:
        """The table's pixels in the light and in a shadow, (2, H, W, 3) uint8.

        Both colours of a texture come with their shades; the pattern blends those.
        """
        table, camera = scene.table, scene.camera
        plain = self._table_shades(table.color, scene.light)
        if table.texture is None:
            whole = (2, camera.height, camera.width, 3)
            return np.broadcast_to(plain[:, None, None], whole)
        x, y = _ground(camera, table)
        on_table = ~np.isnan(x)
        share = pattern(table.texture, x[on_table], y[on_table])[:, None]
        first, second = plain.astype(float), self._table_shades(table.texture.color, scene.light)
        shades = np.zeros((2, *x.shape, 3), dtype=np.uint8)
        for k in range(2):
            shades[k, on_table] = np.rint(first[k] + share * (second[k] - first[k]))
        return shades

    def _table_shades(self, color: Color, light: Light) -> np.ndarray:
        """A colour of the table in the light and in a shadow, (2, 3) uint8.

        The lit one is what TinyRenderer makes of a patch of it; a plane has the same shade all
        over, since light and normal are the same. Changes the simulated world.
        """
        key = (color, light)
        if key not in self._table_colors:
            pybullet.resetSimulation(physicsClientId=self.client)
            # GEOM_PLANE has no visual; a mesh quad does.
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                vertices=[[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]],
                indices=[0, 1, 2, 0, 2, 3],
                normals=[[0, 0, 1]] * 4,
                uvs=[[0, 0], [1, 0], [1, 1], [0, 1]],
                rgbaColor=[*color, 1.0],
                specularColor=[0.0, 0.0, 0.0],
                physicsClientId=self.client,
            )
            pybullet.createMultiBody(
                baseMass=0.0, baseVisualShapeIndex=shape, physicsClientId=self.client
            )
            camera = Camera(eye=(-0.5, 0.0, 0.5), width=8, height=8, fov=10.0)
            lit = self._picture(camera, light)[0][4, 4, :3]
            ambient = 255 * light.ambient * np.array(color)
            shadowed = ambient + SHADOWED * np.maximum(lit - ambient, 0)
            self._table_colors[key] = np.array([lit, np.minimum(shadowed, 255)], dtype=np.uint8)
            if len(self._table_colors) > _CACHED_SHADES:
                self._table_colors.popitem(last=False)
        return self._table_colors[key]

    def _pixels_alone(self, i: int, scene: Scene) -> int:
        """How many pixels object i, partly behind the camera, covers when nothing hides it."""
        for j in range(len(scene.objects)):
            if j != i:
                self._put(j, _PARKED, 0.0)
        _, bodies = self._picture(scene.camera, scene.light)
        for j, box in enumerate(scene.objects):
            self._put(j, box.position, box.yaw)
        return int((bodies == i).sum())


def rejects(rendering: Rendering) -> str | None:
    """Why a scene is not worth keeping: an object that can hardly be seen; None if all can."""
    for i, fraction in enumerate(rendering.visible_fraction):
        pixels = int(rendering.visible_pixels[i])
        if fraction < MIN_VISIBLE_FRACTION:
            return f"object {i} is {fraction:.0%} visible, under {MIN_VISIBLE_FRACTION:.0%}"
        if pixels < MIN_VISIBLE_PIXELS:
            return f"object {i} shows {pixels} pixels, under {MIN_VISIBLE_PIXELS}"
    return None


def _source(light: Light) -> np.ndarray:
    """Where TinyRenderer's light stands, world frame (3,), m."""
    direction = np.array(light.direction)
    return direction / np.linalg.norm(direction) * light.distance


def _silhouettes(boxes: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """`silhouettes` of rows (N, UPRIGHT) in a camera's picture."""
    return silhouettes(boxes, *pinhole(camera), camera.width, camera.height, camera.near)


@lru_cache(maxsize=8)
def _ground(camera: Camera, table: Table) -> np.ndarray:
    """Where each pixel meets the table, x and y (2, H, W), m, NaN off it."""
    return ground(*pinhole(camera), camera.width, camera.height, np.array(table.size) / 2)
