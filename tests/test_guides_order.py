"""Guides that order the search: the likeliest first, whatever the scores nothing is lost, and what
was tried once is not tried again."""

import math
import random
from collections import Counter
from dataclasses import replace

import pytest

from relevance.planner import GUIDES, Guide, GuideError, PlannerConfig, plan
from relevance.planner.keyframes import KeyframeBound
from tests.planning import BLUE, GREEN, GREY, OPEN, Given, Says, box, tasks

SEARCHES = pytest.mark.parametrize("search", ["tree", "informed"])
ORDERING = ("order", "shortest", "lazy")
AHEAD = type(OPEN)(
    objects=(
        *OPEN.objects,
        box("green", 0.0, -0.15, GREEN, size=(0.04, 0.04, 0.05), bottom=0.06, on="blue"),
        box("grey", 0.2, 0.3, GREY),
    )
)
"""A box stands on `blue`; `grey` is in nobody's way."""


@pytest.fixture(scope="module")
def crowded():
    """Tasks of which many take a blocker or two."""
    return tasks(40, seed=11)


def rules():
    draws = random.Random(3)
    return {
        "random": lambda _: draws.uniform(-4, 4),
        "reversed": lambda i: float(-i),
        "constant": lambda _: -1.0,
        "certain": lambda i: math.inf if i % 2 else -math.inf,
    }


class Counted(Says):
    """Scores from a table, and how often they were asked."""

    asked = 0

    def scores(self, scene, goal):
        self.asked += 1
        return super().scores(scene, goal)


@SEARCHES
def test_complete_guides_lose_nothing_that_the_unguided_search_solves_in_as_many_nodes(
    crowded, search
):
    checked = 0
    for scene, goal in crowded:
        plain = plan(scene, goal, config=PlannerConfig(search=search), replay=False)
        if plain.status != "solved" or len(plain.moved) < 2:
            continue
        tight = PlannerConfig(search=search, node_limit=plain.counts.nodes)
        for mode in (name for name, kind in GUIDES.items() if kind.complete):
            for patience in (0, 200, 10**9) if GUIDES[mode].waits else (0,):
                for rule in rules().values():
                    guide = Guide(scorer=Given(rule), mode=mode, patience=patience)
                    result = plan(scene, goal, config=tight, guide=guide, replay=False)
                    assert result.status == "solved", (mode, patience, result.reason)
                    assert result.check_ok
                    checked += 1
        if checked > 120:
            break
    assert checked > 60


@SEARCHES
def test_wrong_scores_make_no_task_infeasible_nor_a_hopeless_one_solved(crowded, search):
    config, unsolved = PlannerConfig(search=search, max_actions=4), 0
    for scene, goal in crowded:
        plain = plan(scene, goal, config=config, replay=False)
        for mode in ORDERING:
            scorer = Says([name for name in scene.names if name not in plain.moved])
            result = plan(scene, goal, config=config, guide=Guide(scorer=scorer, mode=mode))
            assert result.status == plain.status, (mode, str(goal), result.reason)
        unsolved += plain.status != "solved"
    assert unsolved


@SEARCHES
def test_shortest_gives_the_plan_of_the_unguided_search(crowded, search):
    longer = 0
    for scene, goal in crowded:
        config = PlannerConfig(search=search)
        plain = plan(scene, goal, config=config, replay=False)
        for rule in rules().values():
            guide = Guide(scorer=Given(rule), mode="shortest")
            whole = plan(scene, goal, config=config, guide=guide, replay=False)
            assert (whole.status, whole.moved) == (plain.status, plain.moved)
            assert whole.cost == plain.cost or plain.status != "solved"
            first = plan(scene, goal, config=replace(config, stop="first"), guide=guide)
            assert len(first.moved) == len(plain.moved)
        longer += len(plain.moved) > 1
    assert longer


@SEARCHES
def test_order_moves_what_is_likely_though_fewer_moves_would_do(search):
    config = PlannerConfig(search=search)
    plain = plan(AHEAD, "on(red, blue)", config=config)
    assert plain.moved == ("green", "red")
    for relevant in (["green"], [], AHEAD.names):
        guide = Guide(scorer=Says(relevant), mode="order")
        result = plan(AHEAD, "on(red, blue)", config=config, guide=guide)
        assert result.status == "solved"
        assert result.looked
        # `informed` leaves out what cannot help, the reference is moved only where it must be
        needless = {"grey"} & set(relevant) if search == "tree" else set()
        assert {*result.moved} == {"green", "red"} | needless
        assert result.counts.sequences == 1


