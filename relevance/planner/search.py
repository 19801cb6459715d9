"""Multi-bound tree search over pick and place, and how a guide enters it: `plan(scene, goal)`.

Without a guide it is one breadth-first attempt (`levels`). A guide that prunes makes several, each
with other objects that may move. A guide that orders has a best-first attempt (`likely`) take turns
with the unguided one: what either refuses the other does not try again, nodes of the best-first one
are no part of the unguided one's limit and are capped at it. So whatever the scores say, all is
solved that the unguided search solves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Generator, Mapping
from dataclasses import replace
from functools import cache
from itertools import count

from relevance.planner.attempts import Bounds
from relevance.planner.compiling import compile_once, other_half
from relevance.planner.guides import GUIDES, Guide, ask, rounds
from relevance.planner.levels import Levels
from relevance.planner.likely import Likely
from relevance.planner.problem import Problem
from relevance.planner.result import (
    Counts,
    PlannerConfig,
    PlanResult,
    Seconds,
    movable_names,
    replayed,
)
from relevance.scene import Box, Goal, Scene, goal_holds

SHARE = 3_000
"""Work of the first turns, of the guided attempt and of the unguided one: a set that the scores are
sure of has begun its motion by then, and goes on with it to its end."""
LONGER = (3, 4)
"""How much longer each later turn is, guided and unguided: the longer scores have not helped, the
less they are trusted."""


def plan(
    scene: Scene,
    goal: Goal | str,
    *,
    config: PlannerConfig | None = None,
    guide: Guide | None = None,
    movable: Collection[str] | None = None,
    replay: bool = True,
) -> PlanResult:
    """Find the shortest sequence of picks and places, and its motion, that makes the goal true.

    Guided by `order` or `lazy` it is the first that was found, likely but not always of least
    length; by `shortest` it is. config None: the defaults. movable: the objects that may be moved
    (None: all). replay: whether the plan is executed again in the simulator, which has to confirm
    it; this is not counted in its seconds. Raises SceneError for an unknown predicate or object. A
    goal that cannot be reached is a result with a reason.
    """
    warm_up()
    found = _plan(scene, scene.goal(goal), config or PlannerConfig(), guide, movable)
    return replayed(scene, found) if replay else found


def _plan(
    scene: Scene,
    goal: Goal,
    config: PlannerConfig,
    guide: Guide | None,
    movable: Collection[str] | None,
) -> PlanResult:
    everything = movable_names(scene, movable)
    began = time.process_time()
    if goal_holds(scene.objects, goal, scene.robot):
        seconds = Seconds(total=time.process_time() - began)
        return PlanResult(
            goal=goal, status="solved", final={}, cost=0.0, check_ok=True, counts=Counts(),
            seconds=seconds,
        )  # fmt: skip
    planning = _Planning(Bounds(Problem(scene, goal)), config, guide, everything)
    result = planning.result()
    seconds = result.seconds
    seconds.total = time.process_time() - began
    seconds.pose = seconds.total - seconds.keyframe - seconds.path - seconds.guide
    return replace(result, looked=planning.looked)


class _Planning:
    """One goal that is planned, by one attempt or several."""

    def __init__(
        self, bounds: Bounds, config: PlannerConfig, guide: Guide | None, everything: frozenset[str]
    ) -> None:
        self.bounds, self.problem = bounds, bounds.problem
        self.config, self.guide, self.everything = config, guide, everything
        self.looked = False
        """Whether the guide was asked for scores."""

    def result(self) -> PlanResult:
        """As the guide's mode has it."""
        mode = GUIDES[self.guide.mode if self.guide else "none"]
        if mode.walk == "levels":
            return self._rounds()
        return self._shortest() if mode.walk == "shortest" else self._likeliest(waits=mode.waits)

    def _levels(self, config: PlannerConfig, allowed: frozenset[str], limit: int) -> Levels:
        return Levels(self.bounds, config, allowed, limit)

    def _likely(
        self, config: PlannerConfig, scores: Mapping[str, float], *, shortest: bool
    ) -> Likely:
        limit = config.node_limit
        return Likely(self.bounds, config, self.everything, limit, scores, shortest=shortest)

    def _scores(self) -> Mapping[str, float]:
        began = time.process_time()
        scores = ask(self.guide, self.problem.scene, self.problem.goal)
        self.problem.seconds.guide += time.process_time() - began
        self.looked = bool(scores)
        return scores

    def _rounds(self) -> PlanResult:
        """Unguided attempts, each with what may move in its round."""
        goal, config = self.problem.goal, self.config
        *early, last = rounds(self.everything, goal, self.guide, self._scores())
        budget = config.node_limit
        for allowed in early:  # these share one limit, the last round has it whole
            attempt = self._levels(config, allowed, budget)
            result = attempt.run()
            if result.status == "solved":
                return result
            budget = attempt.left
            if budget <= 0:
                break
        result = self._levels(config, last, config.node_limit).run()
        hopeless = result.status == "infeasible" and not result.blocking
        if result.status != "solved" and last != self.everything and not hopeless:
            kept = ", ".join(name for name in self.problem.boxes if name in last)
            reason = f"none that moves only what was kept ({kept}): {result.reason}"
            result = replace(result, reason=reason)
        return result

    def _shortest(self) -> PlanResult:
        """Best-first, by length before anything else."""
        likely = self._likely(self.config, self._scores(), shortest=True)
        result = likely.run()
        if result.status == "solved" or likely.conclusive:
            return result
        return self._levels(self.config, self.everything, self.config.node_limit).run()

    def _likeliest(self, *, waits: bool) -> PlanResult:
        """Best-first and unguided in turns; where the mode waits, the unguided one begins."""
        assert self.guide is not None
        first, counts = replace(self.config, stop="first"), self.problem.counts
        plain = self._levels(first, self.everything, first.node_limit)
        unguided = _Turns(plain.turns(), counts)
        if waits and (result := unguided.go(self.guide.patience)):
            return result
        likely = self._likely(first, self._scores(), shortest=False)
        guided = _Turns(likely.turns(), counts)
        for turn in count():
            result = guided.go(SHARE * LONGER[0] ** turn)
            if result is None:
                result = unguided.go(SHARE * LONGER[1] ** turn)
            elif result.status != "solved" and not likely.conclusive:
                result = unguided.go(math.inf)
            if result is not None:
                return result
        raise AssertionError("the unguided attempt ends")


