"""Everything that pybullet does here: pictures of scenes, and the replay of plans.

The only part of the project that imports pybullet.
"""

from relevance.simulation.rendering import (
    MIN_VISIBLE_FRACTION,
    MIN_VISIBLE_PIXELS,
    VIEW_PIXELS,
    Renderer,
    Rendering,
    rejects,
)
from relevance.simulation.replaying import MAX_PENETRATION, Replay, panda_urdf, replay

RENDERER_VERSION = "1"
"""Raised when equal scenes give other pictures."""

__all__ = [
    "MAX_PENETRATION",
    "MIN_VISIBLE_FRACTION",
    "MIN_VISIBLE_PIXELS",
    "RENDERER_VERSION",
    "VIEW_PIXELS",
    "Renderer",
    "Rendering",
    "Replay",
    "panda_urdf",
    "rejects",
    "replay",
]
