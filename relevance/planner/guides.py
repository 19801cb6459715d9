"""How scores enter the search: a registry of guide modes, one small object each.

A mode says which objects each round of the search may move, and how it goes through them. The
last round of a complete mode is the unguided search with its whole limits, so that no scores can
lose a task that the unguided search solves.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from relevance.errors import RelevanceError
from relevance.registry import Registry
from relevance.scene import Goal, Scene


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
    ordered: bool = False
    """Whether the search goes through objects by descending score, not by their index."""

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
    Everything(name="order", color="#7a5aa6", ordered=True),
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

    def __post_init__(self) -> None:
        GUIDES[self.mode]
        if math.isnan(self.beta):
            raise GuideError("guide: beta is nan, expected a number")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rounds:
    """What a guide makes of one task."""

    allowed: tuple[frozenset[str], ...]
    """What each round may move; the search ends with the first that finds a plan."""
    scores: Mapping[str, float] | None
    """By which the search goes through the objects; None: by index."""


def rounds(
    everything: frozenset[str], goal: Goal, guide: Guide | None, scores: Mapping[str, float]
) -> Rounds:
    """The rounds of a guide for one task; scores as `ask` gives them."""
    if guide is None:
        return Rounds(allowed=(everything,), scores=None)
    mode = GUIDES[guide.mode]
    always = everything & {goal.subject, goal.reference}
    kept = always | {name for name in everything if scores and scores[name] > -guide.beta}
    return Rounds(
        allowed=tuple(mode.rounds(everything, kept, scores)),
        scores=scores if mode.ordered else None,
    )


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
