"""The dataset card: one folder with a page of Markdown and its pictures, nothing else needed.

Numbers come from the SQL views; pictures are PNG, so that the page reads anywhere, with a few
example scenes drawn from the stored images.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from relevance.report.style import (
    BOUND_COLOR,
    CARD_REFERENCE,
    CARD_RELEVANT,
    CARD_SUBJECT,
    GREY,
    GROUPS,
    SPLIT_COLOR,
    family_color,
    named,
)
from relevance.report.tables import Statistics, Table, cell, statistics
from relevance.scene import FAMILIES
from relevance.store import Dataset, decode, replacing

PAGE = "README.md"
MADE_WITH = ("relevance", "numpy", "pybullet", "casadi", "numba", "pyarrow", "duckdb")
"""Packages whose versions the card states."""
ACCURACY = (
    "How right networks are on it: `relevance report` and `relevance dashboard` under Accuracy; "
    "in SQL the view `judged`."
)
_WIDTH, _DPI = 7.2, 110


def write_card(root: str | Path, out: str | Path) -> Path:
    """Write a dataset's card into a folder (made if needed); returns its page.

    Equal datasets give an equal page but for the times that they took. Raises DatasetError when
    there is no dataset.
    """
    dataset, found, out = Dataset.open(root), statistics(root), Path(out)
    pictures: dict[str, str] = {}
    for name, (title, draw) in _PICTURES.items():
        figure = draw(found)
        if figure is not None:
            _save(figure, out / f"{name}.png")
            pictures[name] = title
    for family in FAMILIES:
        drawn = _drawn(dataset, family)
        if drawn is not None:
            _save(drawn, out / f"scenes-{family}.png")
            pictures[f"scenes-{family}"] = f"Random scenes of family {family}"
    examples = _examples(dataset)
    if examples is not None:
        _save(examples, out / "examples.png")
        pictures["examples"] = (
            "Example scenes: subject outlined in white, reference in black, relevant in pink"
        )
    page = out / PAGE
    with replacing(page) as temporary:
        temporary.write_text(card(found, dataset, pictures), encoding="utf-8")
    return page


def _save(figure: Figure, file: Path) -> None:
    with replacing(file) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI, metadata={"Software": None})


def card(found: Statistics, dataset: Dataset, pictures: Mapping[str, str] = {}) -> str:
    """The page: what there is, pictures (file stem -> title), tables, and what made it."""
    lines = [f"# Dataset {Path(found.path).resolve().name}", "", _summary(found), "", ACCURACY, ""]
    for name, title in pictures.items():
        lines += [f"![{title}]({name}.png)", "", f"*{title}.*", ""]
    for table in found.tables:
        lines += ["", f"## {table.title}", "", *_markdown(table)]
    lines += ["", "## Provenance", "", *_provenance(dataset)]
    return "\n".join(lines) + "\n"


def _summary(found: Statistics) -> str:
    shares = {
        family: f"{100 * relevant / queries:.1f}% of {queries} ({family})"
        for family, (queries, relevant) in _balance(found).items()
        if queries
    }
    return (
        f"{found.scenes} scenes, {found.goals} goals, {found.plans} plans that hold, "
        f"{found.queries} queries; relevant are {' and '.join(shares.values()) or 'none'}. "
        f"{found.shards[0]} of {found.shards[1]} shards made, "
        f"{found.labelled[0]} of {found.labelled[1]} labelled."
    )


def _provenance(dataset: Dataset) -> list[str]:
    description = dataset.description
    config = description.get("config", {})
    rows = {
        "content hash of labels and images": dataset.content_hash(),
        "seed": config.get("seed"),
        "scene settings (hash)": description.get("hashes", {}).get("scenes"),
        "plan settings (hash)": description.get("hashes", {}).get("plans"),
        "planner version": description.get("planner_version"),
        "label policy": config.get("policy"),
        "schema versions": ", ".join(f"{k} {v}" for k, v in description.get("tables", {}).items()),
        "merged from": ", ".join(str(source.dataset.path.name) for source in dataset.sources),
        "card written with": ", ".join(
            [f"Python {sys.version.split()[0]}", *(f"{name} {version(name)}" for name in MADE_WITH)]
        ),
    }
    lines = [_bar(("what", "value")), _bar(("---", "---"))]
    lines += [_bar((name, str(value))) for name, value in rows.items() if value not in (None, "")]
    return [
        *lines,
        "",
        "Every setting:",
        "",
        "```json",
        json.dumps(config, indent=2, sort_keys=True),
        "```",
    ]


def _markdown(table: Table) -> list[str]:
    if not table.rows:
        return ["None."]
    lines = [_bar(table.columns), _bar("---" for _ in table.columns)]
    return lines + [_bar(cell(value) for value in row) for row in table.rows]


def _bar(cells: Iterable[str]) -> str:
    return "| " + " | ".join(text.replace("|", "\\|") for text in cells) + " |"


# pictures ---------------------------------------------------------------------------------------


def _dicts(table: Table) -> list[dict[str, Any]]:
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def _figure(columns: int, height: float = 2.6) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, columns))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
        ax.title.set_fontsize(9)
        ax.xaxis.label.set_fontsize(8)
        ax.yaxis.label.set_fontsize(8)
    return figure, list(axes)


def _balance(found: Statistics) -> dict[str, tuple[int, int]]:
    """Queries and relevant ones of each family."""
    sums: dict[str, tuple[int, int]] = {group: (0, 0) for group in GROUPS}
    for row in _dicts(found["label_balance"]):
        family = row["family"]
        queries, relevant = sums[family]
        sums[family] = queries + row["queries"], relevant + row["relevant"]
    return sums


def _label_balance(found: Statistics) -> Figure | None:
    rows = named(row for row in _dicts(found["label_balance"]) if row["queries"])
    if not rows:
        return None
    figure, (ax,) = _figure(1)
    predicates = list(dict.fromkeys(row["group"] for row in rows))
    splits = [s for s in SPLIT_COLOR if any(r["split"] == s for r in rows)]
    width = 0.8 / len(splits)
    for i, split in enumerate(splits):
        mine = {row["group"]: row["relevant_share"] for row in rows if row["split"] == split}
        at = np.array([predicates.index(p) for p in mine]) + (i - (len(splits) - 1) / 2) * width
        ax.bar(at, [100 * s for s in mine.values()], width, label=split, color=SPLIT_COLOR[split])
    ax.set_xticks(range(len(predicates)), predicates)
    ax.set_ylabel("relevant queries, %")
    ax.legend(fontsize=8, frameon=False)
    return figure


def _shares(
    ax: Axes, rows: list[dict[str, Any]], key: str, count: str, family: Callable[[Any], str]
) -> None:
    """Bars: for each family, the share of each value of `key`."""
    values = sorted({row[key] for row in rows})
    families = [f for f in GROUPS if any(family(row) == f for row in rows)]
    width = 0.8 / max(len(families), 1)
    for i, name in enumerate(families):
        mine = [row for row in rows if family(row) == name]
        total = sum(row[count] for row in mine)
        heights = [100 * sum(r[count] for r in mine if r[key] == v) / total for v in values]
        at = np.arange(len(values)) + (i - (len(families) - 1) / 2) * width
        ax.bar(at, heights, width, label=name, color=family_color(name))
    ax.set_xticks(range(len(values)), [str(value) for value in values])
    ax.set_ylabel("%")


def _lengths(found: Statistics) -> Figure | None:
    lengths, blockers = _dicts(found["plan_lengths"]), _dicts(found["plan_blockers"])
    if not lengths:
        return None
    figure, (left, right) = _figure(2)
    for ax, rows, key, label in (
        (left, lengths, "n_actions", "actions of the plan"),
        (right, blockers, "blockers", "objects in the way"),
    ):
        _shares(ax, rows, key, "plans", lambda row: row["family"])
        ax.set_xlabel(label)
    left.legend(fontsize=8, frameon=False)
    return figure


def _sizes(found: Statistics) -> Figure | None:
    rows = _dicts(found["by_size"])
    if not rows:
        return None
    figure, axes = _figure(3)
    for ax, key, label, factor in (
        (axes[0], "relevant_share", "relevant queries, %", 100),
        (axes[1], "plan_share", "goals with a plan, %", 100),
        (axes[2], "median_seconds", "median planning time, ms", 1000),
    ):
        for family in GROUPS:
            mine = [r for r in rows if r["family"] == family and r[key] is not None]
            if mine:
                ax.plot(
                    [row["n_objects"] for row in mine],
                    [factor * row[key] for row in mine],
                    marker="o",
                    markersize=3,
                    color=family_color(family),
                    label=family,
                )
        ax.set_xlabel("boxes")
        ax.set_ylabel(label)
        ax.set_ylim(bottom=0)
    axes[0].legend(fontsize=8, frameon=False)
    return figure


def _visibility(found: Statistics) -> Figure | None:
    rows = _dicts(found["visibility_tenths"])
    if not rows:
        return None
    figure, (ax,) = _figure(1, 2.2)
    _shares(ax, rows, "tenth", "objects", lambda row: row["family"])
    names = [f"{10 * int(tick.get_text())}+" for tick in ax.get_xticklabels()]
    ax.set_xticks(range(len(names)), names)
    ax.set_xlabel("share of the object that shows, %")
    ax.set_ylabel("objects, %")
    ax.legend(fontsize=8, frameon=False)
    return figure


def _failures(found: Statistics) -> Figure | None:
    goals: dict[str, int] = {}
    for row in _dicts(found["plan_failures"]):
        goals[row["reason"]] = goals.get(row["reason"], 0) + row["goals"]
    if not goals:
        return None
    ordered = sorted(goals.items(), key=lambda item: (item[1], item[0]))[-8:]
    figure, (ax,) = _figure(1, 0.7 + 0.28 * len(ordered))
    bars = ax.barh(
        [name for name, _ in ordered], [100 * n / found.goals for _, n in ordered], color=GREY
    )
    ax.bar_label(bars, [str(n) for _, n in ordered], fontsize=8, padding=3)
    ax.set_xlabel("goals, %")
    return figure


def _seconds(found: Statistics) -> Figure | None:
    rows = named(_dicts(found["bound_seconds"]))
    if not rows:
        return None
    figure, (ax,) = _figure(1, 2.4)
    names = [row["group"] for row in rows]
    left = np.zeros(len(rows))
    for part, color in BOUND_COLOR.items():
        widths = np.array([1000 * (row[part] or 0.0) / row["goals"] for row in rows])
        ax.barh(names, widths, left=left, color=color, label=part)
        left += widths
    ax.set_xlabel("mean time a goal, ms")
    ax.legend(fontsize=8, frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


_PICTURES: dict[str, tuple[str, Callable[[Statistics], Figure | None]]] = {
    "balance": ("Relevant share of the queries", _label_balance),
    "lengths": ("Plan lengths, and objects in the way", _lengths),
    "sizes": ("What the number of boxes does", _sizes),
    "failures": ("Goals without a plan, by reason", _failures),
    "visibility": ("How much of the objects shows", _visibility),
    "seconds": ("Planning time by bound (replays left out)", _seconds),
}


_SHOWN = 12
"""Random scenes of each family in the card."""


def _drawn(dataset: Dataset, family: str) -> Figure | None:
    """Some scenes of a family, drawn by the hash of their ids."""
    with dataset.connect() as connection:
        rows = connection.execute(
            "SELECT scene_id, split, shard FROM scenes WHERE family = ?"
            " ORDER BY md5(scene_id) LIMIT ?",
            [family, _SHOWN],
        ).fetchall()
    if not rows:
        return None
    wanted = {scene_id for scene_id, _, _ in rows}
    images = {
        members["__key__"]: decode(members).image
        for split, shard in sorted({(split, shard) for _, split, shard in rows})
        for members in dataset.undecoded(split, shard)
        if members["__key__"] in wanted
    }
    figure = Figure(figsize=(_WIDTH, 1.12 * -(-len(rows) // 4)), layout="constrained")
    grid = figure.subplots(-(-len(rows) // 4), 4, squeeze=False).ravel()
    for ax in grid:
        ax.set_axis_off()
    for ax, (scene_id, _, _) in zip(grid, rows, strict=False):
        ax.imshow(images[scene_id])
    return figure


_EXAMPLES = """
    SELECT
        p.scene_id, p.split, p.shard, f.family, p.predicate, p.subject, p.reference, p.n_actions,
        coalesce(l.relevant, []) AS relevant
    FROM plans AS p LEFT JOIN shard_families AS f USING (split, shard) LEFT JOIN (
        SELECT plan_id, list(query) FILTER (relevant) AS relevant FROM labels GROUP BY plan_id
    ) AS l USING (plan_id)
    WHERE p.holds
    QUALIFY row_number() OVER (
        PARTITION BY f.family, p.predicate
        ORDER BY p.split <> 'test', least(p.n_actions, 4) DESC, md5(p.plan_id)) = 1
    ORDER BY f.family, p.predicate
