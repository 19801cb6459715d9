"""Accuracies of the checkpoint at the chosen beta, against the base rate."""

import streamlit as st

from dashboards.data import chosen, figures, percent_column, predictions
from relevance.report.paper import paper
from relevance.report.style import DASH, GROUPS, groups, percent

choice = chosen()
if choice.checkpoint is None:
    st.info("No checkpoint yet: `relevance train` makes one.")
    st.stop()
found, notes = predictions(choice)
for note in notes:
    st.warning(note)
if not len(found):
    st.info(
        f"No predictions on the {choice.split} split by the labels of policy {choice.policy} yet: "
        "`relevance evaluate` makes them."
    )
    st.stop()
by_group = {g: found.of(g).accuracy(choice.beta) for g in groups() if len(found.of(g))}
shown = []
for group in (g for g in GROUPS if g in by_group):
    a, theirs = by_group[group], paper().accuracy.get(group)
    total, relevant = (
        (f"{theirs.total:.0%}", f"{theirs.true_relevant:.0%}") if theirs else (DASH, DASH)
    )
    note = f"base rate {percent(a.base_rate)}, paper {total}; {a.n_tasks} tasks"
    shown.append((f"Total, {group}", percent(a.total), note))
    count = round(a.share_relevant * a.n_rows)
    note = f"paper {relevant}; {count} relevant queries"
    shown.append((f"True relevant, {group}", percent(a.true_relevant), note))
figures(*shown, columns=2 * len(GROUPS))
st.dataframe(
    [
        {
            "queries of": group,
            "true relevant": a.true_relevant,
            "true irrelevant": a.true_irrelevant,
            "total": a.total,
            "base rate": a.base_rate,
            "balanced": a.balanced,
            "tasks kept whole": a.tasks_whole,
            "tasks": a.n_tasks,
            "queries": a.n_rows,
        }
        for group, a in by_group.items()
    ],
    hide_index=True,
    column_config={
        name: percent_column()
        for name in (
            "true relevant",
            "true irrelevant",
            "total",
            "base rate",
            "balanced",
            "tasks kept whole",
        )
    },
)
st.caption(
    f"Judged by the labels of policy {choice.policy}. Base rate: the total of answering "
    "irrelevant always. Kept whole: tasks in which no relevant query is left out at this beta."
)
