"""Pictures of scenes: image, mask, canonical views and how much of each object shows.

Boxes are drawn by pybullet's TinyRenderer (no GPU, no display), shadows among them included.
The table is a plane of one colour under one light, so its pixels and the shadows on it are
filled in closed form: the mask and the pixels of the boxes are those of a full render, in a
third of the time. How many pixels a box would show alone is closed form too (a convex
silhouette); nothing is rendered twice. Light arguments persist in pybullet from one call to
the next, so every call passes all of them; each scene starts from `resetSimulation`, which
leaks least. The arm is left out: its meshes cost more than the rest of the picture.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import TracebackType

import numpy as np
import pybullet  # pyright: ignore[reportMissingImports]  (compiled, has no stubs)

from relevance.sampling import camera_up, project, vertices
from relevance.scene import Box, Camera, Light, Scene, Table

VIEW_PIXELS = 32
"""Edge of a canonical view, pixels."""
MIN_VISIBLE_FRACTION = 0.25
"""A scene is rejected when an object shows less of itself than this."""
MIN_VISIBLE_PIXELS = 60
"""A scene is rejected when an object shows fewer pixels than this."""

_FLOOR = np.array([176, 180, 188], dtype=np.uint8)
_VIEW_BACKGROUND = 128
_SHADOWED = 0.8  # the share of direct light that TinyRenderer leaves in a shadow
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
_VIEW_YAW = 0.5
_CACHED_VIEWS = 1024
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


class Renderer:
    """Renders scenes in a pybullet client of its own; use as a context manager.

    Equal scenes give equal pixels, whatever was rendered before and in which process.
    """

    def __init__(self) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("pybullet gave no client: too many are open in this process")
        self._views: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._table_colors: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the client back; the renderer cannot be used afterwards."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def render(self, scene: Scene) -> Rendering:
        """Scene image, mask, canonical views and visibility of every object."""
        lit, shadowed = self._table_shades(scene.table, scene.light)
        pybullet.resetSimulation(physicsClientId=self._client)
        bodies, views = [], []
        for box in scene.objects:
            body = self._create(box)
            views.append(self._view(body, box, scene.light))
            self._put(body, _PARKED, 0.0)
            bodies.append(body)
        for body, box in zip(bodies, scene.objects, strict=True):
            self._put(body, box.position, box.yaw)
        image, segments = self._picture(scene.camera, scene.light, scene.light.shadow)
        mask = np.zeros(segments.shape, dtype=np.uint8)
        for i, body in enumerate(bodies):
            mask[segments == body] = i + 1
        _fill_ground(image, mask == 0, scene, lit, shadowed)
        visible = np.bincount(mask.ravel(), minlength=len(bodies) + 1)[1:]
        alone = np.array([self._pixels_alone(box, scene) for box in scene.objects])
        return Rendering(
            image=image,
            mask=mask,
            views=np.stack(views),
            visible_pixels=visible,
            visible_fraction=visible / np.maximum(alone, 1),
        )

    def _create(self, box: Box) -> int:
        shape = pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[edge / 2 for edge in box.size],
            rgbaColor=[*box.color, 1.0],
            specularColor=[0.0, 0.0, 0.0],
            physicsClientId=self._client,
        )
        return pybullet.createMultiBody(
            baseMass=0.0, baseVisualShapeIndex=shape, physicsClientId=self._client
        )

    def _put(self, body: int, position: Sequence[float], yaw: float) -> None:
        pybullet.resetBasePositionAndOrientation(
            body,
            position,
            (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
            physicsClientId=self._client,
        )

    def _picture(self, camera: Camera, light: Light, shadow: bool) -> tuple[np.ndarray, np.ndarray]:
        """RGB (H, W, 3) uint8 and body ids (H, W), -1 for nothing."""
        aspect = camera.width / camera.height
        vertical = 2 * math.atan(math.tan(math.radians(camera.fov) / 2) / aspect)
        _, _, rgba, _, segments = pybullet.getCameraImage(
            camera.width,
            camera.height,
            pybullet.computeViewMatrix(camera.eye, camera.target, camera_up(camera)),
            pybullet.computeProjectionMatrixFOV(
                math.degrees(vertical), aspect, camera.near, camera.far
            ),
            lightDirection=light.direction,
            lightColor=light.color,
            lightDistance=light.distance,
            shadow=int(shadow),
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        shape = (camera.height, camera.width)
        rgb = np.reshape(np.asarray(rgba, dtype=np.uint8), (*shape, 4))[..., :3]
        return np.ascontiguousarray(rgb), np.reshape(np.asarray(segments), shape)

    def _view(self, body: int, box: Box, light: Light) -> np.ndarray:
        """Canonical view of a box, alone in front of the camera, (32, 32, 3) uint8."""
        key = (box.size, box.color, light)
        if key in self._views:
            self._views.move_to_end(key)
            return self._views[key]
        self._put(body, (0.0, 0.0, 0.0), _VIEW_YAW)
        image, segments = self._picture(_VIEW_CAMERA, light, shadow=False)
        image[segments != body] = _VIEW_BACKGROUND
        blocks = image.reshape(VIEW_PIXELS, 2, VIEW_PIXELS, 2, 3).astype(np.uint16)
        view = ((blocks.sum(axis=(1, 3)) + 2) // 4).astype(np.uint8)
        self._views[key] = view
        if len(self._views) > _CACHED_VIEWS:
            self._views.popitem(last=False)
        return view

    def _table_shades(self, table: Table, light: Light) -> tuple[np.ndarray, np.ndarray]:
        """The table's colour in the light and in a shadow, each (3,) uint8.

        The lit one is what TinyRenderer makes of a patch of it; a plane has the same shade all
        over, since light and normal are the same. Changes the simulated world.
        """
        key = (table.color, light)
        if key not in self._table_colors:
            pybullet.resetSimulation(physicsClientId=self._client)
            # GEOM_PLANE has no visual; a mesh quad does.
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                vertices=[[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]],
                indices=[0, 1, 2, 0, 2, 3],
                normals=[[0, 0, 1]] * 4,
                uvs=[[0, 0], [1, 0], [1, 1], [0, 1]],
                rgbaColor=[*table.color, 1.0],
                specularColor=[0.0, 0.0, 0.0],
                physicsClientId=self._client,
            )
            pybullet.createMultiBody(
                baseMass=0.0, baseVisualShapeIndex=shape, physicsClientId=self._client
            )
            camera = Camera(eye=(-0.5, 0.0, 0.5), width=8, height=8, fov=10.0)
            image, _ = self._picture(camera, light, shadow=False)
            lit = image[4, 4]
            ambient = 255 * light.ambient * np.array(table.color)
            shadowed = ambient + _SHADOWED * np.maximum(lit - ambient, 0)
            self._table_colors[key] = (lit, np.clip(shadowed, 0, 255).astype(np.uint8))
        return self._table_colors[key]

    def _pixels_alone(self, box: Box, scene: Scene) -> int:
        """How many pixels of the image the box covers when nothing hides it."""
        camera = scene.camera
        corners, depth = project(camera, vertices(box))
        if (depth > camera.near).all():
            rows, columns, x, y = _window(corners, camera)
            return int(_inside(_hull(corners), x, y).sum()) if rows and columns else 0
        # Partly behind the camera, the silhouette is not the hull of the corners: look.
        others = [
            pybullet.getBodyUniqueId(k, physicsClientId=self._client)
            for k in range(pybullet.getNumBodies(physicsClientId=self._client))
        ]
        poses = [
            pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
            for body in others
        ]
        mine = others[[b.name for b in scene.objects].index(box.name)]
        for body in others:
            if body != mine:
                self._put(body, (0.0, 0.0, -1e6), 0.0)
        _, segments = self._picture(camera, scene.light, shadow=False)
        for body, (position, orientation) in zip(others, poses, strict=True):
            pybullet.resetBasePositionAndOrientation(
                body, position, orientation, physicsClientId=self._client
            )
        return int((segments == mine).sum())


def rejects(rendering: Rendering) -> str | None:
    """Why a scene is not worth keeping: an object that can hardly be seen; None if all can."""
    for i, fraction in enumerate(rendering.visible_fraction):
        pixels = int(rendering.visible_pixels[i])
        if fraction < MIN_VISIBLE_FRACTION:
            return f"object {i} is {fraction:.0%} visible, under {MIN_VISIBLE_FRACTION:.0%}"
        if pixels < MIN_VISIBLE_PIXELS:
            return f"object {i} shows {pixels} pixels, under {MIN_VISIBLE_PIXELS}"
    return None


def _fill_ground(
    image: np.ndarray, empty: np.ndarray, scene: Scene, lit: np.ndarray, shadowed: np.ndarray
) -> None:
    """Paint table, its shadows and the floor where no box is, in place."""
    camera, light = scene.camera, scene.light
    on_table, x_ground, y_ground = _ground(camera, scene.table)
    on_table = on_table & empty
    image[empty] = _FLOOR
    image[on_table] = lit
    if not light.shadow:
        return
    direction = np.array(light.direction)
    source = direction / np.linalg.norm(direction) * light.distance
    for box in scene.objects:
        if source[2] <= box.top:
            continue  # The light stands lower than the box: no shadow falls on the table.
        corners = vertices(box)
        ray = corners - source
        cast = source + ray * (source[2] / -ray[:, 2:])
        pixels, depth = project(camera, cast)
        if (depth > camera.near).all():
            rows, columns, _, _ = _window(pixels, camera)
        else:
            rows, columns = slice(0, camera.height), slice(0, camera.width)
        if not rows or not columns:
            continue
        dark = _inside(_hull(cast[:, :2]), x_ground[rows, columns], y_ground[rows, columns])
        image[rows, columns][dark & on_table[rows, columns]] = shadowed


@lru_cache(maxsize=8)
def _ground(camera: Camera, table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each pixel meets the plane z = 0: on the table or not, x and y, each (H, W)."""
    # The inverse of `project` at TinyRenderer's sample points (see `_window`).
    origin = np.array(camera.eye)
    forward = np.array(camera.target) - origin
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera_up(camera))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    focal = camera.width / 2 / math.tan(math.radians(camera.fov) / 2)
    u = (np.arange(camera.width) - camera.width / 2) / focal
    v = (np.arange(camera.height) + 1 - camera.height / 2) / focal
    rays = forward + u[None, :, None] * right + v[:, None, None] * down
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = -origin[2] / rays[..., 2]
        x = origin[0] + scale * rays[..., 0]
        y = origin[1] + scale * rays[..., 1]
        half_x, half_y = table.size[0] / 2, table.size[1] / 2
        on_table = (scale > 0) & (np.abs(x) <= half_x) & (np.abs(y) <= half_y)
    return on_table, x, y


