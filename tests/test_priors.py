"""Priors: whoever gives it, it is a probability for each object, and the planner can go by it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from relevance.errors import RelevanceError
from relevance.evaluation import PRIORS, TRUE, Believing, NetworkScorer, Prior, prior_scorer
from relevance.networks import read_checkpoint, shipped
from relevance.planner import Guide, plan
from relevance.scene import Goal, Scene
from tests.planning import BLUE, GREEN, GREY, RED, box, tasks

GOAL = Goal.parse("behind(red, blue)")
ROW = Scene(
    objects=(
        box("red", -0.15, 0.3, RED),
        box("blue", -0.1, -0.1, BLUE),
        box("there", -0.02, -0.1, GREEN),  # where red shall stand
        box("between", -0.09, 0.1, GREY, size=(0.05, 0.05, 0.07)),  # on the straight way
        box("far", 0.2, 0.35, GREY),
    )
)


@pytest.mark.parametrize("name", PRIORS)
def test_a_prior_is_a_probability_for_each_object(name):
    for scene, goal in tasks(12, seed=4):
        moved = scene.names[:2]
        said = PRIORS[name].say(scene, goal, moved)
        assert set(said) == set(scene.names)
        assert all(0 <= p <= 1 for p in said.values())
        assert said == PRIORS[name].say(replace(scene, id="another"), goal, moved)
        scores = prior_scorer(name, moved).scores(scene, goal)
        assert list(scores) == list(scene.names)
        for one, p in said.items():
            assert 1 / (1 + math.exp(-scores[one])) == pytest.approx(p, abs=0.003)


def test_what_each_goes_by():
    def said(name, moved=()):
        return PRIORS[name].say(ROW, GOAL, moved)

    assert set(said("all").values()) == {1.0}
    assert set(said("none").values()) == {0.0}
    assert said(TRUE, ["red", "far"]) == {
        "red": 1.0, "blue": 0.0, "there": 0.0, "between": 0.0, "far": 1.0,
    }  # fmt: skip
    distance, swept = said("distance"), said("swept")
    assert distance["there"] > distance["between"] > distance["far"]
    assert min(swept["there"], swept["between"]) > swept["far"]
    for by_place in (distance, swept):
        assert (by_place["red"], by_place["blue"]) == (1.0, 0.0)
    drawn = said("random")
    assert len(set(drawn.values())) == len(drawn)
    assert PRIORS["random"].say(ROW, replace(GOAL, reference="far"), ()) != drawn


def test_what_stands_below_the_way_is_not_swept():
    low = box("low", -0.09, 0.1, GREY, size=(0.05, 0.05, 0.02))
    tower = [
        box("a", -0.15, 0.3, RED, size=(0.08, 0.08, 0.06)),
        box("red", -0.15, 0.3, RED, size=(0.05, 0.05, 0.05), bottom=0.06, on="a"),
        box("blue", -0.05, -0.1, BLUE),
    ]
    scene = Scene(objects=(*tower, low))
    above = PRIORS["swept"].say(scene, Goal.parse("on(red, blue)"), ())
    beside = PRIORS["swept"].say(scene, Goal.parse("on-the-left(red, blue)"), ())
    assert above["low"] == 0.0
    assert beside["low"] > 0.3


def test_every_prior_guides_and_loses_nothing():
    for scene, goal in tasks(6, seed=9):
        plain = plan(scene, goal, replay=False)
        for name in PRIORS:
            scorer = prior_scorer(name, plain.moved)
            found = plan(scene, goal, guide=Guide(scorer=scorer, mode="order"), replay=False)
            assert found.status == plain.status
            if name == TRUE and plain.status == "solved":
                assert set(found.moved) == set(plain.moved)
                assert found.counts.sequences <= plain.counts.sequences


def test_checkpoints_are_priors_by_their_names():
    geometry = prior_scorer("geometry")
    assert isinstance(geometry, NetworkScorer)
    assert set(geometry.scores(ROW, GOAL)) == set(ROW.names)
    assert geometry.patience == read_checkpoint(shipped()["geometry"]).meta["patience"]
    assert prior_scorer("swept").patience == 0  # asking costs nothing
    with pytest.raises(RelevanceError, match="unknown prior 'tru', expected one of true, all"):
        prior_scorer("tru")
    with pytest.raises(RelevanceError, match=r"nowhere\.pt"):
        prior_scorer("nowhere.pt")


def test_a_prior_registered_from_outside_is_one():
    half = Prior(
        name="half",
        color="#000000",
        about="a coin",
        say=lambda scene, goal, moved: dict.fromkeys(scene.names, 0.5),
    )
    PRIORS.register("half", half)
    try:
        scorer = prior_scorer("half")
        assert isinstance(scorer, Believing)
        assert set(scorer.scores(ROW, GOAL).values()) == {0.0}
    finally:
        PRIORS.unregister("half")
