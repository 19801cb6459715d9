"""How much to keep so that nothing relevant is left out, with a stated probability.

Split-conformal prediction over scenes. A goal *needs* a beta: the one from which on every relevant
object of it is kept. Exchangeable are scenes, those of the calibration and a new one, drawn alike;
the goals of one scene are not independent of each other, however many there are. So each of n
scenes weighs 1 / (n + 1), shared equally by its goals, and what is left is the new scene's, whose
needs may be anything. The beta of a coverage is the least one below which the needs of that weight
lie (with one goal a scene: the ceil((n + 1) coverage)-th smallest of n). Then all relevant objects
of a goal, any of those asked of a new scene, are kept with at least that probability, over the
draw of all scenes and whatever the network is worth (Lee, Barber and Willett, Distribution-free
inference with hierarchical data, 2023).

It says nothing of scenes that are drawn otherwise, of goals that the labelling planner leaves
unsolved, or of one scene in particular. With fewer than coverage / (1 - coverage) scenes there is
no such beta.

Shape suffixes: G goals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from relevance.errors import RelevanceError

LEVELS = (0.9, 0.95, 0.99)
"""Coverages that tables show."""
LEAST = -50.0
"""The beta of a goal that needs none: low enough to keep hardly anything."""
_TIE = 1e-4  # logits may differ by as much from one machine to another; equal ones are kept
_STEPS = 1000  # how finely shares are stored; between two of them the larger beta counts
_ROUNDING = 1e-12  # of sums of weights


class CalibrationError(RelevanceError):
    """A coverage that cannot be had: says of what, why, and what was expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Needs:
    """What share of the goals needs at most which beta: a step function, in ascending order."""

    scenes: int
    goals: int
    shares: tuple[float, ...]
    """Weight of the goals that need at most the beta of the same place; at most n / (n + 1)."""
    betas: tuple[float, ...]

    @classmethod
    def of(cls, needs: np.ndarray, scenes: np.ndarray) -> Needs:
        """Of what each goal needs (G,), -inf for nothing, and the number of its scene (G,)."""
        _, place, goals = np.unique(scenes, return_inverse=True, return_counts=True)
        weights = 1 / ((len(goals) + 1) * goals[place])
        order = np.argsort(needs, kind="stable")
        shares = np.cumsum(weights[order])
        steps = np.floor(shares * _STEPS + _ROUNDING * _STEPS)
        kept = np.flatnonzero(np.diff(steps, prepend=0.0) > 0)
        if len(order):
            kept = np.union1d(kept, len(order) - 1)
        return cls(
            scenes=len(goals),
            goals=len(needs),
            shares=tuple(shares[kept].tolist()),
            betas=tuple((np.maximum(needs[order][kept], LEAST) + _TIE).tolist()),
        )

    def beta(self, coverage: float) -> float | None:
        """The least stored beta of that coverage; None where so few scenes have none."""
        place = int(np.searchsorted(self.shares, coverage - _ROUNDING))
        return self.betas[place] if place < len(self.betas) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """What a checkpoint's scores of one dataset say about every coverage."""

    dataset_hash: str
    """Labels and images that it rests on."""
    split: str
    needs: Mapping[str, Mapping[str, Needs]]
    """By predicate, then by family of scenes."""

    def beta(self, predicate: str, coverage: float) -> float:
        """The beta that keeps the promise in every family of scenes, so in any mix of them.

        CalibrationError where the predicate was not calibrated, or in too few scenes.
        """
        check_coverage(coverage)
        families = self.needs.get(predicate)
        if not families:
            known = ", ".join(self.needs) or "none"
            raise CalibrationError(f"not calibrated for {predicate}, expected one of {known}")
        betas = []
        for family, needs in families.items():
            found = needs.beta(coverage)
            if found is None:
                least = math.ceil(coverage / (1 - coverage) - 1e-9)
                raise CalibrationError(
                    f"{predicate}: coverage {coverage:g} takes {least} calibrated scenes of "
                    f"{family}, found {needs.scenes}: expected more, or a coverage of at most "
                    f"{math.floor(1000 * needs.scenes / (needs.scenes + 1)) / 1000:g}"
                )
            betas.append(found)
        return max(betas)

    def to_json(self) -> dict[str, Any]:
        """As it stands in a checkpoint."""
        return _ADAPTER.dump_python(self, mode="json")

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> Calibration | None:
        """The one among what is known of a checkpoint; None where it was not calibrated."""
        if KEY not in meta:
            return None
        try:
            return _ADAPTER.validate_python(meta[KEY])
        except ValidationError:
            name = meta.get("checkpoint_id", "(unnamed)")
            raise CalibrationError(
                f"checkpoint {name}: its calibration cannot be read, expected one of this version; "
                "`relevance calibrate` makes it anew"
            ) from None


KEY = "calibration"
"""Where it stands among what is known of a checkpoint: in the file, for those weights alone."""
_ADAPTER = TypeAdapter(Calibration)


@dataclass(frozen=True, slots=True, kw_only=True)
class Promise:
    """A coverage that a checkpoint was asked for."""

    checkpoint_id: str
    calibration: Calibration
    coverage: float

    @classmethod
    def of(cls, meta: Mapping[str, Any], coverage: float) -> Promise:
        """Of a checkpoint; CalibrationError where it was not calibrated."""
        check_coverage(coverage)
        found, name = Calibration.of(meta), meta.get("checkpoint_id", "(unnamed)")
        if found is None:
            raise CalibrationError(
                f"checkpoint {name}: is not calibrated, which a coverage needs; "
                "`relevance calibrate DATASET --checkpoint FILE` does it"
            )
        return cls(checkpoint_id=name, calibration=found, coverage=coverage)

    def beta(self, predicate: str) -> float:
        """The beta for a predicate; CalibrationError where there is none."""
        try:
            return self.calibration.beta(predicate, self.coverage)
        except CalibrationError as error:
            raise CalibrationError(f"checkpoint {self.checkpoint_id}: {error}") from None


def check_coverage(coverage: float) -> None:
    """CalibrationError unless it is a share that can be promised."""
    if not 0 < coverage < 1:
        raise CalibrationError(f"coverage {coverage:g}: expected more than 0 and less than 1")
