"""Guides change the effort, never what can be solved; planners and guides come by name."""

import math
import random
from dataclasses import dataclass

import pytest

from relevance.errors import RelevanceError
from relevance.planner import (
    GUIDES,
    PLANNERS,
    Guide,
    PlannerConfig,
    plan,
)
from relevance.planner.guides import Everything, GuideError, Mode
from relevance.simulation import Replay
from tests.planning import GREEN, OPEN, box, tasks


@pytest.fixture(scope="module")
def planned():
    return [(scene, goal, plan(scene, goal, replay=False)) for scene, goal in tasks(24, seed=11)]


class Says:
    """Scores from a table."""

    def __init__(self, relevant):
        self.relevant = relevant

    def scores(self, scene, goal):
        return {name: 3.0 if name in self.relevant else -3.0 for name in scene.names}


def test_guide_that_keeps_everything_equals_no_guide(planned):
    for scene, goal, plain in planned[:10]:
        for mode in ("prune", "prune-then-full", "expand"):
            guided = plan(scene, goal, guide=Guide(scorer=Says(scene.names), mode=mode))
            assert (guided.status, guided.moved) == (plain.status, plain.moved)
            assert guided.counts == plain.counts


def test_right_guide_saves_nodes_and_wrong_guide_costs_only_with_prune(planned):
    scene, goal, plain = next(
        (scene, goal, plain)
        for scene, goal, plain in planned
        if len(plain.moved) == 2 and not plain.ambiguous and goal.reference not in plain.moved
    )
    tree = PlannerConfig(search="tree")
    unguided = plan(scene, goal, config=tree)
    for mode in ("prune", "prune-then-full", "expand", "order"):
        right = plan(scene, goal, config=tree, guide=Guide(scorer=Says(plain.moved), mode=mode))
        assert right.status == "solved"
        assert set(right.moved) == set(plain.moved)
        assert right.counts.nodes <= unguided.counts.nodes
        if mode.startswith("prune"):
            assert right.counts.nodes < unguided.counts.nodes
    keep_none = Says(())
    for mode in ("prune-then-full", "expand", "order"):
        wrong = plan(scene, goal, config=tree, guide=Guide(scorer=keep_none, mode=mode))
        assert wrong.status == "solved"
    wrong = plan(scene, goal, config=tree, guide=Guide(scorer=keep_none, mode="prune"))
    assert wrong.status == "infeasible" or goal.reference in wrong.moved
    assert wrong.moved != plain.moved
    # A beta beyond all scores keeps everything.
    kept = plan(scene, goal, config=tree, guide=Guide(scorer=keep_none, mode="prune", beta=4.0))
    assert kept.counts == unguided.counts


class Given:
    """Scores by a rule."""

    def __init__(self, rule):
        self.rule = rule

    def scores(self, scene, goal):
        return {name: self.rule(i) for i, name in enumerate(scene.names)}


@pytest.mark.parametrize("search", ["tree", "informed"])
def test_complete_guides_lose_nothing_that_the_unguided_search_solves_in_as_many_nodes(
    planned, search
):
    draws = random.Random(3)
    rules = {
        "random": lambda _: draws.uniform(-4, 4),
        "reversed": lambda i: float(-i),
        "constant": lambda _: -1.0,
    }
    checked = 0
    for scene, goal, found in planned:
        if found.status != "solved" or len(found.moved) < 2:
            continue
        full = PlannerConfig(search=search)
        plain = plan(scene, goal, config=full, replay=False)
        if plain.status != "solved":
            continue
        tight = PlannerConfig(search=search, node_limit=plain.counts.nodes)
        for mode in (name for name, kind in GUIDES.items() if kind.complete):
            for rule in rules.values():
                guide = Guide(scorer=Given(rule), mode=mode)
                result = plan(scene, goal, config=tight, guide=guide, replay=False)
                assert result.status == "solved", (mode, result.reason)
                checked += 1
        if checked > 60:
            break
    assert checked > 30


def test_scores_that_are_no_numbers_are_refused():
    for mode in ("prune", "order", "expand", "prune-then-full"):
        guide = Guide(scorer=Given(lambda _: math.nan), mode=mode)
        with pytest.raises(GuideError, match="the score of 'red' is nan"):
            plan(OPEN, "on(red, blue)", guide=guide)
    with pytest.raises(RelevanceError, match="unknown guide 'prunes', expected one of none, prune"):
        Guide(scorer=Given(float), mode="prunes")


def test_first_stops_at_the_first_plan_for_every_guide(planned):
    fewer = 0
    for scene, goal, found in planned:
        first = plan(scene, goal, config=PlannerConfig(stop="first"), replay=False)
        assert (first.status, len(first.moved)) == (found.status, len(found.moved))
        assert first.counts.nodes <= found.counts.nodes
        fewer += first.counts.nodes < found.counts.nodes
        guide = Guide(scorer=Given(lambda i: float(-i)), mode="order")
        ordered = plan(scene, goal, guide=guide, replay=False)  # to the end of the level
        if found.status == "solved":
            assert ordered.moved == found.moved
            assert ordered.counts.nodes == found.counts.nodes
    assert fewer


def test_a_prune_that_finds_nothing_says_what_it_kept():
    top = box("green", 0.0, -0.15, GREEN, size=(0.04, 0.04, 0.05), bottom=0.06, on="blue")
    scene = type(OPEN)(objects=(*OPEN.objects, top))
    guide = Guide(scorer=Says(()), mode="prune")
    result = plan(scene, "on(red, blue)", guide=guide)
    assert result.status == "infeasible"
    assert result.reason.startswith("none that moves only what was kept (red, blue): green")


def test_a_guide_registered_from_outside_guides():
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Backwards(Mode):
        def rounds(self, everything, kept, scores):
            yield everything

    GUIDES.register("backwards", Backwards(name="backwards", color="#000000", ordered=True))
    try:
        guide = Guide(scorer=Given(float), mode="backwards")
        assert plan(OPEN, "on(red, blue)", guide=guide).status == "solved"
    finally:
        GUIDES.unregister("backwards")
    assert isinstance(GUIDES["order"], Everything)


def test_every_planner_answers_in_one_way():
    assert {"ours", "rai"} <= set(PLANNERS)
    ours = PLANNERS["ours"]
    ours.require()
    result = ours.plan(OPEN, "on(red, blue)", config=ours.Config(node_limit=100))
    assert result.status == "solved"
    with pytest.raises(RelevanceError, match=r"unknown planner 'theirs', expected one of .*ours"):
        PLANNERS["theirs"]


def test_plans_are_replayed_unless_told_not_to_and_a_refused_one_is_not_solved(monkeypatch):
    kept = plan(OPEN, "on(red, blue)")
    assert kept.replay is not None
    assert kept.replay.ok
    assert plan(OPEN, "on(red, blue)", replay=False).replay is None
    no = Replay(ok=False, max_penetration=0.1, reason="the hand is in the table")
    monkeypatch.setattr("relevance.simulation.replay", lambda *_: no)
    refused = plan(OPEN, "on(red, blue)")
    assert (refused.status, refused.replay) == ("refused", no)
    assert "the hand is in the table" in refused.reason
    assert refused.moved == kept.moved
