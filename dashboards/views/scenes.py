"""Scenes of the split with their goals, the relevant objects outlined."""

from collections.abc import Mapping
from typing import Any

import streamlit as st

from dashboards.data import ask, chosen, samples
from relevance.report.gallery import outlined
from relevance.scene import FAMILIES, PREDICATES
from relevance.store import Sample

PER_PAGE = 9


def show(sample: Sample, task: Mapping[str, Any], beta: float) -> None:
    """One scene with its goal and plan."""
    scores = task["scores"] or {}
    picture = outlined(
        sample,
        relevant=set(task["relevant"]),
        subject=task["subject"],
        reference=task["reference"],
        scores=scores,
        beta=beta,
    )
    st.image(picture, width="stretch")
    goal = f"{task['predicate']}({task['subject']}, {task['reference']})"
    st.markdown(f"**{goal}**")
    words = [" ".join(action[:2]) for action in task["actions"]]
    st.caption(" → ".join(words) or f"{task['status']}: {task['reason']}")
    if scores:
        order = sorted(scores.items(), key=lambda item: -item[1])
        st.caption(", ".join(f"{name} {score:+.1f}" for name, score in order))


choice = chosen()
zero, one, two, three = st.columns([2, 3, 2, 1])
families = zero.multiselect("Families", list(FAMILIES), list(FAMILIES), key="families")
predicates = one.multiselect("Predicates", list(PREDICATES), list(PREDICATES), key="predicates")
known = [row["status"] for row in ask(choice, "statuses")]
statuses = two.multiselect("Status", known, [s for s in known if s == "solved"], key="statuses")
blocked = three.toggle("With blockers", True, help="Only plans that move a query", key="blocked")
tasks = ask(
    choice,
    "tasks",
    split=choice.split,
    families=families,
    predicates=predicates,
    statuses=statuses,
    checkpoint_id=choice.checkpoint or "",
)
if blocked:
    tasks = [task for task in tasks if task["blockers"] or task["status"] != "solved"]
if not tasks:
    st.info("No task fits.")
    st.stop()
pages = -(-len(tasks) // PER_PAGE)
page = int(three.number_input("Page", 1, pages, 1, key="page"))
shown = tasks[(page - 1) * PER_PAGE : page * PER_PAGE]
wanted = {task["scene_id"]: task["shard"] for task in shown}
found = samples(choice.path, choice.version, choice.split, wanted)
st.caption(
    f"{len(tasks)} tasks, page {page} of {pages}. S subject, R reference; green: relevant; "
    "dashed orange: kept, though irrelevant; dashed red: left out, though relevant."
)
for start in range(0, len(shown), 3):
    row = zip(st.columns(3, gap="medium"), shown[start : start + 3], strict=False)
    for column, task in row:
        with column.container(border=True):
            show(found[task["scene_id"]], task, choice.beta)
