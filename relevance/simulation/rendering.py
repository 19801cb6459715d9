"""Pictures of scenes: image, mask, canonical views and how much of each object shows.

Boxes are drawn by pybullet's TinyRenderer (no GPU, no display). The table is a plane under one
light, so its pixels (and the pattern on it, if any) are filled in closed form, in a third of the
time; the mask stays that of a full render. Shadows are closed form too, on the table and on the
boxes: TinyRenderer's shadow map speckles faces that the light grazes. So is the number of pixels
that a box would show alone (a convex silhouette); nothing is rendered twice. Light arguments
persist in pybullet from one call to the next, so every call passes all of them; each scene
starts from `resetSimulation`, which leaks least. The arm is left out: its meshes cost more
than the rest of the picture.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import TracebackType

import numpy as np

from relevance.sampling import camera_up, project, vertices
from relevance.scene import Box, Camera, Color, Light, Scene, Table
from relevance.simulation.bullet import pybullet
from relevance.simulation.textures import pattern

VIEW_PIXELS = 32
"""Edge of a canonical view, pixels."""
MIN_VISIBLE_FRACTION = 0.25
"""A scene is rejected when an object shows less of itself than this."""
MIN_VISIBLE_PIXELS = 60
"""A scene is rejected when an object shows fewer pixels than this."""


def _pack(color: Sequence[float] | np.ndarray) -> np.uint32:
    """A colour in 0..255 as one word, in the byte order of pybullet's RGBA pixels.

    Moving a word a pixel makes the fills below eight times faster than three bytes.
    """
    red, green, blue = (int(min(max(value, 0), 255)) for value in color)
    return np.array([red, green, blue, 255], dtype=np.uint8).view(np.uint32)[0]


def _unpack(words: np.ndarray) -> np.ndarray:
    """RGB (H, W, 3) uint8 of packed pixels (H, W)."""
    return np.ascontiguousarray(words.view(np.uint8).reshape(*words.shape, 4)[..., :3])


_FLOOR = _pack((176, 180, 188))
_VIEW_BACKGROUND = _pack((128, 128, 128))
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


class Renderer:
    """Renders scenes in a pybullet client of its own; use as a context manager.

    Equal scenes give equal pixels, whatever was rendered before and in which process.
    """

    def __init__(self) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("pybullet gave no client: too many are open in this process")
        self._views: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._table_colors: OrderedDict[tuple, tuple[np.uint32, np.uint32]] = OrderedDict()

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
        shades = self._table_shades(scene.table.color, scene.light)
        if scene.table.texture is not None:
            second = self._table_shades(scene.table.texture.color, scene.light)
            shades = _textured(scene, shades, second)
        pybullet.resetSimulation(physicsClientId=self._client)
        bodies, views = [], []
        for box in scene.objects:
            body = self._create(box)
            views.append(self._view(body, box, scene.light))
            self._put(body, _PARKED, 0.0)
            bodies.append(body)
        for body, box in zip(bodies, scene.objects, strict=True):
            self._put(body, box.position, box.yaw)
        words, segments = self._picture(scene.camera, scene.light)
        # One look-up a pixel; body ids count up from 0, and -1 is nothing.
        values = np.zeros(max(bodies) + 2, dtype=np.uint8)
        values[np.array(bodies) + 1] = np.arange(1, len(bodies) + 1)
        mask = values[segments + 1]
        _fill_ground(words, mask == 0, scene, *shades)
        image = _unpack(words)
        if scene.light.shadow:
            _shade_boxes(image, mask, scene)
        visible = np.bincount(mask.ravel(), minlength=len(bodies) + 1)[1:]
        alone = np.array([self._pixels_alone(i, bodies, scene) for i in range(len(bodies))])
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

    def _picture(self, camera: Camera, light: Light) -> tuple[np.ndarray, np.ndarray]:
        """Packed pixels (H, W) uint32 and body ids (H, W), -1 for nothing."""
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
            shadow=0,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        shape = (camera.height, camera.width)
        words = np.asarray(rgba, dtype=np.uint8).reshape(-1).view(np.uint32)
        return words.reshape(shape), np.reshape(np.asarray(segments), shape)

    def _view(self, body: int, box: Box, light: Light) -> np.ndarray:
        """Canonical view of a box, alone in front of the camera, (32, 32, 3) uint8."""
        key = (box.size, box.color, light)
        if key in self._views:
            self._views.move_to_end(key)
            return self._views[key]
        self._put(body, (0.0, 0.0, 0.0), _VIEW_YAW)
        words, segments = self._picture(_VIEW_CAMERA, light)
        words[segments != body] = _VIEW_BACKGROUND
        blocks = _unpack(words).reshape(VIEW_PIXELS, 2, VIEW_PIXELS, 2, 3).astype(np.uint16)
        view = ((blocks.sum(axis=(1, 3)) + 2) // 4).astype(np.uint8)
        self._views[key] = view
        if len(self._views) > _CACHED_VIEWS:
            self._views.popitem(last=False)
        return view

    def _table_shades(self, color: Color, light: Light) -> tuple[np.uint32, np.uint32]:
        """A colour of the table in the light and in a shadow, packed.

        The lit one is what TinyRenderer makes of a patch of it; a plane has the same shade all
        over, since light and normal are the same. Changes the simulated world.
        """
        key = (color, light)
        if key not in self._table_colors:
            pybullet.resetSimulation(physicsClientId=self._client)
            # GEOM_PLANE has no visual; a mesh quad does.
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                vertices=[[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]],
                indices=[0, 1, 2, 0, 2, 3],
                normals=[[0, 0, 1]] * 4,
                uvs=[[0, 0], [1, 0], [1, 1], [0, 1]],
                rgbaColor=[*color, 1.0],
                specularColor=[0.0, 0.0, 0.0],
                physicsClientId=self._client,
            )
            pybullet.createMultiBody(
                baseMass=0.0, baseVisualShapeIndex=shape, physicsClientId=self._client
            )
            camera = Camera(eye=(-0.5, 0.0, 0.5), width=8, height=8, fov=10.0)
            lit = _unpack(self._picture(camera, light)[0])[4, 4]
            ambient = 255 * light.ambient * np.array(color)
            shadowed = ambient + _SHADOWED * np.maximum(lit - ambient, 0)
            self._table_colors[key] = (_pack(lit), _pack(shadowed))
            if len(self._table_colors) > _CACHED_SHADES:
                self._table_colors.popitem(last=False)
        return self._table_colors[key]

    def _pixels_alone(self, i: int, bodies: Sequence[int], scene: Scene) -> int:
        """How many pixels of the image object i covers when nothing hides it."""
        camera = scene.camera
        corners, depth = project(camera, vertices(scene.objects[i]))
        if (depth > camera.near).all():
            rows, columns, x, y = _window(corners, camera)
            return int(_inside(_hull(corners), x, y).sum()) if rows and columns else 0
        # Partly behind the camera, the silhouette is not the hull of the corners: look.
        for j, body in enumerate(bodies):
            if j != i:
                self._put(body, _PARKED, 0.0)
        _, segments = self._picture(camera, scene.light)
        for body, box in zip(bodies, scene.objects, strict=True):
            self._put(body, box.position, box.yaw)
        return int((segments == bodies[i]).sum())


def rejects(rendering: Rendering) -> str | None:
    """Why a scene is not worth keeping: an object that can hardly be seen; None if all can."""
    for i, fraction in enumerate(rendering.visible_fraction):
        pixels = int(rendering.visible_pixels[i])
        if fraction < MIN_VISIBLE_FRACTION:
            return f"object {i} is {fraction:.0%} visible, under {MIN_VISIBLE_FRACTION:.0%}"
        if pixels < MIN_VISIBLE_PIXELS:
            return f"object {i} shows {pixels} pixels, under {MIN_VISIBLE_PIXELS}"
    return None


def _textured(
    scene: Scene, first: tuple[np.uint32, np.uint32], second: tuple[np.uint32, np.uint32]
) -> tuple[np.ndarray, np.ndarray]:
    """The table's pixels in the light and in a shadow, packed, (H, W) each.

    Both colours of the texture come with their shades; the pattern blends those.
    """
    texture = scene.table.texture
    assert texture is not None, "a plain table has one shade"
    on_table, x, y = _ground(scene.camera, scene.table)
    share = pattern(texture, x[on_table], y[on_table])[:, None]
    blended = []
    for one, other in zip(first, second, strict=True):
        a, b = (_unpack(np.array([[word]]))[0, 0].astype(float) for word in (one, other))
        pixels = np.full((*on_table.shape, 4), 255, dtype=np.uint8)
        pixels[on_table, :3] = np.rint(a + share * (b - a))
        blended.append(pixels.view(np.uint32)[..., 0])
    return blended[0], blended[1]


def _fill_ground(
    words: np.ndarray,
    empty: np.ndarray,
    scene: Scene,
    lit: np.uint32 | np.ndarray,
    shadowed: np.uint32 | np.ndarray,
) -> None:
    """Paint table, its shadows and the floor where no box is: packed pixels, in place.

    lit, shadowed: the table's pixels, one for all or (H, W).
    """
    camera, source = scene.camera, _source(scene.light)
    on_table, x_ground, y_ground = _ground(camera, scene.table)
    picture = np.where(on_table, lit, _FLOOR)
    shadowed = np.broadcast_to(shadowed, picture.shape)
    for box in scene.objects if scene.light.shadow else ():
        if source[2] <= box.top:
            continue  # The light stands lower than the box: no shadow falls on the table.
        cast = _cast(box, source)
        pixels, depth = project(camera, np.hstack([cast, np.zeros((8, 1))]))
        if (depth > camera.near).all():
            rows, columns, _, _ = _window(pixels, camera)
        else:
            rows, columns = slice(0, camera.height), slice(0, camera.width)
        if rows and columns:
            where = (rows, columns)
            dark = _inside(_hull(cast), x_ground[where], y_ground[where]) & on_table[where]
            np.copyto(picture[where], shadowed[where], where=dark)
    np.copyto(words, picture, where=empty)


def _shade_boxes(image: np.ndarray, mask: np.ndarray, scene: Scene) -> None:
    """Darken what a box shows in the shadow of other boxes, in place."""
    light, source, eye = scene.light, _source(scene.light), np.array(scene.camera.eye)
    rays = _rays(scene.camera)
    low, high = _shadow_bounds(scene.objects, source)
    all_rows, all_columns = np.nonzero(mask)
    shown = mask[all_rows, all_columns]
    for i, box in enumerate(scene.objects):
        centre, extents = np.array(box.position[:2]), np.array(box.extents)
        near_it = np.all((low <= centre + extents) & (high >= centre - extents), axis=1)
        casters = [
            other
            for j, other in enumerate(scene.objects)
            if near_it[j] and j != i and other.top > box.bottom
        ]
        if not casters:
            continue
        mine = shown == i + 1
        rows, columns = all_rows[mine], all_columns[mine]
        sight = rays[rows, columns]
        points = eye + _crossing(box, eye, sight)[0][:, None] * sight
        dark = np.zeros(len(points), dtype=bool)
        for other in casters:
            near, far = _crossing(other, points, source - points)
            dark |= (near < far) & (far > 1e-6) & (near < 1)
        rows, columns = rows[dark], columns[dark]
        ambient = 255 * light.ambient * np.array(box.color)
        direct = np.maximum(image[rows, columns] - ambient, 0)
        image[rows, columns] = (ambient + _SHADOWED * direct).astype(np.uint8)


def _source(light: Light) -> np.ndarray:
    """Where TinyRenderer's light stands, world frame (3,), m."""
    direction = np.array(light.direction)
    return direction / np.linalg.norm(direction) * light.distance


