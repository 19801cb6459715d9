"""The closed-form parts of a picture: ground and its patterns, shadows, silhouettes, small views.

Compiled loops over pixels. Boxes are rows as `relevance.scene.geometry` has them; eye, axes and
focal length are those of `pinhole`. TinyRenderer samples pixel (row, column) at x = column,
y = row + 1: with these points the silhouettes equal the rendered ones pixel by pixel.

H, W pixels; N boxes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from relevance.scene import Texture
from relevance.scene.geometry import bound, corners, crossing, extents, projected

SHADOWED = 0.8
"""The share of direct light that TinyRenderer leaves in a shadow."""


@njit(cache=True, error_model="numpy")
def ground(eye, axes, focal, width, height, table):
    """Where each pixel meets a table of half edges (2,), m: x and y (2, H, W), NaN off it."""
    points = np.empty((2, height, width))
    for row in range(height):
        for column in range(width):
            dx, dy, dz = _sight(axes, focal, width, height, row, column)
            scale = -eye[2] / dz
            x, y = eye[0] + scale * dx, eye[1] + scale * dy
            on_table = scale > 0 and abs(x) <= table[0] and abs(y) <= table[1]
            points[0, row, column] = x if on_table else np.nan
            points[1, row, column] = y if on_table else np.nan
    return points


@njit(cache=True, error_model="numpy")
def paint(pixels, bodies, boxes, ambient, points, eye, axes, focal, source, shades, floor):
    """Table, floor and all shadows, around and on the boxes that pybullet drew.

    pixels (H, W, 4) and bodies (H, W): RGBA and box indices (-1: none) of its picture. boxes
    (N, UPRIGHT), ambient (N, 3): their colours in ambient light alone, 0..255. points: of `ground`.
    source: where the light stands, (3,), m; (0,) for no shadows. shades: the table's
    pixels in the light and in a shadow, (2, H, W, 3); floor: RGB.
    Returns image (H, W, 3) and mask (H, W), uint8, and how many pixels each box shows (N,).
    """
    height, width = bodies.shape
    image = np.empty((height, width, 3), np.uint8)
    mask = np.empty((height, width), np.uint8)
    visible = np.zeros(len(boxes), np.int64)
    hulls, sizes, bounds, reaches = _shadows(boxes, source)
    every = np.array([np.inf, np.inf, -np.inf, -np.inf])  # bounds of all shadows
    for j in range(len(bounds)):
        for k in range(2):
            if bounds[j, k] < every[k]:  # not so where there is no shadow
                every[k] = bounds[j, k]
            if bounds[j, 2 + k] > every[2 + k]:
                every[2 + k] = bounds[j, 2 + k]
    for row in range(height):
        for column in range(width):
            i = bodies[row, column]
            mask[row, column] = i + 1
            if i < 0:
                x, y = points[0, row, column], points[1, row, column]
                dark = 0
                shaded = every[0] <= x <= every[2] and every[1] <= y <= every[3]
                for j in range(len(boxes) if shaded else 0):
                    if (
                        bounds[j, 0] <= x <= bounds[j, 2]
                        and bounds[j, 1] <= y <= bounds[j, 3]
                        and _inside(hulls[j], sizes[j], x, y)
                    ):
                        dark = 1
                        break
                for k in range(3):
                    shade = floor[k] if math.isnan(x) else shades[dark, row, column, k]
                    image[row, column, k] = shade
            else:
                visible[i] += 1
                for k in range(3):
                    image[row, column, k] = pixels[row, column, k]
                sight = _sight(axes, focal, width, height, row, column)
                if _in_shadow(i, boxes, reaches, eye, sight, source):
                    for k in range(3):
                        direct = max(image[row, column, k] - ambient[i, k], 0.0)
                        image[row, column, k] = np.uint8(ambient[i, k] + SHADOWED * direct)
    return image, mask, visible


@njit(cache=True)
def silhouettes(boxes, eye, axes, focal, width, height, near):
    """How many pixels each box covers when alone, (N,), and the part of the picture around all.

    The part (4,) is left, upper, right and lower pixel; the latter two are the first beyond. A
    box that is partly nearer than `near`, m, is no hull of its corners: its count is -1, and
    the part is the whole picture.
    """
    counts, part = np.zeros(len(boxes), np.int64), np.array([width, height, 0, 0])
    hull, bounds = np.empty((16, 2)), np.empty(4)
    for i in range(len(boxes)):
        seen = projected(corners(boxes[i]), eye, axes, focal)
        for k in range(8):
            if seen[k, 2] <= near:
                counts[i] = -1
        if counts[i] < 0:
            part[0], part[1], part[2], part[3] = 0, 0, width, height
            continue
        bound(seen, bounds)
        left = max(math.floor(bounds[0] + width / 2), 0)
        upper = max(math.floor(bounds[1] + height / 2) - 1, 0)
        right = min(math.ceil(bounds[2] + width / 2) + 1, width)
        lower = min(math.ceil(bounds[3] + height / 2) + 1, height)
        if left >= right or upper >= lower:
            continue  # outside the picture
        part[0], part[1] = min(part[0], left), min(part[1], upper)
        part[2], part[3] = max(part[2], right), max(part[3], lower)
        size = _hull(seen, hull)
        for row in range(upper, lower):
            for column in range(left, right):
                counts[i] += _inside(hull, size, column - width / 2, row + 1 - height / 2)
    return counts, part


@njit(cache=True)
def halved(pixels, bodies, body, background):
    """A picture (H, W, 4) at half its size, (H / 2, W / 2, 3) uint8, with one RGB around a body."""
    height, width = bodies.shape[0] // 2, bodies.shape[1] // 2
    view = np.empty((height, width, 3), np.uint8)
    for row in range(height):
        for column in range(width):
            for k in range(3):
                total = 2  # half of four, to round
                for i in range(2 * row, 2 * row + 2):
                    for j in range(2 * column, 2 * column + 2):
                        total += pixels[i, j, k] if bodies[i, j] == body else background[k]
                view[row, column, k] = total // 4
    return view


@njit(cache=True)
def _sight(axes, focal, width, height, row, column):
    """Direction of sight of a pixel with unit depth: the inverse of `project`."""
    u, v = (column - width / 2) / focal, (row + 1 - height / 2) / focal
    return (
        axes[0, 2] + u * axes[0, 0] + v * axes[0, 1],
        axes[1, 2] + u * axes[1, 0] + v * axes[1, 1],
        axes[2, 2] + u * axes[2, 0] + v * axes[2, 1],
    )


@njit(cache=True)
def _shadows(boxes, source):
    """The shadows on the table plane: hulls (N, 16, 2) with their numbers of points (N,) and
    bounds (N, 4), lowest x and y and highest; and which box (N) may darken which other, (N, N).
    """
    count = len(boxes)
    hulls, sizes = np.empty((count, 16, 2)), np.zeros(count, np.int64)
    bounds, reaches = np.empty((count, 4)), np.zeros((count, count), np.bool_)
    cast, both = np.empty((8, 2)), np.empty(4)
    bounds[:] = np.nan  # no shadow: nothing lies within
    if len(source) == 0:
        return hulls, sizes, bounds, reaches
    for j in range(count):
        for k in range(2):
            both[k], both[2 + k] = -np.inf, np.inf
        # A light that stands lower than the box casts no shadow of it on the table.
        if source[2] > boxes[j, 2] + boxes[j, 6]:
            points = corners(boxes[j])
            for k in range(8):
                scale = source[2] / (source[2] - points[k, 2])
                for i in range(2):
                    cast[k, i] = source[i] + (points[k, i] - source[i]) * scale
            sizes[j] = _hull(cast, hulls[j])
            bound(cast, bounds[j])
            bound(points, both)
            for k in range(2):
                both[k] = min(both[k], bounds[j, k])
                both[2 + k] = max(both[2 + k], bounds[j, 2 + k])
        for i in range(count):
            (x, y), (ex, ey) = (boxes[i, 0], boxes[i, 1]), extents(boxes[i], 1.0, 0.0)
            reaches[i, j] = (
                i != j
                and boxes[j, 2] + boxes[j, 6] > boxes[i, 2] - boxes[i, 6]
                and both[0] <= x + ex
                and both[1] <= y + ey
                and both[2] >= x - ex
                and both[3] >= y - ey
            )
    return hulls, sizes, bounds, reaches


@njit(cache=True)
def _in_shadow(i, boxes, reaches, eye, sight, source):
    """Whether the light misses what shows of box i along a line of sight (3,)."""
    x = y = z = np.nan
    for j in range(len(boxes)):
        if not reaches[i, j]:
            continue
        if math.isnan(x):
            (dx, dy, dz), (x, y, z) = sight, (eye[0], eye[1], eye[2])
            enter, _ = crossing(boxes[i], x, y, z, dx, dy, dz)
            x, y, z = x + enter * dx, y + enter * dy, z + enter * dz
        enter, leave = crossing(boxes[j], x, y, z, source[0] - x, source[1] - y, source[2] - z)
        if enter < leave and leave > 1e-6 and enter < 1:
            return True
    return False


@njit(cache=True)
def _hull(points, hull):
    """Fill hull (2 K, 2) with the convex hull of points (K, 2 or more), counter-clockwise.

    Returns its number of points; the monotone chain.
    """
    count = len(points)
    order = np.arange(count)
    for k in range(1, count):  # by x, then y
        at = k
        while at > 0:
            p, q = order[at - 1], order[at]
            if points[p, 0] < points[q, 0] or (
                points[p, 0] == points[q, 0] and points[p, 1] <= points[q, 1]
            ):
                break
            order[at - 1], order[at] = q, p
            at -= 1
    size = 0
    for chain in range(2):
        first = size
        for k in range(count):
            point = order[k if chain == 0 else count - 1 - k]
            x, y = points[point, 0], points[point, 1]
            while size - first > 1 and _turn(hull, size - 2, size - 1, x, y) <= 0:
                size -= 1
            hull[size, 0], hull[size, 1] = x, y
            size += 1
        size -= 1  # the last point is the first of the other chain
    return size


@njit(cache=True)
def _inside(hull, size, x, y):
    """Whether a point lies in a counter-clockwise convex polygon, borders included."""
    before = size - 1
    for k in range(size):
        if _turn(hull, before, k, x, y) < 0:
            return False
        before = k
    return True


@njit(cache=True)
def _turn(hull, a, b, x, y):
    """Over 0 when (x, y) lies left of the line from one point of a hull to another."""
    ax, ay = hull[a, 0], hull[a, 1]
    return (hull[b, 0] - ax) * (y - ay) - (hull[b, 1] - ay) * (x - ax)


def pattern(texture: Texture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Share of the second colour at points x, y on the table (any shape), m: 0 to 1.

    A function of the place and of the texture's parameters alone, so a stored scene gives the
    same pixels again, on any machine, with no texture file. Noise comes from hashed whole numbers
    rather than from a generator or a sine, whose last digits differ between machines.
    """
    c, s = math.cos(texture.angle), math.sin(texture.angle)
    along, across = (c * x + s * y) / texture.scale, (c * y - s * x) / texture.scale
    # Where the pattern lies: two numbers in 0..1 of the seed.
    shift = _hashed(np.arange(2), np.zeros(2, dtype=np.int64), texture.seed)
    along, across = along + shift[0], across + shift[1]
    if texture.kind == "checks":
        return (np.floor(along) + np.floor(across)) % 2
    if texture.kind == "stripes":
        # Bands that waver slowly along their length, like the grain of wood.
        place = across + 0.6 * _noise(along / 8, across / 2, texture.seed)
        return np.abs(place % 2 - 1)
    return (
        2 * _noise(along, across, texture.seed) + _noise(3 * along, 3 * across, texture.seed)
    ) / 3


def _noise(u: np.ndarray, v: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in 0..1: hashed values at whole numbers, blended between them."""
    i, j = np.floor(u), np.floor(v)
    a, b = u - i, v - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    i, j = i.astype(np.int64), j.astype(np.int64)
    near = _hashed(i, j, seed) * (1 - a) + _hashed(i + 1, j, seed) * a
    far = _hashed(i, j + 1, seed) * (1 - a) + _hashed(i + 1, j + 1, seed) * a
    return near * (1 - b) + far * b


def _hashed(i: np.ndarray, j: np.ndarray, seed: int) -> np.ndarray:
    """A number in [0, 1) for each lattice point: multiply, fold, multiply (as murmur3 ends)."""
    mixed = i.astype(np.uint32) * np.uint32(0x9E3779B1)
    mixed ^= j.astype(np.uint32) * np.uint32(0x85EBCA77)
    mixed += np.uint32(seed)
    for factor in (0x85EBCA6B, 0xC2B2AE35):
        mixed ^= mixed >> np.uint32(15)
        mixed *= np.uint32(factor)
    mixed ^= mixed >> np.uint32(16)
    return mixed / 2**32
