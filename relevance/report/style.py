"""How pages and plots look: every colour once, matplotlib's settings, and how figures are written.

A family has one colour everywhere, and so has a guide, a split and a bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from relevance.scene import FAMILIES, PREDICATES, group_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GROUPS = FAMILIES
"""Families, in the order in which tables and plots show them."""

INK, MUTED, FAINT, GRID = "#22282f", "#6b7480", "#d9dde2", "#eceff2"
"""Text; what stands back; lines; the grid of a plot."""
BLUE, ORANGE, GREEN, VIOLET = "#2f6db3", "#c26a1c", "#3a8a5f", "#7a5aa6"
TEAL, ROSE = "#2a8c94", "#b5476b"
GREY, PALE, BAND = "#8a939d", "#9aa4af", "#f0e4d4"
_OTHERS = (TEAL, ROSE, GREEN, VIOLET)

RELEVANT, KEPT, LOST = "#12a150", "#e08a00", "#d92d20"
"""Outlines: relevant; kept by the network though irrelevant; left out though relevant."""
CARD_SUBJECT, CARD_REFERENCE, CARD_RELEVANT = "#ffffff", "#101418", "#ff2d95"
"""Outlines in the card, whose pictures have no tags."""

SPLIT_COLOR = {"train": BLUE, "validation": GREY, "test": ORANGE}
BOUND_COLOR = {"pose": BLUE, "keyframe": GREEN, "path": ORANGE, "rest": GREY}
LOSS_COLOR = {"loss": INK, "relevance": BLUE, "mask": ORANGE, "geometry": GREEN}
SHARES = (
    ("true relevant", "true_relevant", GREEN),
    ("true irrelevant", "true_irrelevant", GREY),
    ("total", "total", INK),
)
"""Label, attribute of an Accuracy, and colour."""
UNGUIDED = "unguided"


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideStyle:
    """How a guide is shown."""

    color: str
    complete: bool
    """Whether it solves whatever the unguided search solves; otherwise it may miss."""


def guide_style(name: str) -> GuideStyle:
    """How a guide is shown; one that nobody knows (any more) gets a colour by its name."""
    from relevance.planner import GUIDES  # and what it compiles: only where a guide is shown

    if name == UNGUIDED:
        name = "none"
    if name not in GUIDES:
        return GuideStyle(color=_spare(name), complete=False)
    return GuideStyle(color=GUIDES[name].color, complete=GUIDES[name].complete)


def groups() -> list[str]:
    """Rows of tables, in order: each family, then its predicates; a name of both comes once."""
    names = [
        name
        for family in FAMILIES
        for name in (family, *(p.name for p in PREDICATES.values() if p.family == family))
    ]
    return list(dict.fromkeys([*names, *PREDICATES]))


def pooled(group: str) -> bool:
    """Whether a row sums up others: a family that is not shown as one predicate alone."""
    own = [p.name for p in PREDICATES.values() if p.family == group]
    return bool(own) and group not in own


def named(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with family and predicate, each with the `group` that it is shown as, in order; what
    is not registered here comes last."""
    found = [row | {"group": _named(row["predicate"], row["family"])} for row in rows]
    order = {group: place for place, group in enumerate(groups())}
    return sorted(found, key=lambda row: (order.get(row["group"], len(order)), row["group"]))


def _named(predicate: str, family: str | None) -> str:
    return str(family) if predicate == "all" else group_of(predicate, family)


def family_color(name: str) -> str:
    """Colour of a family of scenes, or of the one that a predicate belongs to."""
    family = PREDICATES[name].family if name in PREDICATES else name
    return {"same-plane": BLUE, "on": ORANGE, "stacks": GREEN}.get(family) or _spare(family)


def _spare(name: str) -> str:
    return _OTHERS[sum(name.encode()) % len(_OTHERS)]


STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "svg.fonttype": "none",
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
}
"""matplotlib's settings."""

# --- how figures are written ----------------------------------------------------------------

DASH, TIMES = "\u2013", "\u00d7"


def seconds(value: float | None) -> str:
    """Seconds in the unit that reads best; a dash where there are none."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    if value >= 1:
        return f"{value:.0f} s" if value >= 10 else f"{value:.1f} s"
    return f"{1000 * value:.0f} ms" if value >= 0.01 else f"{1000 * value:.1f} ms"


def percent(value: float | None, decimals: int = 1) -> str:
    """A share in 0..1 as per cent; a dash where there is none."""
    return DASH if value is None or not math.isfinite(value) else f"{100 * value:.{decimals}f}%"


def number(value: float | int | None, decimals: int = 0) -> str:
    """A number with thin spaces between thousands; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:,.{decimals}f}".replace(",", "\u202f")


def legend_below(ax: Axes, *, most: int = 4, **room: float) -> None:
    """One legend under all panels, in rows of so many; room: matplotlib's spacings."""
    handles, labels = ax.get_legend_handles_labels()
    columns = min(most, max(1, len(labels)))
    ax.figure.legend(handles, labels, loc="outside lower center", ncols=columns, **room)  # pyright: ignore[reportArgumentType]
