"""What a plan is made of: poses, actions and motions."""

from __future__ import annotations

import numpy as np
from pydantic.dataclasses import dataclass

from relevance.scene.boxes import Vector
from relevance.scene.checks import checked


@checked
class Pose:
    """Where a box stands: centre (m), yaw (rad), and on which box (None: table)."""

    position: Vector
    yaw: float
    on: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """`pick(object)` or `place(object, support)`; exactly one object each."""

    name: str
    """`pick` or `place`."""
    object: str
    support: str | None = None
    """For `place`: a box's name or `table`."""

    def to_list(self) -> list[str]:
        """As it stands in plan rows and JSON: `["place", "red", "table"]`."""
        return [part for part in (self.name, self.object, self.support) if part is not None]


@dataclass(
    frozen=True, slots=True, kw_only=True, eq=False, config={"arbitrary_types_allowed": True}
)
class Phase:
    """One motion of the arm, ending at a switch (grasp or release) or in the final retreat.

    Joint angles are linear between rows. During the motion the fingers keep `opening`; a
    carried box is rigid to the hand with the offset that it had when it was grasped.
    """

    action: Action | None
    """What happens at the last row; None for the final retreat."""
    q: np.ndarray
    """(T + 1, 7), rad; the first row equals the last row of the phase before."""
    dt: float
    """Seconds between rows."""
    opening: float
    """Value of each of the two finger joints during the motion, m."""
    carried: str | None
    """Name of the box in the hand, if any."""
