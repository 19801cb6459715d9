"""Everything that pybullet does here: pictures of scenes, the replay of plans, others' worlds.

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
from relevance.simulation.worlds import Note, World, WorldError, read_bullet, write_bullet

__all__ = [
    "MAX_PENETRATION",
    "MIN_VISIBLE_FRACTION",
    "MIN_VISIBLE_PIXELS",
    "RENDERER_VERSION",
    "VIEW_PIXELS",
    "Film",
    "Note",
    "Renderer",
    "Rendering",
    "Replay",
    "World",
    "WorldError",
    "film_camera",
    "read_bullet",
    "rejects",
    "replay",
    "write_bullet",
]
