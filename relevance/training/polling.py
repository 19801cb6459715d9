"""Polling: which predicates look at scenes together, and which look a step takes.

Arithmetic alone: a step needs no memory of those before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from relevance.scene import Predicate
from relevance.training.settings import TrainConfig


def polling(predicates: Sequence[Predicate], *, share: bool) -> list[tuple[Predicate, ...]]:
    """One round of turns p0, p1, ...: the predicates of each optimiser step, in order.

    With `share`, neighbours of one scene family make one step; the order stays the same.
    """
    if not share:
        return [(predicate,) for predicate in predicates]
    return [tuple(group) for _, group in groupby(predicates, key=lambda p: p.family)]


def groups_of(predicates: Sequence[Predicate], config: TrainConfig) -> list[tuple[Predicate, ...]]:
    """The predicates that look at scenes together, in the order of a round.

    Neighbours of one family do, also where each then has a step of its own, so that no picture is
    decoded twice; not where single queries are drawn or one is trained after the other.
    """
    alone = config.queries_per_batch > 0 or config.polling == "one-by-one"
    return polling(predicates, share=not alone)


def looks_of(
    step: int, groups: Sequence[Sequence[Predicate]], config: TrainConfig
) -> list[tuple[int, slice]]:
    """The looks that a step learns from, numbered as they come in a run, and which turns of each.

    In turns and in rounds the groups look one after the other; one by one, each takes all its
    looks before the next, and the steps are shared out evenly.
    """
    whole = [slice(None)]
    turns = [
        (group, turn)
        for group, predicates in enumerate(groups)
        for turn in (
            whole if config.share_encodings else [slice(i, i + 1) for i in range(len(predicates))]
        )
    ]
    if config.polling == "one-by-one":
        return [(step, whole[0])]
    if config.polling == "rounds":
        return [(step * len(groups) + group, turn) for group, turn in turns]
    round_, place = divmod(step, len(turns))
    group, turn = turns[place]
    return [(round_ * len(groups) + group, turn)]
