"""How well scores tell relevant objects from irrelevant ones."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata


def accuracy(score: np.ndarray, relevant: np.ndarray) -> dict[str, float | int | None]:
    """Shares scored right, of the relevant, the irrelevant and all; None where there are none.

    `base_rate` is what always answering irrelevant gets right, `balanced` the mean of true
    relevant and true irrelevant, `auc` the chance that a relevant object outscores another.
    `best_beta` has the highest total here (an object is kept iff score > -beta); eta makes
    beta = 0 lean towards keeping.
    """
    kept, n, k = score > 0, len(score), int(relevant.sum())

    def share(right: np.ndarray) -> float | None:
        return float(right.mean()) if len(right) else None

    true_relevant, true_irrelevant = share(kept[relevant]), share(~kept[~relevant])
    both = None not in (true_relevant, true_irrelevant)
    return {
        "relevant": k,
        "irrelevant": n - k,
        "true_relevant": true_relevant,
        "true_irrelevant": true_irrelevant,
        "total": share(kept == relevant),
        "base_rate": share(~relevant),
        "balanced": ((true_relevant or 0) + (true_irrelevant or 0)) / 2 if both else None,
        "auc": float((rankdata(score)[relevant].sum() - k * (k + 1) / 2) / (k * (n - k)))
        if both
        else None,
        "best_beta": _best_beta(score, relevant),
    }


def _best_beta(score: np.ndarray, relevant: np.ndarray) -> float | None:
    """The beta half-way between the scores where most objects are judged rightly."""
    if not len(score):
        return None
    order = np.argsort(-score, kind="stable")
    ranked = np.r_[np.inf, score[order], -np.inf]
    gained = np.r_[0, np.cumsum(np.where(relevant[order], 1, -1))]
    # Objects of equal score are kept together.
    splits = ranked[:-1] > ranked[1:]
    best = int(np.argmax(np.where(splits, gained, -len(score))))
    above, below = ranked[best], ranked[best + 1]
    if np.isinf(above) or np.isinf(below):
        return float(-below - 1.0) if np.isinf(above) else float(-above + 1.0)
    return float(-(above + below) / 2)
