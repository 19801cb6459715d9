"""The guided search: best-first over sets of moved objects, the likeliest first.

A set costs -log of its probability under the prior, against that of moving nothing, and a price
for each object: its steps sum up to it. A set that needs less comes as soon as its steps are
known, whatever its size; so the plan that is found first need not be one of least length. With
`shortest` sets go by size first, then by cost.

Sets grow as in the unguided searches: by everything that can be picked then (`tree`), or by what
could help (`informed`). A set that the pose bound refuses takes all its subsets with it, since
whatever leaves only makes room.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush

from relevance.planner.attempts import LOOK, Attempt, Bounds, Turns
from relevance.planner.path import Motion
from relevance.planner.result import PlannerConfig

PRICE = 1.0
"""Of moving an object (two actions), nats."""
LANDMARK = 3.0
"""What it costs besides to move the reference, nats: sequences that do it count only when no other
does it, as far as the prior does not say otherwise."""
CERTAIN = 6.0
"""No score counts for more, nats."""
DOUBT = 8
"""After how many sets the search asks what can be picked at all, and whether a plan is possible;
with `shortest` it is from LOOK objects on, as in the unguided searches."""
REMEMBERED = 64
"""How many refused sets others are compared with."""

_Key = tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Set:
    """Objects that leave before the subject is taken, and what that costs."""

    chosen: frozenset[str]
    cost: float


@dataclass(slots=True, kw_only=True)
class _Growth:
    """What a set may still grow by, the cheapest first."""

    of: _Set
    by: deque[str]
    rest: bool = False
    """Whether these only make room for what is put aside."""
    sifted: bool = False
    """Whether what does not help has been left out."""


class Likely(Attempt):
    """Best-first over sets of moved objects."""

    def __init__(
        self,
        bounds: Bounds,
        config: PlannerConfig,
        allowed: frozenset[str],
        limit: int,
        scores: Mapping[str, float],
        *,
        shortest: bool = False,
    ) -> None:
        super().__init__(bounds, config, allowed, limit)
        self.shortest = shortest
        goal = self.problem.goal
        self._steps = {n: PRICE - max(-CERTAIN, min(CERTAIN, scores[n])) for n in self.order}
        if goal.reference in self._steps:
            self._steps[goal.reference] += LANDMARK
        self._most = config.max_actions // 2 - 1
        """Objects that may leave before the subject is taken."""
        self._heap = list[tuple[_Key, bool, int, _Set | _Growth]]()
        self._pushed = 0
        self._seen = {frozenset[str]()}
        self._picks = dict[frozenset[str], frozenset[str]]()
        self._deepest = list[frozenset[str]]()
        """Sets that may not grow."""
        self._refused = {True: list[frozenset[str]](), False: list[frozenset[str]]()}
        """Sets that the pose bound refuses, by whether the reference is in them."""
        self._tested = 0
        self._doubted = False
        self._stands = True
        """Whether a plan may let the reference stand."""
        names = [n for n in self.order if n != goal.subject]
        if not self._reference_moves():
            names = [n for n in names if n != goal.reference]
        self._names = sorted(names, key=self._turn)
        self._leaves = frozenset(names)
        """What can leave, as far as the search has asked."""

    @property
    def conclusive(self) -> bool:
        """Whether no plan was found because there is none: nothing was left untried or open."""
        return self.exhausted and not self.cut and not self.problem.open

    def _turn(self, name: str) -> _Key:
        landmark = self.shortest and name == self.problem.goal.reference
        return landmark, self._steps[name]

    def _key(self, chosen: _Set, name: str | None = None, *, rest: bool = False) -> _Key:
        """When a set's turn is, or that of the one that it grows to by one object."""
        cost = chosen.cost + (self._steps[name] if name else 0.0)
        if not self.shortest:
            return (cost,)
        reference = self.problem.goal.reference
        landmark = reference in chosen.chosen or name == reference
        return landmark, len(chosen.chosen) + bool(name), rest, cost

    def _push(self, key: _Key, item: _Set | _Growth) -> None:
        self._pushed += 1
        heappush(self._heap, (key, isinstance(item, _Growth), self._pushed, item))

    def _search(self) -> Turns:
        """The first plan; with `shortest` and whole levels all that are as short."""
        until = ()
        if self.problem.goal.subject not in self.allowed:
            return
        self._add(_Set(chosen=frozenset(), cost=0.0))
        while self._heap:
            key, _, _, item = heappop(self._heap)
            if self.found and key[:-1] > until:
                break
            if isinstance(item, _Growth):
                self._grow(item)
            elif motions := (yield from self._test(item.chosen)):
                until = key[:-1]
                self.found += motions
                if not self.shortest or self.config.stop == "first":
                    break
            elif self.late:  # the others' leaving can make room for what is put aside
                self._open(_Growth(of=item, by=self._others(item.chosen), rest=True, sifted=True))
            yield
        if not self.found:
            self.cut = any(self._can_grow(chosen) for chosen in self._deepest)

    def _add(self, item: _Set, *, rest: bool = False) -> None:
        """A set's turn to be tested, and to grow."""
        self._push(self._key(item, rest=rest), item)
        self._open(_Growth(of=item, by=self._others(item.chosen)))

    def _others(self, chosen: frozenset[str]) -> deque[str]:
        return deque(name for name in self._names if name not in chosen)

    def _open(self, growth: _Growth) -> None:
        """The next turn of a set to grow."""
        if len(growth.of.chosen) == self._most:
            self._deepest.append(growth.of.chosen)
        elif growth.by:
            self._push(self._key(growth.of, growth.by[0], rest=growth.rest), growth)

    def _grow(self, growth: _Growth) -> None:
        """Let a set grow by one object, or first see what helps it."""
        chosen = growth.of.chosen
        if not growth.sifted:
            growth.sifted = True
            first = growth.by[0]
            growth.by = self._helpful(chosen, growth.by)
            if not growth.by or growth.by[0] != first:
                self._open(growth)
                return
        name = growth.by.popleft()
        larger = chosen | {name}
        if larger not in self._seen and self._can_move(name, chosen):
            self._seen.add(larger)
            self._visit()
            cost = growth.of.cost + self._steps[name]
            self._add(_Set(chosen=larger, cost=cost), rest=growth.rest)
        self._open(growth)

    def _helpful(self, chosen: frozenset[str], names: deque[str]) -> deque[str]:
        """What a set should grow by, of some names: whatever else leaves, one is among it."""
        if self.config.search == "tree":
            return names
        if open_picks := self._open_picks(chosen):
            helpful = frozenset().union(*map(self.pose.in_the_way, open_picks))
        else:
            helpful = self._near
        return deque(name for name in names if name in helpful)

    def _open_picks(self, chosen: frozenset[str]) -> frozenset[str]:
        if chosen not in self._picks:
            self._picks[chosen] = super()._open_picks(chosen)
        return self._picks[chosen]

    @cached_property
    def _near(self) -> frozenset[str]:
        return self._beside_goal()

    def _can_move(self, name: str, chosen: frozenset[str]) -> bool:
        """Whether an object can leave: once these have (`tree`), or at all (`informed`)."""
        if name not in self._leaves:
            return False
        if self.config.search == "tree":
            return self.pose.pickable(name, chosen)
        return not self._stays(name)

    def _can_grow(self, chosen: frozenset[str]) -> bool:
        names = self._helpful(chosen, self._others(chosen))
        return any(self._can_move(name, chosen) for name in names)

    def _test(self, chosen: frozenset[str]) -> Generator[None, None, list[Motion]]:
        """The plans that move a set and then the subject."""
        self.late = False
        moves = self.problem.goal.reference in chosen
        if not (moves or self._stands) or any(chosen <= other for other in self._refused[moves]):
            return []
        self._tested += 1
        if len(chosen) >= LOOK if self.shortest else self._tested > DOUBT:
            self._doubt()
            if not (moves or self._stands):
                return []
        open_picks = self._open_picks(chosen) if self.config.search == "informed" else ()
        if open_picks:
            if self.problem.goal.subject in open_picks:
                self._refuse(chosen)
            return []
        if not self._passes(chosen):
            self._refuse(chosen)
            return []
        orders, found = self._orders(chosen), list[Motion]()
        if self.shortest and self.config.search == "tree" and self.config.stop == "level":
            apart = ([order] for order in orders)  # there each is a plan of its own
        else:
            apart = [orders]
        for some in apart:
            motion = yield from self._motion(some)
            if motion is not None:
                found.append(motion)
        return found

    def _refuse(self, chosen: frozenset[str]) -> None:
        """Remember that the pose bound refuses a set; the first are the likeliest and largest."""
        refused = self._refused[self.problem.goal.reference in chosen]
        if not self.shortest and len(refused) < REMEMBERED:
            refused.append(chosen)

    def _doubt(self) -> None:
        """Leave out what can never be picked, and what cannot be a plan; once."""
        if self._doubted:
            return
        self._doubted = True
        reference = self.problem.goal.reference
        self._leaves = frozenset(self._leaving(self._names))
        without = self._leaving([name for name in self._names if name != reference])
        self._stands = self._within_reach() and self._works(frozenset(without))
        if not (self._stands or self._reference_moves()):
            self._heap.clear()
            self._deepest.clear()
