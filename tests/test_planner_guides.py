"""Guides change the effort, never what can be solved; planners and guides come by name."""

import math
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
from tests.planning import GREEN, OPEN, Given, Says, box, tasks


@pytest.fixture(scope="module")
def planned():
    return [(scene, goal, plan(scene, goal, replay=False)) for scene, goal in tasks(24, seed=11)]


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


def test_scores_that_are_no_numbers_are_refused():
    for mode in (name for name, kind in GUIDES.items() if kind.guided):
        guide = Guide(scorer=Given(lambda _: math.nan), mode=mode, patience=0)
        with pytest.raises(GuideError, match="the score of 'red' is nan"):
            plan(OPEN, "on(red, blue)", guide=guide)
    with pytest.raises(RelevanceError, match="unknown guide 'prunes', expected one of none, prune"):
        Guide(scorer=Given(float), mode="prunes")


def test_first_stops_at_the_first_plan(planned):
    fewer = 0
    for scene, goal, found in planned:
        first = plan(scene, goal, config=PlannerConfig(stop="first"), replay=False)
        assert (first.status, len(first.moved)) == (found.status, len(found.moved))
        assert first.counts.nodes <= found.counts.nodes
        fewer += first.counts.nodes < found.counts.nodes
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

    GUIDES.register("backwards", Backwards(name="backwards", color="#000000", walk="likeliest"))
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
