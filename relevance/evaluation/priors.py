"""Priors: what says of each object how probable it is that a plan moves it, whoever gives it.

Every checkpoint is one. The others here are what it is measured against: true labels (an oracle,
the most that guidance can be worth), answers that nobody had to learn, and none at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from relevance.counters import generator
from relevance.evaluation.scorer import load_scorer
from relevance.hashing import content_hash
from relevance.networks import shipped
from relevance.planner import Scorer
from relevance.registry import Registry
from relevance.scene import Box, Goal, Rectangle, Scene, footprint_gap

CERTAIN = 6.0
"""Logit of what a prior is sure of."""
TRUE = "true"
"""Name of the oracle."""

Moved = Collection[str]
"""What a known plan moves; nothing where none is known."""
Say = Callable[[Scene, Goal, Moved], Mapping[str, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """A prior that needs no checkpoint."""

    name: str
    color: str
    """Of its marks in plots."""
    about: str
    """What it goes by, in a few words."""
    say: Say
    """Probability, 0..1, of every object of a scene."""


class Believing:
    """A prior as the planner's scorer; asking costs nothing, so nobody waits with it."""

    patience = 0

    def __init__(self, prior: Prior, moved: Moved = ()) -> None:
        self.prior, self.moved = prior, moved

    def scores(self, scene: Scene, goal: Goal) -> dict[str, float]:
        """Logits, none beyond CERTAIN."""
        said = self.prior.say(scene, goal, self.moved)
        return {name: _logit(said[name]) for name in scene.names}


def _logit(probability: float) -> float:
    edge = 1 / (1 + math.exp(CERTAIN))
    inside = min(max(probability, edge), 1 - edge)
    return math.log(inside / (1 - inside))


PRIORS: Registry[Prior] = Registry("prior")
"""Every prior by name but checkpoints, which go by theirs."""


def prior_scorer(name: str, moved: Moved = ()) -> Scorer:
    """The scorer of a prior by name: one of PRIORS, else a checkpoint (a file, or one that comes
    with the package). `moved` is what is known to be true.

    Raises RelevanceError with the names that there are.
    """
    if name in PRIORS or not _is_checkpoint(name):
        return Believing(PRIORS[name], moved)
    return load_scorer(name)


def prior_name(name: str) -> str:
    """What rows and tables call it: of a file its name alone."""
    return Path(name).stem if name.endswith(".pt") else name


def _is_checkpoint(name: str) -> bool:
    return name in shipped() or name.endswith(".pt")


# --- what nobody had to learn --------------------------------------------------------------------

THERE = 0.38
"""Probability of what reaches into where the subject goes, as measured on the demo's labels."""
FALL = 0.015
"""Gap by which the odds of what does not fall by e, m."""


def _constant(probability: float) -> Say:
    return lambda scene, goal, moved: dict.fromkeys(scene.names, probability)


def _true(scene: Scene, goal: Goal, moved: Moved) -> Mapping[str, float]:
    return {name: float(name in moved) for name in scene.names}


def _random(scene: Scene, goal: Goal, moved: Moved) -> Mapping[str, float]:
    """The same for equal scenes, whatever they are called."""
    known = content_hash([replace(scene, id="", goals=()).id, str(goal)])
    drawn = generator(0, f"prior/{known}").uniform(size=len(scene.names))
    return dict(zip(scene.names, drawn.tolist(), strict=True))


def _distance(scene: Scene, goal: Goal, moved: Moved) -> Mapping[str, float]:
    """By the gap between an object and where the subject shall stand."""
    subject, reference = scene[goal.subject], scene[goal.reference]
    region = goal.predicate.region(subject, reference, scene.robot)
    half = min(subject.size[:2]) / 2
    places = [_standing(each, half) for each in region.rectangles]
    return _by_gap(scene, goal, lambda box: min(_gap(box, p) for p in places))


def _swept(scene: Scene, goal: Goal, moved: Moved) -> Mapping[str, float]:
    """By the gap between an object and what the subject and the hand over it sweep on the straight
    way to the middle of where it shall stand."""
    subject, reference = scene[goal.subject], scene[goal.reference]
    region = goal.predicate.region(subject, reference, scene.robot)
    (x, y), area = subject.position[:2], region.rectangles[0]
    half = min(subject.size[:2]) / 2
    way = Rectangle(
        x=(x + area.x) / 2,
        y=(y + area.y) / 2,
        angle=math.atan2(area.y - y, area.x - x),
        half=(math.hypot(area.x - x, area.y - y) / 2, 0.0),
    )
    swept = _standing(way, half)
    floor = min(subject.bottom, reference.top if goal.predicate.stacked else 0.0)

    def gap(box: Box) -> float:
        return math.inf if box.top <= floor else _gap(box, swept)

    return _by_gap(scene, goal, gap)


def _standing(area: Rectangle, margin: float) -> Box:
    """A rectangle, larger by a margin to all sides, as a footprint."""
    size = (2 * (area.half[0] + margin), 2 * (area.half[1] + margin), 0.01)
    return Box(
        name="area", size=size, position=(area.x, area.y, 0.0), yaw=area.angle, color=(0, 0, 0)
    )


def _gap(box: Box, area: Box) -> float:
    """How far apart two footprints are, m."""
    return max(0.0, footprint_gap(box, area))


def _by_gap(scene: Scene, goal: Goal, gap: Callable[[Box], float]) -> Mapping[str, float]:
    """The subject moves for certain, the reference is a landmark and does not."""
    said = {goal.subject: 1.0, goal.reference: 0.0}
    for box in scene.objects:
        if box.name not in said:
            odds = THERE / (1 - THERE) * math.exp(-gap(box) / FALL)
            said[box.name] = odds / (1 + odds)
    return said


for _name, _color, _about, _say in (
    (TRUE, "#22282f", "what the found plan moves", _true),
    ("all", "#8a939d", "everything is relevant", _constant(1.0)),
    ("none", "#9aa4af", "nothing is relevant", _constant(0.0)),
    ("random", "#b5476b", "drawn by the content of scene and goal", _random),
    ("distance", "#3a8a5f", "how far from the goal region", _distance),
    ("swept", "#2a8c94", "how far from the straight way to the goal", _swept),
):
    PRIORS.register(_name, Prior(name=_name, color=_color, about=_about, say=_say))
