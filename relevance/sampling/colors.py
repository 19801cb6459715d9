"""Colours that can be told apart, and a word for each.

A colour is RGB in 0..1 as it stands in an image file, that is sRGB: the renderer multiplies it
by the light and writes the result.
"""

from __future__ import annotations

import colorsys
import math
from operator import itemgetter

import numpy as np

from relevance.scene import Color, lab

FEW = 11
"""Up to this many boxes keep the full distance of colours."""
MOST = 31
"""Most boxes in one scene."""

COLOR_NAMES: dict[str, Color] = {
    "red": (0.85, 0.1, 0.1),
    "maroon": (0.45, 0.1, 0.12),
    "orange": (0.95, 0.5, 0.1),
    "brown": (0.5, 0.3, 0.12),
    "yellow": (0.95, 0.9, 0.15),
    "olive": (0.5, 0.5, 0.12),
    "lime": (0.6, 0.95, 0.2),
    "green": (0.15, 0.75, 0.2),
    "forest": (0.12, 0.42, 0.15),
    "mint": (0.35, 0.95, 0.65),
    "cyan": (0.2, 0.9, 0.95),
    "teal": (0.1, 0.5, 0.5),
    "azure": (0.25, 0.6, 0.95),
    "blue": (0.12, 0.2, 0.9),
    "navy": (0.1, 0.12, 0.45),
    "violet": (0.5, 0.35, 0.95),
    "purple": (0.5, 0.1, 0.75),
    "plum": (0.42, 0.12, 0.42),
    "magenta": (0.95, 0.15, 0.85),
    "pink": (0.95, 0.5, 0.75),
    "crimson": (0.85, 0.1, 0.45),
    "rust": (0.7, 0.3, 0.05),
    "gold": (0.8, 0.65, 0.05),
    "salmon": (0.95, 0.45, 0.4),
    "sand": (0.75, 0.65, 0.3),
    "moss": (0.35, 0.55, 0.1),
    "emerald": (0.05, 0.6, 0.4),
    "turquoise": (0.2, 0.8, 0.7),
    "steel": (0.25, 0.45, 0.65),
    "cobalt": (0.1, 0.35, 0.75),
    "indigo": (0.3, 0.1, 0.6),
    "orchid": (0.75, 0.3, 0.85),
    "rose": (0.75, 0.25, 0.4),
}


def draw_colors(
    rng: np.random.Generator,
    count: int,
    avoid: list[Color],
    *,
    distance: float,
    perceptual: bool = False,
    saturation: tuple[float, float] = (0.55, 1.0),
    brightness: tuple[float, float] = (0.4, 1.0),
) -> list[tuple[str, Color]] | None:
    """Distinct colours, each named after the nearest colour word not yet taken.

    distance: the least to each other and to those to avoid, in RGB (0..1), or when `perceptual`
    as CIE 1976 Delta E. With n > 11 colours it shrinks by (11 / n)^(1/2). None when they could
    not be found.
    """
    anchors = list(COLOR_NAMES.items())
    taken = [_place(color, perceptual) for color in avoid]
    least = (distance * min(1.0, math.sqrt(FEW / count))) ** 2
    named: dict[str, Color] = {}
    for _ in range(200 * count):
        color = from_hsv(rng.uniform(0, 1), rng.uniform(*saturation), rng.uniform(*brightness))
        place = _place(color, perceptual)
        if min(_apart(place, other) for other in taken) < least:
            continue
        free = ((_apart(anchor, color), word) for word, anchor in anchors if word not in named)
        taken.append(place)
        named[min(free, key=itemgetter(0))[1]] = color
        if len(named) == count:
            return list(named.items())
    return None


def from_hsv(hue: float, saturation: float, value: float) -> Color:
    """RGB of a hue, saturation and value in 0..1, rounded to 0.001."""
    red, green, blue = (
        round(1000 * channel) / 1000 for channel in colorsys.hsv_to_rgb(hue, saturation, value)
    )
    return red, green, blue


# Plain floats: numpy takes ten times as long for three numbers.
def _apart(a: Color, b: Color) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


def _place(color: Color, perceptual: bool) -> Color:
    """Where a colour is in the space whose distances count."""
    if not perceptual:
        return color
    x, y, z = lab(np.array(color)).tolist()
    return x, y, z
