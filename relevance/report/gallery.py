"""Example scenes: the picture, and over it the outlines of the objects that matter."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import cv2
import numpy as np

from relevance.hashing import content_hash
from relevance.report.style import INK, KEPT, LOST, RELEVANT
from relevance.scene import PREDICATES, Scene, project, vertices
from relevance.store import Dataset, Sample

Rows = Callable[..., list[dict[str, Any]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """One task with its picture."""

    anchor: str
    goal: str
    scene_id: str
    picture: str
    """SVG."""
    plan: str
    """Actions in words; empty without a plan."""
    status: str
    scores: Sequence[tuple[str, str, bool, float | None]]
    """Name, colour (#rrggbb), relevant, score (None: no prediction), of every object."""
    note: str


def anchor(row: Mapping[str, Any]) -> str:
    """Name of a task on the page."""
    task = [row[key] for key in ("scene_id", "predicate", "subject", "reference")]
    return f"task-{content_hash(task)}"


def choose_examples(
    rows: Rows,
    checkpoint_id: str | None,
    *,
    missed: Sequence[Mapping[str, Any]] = (),
    per_predicate: int = 2,
    most_missed: int = 4,
) -> list[dict[str, Any]]:
    """Test tasks to show: of each predicate those with most blockers, and some that were missed.

    `missed` holds the evaluation rows of tasks that a guide failed and the unguided run solved.
    What is relevant is what the labels that `rows` sees say.
    """
    wanted = rows(
        """
        with tasks as (
            select *, len(list_filter(moved, lambda name: name not in (subject, reference)))
                as n_blockers
            from plans left join shard_families using (split, shard)
            where split = 'test' and holds
        )
        select * from (
            select *, row_number() over (
                partition by family, predicate
                order by least(n_blockers, 2) desc, md5(plan_id)) as nth
            from tasks)
        where nth <= ?
        """,
        per_predicate,
    )
    failed = {anchor(row): row for row in missed}
    chosen = {anchor(row): row for row in wanted}
    for row in list(failed.values())[:most_missed]:
        task = [row[key] for key in ("scene_id", "predicate", "subject", "reference")]
        chosen |= {
            anchor(plan): plan
            for plan in rows(
                """
                select * from plans where split = 'test' and status = 'solved'
                    and scene_id = ? and predicate = ? and subject = ? and reference = ?
                """,
                *task,
            )
        }
    labels = rows(
        """
        select plan_id, list(query order by query) filter (relevant) as relevant
        from labels where plan_id in (select unnest(?::varchar[])) group by plan_id
        """,
        [row["plan_id"] for row in chosen.values()],
    )
    relevant = {row["plan_id"]: row["relevant"] or [] for row in labels}
    predictions = rows(
        """
        select scene_id, predicate, subject, reference, query, score from predictions
        where checkpoint_id = ? and scene_id in (select unnest(?::varchar[]))
        """,
        checkpoint_id,
        [row["scene_id"] for row in chosen.values()],
    )
    scores: dict[str, dict[str, float]] = {}
    for row in predictions:
        scores.setdefault(anchor(row), {})[row["query"]] = row["score"]
    order = list(PREDICATES)
    for key, row in chosen.items():
        row |= {
            "anchor": key,
            "note": f"Missed by {failed[key]['guide']}." if key in failed else "",
            "scores": scores.get(key, {}),
            "relevant": relevant.get(row["plan_id"], []),
        }
    return sorted(chosen.values(), key=lambda r: (bool(r["note"]), order.index(r["predicate"])))


def draw_examples(dataset: Dataset, chosen: Sequence[dict[str, Any]]) -> list[Example]:
    """Read the scenes of the chosen tasks and outline what matters in each."""
    samples = test_samples(dataset, chosen)
    return [_example(samples[row["scene_id"]], row) for row in chosen]


def test_samples(dataset: Dataset, rows: Sequence[Mapping[str, Any]]) -> dict[str, Sample]:
    """The pictures of the scenes of test tasks, by the scene's id."""
    shards = sorted({row["shard"] for row in rows})
    wanted = {row["scene_id"] for row in rows}
    return {
        sample.key: sample
        for sample in (dataset.samples("test", shards) if shards else ())
        if sample.key in wanted
    }


def _example(sample: Sample, row: dict[str, Any]) -> Example:
    scores, relevant = row["scores"], set(row["relevant"])
    return Example(
        anchor=row["anchor"],
        goal=f"{row['predicate']}({row['subject']}, {row['reference']})",
        scene_id=row["scene_id"],
        picture=outlined(
            sample,
            relevant=relevant,
            subject=row["subject"],
            reference=row["reference"],
            scores=scores,
        ),
        plan=in_words(row["actions"]),
        status=row["status"],
        scores=[
            (box.name, _hex(box.color), box.name in relevant, scores.get(box.name))
            for box in sample.scene.objects
        ],
        note=row["note"],
    )


def in_words(actions: Iterable[Sequence[str]]) -> str:
    """A plan's actions, one after the other."""
    return " → ".join(
        f"{action[0]} {action[1]}" + (f" on {action[2]}" if len(action) > 2 else "")
        for action in actions
    )


def outlined(
    sample: Sample,
    *,
    relevant: set[str],
    subject: str,
    reference: str,
    scores: Mapping[str, float] | None = None,
    beta: float = 0.0,
    final: Sequence[Mapping[str, Any]] = (),
) -> str:
    """A scene as SVG: relevant objects outlined, goal objects tagged S and R.

    With scores, queries that the network judges wrongly get a dashed outline. `final` (of `plans`)
    says where each moved object ends: an arrow goes there, numbered in the order of the moves.
    """
    height, width = sample.mask.shape
    done, png = cv2.imencode(".png", cv2.cvtColor(sample.image, cv2.COLOR_RGB2BGR))
    assert done, "the PNG encoder takes any uint8 image"
    picture = base64.b64encode(png.tobytes()).decode()
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escape(f"{subject}, {reference}")}">',
        f'<image href="data:image/png;base64,{picture}" width="{width}" height="{height}"/>',
    ]
    tags = []
    for number, box in enumerate(sample.scene.objects, 1):
        mask = (sample.mask == number).astype(np.uint8)
        goal_object = box.name in (subject, reference)
        kept = goal_object or not scores or scores.get(box.name, 0.0) > -beta
        color = None
        if box.name in relevant:
            color = RELEVANT if kept else LOST
        elif scores and kept and not goal_object:
            color = KEPT
        if color:
            dashes = "" if color == RELEVANT else ' stroke-dasharray="4 2.5"'
            path = _path(mask)
            parts.append(
                f'<path d="{path}" fill="none" stroke="#fff" stroke-width="4" '
                'stroke-linejoin="round" opacity="0.9"/>'
                f'<path d="{path}" fill="none" stroke="{color}" stroke-width="2" '
                f'stroke-linejoin="round"{dashes}><title>{escape(box.name)}</title></path>'
            )
        if goal_object and mask.any():
            ys, xs = np.nonzero(mask)
            x, y = float(xs.mean()), float(ys.mean())
            letter = "S" if box.name == subject else "R"
            tags.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="#fff" stroke="{INK}"/>'
                f'<text x="{x:.1f}" y="{y + 3.4:.1f}" text-anchor="middle" font-size="9.5" '
                f'font-weight="700" font-family="system-ui, sans-serif" fill="{INK}">{letter}'
                f"<title>{escape(box.name)}</title></text>"
            )
    moves = [_move(sample.scene, place, number) for number, place in enumerate(final, 1)]
    return "".join([*parts, *moves, *tags, "</svg>"])


