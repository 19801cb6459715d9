"""What a planner is asked and what it answers; planners by name.

A planner is an object of the `Planner` protocol, registered in PLANNERS; `rai` is one in a folder
of its own.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

from pydantic import Field

from relevance.configs import config
from relevance.planner.guides import Guide
from relevance.registry import Registry
from relevance.scene import Action, Goal, Phase, Pose, Scene, SceneError
from relevance.scene.words import normal, shown

if TYPE_CHECKING:  # it imports pybullet, which planning does without
    from relevance.simulation import Replay

PLANNER_VERSION = "10"
Status = Literal["solved", "infeasible", "limit", "refused"]
"""`refused`: a plan was found, and the replay in the simulator does not confirm it."""


@config
class PlannerConfig:
    """Settings that labels depend on; their hash is stored with every row."""

    search: Literal["tree", "informed"] = "informed"
    max_actions: Annotated[int, Field(ge=2, multiple_of=2)] = 6
    node_limit: Annotated[int, Field(ge=1)] = 20_000
    stop: Literal["first", "level"] = "level"
    """Whether the first plan counts, or the cheapest of all plans that are as short (at the node
    limit of those so far); guides that go by the likeliest stop at the first in any case."""


@dataclass(slots=True, kw_only=True)
class Counts:
    """Work done: nodes of the search tree, and calls of each bound."""

    nodes: int = 0
    pose: int = 0
    keyframe: int = 0
    path: int = 0
    sequences: int = 0
    """Action sequences whose keyframes were sought; ideally one."""
    squares: int = 0
    """Moved objects of the keyframe problems, squared and summed: their cost goes with it."""

    @property
    def work(self) -> int:
        """All of it in one figure, of about a microsecond each; no clock has a part in it."""
        return self.nodes + 10 * self.pose + 300 * self.squares + 900 * self.path


@dataclass(slots=True, kw_only=True)
class Seconds:
    """CPU seconds, in all and by bound: pose with the search around it, guide for the scores."""

    total: float = 0.0
    pose: float = 0.0
    keyframe: float = 0.0
    path: float = 0.0
    guide: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanResult:
    """What the planner found, and what it cost to find it."""

    goal: Goal
    status: Status
    reason: str = ""
    """Why there is no plan, or which limit ended the search."""
    blocking: tuple[str, ...] = ()
    """A smallest set of objects without which the subject could be taken and put there, as far
    as the pose bound can tell; only where there is no plan."""
    actions: tuple[Action, ...] = ()
    moved: tuple[str, ...] = ()
    """Moved objects, in order."""
    alternatives: tuple[tuple[str, ...], ...] = ()
    """Moved objects of every plan of this length that was found, in order; the best first."""
    final: dict[str, Pose]
    cost: float = math.nan
    """Squared joint accelerations (second differences of rows, no clock), summed over the rows of
    all phases, rad^2; of our planner with the prices of its holds."""
    ambiguous: bool = False
    """Whether another set of moved objects does as well, a bound was left open or a late one
    refused, or a box standing 0.2 mm elsewhere might have changed a decision."""
    counts: Counts
    looked: bool = False
    """Whether the guide was asked for scores."""
    check_ok: bool = False
    max_penetration: float = 0.0
    """Deepest penetration at the sub-steps of the dense check, m."""
    phases: tuple[Phase, ...] = ()
    seconds: Seconds
    replay: Replay | None = None
    """The verdict of the replay in the simulator; None where the plan was not replayed."""


class Planner(Protocol):
    """A planner as the command line, benchmarks and evaluations see it."""

    name: str
    Config: Any
    """Its class of settings; `Config()` are the defaults."""

    def require(self) -> None:
        """Raise RelevanceError where it cannot run here, with what is missing."""
        ...

    def warm_up(self) -> None:
        """Load and compile all that it needs, so that no plan's time includes it."""
        ...

    def plan(
        self,
        scene: Scene,
        goal: Goal | str,
        *,
        config: Any = None,
        guide: Guide | None = None,
        movable: Collection[str] | None = None,
        replay: bool = True,
    ) -> PlanResult:
        """Find a plan; config None: the defaults, movable None: every object, else as `plan`."""
        ...


PLANNERS: Registry[Planner] = Registry("planner")
"""Every planner by name."""


def movable_names(scene: Scene, movable: Collection[str] | None) -> frozenset[str]:
    """Names of what may be moved (None: all); raises SceneError for an unknown one."""
    if isinstance(movable, str):  # else its letters would be names
        raise SceneError(f"movable: expected a list of names, found {shown(movable)}")
    given = scene.names if movable is None else map(str, movable)
    names = frozenset(map(normal, given))
    for name in names - set(scene.names):
        known = ", ".join(scene.names)
        raise SceneError(f"movable: no object {shown(name)}, expected some of {known}")
    return names


def replayed(scene: Scene, result: PlanResult) -> PlanResult:
    """The result with the replay's verdict; a plan that the replay does not confirm is refused."""
    if result.status != "solved":
        return result
    from relevance.simulation import replay

    verdict = replay(scene, result.goal, result.phases)
    if verdict.ok:
        return replace(result, replay=verdict)
    reason = f"the replay does not confirm the plan: {verdict.reason}"
    return replace(result, status="refused", reason=reason, replay=verdict)
