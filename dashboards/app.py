"""The dashboard: what a dataset holds, what its networks say, what they save the planner.

    streamlit run dashboards/app.py -- DATASET

The dataset may also come from the environment variable RELEVANCE_DATASET, and from the field
in the side bar. This file chooses dataset, split, checkpoint and beta for all pages; each page
is a file of `views/`, its questions are the SQL of `sql/`, and accuracies and intervals are
computed as the report does.

Streamlit would run the files of a folder `pages/` by themselves, without the choice, when a link
leads straight to one. No icon is named anywhere: the browser would fetch it elsewhere.
"""

from __future__ import annotations

import os
import sys

import streamlit as st

from dashboards.data import Choice, ask, figures, percent, stamp
from relevance.errors import RelevanceError
from relevance.report.style import seconds
from relevance.store import SPLITS, Dataset

# File in `views/` and title; the first is the start page.
PAGES = {"labels": "Labels", "accuracy": "Accuracy", "speed": "Speed-up", "scenes": "Scenes"}


def main() -> None:
    """Choose what all pages show, then draw the page that was asked for."""
    st.set_page_config(page_title="relevance", layout="wide")
    first = next(iter(PAGES))
    page = st.navigation(
        [st.Page(f"views/{n}.py", title=t, default=n == first) for n, t in PAGES.items()]
    )
    start = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("RELEVANCE_DATASET", "data/demo")
    path = st.sidebar.text_input("Dataset folder", start, key="dataset")
    try:
        dataset = Dataset.open(path)
    except RelevanceError as error:
        missing(path, error)
        return
    try:
        choice = choose(dataset, path)
        st.session_state["choice"] = choice
        if top(choice):
            page.run()
    except RelevanceError as error:
        broken(path, error)


def choose(dataset: Dataset, path: str) -> Choice:
    """The side bar."""
    version = stamp(dataset)
    own = dataset.labelling.policy if dataset.labelling else None
    given = Choice(path=path, version=version, own_policy=own)
    names = {row["checkpoint_id"]: row["policy"] for row in ask(given, "checkpoints")}
    with st.sidebar:
        split = st.selectbox("Split", SPLITS, index=SPLITS.index("test"), key="split")
        checkpoint = st.selectbox("Checkpoint", list(names), key="checkpoint") if names else None
        beta = st.slider(
            "beta: an object is kept when its score is over -beta", -8.0, 8.0, 0.0, key="beta"
        )
        policy = names[checkpoint] if checkpoint else own
        if policy:
            learned = ", which the checkpoint learned" if checkpoint else ""
            st.caption(f"Labels: policy {policy}{learned}.")
    return Choice(
        path=path,
        version=version,
        own_policy=own,
        policy=policy,
        split=split,
        checkpoint=checkpoint,
        beta=beta,
    )


def top(choice: Choice) -> bool:
    """The figures over each page; False when there is nothing to show yet."""
    totals = ask(choice, "totals")[0]
    if not totals["scenes"]:
        st.header("This dataset is empty")
        st.write("It has its settings and no scenes yet. The same command that began it goes on:")
        st.code(f"relevance generate {choice.path}", language="sh")
        st.write("Then `relevance label` plans and labels; this page fills as files appear.")
        return False
    figures(
        ("Scenes", f"{totals['scenes']:,}", "all splits"),
        ("Goals solved", percent(totals["solved"]), f"of {totals['goals']:,}"),
        ("Replays within 1 mm", percent(totals["replay_ok"]), f"of {totals['replayed']:,}"),
        (
            "Median planning time",
            seconds(totals["median_seconds"]),
            f"{totals['timed']:,} tasks",
        ),
    )
    return True


def missing(path: str, error: RelevanceError) -> None:
    """What to do without a dataset."""
    st.header("No dataset here")
    st.error(str(error))
    st.write("Name another folder in the side bar, or make a dataset there:")
    folder = path.strip() or "data/demo"
    st.code(f"relevance generate {folder} --preset smoke\nrelevance label {folder}", language="sh")


def broken(path: str, error: RelevanceError) -> None:
    """What to do with a file that cannot be read."""
    st.header("This dataset has a broken file")
    st.error(str(error))
    st.write("The first command lists all that is broken, the second makes it again:")
    st.code(f"relevance check {path}\nrelevance repair {path}", language="sh")


main()