def _cast(box: Box, source: np.ndarray) -> np.ndarray:
    """Where the rays from the light through a box's corners meet the table plane, (8, 2)."""
    corners = vertices(box)
    rays = corners - source
    return (source + rays * (source[2] / -rays[:, 2:]))[:, :2]


def _shadow_bounds(boxes: Sequence[Box], source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of each box together with its shadow, lowest and highest x and y, each (N, 2)."""
    low, high = np.full((len(boxes), 2), -np.inf), np.full((len(boxes), 2), np.inf)
    for i, box in enumerate(boxes):
        if source[2] > box.top:
            both = np.vstack([_cast(box, source), box.corners()])
            low[i], high[i] = both.min(axis=0), both.max(axis=0)
    return low, high


def _crossing(
    box: Box, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (K, 3) enter and leave a box, in multiples of the direction, each (K,).

    A ray that misses enters later than it leaves.
    """
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    T_box_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    start = (origins - np.array(box.position)) @ T_box_world.T
    along = directions @ T_box_world.T
    half = np.array(box.size) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - start) / along, (half - start) / along
    # 0 / 0: the ray runs within a face; let the other axes decide.
    near = np.nan_to_num(np.minimum(a, b), nan=-np.inf, neginf=-np.inf, posinf=np.inf)
    far = np.nan_to_num(np.maximum(a, b), nan=np.inf, neginf=-np.inf, posinf=np.inf)
    return near.max(axis=-1), far.min(axis=-1)


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> np.ndarray:
    """Direction of sight of every pixel, (H, W, 3): the inverse of `project`.

    At TinyRenderer's sample points (see `_window`), with unit depth along the optical axis.
    """
    forward = np.array(camera.target) - np.array(camera.eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera_up(camera))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    focal = camera.width / 2 / math.tan(math.radians(camera.fov) / 2)
    u = (np.arange(camera.width) - camera.width / 2) / focal
    v = (np.arange(camera.height) + 1 - camera.height / 2) / focal
    return forward + u[None, :, None] * right + v[:, None, None] * down


@lru_cache(maxsize=8)
def _ground(camera: Camera, table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each pixel meets the plane z = 0: on the table or not, x and y, each (H, W)."""
    rays = _rays(camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = -camera.eye[2] / rays[..., 2]
        x = camera.eye[0] + scale * rays[..., 0]
        y = camera.eye[1] + scale * rays[..., 1]
        half_x, half_y = table.size[0] / 2, table.size[1] / 2
        on_table = (scale > 0) & (np.abs(x) <= half_x) & (np.abs(y) <= half_y)
    # Rays that miss the plane have no point; nobody asks for one off the table.
    return on_table, np.where(on_table, x, 0.0), np.where(on_table, y, 0.0)


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
