"""Label balance of the split, and its goals without a label."""

import streamlit as st

from dashboards.data import ask, chosen
from relevance.report.paper import paper
from relevance.report.style import GROUPS, percent

choice = chosen()
rows = ask(choice, "label_balance", split=choice.split)
if not rows:
    st.info(f"No goal of the {choice.split} split was planned yet: `relevance label` plans them.")
    st.stop()
left, right = st.columns([3, 2], gap="large")
with left:
    st.subheader("Label balance")
    st.dataframe(
        rows,
        hide_index=True,
        column_config={
            "relevant_share": st.column_config.ProgressColumn(
                "relevant among queries", format="percent", min_value=0.0, max_value=0.5
            )
        },
    )
    theirs = [(group, paper().train[group].share) for group in GROUPS if group in paper().train]
    said = ", ".join(f"{percent(share)} for {group}" for group, share in theirs)
    st.caption(f"The paper's datasets: {said}.")
with right:
    st.subheader("Goals without a label")
    failures = ask(choice, "failures", split=choice.split)
    if failures:
        st.dataframe(failures, hide_index=True)
    else:
        st.write("None: every goal of this split has a plan that holds.")
