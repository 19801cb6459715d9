"""What a beta would cost, read off the reruns: exact at one, between two elsewhere."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relevance.evaluation import saved, summarise, swept, working_point

SCORES = [3.0, 1.0, -1.0, -3.0]
"""Of the four queries of each task; at beta 0 two are kept, so four of six objects."""
BETAS = (-2.0, 0.0, 2.0)
"""They keep 3, 4 and 5 objects."""


def row(task: int, beta: float, seconds: float, *, solved: bool = True) -> dict[str, Any]:
    kept = 2 + sum(score > -beta for score in SCORES)
    return {
        "scene_id": f"s{task}",
        "predicate": "behind",
        "subject": "a",
        "reference": "b",
        "guide": "prune",
        "search": "tree",
        "beta": beta,
        "n_objects": 6,
        "n_kept": kept,
        "solved_unguided": True,
        "solved_guided": solved,
        "seconds_unguided": 1.0 + task,
        "seconds_guided": seconds + 0.01,
        "seconds_inference": 0.01,
        **dict.fromkeys(("nodes_unguided", "nodes_guided", "nlps_unguided", "nlps_guided"), 1),
        **dict.fromkeys(("n_actions_unguided", "n_actions_guided"), 2),
    }


def scored(task: int, relevant: list[bool]) -> dict[str, Any]:
    keys = {"scene_id": f"s{task}", "predicate": "behind", "subject": "a", "reference": "b"}
    return keys | {"scores": SCORES, "relevant": relevant}


@settings(max_examples=20, deadline=None)
@given(
    seconds=st.lists(st.floats(0.001, 5), min_size=6, max_size=6),
    solved=st.lists(st.booleans(), min_size=2, max_size=2),
)
def test_at_a_beta_that_was_rerun_it_is_that_rerun(seconds, solved) -> None:
    rows = [
        row(task, beta, seconds[3 * task + place], solved=place > 0 or solved[task])
        for task in range(2)
        for place, beta in enumerate(BETAS)
    ]
    tasks = swept(rows, [scored(task, [False] * 4) for task in range(2)])["tree"]
    for beta in BETAS:
        expected = summarise([r for r in rows if r["beta"] == beta])
        found = working_point(tasks, beta)
        assert found.exact == 1
        assert found.misses == expected.misses
        assert found.kept == pytest.approx(sum(r["n_kept"] for r in rows if r["beta"] == beta) / 12)
        assert found.speedup.value == pytest.approx(expected.speedup.value)
        assert saved(tasks, [beta]) == [pytest.approx(expected.speedup.value)]


def test_between_two_reruns_its_time_is_between_theirs() -> None:
    rows = [row(0, -2.0, 0.1), row(0, 2.0, 0.4)]
    [task] = swept(rows, [scored(0, [True, False, False, False])])["tree"]
    run = task.at(0.0)  # four objects: three were tried, and five
    assert not run.exact
    assert run.seconds == pytest.approx(0.2)  # half-way, in logarithms
    assert run.solved


def test_what_keeps_everything_is_the_unguided_run_and_a_look() -> None:
    [task] = swept([row(0, 0.0, 0.1)], [scored(0, [False] * 4)])["tree"]
    assert task.cost(10.0) == pytest.approx(1.0 + 0.01)
    assert working_point([task], 10.0).kept == 1


@pytest.mark.parametrize("tried", [True, False])
def test_a_relevant_object_left_out_is_a_miss_unless_less_was_enough(tried) -> None:
    """Where fewer objects solved it more do, whatever the label of one of them says."""
    rows = [row(0, -2.0, 0.1, solved=tried), row(0, 2.0, 0.4)]
    [task] = swept(rows, [scored(0, [False, False, True, False])])["tree"]
    run = task.at(0.0)  # leaves out the relevant one
    assert run.solved == tried
    assert task.cost(0.0) == pytest.approx(0.01 + run.seconds + (0.0 if tried else 1.0))


def test_fewer_objects_than_were_tried() -> None:
    rows = [row(0, 0.0, 0.1)]
    [task] = swept(rows, [scored(0, [True, False, False, False])])["tree"]
    assert task.at(-2.0).solved  # the relevant one is kept
    assert not task.at(-5.0).solved
    assert task.at(-5.0).kept == 2


def test_other_guides_and_unscored_tasks_are_left_out() -> None:
    rows = [row(0, 0.0, 0.1), row(1, 0.0, 0.1), row(0, 0.0, 0.1) | {"guide": "order"}]
    found = swept(rows, [scored(0, [False] * 4)])
    assert [len(tasks) for tasks in found.values()] == [1]
    assert swept([], []) == {}
