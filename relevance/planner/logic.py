"""Symbolic side of the search: who can be picked when, and what a sequence of moves means.

A move is the pair pick(o), place(o, support); a plan is an order of distinct objects that ends
with the goal's subject. Blockers go to the table; the subject goes where the goal says.
"""

from __future__ import annotations

from collections.abc import Sequence

from relevance.scene import Action, Box, Goal, Scene


def stacked_on(scene: Scene) -> dict[str, frozenset[str]]:
    """For each object, the objects that stand directly on it."""
    return {
        name: frozenset(box.name for box in scene.objects if name in supports(box))
        for name in scene.names
    }


def supports(box: Box) -> tuple[str, ...]:
    """The boxes that a box stands on; none for the table."""
    if box.on is None:
        return ()
    return (box.on,) if isinstance(box.on, str) else tuple(box.on)


def actions(goal: Goal, order: Sequence[str]) -> tuple[Action, ...]:
    """The action sequence of an order of moved objects, the subject last."""
    found = []
    for name in order:
        last = name == goal.subject
        support = goal.reference if last and goal.predicate.stacked else "table"
        found.append(Action(name="pick", object=name))
        found.append(Action(name="place", object=name, support=support))
    return tuple(found)
