"""The paper's figures, read from `paper.toml`: the only place that has them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple


class Shares(NamedTuple):
    """Accuracy of a network, 0..1."""

    true_relevant: float
    true_irrelevant: float
    total: float


class Runtime(NamedTuple):
    """Mean planning time of a task, s, misses left out, and the share of it that was saved."""

    unguided: float
    guided: float
    saved: float


class Queries(NamedTuple):
    """How many queries a dataset has."""

    relevant: int
    irrelevant: int

    @property
    def share(self) -> float:
        """Relevant among all."""
        return self.relevant / (self.relevant + self.irrelevant)


@dataclass(frozen=True, slots=True, kw_only=True)
class Paper:
    """What the paper reports; groups are predicates and families."""

    title: str
    authors: str
    accuracy: Mapping[str, Shares]
    """By group."""
    runtime: Mapping[str, Runtime]
    """By group."""
    spread: Mapping[str, tuple[float, float]]
    """By predicate: half of the 67% intervals of its unguided and guided times, s."""
    scenes: Mapping[str, int]
    """By predicate: scenes to train on."""
    test_scenes: Mapping[str, int]
    """By predicate: scenes to test on."""
    train: Mapping[str, Queries]
    """By group."""
    test: Mapping[str, Queries]
    """By group."""
    eta: Mapping[str, float]
    """By family: weight of the relevant objects in the loss."""
    bodies: Mapping[str, Shares]
    """Table III: accuracy on `on` by body."""
    body_names: Mapping[str, str]
    """Our name of each body of `bodies`."""
    curves: Mapping[str, tuple[float, ...]]
    """Figures 7 and 8: shares and time saved over `beta`, on `on`."""
    axes: Mapping[str, tuple[float, float]]
    """Of those figures: ends of `beta`, `share` and `saved`."""
    notes: Mapping[str, tuple[str, ...]]
    """What to know of `data`, `accuracy`, `times`, `bodies` and `beta`, and how we read it."""

    @property
    def seconds(self) -> tuple[float, float]:
        """Range of the predicates' mean unguided planning times, s."""
        times = [self.runtime[predicate].unguided for predicate in self.scenes]
        return min(times), max(times)


@cache
def paper() -> Paper:
    """The paper's figures."""
    with (Path(__file__).parent / "paper.toml").open("rb") as stream:
        raw = tomllib.load(stream)
    predicates, families = raw["predicates"], raw["families"]
    queries = {
        split: {p["name"]: Queries(**p[split]) for p in predicates}
        | {f["name"]: _pooled(predicates, split, f["name"]) for f in families}
        for split in ("train", "test")
    }
    return Paper(
        title=raw["title"],
        authors=raw["authors"],
        accuracy={g["name"]: Shares(*g["accuracy"]) for g in (*predicates, *families)},
        runtime={
            p["name"]: Runtime(p["unguided"][0], p["guided"][0], p["saved"]) for p in predicates
        }
        | {f["name"]: Runtime(f["unguided"], f["guided"], f["saved"]) for f in families},
        spread={p["name"]: (p["unguided"][1], p["guided"][1]) for p in predicates},
        scenes={p["name"]: p["scenes"] for p in predicates},
        test_scenes={p["name"]: p["test_scenes"] for p in predicates},
        train=queries["train"],
        test=queries["test"],
        eta={f["name"]: f["eta"] for f in families},
        bodies={b["name"]: Shares(*b["accuracy"]) for b in raw["bodies"]},
        body_names={b["name"]: b["body"] for b in raw["bodies"]},
        axes={name: (float(low), float(high)) for name, (low, high) in raw["axes"].items()},
        notes={name: tuple(said) for name, said in raw["notes"].items()},
        curves={name: tuple(map(float, values)) for name, values in raw["curves"].items()},
    )


def _pooled(predicates: list[dict[str, Any]], split: str, family: str) -> Queries:
    mine = [Queries(**p[split]) for p in predicates if p["family"] == family]
    return Queries(sum(q.relevant for q in mine), sum(q.irrelevant for q in mine))
