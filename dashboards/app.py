"""The dashboard: what a dataset holds, what its networks say, what they save the planner.

    streamlit run dashboards/app.py -- DATASET

The dataset may also come from the environment variable RELEVANCE_DATASET, and from the field
in the side bar. This file chooses dataset, split, checkpoint and beta for all pages; each page
is a file of `views/`, its questions are the SQL of `sql/`, its plots the report's.

Streamlit would run the files of a folder `pages/` by themselves, without the choice, when a link
leads straight to one. No icon is named anywhere: the browser would fetch it elsewhere.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import streamlit as st

from dashboards.asking import SCENES, Choice, ask, version_of
from dashboards.showing import command, plain, tighten
from relevance.errors import RelevanceError
from relevance.scene import FAMILIES
from relevance.store import SPLITS, Dataset

# File in `views/` and title; the first is the start page.
PAGES = {
    "data": "Data",
    "scenes": "Scenes",
    "models": "Models",
    "planning": "Planning",
    "runs": "Runs",
}
STARTS = {
    "pick_split": "test",
    "pick_checkpoint": None,
    "pick_how": "beta",
    "pick_beta": 0.0,
    "pick_coverage": 90,
    "pick_other": None,
    "pick_place": 1,
    "only_splits": [*SPLITS],
    "only_families": [*FAMILIES],
    "only_scene_families": [],
    "only_predicates": [],
    "only_statuses": ["solved"],
    "only_blocked": True,
    "only_wrong": False,
}
"""What the widgets say at first, by their keys."""
JUDGING = ("Scenes", "Models", "Planning")
"""Pages on which a checkpoint is asked."""
SAMPLED = ("Models", "Planning")
"""Pages that judge it by a part of a large split."""


def main() -> None:
    """Choose what all pages show, then draw the page that was asked for."""
    st.set_page_config(page_title="relevance", layout="wide")
    tighten()
    for key, value in STARTS.items():  # again each time: Streamlit forgets what other pages ask
        st.session_state[key] = st.session_state.get(key, value)
    first = next(iter(PAGES))
    page = st.navigation(
        [st.Page(f"views/{n}.py", title=t, default=n == first) for n, t in PAGES.items()]
    )
    start = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("RELEVANCE_DATASET", "data/demo")
    path = st.sidebar.text_input("Dataset folder", start, key="dataset")
    try:
        dataset = Dataset.open(path)
    except RelevanceError as error:
        unopened(path, error)
        return
    try:
        st.session_state["choice"] = choice = choose(dataset, path, page.title)
        if choice.version[0]:
            page.run()
        else:
            empty(choice)
    except RelevanceError as error:
        broken(path, error)


def choose(dataset: Dataset, path: str, page: str) -> Choice:
    """The side bar of a page."""
    own = dataset.labelling.policy if dataset.labelling else None
    given = Choice(path=path, version=version_of(dataset), own_policy=own, policy=own)
    if page not in JUDGING:
        return given
    with st.sidebar:
        split = st.selectbox("Split", SPLITS, key="pick_split")
        policies = {row["checkpoint_id"]: row["policy"] for row in ask(given, "checkpoints")}
        given = replace(given, split=split, shards=tuple(dataset.shards(split)))
        if not policies:
            return given
        if st.session_state["pick_checkpoint"] not in policies:  # another dataset's
            st.session_state["pick_checkpoint"] = next(iter(policies))
        checkpoint = st.selectbox(
            "Checkpoint", list(policies), key="pick_checkpoint", help="The newest comes first."
        )
        given = replace(given, checkpoint=checkpoint, policy=policies[checkpoint])
        if page in SAMPLED:
            given = sampled(given)
        return replace(given, beta=choose_beta(given))


def sampled(given: Choice) -> Choice:
    """The split, or every so-manieth shard of each of its families where it is large."""
    scenes = ask(given, "scene_totals", splits=[given.split])[0]["scenes"]
    every = max(1, round(scenes / SCENES))
    judging = ask(given, "judged_shards", split=given.split, every=every) if every > 1 else []
    seen = sum(row["scenes"] for row in judging)
    if seen in (0, scenes):
        return given
    st.caption(
        f"Judged by one shard in {every} of each family (at least one): {seen:,} of {scenes:,} "
        "scenes."
    )
    return replace(given, shards=tuple(row["shard"] for row in judging))


def choose_beta(given: Choice) -> float:
    """beta itself, or what keeps enough of the goals whole."""
    how = st.radio(
        "Keep objects by",
        ["beta", "coverage"],
        horizontal=True,
        key="pick_how",
        help="An object is kept when its score is over -beta: a larger beta keeps more. Coverage "
        "is the share of this split's goals whose relevant objects are all kept.",
    )
    if how == "beta":
        beta = st.slider("beta", -8.0, 8.0, step=0.1, key="pick_beta")
        st.caption("0 decides as validation chose; a larger beta keeps more objects.")
        return beta
    coverage = st.slider("Coverage of the goals, %", 50, 100, key="pick_coverage")
    variables = {"checkpoint_id": given.checkpoint, "split": given.split}
    beta = ask(given, "coverage", coverage=coverage / 100, **variables)[0]["beta"]
    if beta is None:
        st.caption(f"No predictions on the {given.split} split: beta is 0.")
        return 0.0
    st.caption(f"beta = {beta:.2f} keeps all relevant objects in {coverage}% of the goals.")
    return beta


def empty(choice: Choice) -> None:
    """What to do with a dataset that has its settings alone."""
    st.header("This dataset is empty")
    st.write("It has its settings and no scenes yet. The same command that began it goes on:")
    command(f"relevance generate {choice.path}", f"relevance label {choice.path}")
    st.write("Reload this page as files appear: it shows what is there.")


def unopened(path: str, error: RelevanceError) -> None:
    """What to do where there is no dataset, or none that can be opened."""
    if "no dataset.json" not in str(error):
        broken(path, error)
        return
    st.header("No dataset here")
    st.error(plain(str(error)))
    st.write("Name another folder in the side bar, or make a dataset there:")
    folder = path.strip() or "data/demo"
    command(f"relevance generate {folder} --preset smoke", f"relevance label {folder}")


def broken(path: str, error: RelevanceError) -> None:
    """What to do with a file that cannot be read."""
    st.header("This dataset has a broken file")
    st.error(plain(str(error)))
    st.write("The first command lists all that is broken, the second makes it again:")
    command(f"relevance check {path}", f"relevance repair {path}")


main()