def _window(
    pixels: np.ndarray, camera: Camera
) -> tuple[slice | None, slice | None, np.ndarray, np.ndarray]:
    """Rows and columns around projected points (None when off the image) and sample points.

    TinyRenderer samples pixel (row, column) at x = column, y = row + 1: with these the
    closed-form silhouettes equal the rendered ones pixel by pixel.
    """
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    left, right = max(math.floor(low[0]), 0), min(math.ceil(high[0]) + 1, camera.width)
    upper, lower = max(math.floor(low[1]) - 1, 0), min(math.ceil(high[1]) + 1, camera.height)
    if left >= right or upper >= lower:
        return None, None, np.empty(0), np.empty(0)
    x, y = np.arange(left, right)[None, :], np.arange(upper, lower)[:, None] + 1
    return slice(upper, lower), slice(left, right), x, y


def _hull(points: np.ndarray) -> np.ndarray:
    """Convex hull of points (K, 2), counter-clockwise (M, 2): the monotone chain."""
    ordered = sorted(map(tuple, points.tolist()))

    def chain(sequence: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        hull: list[tuple[float, float]] = []
        for x, y in sequence:
            while len(hull) > 1:
                (ax, ay), (bx, by) = hull[-2], hull[-1]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                hull.pop()
            hull.append((x, y))
        return hull[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def _inside(hull: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which points lie in a counter-clockwise convex polygon (M, 2), borders included."""
    inside = np.ones(np.broadcast(x, y).shape, dtype=bool)
    for (ax, ay), (bx, by) in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0
    return inside
