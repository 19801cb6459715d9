"""Checkpoints: how they learned and where they err, one beside another."""

from dataclasses import replace
from typing import Any

import streamlit as st

from dashboards.asking import Choice, ask, chosen
from dashboards.showing import figures, lacking, plot, table, without_predictions
from relevance.evaluation import (
    BREAKDOWNS,
    NETWORK,
    RULE,
    Predictions,
    accuracy_table,
    breakdown_table,
    read_predictions,
    unjudged,
)
from relevance.report import charts, plots
from relevance.report.network import training_history
from relevance.report.paper import paper
from relevance.report.style import DASH, percent
from relevance.scene import FAMILIES

TITLES = {
    "true_relevant": "true relevant",
    "true_irrelevant": "true irrelevant",
    "total": "total",
    "rule": "the rule's total",
    "base_rate": "always irrelevant",
    "balanced": "balanced",
    "average_precision": "average precision",
    "calibration_error": "calibration error",
    "set_recall": "set recall",
    "tasks_whole": "goals kept whole",
    "tasks_right": "goals all right",
    "relevant": "relevant",
    "tasks": "goals",
    "objects": "objects",
}
SHARES = " ".join(list(TITLES)[:-2])
DRAWN = ("n_objects", "predicate", "stands", "visible")
"""Breakdowns that are drawn, in the order in which they fill the columns."""


def predicted(choice: Choice) -> tuple[Predictions, list[str]]:
    """A checkpoint's predictions on the split, and what to know of them."""
    return _predicted(replace(choice, beta=0.0))  # the same ones at every beta


@st.cache_resource(show_spinner=False, max_entries=4)  # not copied: they are large
def _predicted(choice: Choice) -> tuple[Predictions, list[str]]:
    name = choice.checkpoint or ""
    found = read_predictions(choice.dataset, name, split=choice.split)
    return found, unjudged(choice.dataset, name, split=choice.split)


@st.cache_data(show_spinner=False, max_entries=40)
def judged(choice: Choice, goal_objects: bool = False) -> list[dict[str, Any]]:
    """The network beside the rules."""
    found, _ = predicted(choice)
    return accuracy_table(found if goal_objects else found.queries(), beta=choice.beta)


@st.cache_data(show_spinner=False, max_entries=80)
def by_part(choice: Choice, by: str) -> list[dict[str, Any]]:
    """The network by parts of the queries."""
    return breakdown_table(predicted(choice)[0].queries(), by, beta=choice.beta)


def show(choice: Choice, row: dict[str, Any], *, columns: int) -> None:
    """One checkpoint, its plots in that many columns."""
    name = str(choice.checkpoint)
    st.subheader(name, anchor=False)
    took = row["train_seconds"]
    minutes = f"{took / 60:.0f} min" if took >= 60 else f"{took:.0f} s"
    st.caption(
        f"Body {row['body']}, preset {row['preset']}, trained {row['created']:%Y-%m-%d %H:%M} UTC "
        f"in {minutes}. Judged on the {choice.split} split by the labels of policy "
        f"{choice.policy}, at beta {choice.beta:g}."
    )
    everything, notes = predicted(choice)
    for note in notes:
        st.warning(note)
    if len(everything):
        shown_accuracy(choice, 2 * columns)
    else:
        lacking(
            f"It has not scored the {choice.split} split yet:",
            f"relevance evaluate {choice.path} --checkpoint {name}",
        )
    places = st.columns(columns, gap="large")
    with places[0]:
        st.markdown("**How it learned**")
        history = training_history(choice.dataset, row)
        if history:
            plot(f"training-{name}", plots.training_curve, history=history)
        else:
            st.caption("Its file, which holds the learning curve, is not here.")
    for place, by in enumerate(DRAWN if len(everything) else (), 1):
        with places[place % columns]:
            parts(choice, by)
    if len(everything):
        with st.expander("All figures"):
            all_figures(choice)