class _Turns:
    """An attempt that is made a piece at a time."""

    def __init__(self, turns: Generator[None, None, PlanResult], counts: Counts) -> None:
        self._turns, self._counts = turns, counts

    def go(self, work: float) -> PlanResult | None:
        """Its result, None where it has not ended after so much more work."""
        end = self._counts.work + work
        try:
            while self._counts.work < end:
                next(self._turns)
        except StopIteration as ended:
            return ended.value
        return None


class Ours:
    """This planner, as the registry has it."""

    name = "ours"
    Config = PlannerConfig

    def require(self) -> None:
        """It always can."""

    def warm_up(self) -> None:
        """Compile the solvers."""
        warm_up()

    def plan(
        self,
        scene: Scene,
        goal: Goal | str,
        *,
        config: PlannerConfig | None = None,
        guide: Guide | None = None,
        movable: Collection[str] | None = None,
        replay: bool = True,
    ) -> PlanResult:
        """As `plan`."""
        return plan(scene, goal, config=config, guide=guide, movable=movable, replay=replay)


@cache
def warm_up() -> None:
    """Compile or load the solvers, once a process, so that no plan's time includes it."""
    compile_once(_one_of_each)


def _one_of_each() -> None:
    """Plans that need every kernel: a box in the way, one that its neighbours let the hand take
    by its top alone, and a tall one."""
    grey, cube = (0.5, 0.5, 0.5), (0.05, 0.05, 0.05)
    scene = Scene(
        objects=(
            Box(name="a", size=(0.05, 0.05, 0.06), position=(0.0, 0.2, 0.03), color=grey),
            Box(name="d", size=(0.05, 0.05, 0.04), position=(0.055, 0.2, 0.02), color=grey),
            Box(name="e", size=(0.05, 0.05, 0.04), position=(0.0, 0.255, 0.02), color=grey),
            Box(name="b", size=cube, position=(0.0, 0.0, 0.025), color=grey),
            Box(name="c", size=cube, position=(0.0, 0.0, 0.075), color=grey, on="b"),
            Box(name="f", size=(0.2, 0.04, 0.3), position=(0.1, -0.3, 0.15), color=grey),
        )
    )
    for goal in ("on(a, b)", "on-the-left(b, a)", "in-front(f, a)"):
        _plan(scene, scene.goal(goal), PlannerConfig(), None, None)
    other_half()