def _move(scene: Scene, place: Mapping[str, Any], number: int) -> str:
    """An arrow from where a box stands to where it ends, whose top face is drawn there."""
    box = scene[place["name"]]
    there = replace(box, position=tuple(place["position"]), yaw=place["yaw"])
    tops = np.array([[*b.position[:2], b.top] for b in (box, there)])
    (start, end), _ = project(scene.camera, tops)
    face, _ = project(scene.camera, vertices(there)[4:])
    way = end - start
    length = max(float(np.hypot(*way)), 1e-6)
    ahead, beside = way / length, np.array([-way[1], way[0]]) / length
    # the number stands at the end, and the arrow's head just before it
    tip = end - ahead * min(6.0, length / 2)
    head = [tip, *(tip - 7 * ahead + side * beside for side in (3.2, -3.2))]
    color = _hex(box.color)
    x, y = end
    return (
        f"<g><title>{number}: {escape(box.name)}</title>"
        f'<polygon points="{_points(face)}" fill="{color}" fill-opacity="0.35" stroke="{INK}" '
        'stroke-dasharray="3 2"/>'
        f'<path d="M{_points([start, tip])}" stroke="#fff" stroke-width="3.6" fill="none"/>'
        f'<path d="M{_points([start, tip])}" stroke="{INK}" stroke-width="1.6" fill="none"/>'
        f'<polygon points="{_points(head)}" fill="{INK}" stroke="#fff" stroke-width="0.8"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5.5" fill="{INK}"/>'
        f'<text x="{x:.1f}" y="{y + 2.9:.1f}" text-anchor="middle" font-size="8" '
        f'font-weight="700" font-family="system-ui, sans-serif" fill="#fff">{number}</text></g>'
    )


def _points(points: Iterable[Sequence[float] | np.ndarray]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


def _path(mask: np.ndarray) -> str:
    """SVG path of a mask's outlines; pixel centres lie half a pixel in."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_TC89_L1)
    parts = []
    for contour in contours:
        points = " ".join(f"{x + 0.5:g},{y + 0.5:g}" for x, y in contour[:, 0])
        parts.append(f"M{points}Z")
    return "".join(parts)


def _hex(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * value):02x}" for value in color)