"""


def _examples(dataset: Dataset) -> Figure | None:
    """One scene for each predicate of each family, with what is relevant in it."""
    with dataset.connect() as connection:
        found = connection.execute(_EXAMPLES)
        names = [column[0] for column in found.description or ()]
        rows = [dict(zip(names, row, strict=True)) for row in found.fetchall()]
    if not rows:
        return None
    figure = Figure(figsize=(_WIDTH, 1.75 * -(-len(rows) // 2)), layout="constrained")
    grid = figure.subplots(-(-len(rows) // 2), 2, squeeze=False).ravel()
    for ax in grid:
        ax.set_axis_off()
    for ax, row in zip(grid, rows, strict=False):
        sample = next(
            s for s in dataset.samples(row["split"], [row["shard"]]) if s.key == row["scene_id"]
        )
        ax.imshow(sample.image)
        colors = dict.fromkeys(row["relevant"], CARD_RELEVANT)
        colors |= {row["subject"]: CARD_SUBJECT, row["reference"]: CARD_REFERENCE}
        for name, color in colors.items():
            shown = sample.mask == sample.scene.names.index(name) + 1
            ax.contour(shown, levels=[0.5], colors=[color], linewidths=1.4)
        title = f"{row['predicate']}({row['subject']}, {row['reference']}): {row['n_actions']}"
        ax.set_title(f"{title} actions", fontsize=7.5)
    return figure