@SEARCHES
def test_likely_sets_are_tried_first(search):
    """With true scores one action sequence is enough, where the unguided search looks about."""
    boxes = [box(f"b{i}", -0.1 + 0.07 * (i % 4), 0.3 + 0.1 * (i // 4), GREY) for i in range(6)]
    scene = type(OPEN)(objects=(*AHEAD.objects[:3], *boxes))
    plain = plan(scene, "on(red, blue)", config=PlannerConfig(search=search))
    guide = Guide(scorer=Says(plain.moved), mode="order")
    right = plan(scene, "on(red, blue)", config=PlannerConfig(search=search), guide=guide)
    assert right.moved == plain.moved
    assert right.counts.sequences == 1
    assert right.counts.work < plain.counts.work
    assert right.counts.nodes < plain.counts.nodes or search == "informed"


def test_lazy_looks_once_it_has_done_its_work_and_not_before():
    for patience, looked in ((0, True), (10**9, False)):
        scorer = Counted(["green"])
        guide = Guide(scorer=scorer, mode="lazy", patience=patience)
        results = [plan(AHEAD, "on(red, blue)", guide=guide, replay=False) for _ in range(2)]
        assert scorer.asked == 2 * looked
        assert [result.looked for result in results] == [looked, looked]
        assert all(result.moved == ("green", "red") for result in results)
        assert results[0].counts == results[1].counts  # work is counted, not timed
        assert (results[0].seconds.guide > 0) == looked
    broken = Guide(scorer=Given(lambda _: math.nan), mode="lazy", patience=10**9)
    assert plan(AHEAD, "on(red, blue)", guide=broken).status == "solved"
    with pytest.raises(GuideError, match="patience is -1"):
        Guide(scorer=scorer, patience=-1)


@SEARCHES
def test_a_lazy_guide_that_does_not_look_does_what_the_unguided_search_does(crowded, search):
    first, asked = PlannerConfig(search=search, stop="first"), 0
    for scene, goal in crowded[:12]:
        plain = plan(scene, goal, config=first, replay=False)
        for patience in (10**9, 100):
            guide = Guide(scorer=Says(plain.moved), mode="lazy", patience=patience)
            result = plan(scene, goal, config=first, guide=guide, replay=False)
            asked += result.looked
            if not result.looked:
                assert (result.counts, result.moved) == (plain.counts, plain.moved)
                assert (result.status, result.reason) == (plain.status, plain.reason)
    assert 0 < asked <= 12


@SEARCHES
@pytest.mark.parametrize("mode", [name for name, kind in GUIDES.items() if kind.complete])
def test_what_the_late_bounds_refused_is_not_tried_again(monkeypatch, search, mode):
    tried = Counter()

    def refuse(_, order, placements):
        tried[order] += 1

    monkeypatch.setattr(KeyframeBound, "solve", refuse)
    config = PlannerConfig(search=search)
    plain = plan(AHEAD, "on(red, blue)", config=config, replay=False)
    once = dict(tried)
    tried.clear()
    guide = Guide(scorer=Says(["green", "grey"]), mode=mode, patience=300)
    result = plan(AHEAD, "on(red, blue)", config=config, guide=guide, replay=False)
    assert (result.status, result.reason) == (plain.status, plain.reason)
    assert result.status == "limit"
    assert len(tried) > 1
    assert dict(tried) == once


@SEARCHES
def test_nodes_of_the_prior_are_capped_at_the_limit_and_no_part_of_it(search):
    boxes = [box(f"b{i}", -0.1 + 0.07 * (i % 4), 0.3 + 0.1 * (i // 4), GREY) for i in range(8)]
    # nothing can be put on it: it is not there for the hand to reach
    far = box("blue", 0.35, -0.55, BLUE)
    scene = type(OPEN)(objects=(OPEN.objects[0], far, *boxes))
    config = PlannerConfig(search=search, node_limit=40, max_actions=12)
    for mode in ORDERING:
        guide = Guide(scorer=Given(lambda i: float(i)), mode=mode, patience=0)
        result = plan(scene, "behind(red, blue)", config=config, guide=guide)
        assert result.status != "solved"
        assert result.counts.nodes <= 2 * (config.node_limit + 1)