def parts(choice: Choice, by: str) -> None:
    """A checkpoint's shares by parts of the queries, a plot a family."""
    st.markdown(f"**{BREAKDOWNS[by].title}**")
    rows = by_part(choice, by)
    for family in FAMILIES:
        mine = [row for row in rows if row["family"] == family]
        if mine:
            name, height = f"{by}-{family}-{choice.checkpoint}", 1.0 + 0.36 * len(mine)
            given = {"rows": mine, "by": by, "title": family, "size": (4.8, height)}
            plot(name, charts.by_part, **given)


def all_figures(choice: Choice) -> None:
    """Tables of everything."""
    titles = {"family": "family", "judge": "judge", **TITLES}
    del titles["rule"]
    table(judged(choice), titles, SHARES)
    for by, question in BREAKDOWNS.items():
        st.markdown(f"**{question.title}**")
        table(by_part(choice, by), {"family": "family", by: "part", **TITLES}, SHARES)
    st.markdown("**With the goal's own objects**")
    table(judged(choice, goal_objects=True), titles, SHARES)


def shown_accuracy(choice: Choice, per_row: int) -> None:
    """Headlines: total and true relevant of each family, beside rule and paper."""
    rows = judged(choice)
    found = {(row["family"], row["judge"]): row for row in rows}
    shown = []
    for family in dict.fromkeys(row["family"] for row in rows):
        network, rule = found[family, NETWORK], found[family, RULE]
        theirs = paper().accuracy.get(str(family))
        total, relevant = (
            (f"{theirs.total:.0%}", f"{theirs.true_relevant:.0%}") if theirs else (DASH, DASH)
        )
        base = f"always irrelevant {percent(network['base_rate'])}"
        shown += [
            (
                f"Judged rightly, {family}",
                percent(network["total"]),
                f"rule {percent(rule['total'])}, {base}, paper {total}",
            ),
            (
                f"Relevant ones found, {family}",
                percent(network["true_relevant"]),
                f"rule {percent(rule['true_relevant'])}, paper {relevant}; "
                f"{round(network['relevant'] * network['objects']):,} queries",
            ),
        ]
    for start in range(0, len(shown), per_row):
        figures(*shown[start : start + per_row], columns=per_row)


choice = chosen()
st.header("Models")
if without_predictions(choice):
    st.stop()
checkpoints = {row["checkpoint_id"]: row for row in ask(choice, "checkpoints")}
rows = [
    row
    for policy in dict.fromkeys(row["policy"] for row in checkpoints.values())
    for row in ask(replace(choice, policy=policy), "bodies", split=choice.split)
]
others = [name for name in checkpoints if name != choice.checkpoint]
if st.session_state["pick_other"] not in others:
    st.session_state["pick_other"] = None
other = st.columns(2)[0].selectbox(
    "Compare with",
    others,
    index=None,
    placeholder="another checkpoint, side by side" if others else "there is no other checkpoint",
    key="pick_other",
    disabled=not others,
)
if len({row["checkpoint_id"] for row in rows}) > 1:
    with st.container(border=True):
        st.markdown(f"**Every checkpoint, on the {choice.split} split at beta 0**")
        names = len({row["checkpoint_id"] for row in rows})
        panels = len({row["family"] for row in rows})
        size = (9.2, 1.1 + 0.4 * names)
        plot("bodies", charts.bodies, rows=rows, panels=panels, size=size)
if other:
    second = replace(choice, checkpoint=other, policy=checkpoints[other]["policy"])
    for place, one in zip(st.columns(2, gap="large"), (choice, second), strict=True):
        with place:
            show(one, checkpoints[one.checkpoint], columns=1)
else:
    show(choice, checkpoints[choice.checkpoint], columns=2)
st.caption(
    "Rule: relevant iff it stands on subject or reference. Set recall: share of a goal's relevant "
    "queries that are kept at this beta; kept whole: goals in which all of them are; all right: "
    "goals with every query judged rightly."
)
