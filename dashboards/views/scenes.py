"""Scenes with their goals: one large, with views, plan and scores, and those that follow it."""

import shlex
from html import escape
from typing import Any

import streamlit as st

from dashboards.asking import ask, chosen, tasks_with_answers
from dashboards.showing import command, goal_of, lacking, legend, picture, plain, steps, views
from relevance.scene import FAMILIES, PREDICATES

FOLLOWING = 8
"""Smaller pictures under the large one."""
STATUSES = ("solved", "infeasible", "limit", "refused")


def place(number: int) -> None:
    """Show that goal of the list; a button's callback."""
    st.session_state["pick_place"] = number


choice = chosen()
st.header("Scenes and their goals")
with st.container(border=True):
    columns = st.columns([2, 3, 2, 2])
    families = columns[0].multiselect(
        "Families", list(FAMILIES), key="only_scene_families", placeholder="all"
    )
    predicates = columns[1].multiselect(
        "Predicates", list(PREDICATES), key="only_predicates", placeholder="all"
    )
    statuses = columns[2].multiselect(
        "How planning ended", STATUSES, key="only_statuses", placeholder="any way"
    )
    most = ask(choice, "scene_totals", splits=[choice.split])[0]
    low, high = most["fewest"] or 2, most["most"] or 3
    if low < high:
        low, high = columns[3].slider("Boxes in the scene", low, high, (low, high))
    left, right = st.columns(2)
    blocked = left.toggle(
        "Only where something is in the way",
        key="only_blocked",
        help="Goals whose plan moves a box besides the subject.",
    )
    wrong = bool(choice.checkpoint) and right.toggle(
        "Only where the checkpoint errs", key="only_wrong", help="The worst first."
    )
number = st.session_state["pick_place"]
asked = {
    "split": choice.split,
    "families": families or None,
    "predicates": predicates or None,
    "statuses": statuses or None,
    "fewest": low,
    "most": high,
    "blocked": blocked,
    "checkpoint_id": choice.checkpoint,
    "beta": choice.beta,
    "wrong": wrong,
    "rows": 1 + FOLLOWING,
}
rows = ask(choice, "tasks", skip=number - 1, **asked)
if not rows and number > 1:  # the filters leave fewer than that
    number = 1
    rows = ask(choice, "tasks", skip=0, **asked)
if not rows:
    if ask(choice, "goal_totals", splits=[choice.split])[0]["goals"]:
        st.info("No goal fits these filters. Take some of them back.")
    else:
        lacking(
            f"No goal of the {choice.split} split was planned yet:",
            f"relevance label {choice.path}",
        )
    st.stop()
found = rows[0]["found"]
(task, sample), *others = tasks_with_answers(choice, rows)

back, which, on, _ = st.columns([1, 2, 1, 6], vertical_alignment="bottom")
turn: dict[str, Any] = {"on_click": place, "width": "stretch"}
back.button("Back", key="back", disabled=number <= 1, args=[number - 1], **turn)
st.session_state["pick_place"] = number
which.number_input(f"Goal, of {found:,}", 1, found, key="pick_place")
on.button("Next", key="next", disabled=number >= found, args=[number + 1], **turn)

large, beside = st.columns([3, 2], gap="large")
with large:
    st.image(picture(task, sample, choice.beta), width="stretch")
    legend(bool(task["scores"]))
with beside:
    st.subheader(plain(goal_of(task)), anchor=False)
    if task["actions"]:
        st.html(f"<ol>{''.join(f'<li>{escape(step)}</li>' for step in steps(task))}</ol>")
    else:
        st.warning(plain(f"No plan ({task['status']}): {task['reason']}"))
    st.caption(
        f"Scene {task['scene_id']}, {task['n_objects']} boxes, family {task['family']}, "
        f"shard {task['shard']} of {task['split']}."
    )
    if choice.checkpoint and not task["scores"]:
        st.caption(
            f"{choice.checkpoint} has not scored this goal: `relevance evaluate` scores the "
            "labelled goals of the test split."
        )
    st.write("Watch the plan in three dimensions:")
    words = ["relevance", "view", choice.path, "--scene", task["scene_id"], "--goal", goal_of(task)]
    if choice.checkpoint:
        words += ["--checkpoint", choice.checkpoint]
    command(shlex.join(words))
st.subheader("Its objects", anchor=False)
views(task, sample, choice.beta)

if others:
    st.subheader("The goals that follow", anchor=False)
for start in range(0, len(others), 4):
    row = zip(st.columns(4), others[start : start + 4], strict=False)
    for place_in_row, (column, (task, sample)) in enumerate(row, start + 1):
        with column:
            st.image(picture(task, sample, choice.beta), width="stretch")
            st.button(
                plain(goal_of(task)),
                key=f"open-{place_in_row}",
                on_click=place,
                args=[number + place_in_row],
                width="stretch",
            )
