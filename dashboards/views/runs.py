"""What ran: flow runs from Prefect's server, and the checkpoints that came of them."""

from datetime import datetime
from pathlib import Path

import streamlit as st

from dashboards.asking import ask, chosen
from dashboards.prefect_api import NoAnswer, artifacts, flow_runs, server
from dashboards.showing import command, figures, lacking, plain
from relevance.networks import read_record

GOOD, BAD = ("Completed",), ("Failed", "Crashed", "TimedOut")


def checkpoints() -> None:
    """The checkpoint that is used, and those before it."""
    st.subheader("Which checkpoint is used", anchor=False)
    rows = ask(choice, "checkpoints")
    if not rows:
        lacking("Nothing was trained on this dataset yet:", f"relevance train {choice.path}")
        return
    record = read_record(choice.dataset)
    meant, what = rows[0]["checkpoint_id"], "newest"
    if record.champion:
        meant, what = record.champion, "champion"
    st.markdown(
        f"**{plain(meant)}**, the {what}: evaluations, reports and flows take it unless another "
        "is named."
    )
    st.dataframe(
        [
            {
                "checkpoint": row["checkpoint_id"],
                "trained (UTC)": row["created"],
                "minutes": row["train_seconds"] / 60,
                "body": row["body"],
                "preset": row["preset"],
                "trained on from": row["continues"] or "",
                "label policy": row["policy"],
                "scored objects": row["predictions"],
                "reruns": row["reruns"],
            }
            for row in rows
        ],
        hide_index=True,
        column_config={
            "trained (UTC)": st.column_config.DatetimeColumn(format="YYYY-MM-DD HH:mm"),
            "minutes": st.column_config.NumberColumn(format="%.1f"),
        },
    )
    if record.history:
        st.subheader("What became of those that were tried", anchor=False)
        last = record.history[-1]
        st.write(f"The last, {plain(last.checkpoint_id)}, was {last.what}: {plain(last.why)}.")
        st.dataframe(
            [
                {
                    "at (UTC)": datetime.fromisoformat(event.at),
                    "what": event.what,
                    "checkpoint": event.checkpoint_id,
                    "champion before": event.before or "",
                    "why": event.why,
                }
                for event in reversed(record.history)
            ],
            hide_index=True,
            column_config={
                "at (UTC)": st.column_config.DatetimeColumn(format="YYYY-MM-DD HH:mm"),
                "why": st.column_config.TextColumn(width="large"),
            },
        )


def runs(url: str) -> None:
    """Flow runs, filtered."""
    found = flow_runs(url)
    if not found:
        st.info("The server has no run of this project's flows yet. To start one:")
        command(
            "make deploy",
            "prefect worker start --pool relevance",
            f"prefect deployment run generate -p dataset={choice.path}",
        )
        return
    one, two, three = st.columns([2, 2, 2], vertical_alignment="bottom")
    flows = sorted({run.flow for run in found})
    states = sorted({run.state for run in found})
    flow = one.multiselect("Flows", flows, key="runs_flows", placeholder="all")
    state = two.multiselect("States", states, key="runs_states", placeholder="any")
    mine = three.toggle("Only of this dataset")
    here = Path(choice.path).resolve()
    shown = [
        run
        for run in found
        if (not flow or run.flow in flow)
        and (not state or run.state in state)
        and (not mine or (run.dataset and Path(run.dataset).resolve() == here))
    ]
    bad = sum(run.state in BAD for run in shown)
    figures(
        ("Runs", str(len(shown)), "the latest 100 at most"),
        ("Completed", str(sum(run.state in GOOD for run in shown)), "to their end"),
        ("Failed or crashed", str(bad), "their page says why" if bad else "none"),
        ("Running", str(sum(run.state == "Running" for run in shown)), "now"),
    )
    st.dataframe(
        [
            {
                "state": run.state,
                "flow": run.flow,
                "run": run.name,
                "started": run.started,
                "minutes": run.seconds / 60,
                "dataset": run.dataset,
                "said": run.said,
                "page": run.link,
            }
            for run in shown
        ],
        hide_index=True,
        column_config={
            "started": st.column_config.DatetimeColumn(format="YYYY-MM-DD HH:mm"),
            "minutes": st.column_config.NumberColumn(format="%.1f"),
            "page": st.column_config.LinkColumn(display_text="open"),
        },
    )
    left = artifacts(url)
    if left:
        st.subheader("What runs left to look at", anchor=False)
    for artifact in left:
        when = f", {artifact.updated:%Y-%m-%d %H:%M} UTC" if artifact.updated else ""
        with st.expander(f"{plain(artifact.description or artifact.key)}{when}"):
            if artifact.kind == "markdown":
                st.markdown(artifact.data)
            else:
                st.code(artifact.data, language="json" if artifact.kind == "table" else None)


choice = chosen()
st.header("Runs")
checkpoints()
st.subheader("Flow runs", anchor=False)
url = st.text_input("Prefect server", server())
try:
    runs(url)
except NoAnswer as error:
    st.info("No Prefect server answers there, so there are no flow runs to show.")
    st.caption(plain(str(error)))
    st.write("Flows run without a server, too, but leave nothing here then. To keep their runs:")
    command("prefect server start", f"export PREFECT_API_URL={url}", "make deploy")
