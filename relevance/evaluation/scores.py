"""Scores for other people's loops: how relevant each object of a scene or a picture is."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from relevance.evaluation.pictures import Seen, judge
from relevance.evaluation.scorer import EvaluationError, NetworkScorer, load_guide
from relevance.networks import named
from relevance.planner import Guide, ask
from relevance.scene import Goal, Scene

MODEL = "glimpse"
"""The model that is asked where no guide is given: one that comes with the package."""


def scores(seen: Scene | Seen, goal: Goal | str, *, guide: Guide | None = None) -> dict[str, float]:
    """Score of every object for a goal: it is worth moving iff its score > -guide.beta.

    Of a scene (its picture is drawn, as its camera would take it), or of a picture with a view of
    each object: `Seen(image=image, views={"red": view, ...})`, `look_at("table.png", crops=...)`.
    Subject and reference have scores, too, and matter whatever those say. Without a guide it is
    the shipped model `glimpse`, and beta = 0.
    """
    guide = guide or _shipped(named(MODEL), named(MODEL).stat().st_mtime_ns)
    if isinstance(seen, Scene):
        return dict(ask(guide, seen, seen.goal(goal)))
    if not isinstance(guide.scorer, NetworkScorer):
        kind = type(guide.scorer).__name__
        raise EvaluationError(f"scores of a picture: expected a network's guide, found {kind}")
    asked = goal if isinstance(goal, Goal) else Goal.parse(goal)
    return {one.name: one.score for one in judge(guide.scorer, seen, [asked], beta=guide.beta)}


@lru_cache(maxsize=1)
def _shipped(path: Path, changed: int) -> Guide:
    """The guide of a file as it was at a time: read once, not for every goal."""
    del changed
    return load_guide(path)
