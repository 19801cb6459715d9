"""The unguided searches: breadth-first by plan length.

The level in which a plan is found is finished, and the plan of lowest cost counts (rounded, ties
by object index), so that labels do not depend on the order of search.

`tree` extends every sequence by every object (the paper's uninformed search). `informed` goes
through sets of objects, not sequences, and adds to a set only what could help: what reaches
into the goal region, or is in the way of a pick that the set needs. It plans one order of a
set, the others only when that fails.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from relevance.planner.attempts import LOOK, Attempt, Turns


class Levels(Attempt):
    """Breadth-first over sequences or sets of moved objects."""

    def _search(self) -> Turns:
        """All plans of the first level that has one.

        The reference is a landmark: sequences that move it count only when no other does it.
        """
        if self.hopeless is not None:
            return
        reference = self.problem.goal.reference
        levels = self._sequences if self.config.search == "tree" else self._sets
        if self._within_reach():
            yield from levels([name for name in self.order if name != reference], frozenset())
        if not self.found and self._reference_moves():
            yield from levels(self.order, frozenset({reference}))

    def _sequences(self, movable: list[str], required: frozenset[str]) -> Turns:
        """Breadth-first over sequences of objects moved before the subject."""
        subject = self.problem.goal.subject
        frontier: list[tuple[str, ...]] = [()]
        for level in range(self.config.max_actions // 2):
            following = list[tuple[str, ...]]()
            if level == LOOK:
                movable = self._leaving(movable)
                if not (required or self._works(frozenset(movable))):
                    return
            for prefix in frontier:
                self._visit()
                if required <= set(prefix) and self._passes(frozenset(prefix)):
                    motion = yield from self._motion([prefix])
                    if motion is not None:
                        self.found.append(motion)
                        if self.config.stop == "first":
                            return
                yield
                if self.found:
                    continue
                if not prefix:
                    movable = [name for name in movable if not self._stays(name)]
                for name in movable:
                    if name == subject or name in prefix:
                        continue
                    self._visit()
                    if self.pose.pickable(name, frozenset(prefix)):
                        self._visit()
                        following.append((*prefix, name))
            if self.found:
                return
            frontier = following
            if not frontier:
                break
        self.cut |= bool(frontier)

    def _sets(self, movable: list[str], required: frozenset[str]) -> Turns:
        """Breadth-first over sets of objects moved before the subject. A set grows by what blocks
        a pick that it needs, else by what takes room at the goal: every set that would do has one
        of those besides."""
        subject, near = self.problem.goal.subject, self._beside_goal()
        rank = {name: i for i, name in enumerate(movable) if name != subject}
        frontier, rest = [frozenset[str]()], list[frozenset[str]]()

        def leaves(name: str) -> bool:
            return name in rank and not self._stays(name)

        for level in range(self.config.max_actions // 2):
            tried = list[tuple[frozenset[str], frozenset[str], bool]]()
            if level == LOOK:
                leaving = frozenset(self._leaving(list(rank)))
                if not (required or self._works(leaving)):
                    return
                rank = {name: i for name, i in rank.items() if name in leaving}
                frontier = [chosen for chosen in frontier if chosen <= leaving]
                rest = [chosen for chosen in rest if chosen <= leaving]
            for chosen in self._tiers(frontier, rest):
                self._visit()
                self.late, open_picks = False, self._open_picks(chosen)
                if required <= chosen and not open_picks and self._passes(chosen):
                    motion = yield from self._motion(self._orders(chosen))
                    if motion is not None:
                        self.found.append(motion)
                        if self.config.stop == "first":
                            return
                tried.append((chosen, open_picks, self.late))
                yield
            if self.found:
                return
            following, others = set(), set()
            for chosen, open_picks, late in tried:
                # Whatever else leaves, one of these is among it.
                helpful = required - chosen or near
                if open_picks:
                    helpful = frozenset().union(*map(self.pose.in_the_way, open_picks))
                following |= {chosen | {name} for name in helpful - chosen if leaves(name)}
                if late:  # the others' leaving can make room for what is put aside
                    others |= {chosen | {name} for name in rank.keys() - chosen if leaves(name)}
            frontier = sorted(following, key=partial(_ranks, rank))
            rest = sorted(others - following, key=partial(_ranks, rank))
            if not (frontier or rest):
                break
        self.cut |= bool(frontier or rest)

    def _tiers(
        self, first: list[frozenset[str]], rest: list[frozenset[str]]
    ) -> Iterator[frozenset[str]]:
        """The likely sets of a level, and the rest where none of them has given a plan."""
        yield from first
        if not self.found:
            yield from rest


def _ranks(rank: Mapping[str, int], names: frozenset[str]) -> list[int]:
    return sorted(rank[name] for name in names)
