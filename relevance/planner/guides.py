"""How scores enter the search: a registry of guide modes, one small object each.

A mode says which objects each round of the search may move, or in what order the last round goes
through sets of them. The last round of a complete mode ends with the unguided search and its whole
limits, so that no scores can lose a task that the unguided search solves.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from relevance.errors import RelevanceError
from relevance.registry import Registry
from relevance.scene import Goal, Scene

PATIENCE = 3_000
"""Work before a guide that waits asks for scores, where its checkpoint names no other: about what a
look costs, so that waiting in vain at most doubles it."""


class GuideError(RelevanceError):
    """A guide that cannot be followed: says what it holds and what was expected."""


class Scorer(Protocol):
    """Says how relevant each object is."""

    def scores(self, scene: Scene, goal: Goal) -> Mapping[str, float]:
        """Logit of relevance for every object of the scene."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode(ABC):
    """One way in which scores enter the search."""

    name: str
    color: str
    """Of its marks in plots."""
    complete: bool = True
    """Whether it finds a plan whenever the unguided search does."""
    guided: bool = True
    """Whether it asks for scores at all."""
    walk: Literal["levels", "shortest", "likeliest"] = "levels"
    """How the last round goes through sets of moved objects. `levels`: by their number, then by
    index, as the unguided search. `shortest`: by their number, then the likeliest first; the plan
    is of least length. `likeliest`: the likeliest first, whatever their number; the first plan
    counts, which need not be of least length."""
    waits: bool = False
    """Whether the search begins unguided and asks for scores only after the guide's patience."""

    @property
    def first(self) -> bool:
        """Whether the first plan counts, whatever the settings say of when to stop."""
        return self.walk == "likeliest"

    @abstractmethod
    def rounds(
        self, everything: frozenset[str], kept: frozenset[str], scores: Mapping[str, float]
    ) -> Iterator[frozenset[str]]:
        """The object sets that the search may move, one round after the other until it succeeds.

        kept: goal objects and what scores over -beta. A complete mode ends with everything.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Everything(Mode):
    """All objects in one round."""

    def rounds(
        self, everything: frozenset[str], kept: frozenset[str], scores: Mapping[str, float]
    ) -> Iterator[frozenset[str]]:
        """Everything."""
        yield everything


@dataclass(frozen=True, slots=True, kw_only=True)
class Prune(Mode):
    """Only what was kept: the paper's non-admissible heuristic."""

    def rounds(
        self, everything: frozenset[str], kept: frozenset[str], scores: Mapping[str, float]
    ) -> Iterator[frozenset[str]]:
        """What was kept."""
        yield kept


@dataclass(frozen=True, slots=True, kw_only=True)
class PruneThenFull(Mode):
    """What was kept, then everything: the paper's admissible heuristic."""

    def rounds(
        self, everything: frozenset[str], kept: frozenset[str], scores: Mapping[str, float]
    ) -> Iterator[frozenset[str]]:
        """What was kept, then everything."""
        if kept != everything:
            yield kept
        yield everything


@dataclass(frozen=True, slots=True, kw_only=True)
class Expand(Mode):
    """What was kept, then one object more at a time, likeliest first."""

    def rounds(
        self, everything: frozenset[str], kept: frozenset[str], scores: Mapping[str, float]
    ) -> Iterator[frozenset[str]]:
        """What was kept, and more, until it is everything."""
        yield kept
        for name in sorted(everything - kept, key=lambda n: (-scores[n], n)):
            kept |= {name}
            yield kept


GUIDES: Registry[Mode] = Registry("guide")
"""Every guide mode by name."""

for _mode in (
    Everything(name="none", color="#8a939d", guided=False),
    Prune(name="prune", color="#c26a1c", complete=False),
    PruneThenFull(name="prune-then-full", color="#2f6db3"),
    Expand(name="expand", color="#3a8a5f"),
    Everything(name="order", color="#7a5aa6", walk="likeliest"),
    Everything(name="shortest", color="#b5476b", walk="shortest"),
    Everything(name="lazy", color="#2a8c94", walk="likeliest", waits=True),
):
    GUIDES.register(_mode.name, _mode)


@dataclass(frozen=True, slots=True, kw_only=True)
class Guide:
    """Scores, and how they enter the search; goal objects always stay."""

    scorer: Scorer
    mode: str = "prune-then-full"
    """A name in GUIDES."""
    beta: float = 0.0
    """An object is kept iff its score > -beta; a larger beta keeps more."""
    patience: int = PATIENCE
    """Work (`Counts.work`) that a search does before a mode that waits asks for scores."""

    def __post_init__(self) -> None:
        GUIDES[self.mode]
        if math.isnan(self.beta):
            raise GuideError("guide: beta is nan, expected a number")
        if self.patience < 0:
            raise GuideError(f"guide: patience is {self.patience}, expected 0 or more")


def rounds(
    everything: frozenset[str], goal: Goal, guide: Guide | None, scores: Mapping[str, float]
) -> tuple[frozenset[str], ...]:
    """What each round of a guide may move, one round after the other until one finds a plan; scores
    as `ask` gives them."""
    if guide is None:
        return (everything,)
    always = everything & {goal.subject, goal.reference}
    kept = always | {name for name in everything if scores and scores[name] > -guide.beta}
    return tuple(GUIDES[guide.mode].rounds(everything, kept, scores))


def ask(guide: Guide | None, scene: Scene, goal: Goal) -> Mapping[str, float]:
    """The guide's scores of every object, none where it needs none.

    Raises GuideError for a score that is missing or no number.
    """
    if guide is None or not GUIDES[guide.mode].guided:
        return {}
    scores = guide.scorer.scores(scene, goal)
    for name in scene.names:
        if name not in scores or math.isnan(scores[name]):
            found = "nan" if name in scores else "missing"
            raise GuideError(f"guide: the score of {name!r} is {found}, expected a number")
    return scores
