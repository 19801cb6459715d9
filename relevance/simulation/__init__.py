"""Everything that pybullet does here: pictures of scenes, and the replay of plans.

The only part of the project that imports pybullet.
"""

from relevance.simulation.filming import Film, film_camera
from relevance.simulation.rendering import (
    MIN_VISIBLE_FRACTION,
    MIN_VISIBLE_PIXELS,
    RENDERER_VERSION,
    VIEW_PIXELS,
    Renderer,
    Rendering,
    rejects,
)
from relevance.simulation.replaying import MAX_PENETRATION, Replay, replay

__all__ = [
    "MAX_PENETRATION",
    "MIN_VISIBLE_FRACTION",
    "MIN_VISIBLE_PIXELS",
    "RENDERER_VERSION",
    "VIEW_PIXELS",
    "Film",
    "Renderer",
    "Rendering",
    "Replay",
    "film_camera",
    "rejects",
    "replay",
]
