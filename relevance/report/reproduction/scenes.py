"""The paper's Figures 1 and 4, from scenes of the dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle

from relevance.report.plots import Drawing
from relevance.report.style import (
    CARD_REFERENCE,
    CARD_SUBJECT,
    FAINT,
    GREY,
    INK,
    MUTED,
    RELEVANT,
)
from relevance.scene import PREDICATES, Box
from relevance.store import Dataset, Sample

_PLAIN = 0.85
"""How much of every box of an example has to show, where there is such a scene."""

_ONE = """
with seen as (
    select split, scene_id, min(visible_fraction) as least, count(*) as n from objects
    where split = 'test' group by all)
select p.*, list_filter(p.moved, lambda name: name not in (p.subject, p.reference)) as away
from plans as p join seen as s using (split, scene_id)
left join shard_families as f using (split, shard)
where p.holds and f.family = 'same-plane' and len(away) > 0
order by p.ambiguous, s.least < ?, s.n not between 5 and 7, len(away),
    md5(p.plan_id)
limit 1
"""

_ON = """
with
seen as (
    select split, scene_id, min(visible_fraction) as least from objects
    where split = 'test' group by all),
loads as (
    select scene_id, base, list(name) as names from carried where split = 'test' group by all),
asked as (
    select p.*, a.names[1] as upper, list_contains(p.moved, upper) as goes, s.least
    from plans as p join seen as s using (split, scene_id)
    left join shard_families as f using (split, shard)
    join loads as a on a.scene_id = p.scene_id and a.base = p.reference
    left join loads as b on b.scene_id = p.scene_id and b.base = p.subject
    where p.holds and p.predicate = 'on' and f.family = 'on' and len(a.names) = 1
        and a.names[1] <> p.subject and b.base is null)
select * from (
    select *, row_number() over (
        partition by goes order by twin desc, ambiguous, least < ?,
            len(moved), md5(scene_id), md5(plan_id)) as nth
    from (
        select *, count(distinct goes) over (partition by split, scene_id, reference) = 2 as twin
        from asked))
