"""Soft labels: where several sets of moved objects tie, an object's target is its share of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any


def tied_sets(plans: Iterable[Mapping[str, Any]]) -> dict[str, set[frozenset[str]]]:
    """By plan_id the sets that tie, of rows of `plans`; plans whose set is alone are left out.

    The same objects moved in another order are the same set.
    """
    found = {row["plan_id"]: set(map(frozenset, row["alternatives"] or ())) for row in plans}
    return {plan_id: sets for plan_id, sets in found.items() if len(sets) > 1}


def target(query: str, relevant: bool, sets: Collection[frozenset[str]]) -> float:
    """The share of the tied sets that the object is in; its label where none tie."""
    return sum(query in names for names in sets) / len(sets) if sets else float(relevant)
