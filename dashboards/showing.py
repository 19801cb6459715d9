"""What pages are made of: figures, plots, pictures of goals, and what to do where nothing is."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import cv2
import streamlit as st

from dashboards.asking import Choice
from relevance.store import Sample

_FONT = "system-ui, 'Liberation Sans', sans-serif"
_ALONE = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
"""A picture is a file of its own, which has no page to take its names from."""


def plain(text: str) -> str:
    """Text as Markdown that shows it as it is: names are chosen by people."""
    return re.sub(r"([\\`*_\[\]#<>~$:])", r"\\\1", text)


def tighten() -> None:
    """Less empty room above a page than Streamlit leaves."""
    st.html("<style>[data-testid=stMainBlockContainer] { padding-top: 2.5rem }</style>")


def figures(*shown: tuple[str, str, str], columns: int = 0) -> None:
    """Headline figures side by side: label, value, and what it rests on."""
    places = st.columns(max(len(shown), columns))
    for column, (label, value, note) in zip(places, shown, strict=False):
        with column.container(gap=None):
            st.metric(label, value)
            st.caption(plain(note))


def drawing(svg: str, *, width: int = 620) -> None:
    """A plot of the report, at most that many pixels wide."""
    st.image(svg.replace("var(--font)", _FONT).replace("<svg ", _ALONE, 1), width=width)


def plot(name: str, draw: Callable[..., None], **given: Any) -> None:
    """Draw one of the report's plots into the page; `size` in inches."""
    from relevance.report.plots import svg  # matplotlib and the planner: after the first figures

    size = given.get("size", (4.8, 2.9))
    drawing(svg(name, draw, **given), width=round(130 * size[0]))


def command(*lines: str) -> None:
    """Lines for a shell."""
    st.code("\n".join(lines), language="sh", wrap_lines=True)


def lacking(said: str, *lines: str) -> None:
    """What a page lacks, and the commands that make it."""
    st.info(said)
    command(*lines)


def without_predictions(choice: Choice) -> bool:
    """Say what to do when there is nothing of the checkpoint to show; whether that was so."""
    if choice.checkpoint is None:
        lacking(
            "Nothing was trained on this dataset yet. These commands train a model, score the "
            "test split with it and rerun the planner:",
            f"relevance train {choice.path}",
            f"relevance evaluate {choice.path}",
        )
        return True
    return False


def goal_of(task: Mapping[str, Any]) -> str:
    """A goal as people write it."""
    return f"{task['predicate']}({task['subject']}, {task['reference']})"


def steps(task: Mapping[str, Any]) -> list[str]:
    """A plan in words."""
    words = []
    for verb, name, *support in task["actions"]:
        words.append(f"{verb} {name}" + (f" on {support[0]}" if support else ""))
    return words


def picture(task: Mapping[str, Any], sample: Sample, beta: float) -> str:
    """A goal's scene as SVG, outlined."""
    from relevance.report.gallery import outlined

    return outlined(
        sample,
        relevant=set(task["relevant"]),
        subject=task["subject"],
        reference=task["reference"],
        scores=task["scores"],
        beta=beta,
    )


def legend(scored: bool) -> None:
    """What the outlines say."""
    from relevance.report.style import KEPT, LOST, RELEVANT

    marks = [(RELEVANT, "solid", "relevant: the plan moves it")]
    if scored:
        marks[0] = (RELEVANT, "solid", "relevant, and kept")
        marks.append((LOST, "dashed", "relevant, but left out"))
        marks.append((KEPT, "dashed", "kept, though irrelevant"))
    words = " &emsp; ".join(
        f'<span style="display:inline-block;width:1em;height:.8em;border:2.5px {line} {color};'
        f'border-radius:3px;margin-right:.4em"></span>{text}'
        for color, line, text in marks
    )
    st.html(
        f'<p style="font-size:.875rem;margin:0">{words} &emsp; <b>S</b> subject &emsp; '
        "<b>R</b> reference</p>"
    )


def views(task: Mapping[str, Any], sample: Sample, beta: float) -> None:
    """Every object's canonical view, in the order of its score, with what is known of it."""
    from relevance.report.style import FAINT, KEPT, LOST, MUTED, RELEVANT

    scores: Mapping[str, float] = task["scores"]
    boxes = list(zip(sample.scene.objects, sample.views, strict=True))
    boxes.sort(key=lambda pair: -scores.get(pair[0].name, 0.0))
    cards = []
    for box, view in boxes:
        roles = {task["subject"]: "subject", task["reference"]: "reference"}
        relevant, score = box.name in task["relevant"], scores.get(box.name)
        kept = box.name in roles or score is None or score > -beta
        color = (RELEVANT if kept else LOST) if relevant else FAINT
        if score is not None and kept and not relevant and box.name not in roles:
            color = KEPT
        said = [roles.get(box.name, ""), "relevant" if relevant else "irrelevant"]
        if not task["holds"]:
            said[1] = ""
        if score is not None:
            verdict = "" if box.name in roles else (", kept" if kept else ", left out")
            said.append(f"score {score:+.1f}{verdict}")
        done, png = cv2.imencode(".png", cv2.cvtColor(view, cv2.COLOR_RGB2BGR))
        assert done, "the PNG encoder takes any uint8 image"
        data = base64.b64encode(png.tobytes()).decode()
        lines = "<br>".join(escape(word) for word in said if word)
        cards.append(
            f'<div style="width:112px"><img alt="{escape(box.name)}" '
            f'src="data:image/png;base64,{data}" style="width:96px;height:96px;display:block;'
            f'image-rendering:pixelated;border:3px solid {color};border-radius:6px">'
            f'<div style="font-size:.85rem;overflow-wrap:anywhere"><b>{escape(box.name)}</b></div>'
            f'<div style="font-size:.78rem;color:{MUTED};line-height:1.3">{lines}</div></div>'
        )
    st.html(f'<div style="display:flex;flex-wrap:wrap;gap:12px">{"".join(cards)}</div>')


def table(rows: Sequence[Mapping[str, Any]], titles: Mapping[str, str], shares: str = "") -> None:
    """Rows under titles a reader knows, columns in their order; `shares` names those in 0..1."""
    shown = [{title: row[name] for name, title in titles.items()} for row in rows]
    percent = st.column_config.NumberColumn(format="percent")
    columns = {titles[name]: percent for name in shares.split() if name in titles}
    st.dataframe(shown, hide_index=True, column_config=columns)