where nth = 1
order by goes desc
"""


def seen_scene(dataset: Dataset) -> tuple[Drawing, str] | None:
    """Figure 1: a scene from above, its picture, and the three views that ask about a query."""
    rows = _rows(dataset, _ONE)
    if not rows:
        return None
    [row] = rows
    given = {"sample": _sample(dataset, row), "row": row, "query": row["away"][0]}
    drawing = Drawing(
        name="figure-1",
        draw=_scene,
        size=(9.2, 2.6),
        widths=(1.05, 1.75, 0.6, 0.6, 0.6),
        given=given,
    )
    return drawing, (
        f"Figure 1: scene {row['scene_id']}, goal {_goal(row)}. From above (the robot stands "
        "below the edge, dashed: where the subject may stand), as the camera sees it, and the "
        f"canonical views of subject, reference and query: {given['query']} is relevant, it has "
        "to be moved."
    )


def stacked_pair(dataset: Dataset) -> tuple[Drawing, str] | None:
    """Figure 4: an `on` goal for which the upper box must go, and one for which it need not."""
    rows = _rows(dataset, _ON)
    if len(rows) < 2:
        return None
    given = {"pair": [(_sample(dataset, row), row) for row in rows]}
    drawing = Drawing(name="figure-4", draw=_pair, size=(9.2, 3.4), widths=(1.0, 1.0), given=given)
    must, need_not = rows
    same = must["scene_id"] == need_not["scene_id"] and must["reference"] == need_not["reference"]
    return drawing, (
        f"Figure 4: {_goal(must)}, for which {must['upper']} has to leave, and {_goal(need_not)}, "
        f"for which {need_not['upper']} may stay"
        + (": the same scene and reference, another subject. Scene " if same else ". Scenes ")
        + " and ".join(dict.fromkeys((must["scene_id"], need_not["scene_id"])))
        + "."
    )


def _rows(dataset: Dataset, query: str) -> list[dict[str, Any]]:
    names = ("scenes", "plans", "objects", "carried", "shard_families")
    with dataset.connect(names=names) as connection:
        found = connection.execute(query, [_PLAIN])
        names = [column[0] for column in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def _sample(dataset: Dataset, row: Mapping[str, Any]) -> Sample:
    samples = dataset.samples(row["split"], [row["shard"]])
    return next(sample for sample in samples if sample.key == row["scene_id"])


def _goal(row: Mapping[str, Any]) -> str:
    return f"{row['predicate']}({row['subject']}, {row['reference']})"


def _scene(*axes: Axes, sample: Sample, row: Mapping[str, Any], query: str) -> None:
    plan, picture, *views = axes
    _from_above(plan, sample, row)
    roles = {"subject": row["subject"], "reference": row["reference"], "query": query}
    _picture(picture, sample, roles)
    picture.set_title("picture")
    for ax, (role, name) in zip(views, roles.items(), strict=True):
        ax.imshow(sample.views[sample.scene.names.index(name)], interpolation="nearest")
        ax.set_axis_off()
        ax.set_title(f"{role}\n{name}", fontsize=8.5)


def _from_above(ax: Axes, sample: Sample, row: Mapping[str, Any]) -> None:
    """The table as the robot sees it: x is up, y to the left."""
    scene = sample.scene
    depth, width = scene.table.size
    ax.add_patch(
        Rectangle(
            (-width / 2, -depth / 2), width, depth, facecolor=scene.table.color, edgecolor=FAINT
        )
    )
    for box in sorted(scene.objects, key=lambda box: box.top):
        ax.add_patch(
            Polygon(_turned(box.corners()), facecolor=box.color, edgecolor=INK, linewidth=0.6)
        )
        letter = {row["subject"]: "S", row["reference"]: "R"}.get(box.name)
        if letter:
            x, y = box.position[:2]
            ax.text(
                -y,
                x,
                letter,
                ha="center",
                va="center",
                fontsize=7.5,
                color=INK,
                bbox={"boxstyle": "circle,pad=0.15", "facecolor": CARD_SUBJECT, "lw": 0},
            )
    predicate = PREDICATES[row["predicate"]]
    region = predicate.region(scene[row["subject"]], scene[row["reference"]], scene.robot)
    for area in region.rectangles:
        box = Box(
            name="area",
            size=(2 * area.half[0], 2 * area.half[1], 0.01),
            position=(area.x, area.y, 0.0),
            yaw=area.angle,
            color=(0, 0, 0),
        )
        ax.add_patch(
            Polygon(_turned(box.corners()), fill=False, edgecolor=INK, linestyle="--", linewidth=1)
        )
    points = _turned(np.vstack([box.corners() for box in scene.objects]))
    low, high = points.min(axis=0) - 0.08, points.max(axis=0) + 0.08
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    ax.set_title("scene, from above")
    ax.set_xticks([])
    ax.set_yticks([])
    ax.grid(visible=False)


def _turned(points: np.ndarray) -> np.ndarray:
    return np.stack([-points[:, 1], points[:, 0]], axis=1)


def _picture(ax: Axes, sample: Sample, roles: Mapping[str, str], color: str = RELEVANT) -> None:
    """The picture, subject and reference tagged, the query outlined."""
    ax.imshow(sample.image, interpolation="nearest")
    for role, name in roles.items():
        shown = sample.mask == sample.scene.names.index(name) + 1
        if not shown.any():
            continue
        y, x = (float(values.mean()) for values in np.nonzero(shown))
        if role == "query":
            for width, ink in ((3.0, CARD_SUBJECT), (1.6, color)):
                ax.contour(shown, levels=[0.5], colors=[ink], linewidths=width)
        ax.text(
            x,
            y,
            role[0].upper(),
            ha="center",
            va="center",
            fontsize=7.5,
            color=CARD_REFERENCE,
            bbox={"boxstyle": "circle,pad=0.15", "facecolor": CARD_SUBJECT, "lw": 0},
        )
    ax.set_axis_off()


def _pair(*axes: Axes, pair: Sequence[tuple[Sample, Mapping[str, Any]]]) -> None:
    for ax, (sample, row) in zip(axes, pair, strict=True):
        roles = {"subject": row["subject"], "reference": row["reference"], "query": row["upper"]}
        _picture(ax, sample, roles, RELEVANT if row["goes"] else GREY)
        verdict = "must go: relevant" if row["goes"] else "may stay: irrelevant"
        ax.set_title(f"{_goal(row)}\nQ, {row['upper']}, {verdict}", fontsize=9)
        ax.title.set_color(INK if row["goes"] else MUTED)
