"""How right the checkpoint is at the chosen beta, beside two rules, and where."""

import streamlit as st

from dashboards.data import chosen, figures, percent_column, predictions
from relevance.evaluation import BREAKDOWNS, NETWORK, RULE, accuracy_table, breakdown_table
from relevance.report.paper import paper
from relevance.report.style import DASH, percent

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
}


def table(rows: list[dict], *first: str) -> None:
    """Rows as a table: the columns `first`, shares as per cent, then counts."""
    names = [*first, *(name for name in TITLES if name in rows[0]), "tasks", "objects"]
    st.dataframe(
        [{TITLES.get(name, name): row[name] for name in names} for row in rows],
        hide_index=True,
        column_config={title: percent_column() for title in TITLES.values()},
    )


choice = chosen()
if choice.checkpoint is None:
    st.info("No checkpoint yet: `relevance train` makes one.")
    st.stop()
everything, notes = predictions(choice)
for note in notes:
    st.warning(note)
if not len(everything):
    st.info(
        f"No predictions on the {choice.split} split by the labels of policy {choice.policy} yet: "
        "`relevance evaluate` makes them."
    )
    st.stop()
found = everything.queries()
judged = accuracy_table(found, beta=choice.beta)
totals = {(row["family"], row["judge"]): row for row in judged}
shown = []
for family in dict.fromkeys(row["family"] for row in judged):
    row, rule = totals[family, NETWORK], totals[family, RULE]
    theirs = paper().accuracy.get(family)
    total, relevant = (
        (f"{theirs.total:.0%}", f"{theirs.true_relevant:.0%}") if theirs else (DASH, DASH)
    )
    note = f"rule {percent(rule['total'])}, always irrelevant {percent(row['base_rate'])}"
    shown.append((f"Total, {family}", percent(row["total"]), f"{note}, paper {total}"))
    count = round(row["relevant"] * row["objects"])
    note = f"paper {relevant}; {count} relevant queries"
    shown.append((f"True relevant, {family}", percent(row["true_relevant"]), note))
figures(*shown, columns=4)
st.subheader("Against two rules")
table(judged, "family", "judge")
st.caption(
    f"Judged by the labels of policy {choice.policy}; queries only. Set recall: share of a goal's "
    "relevant queries that are kept at this beta; kept whole: goals in which all of them are; all "
    "right: goals with every query judged rightly. beta = 0 is what validation chose."
)
for by, question in BREAKDOWNS.items():
    st.subheader(question.title)
    table(breakdown_table(found, by, beta=choice.beta), "family", by)
st.subheader("With the goal's own objects")
table(accuracy_table(everything, beta=choice.beta), "family", "judge")
