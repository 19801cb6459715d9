"""What a checkpoint saves the planner, at which beta, and where it fails."""

from typing import Any

import streamlit as st

from dashboards.asking import Choice, ask, chosen, tasks_with_answers
from dashboards.showing import (
    drawing,
    figures,
    goal_of,
    lacking,
    legend,
    picture,
    plain,
    plot,
    table,
    without_predictions,
)
from relevance.evaluation import (
    SweptTask,
    read_evaluations,
    saved,
    settings,
    speed_table,
    swept,
    working_point,
)
from relevance.report import charts
from relevance.report.guided import guided_section
from relevance.report.style import DASH, TIMES, percent

WORST = 6
"""Pictures of goals that were missed."""
BETAS = [quarter / 4 for quarter in range(-32, 33)]
TITLES = {
    "search": "search",
    "guide": "guide",
    "beta": "beta",
    "family": "family",
    "tasks": "goals",
    "solvable": "solvable",
    "missed": "missed",
    "seconds_unguided": "unguided, s",
    "seconds_guided": "guided, s",
    "seconds_network": "network, s",
    "speedup": "speed-up",
    "speedup_both": "speed-up, misses left out",
    "nlps_unguided": "NLPs unguided",
    "nlps_guided": "NLPs guided",
}


@st.cache_data(show_spinner=False, max_entries=8)
def guided(path: str, version: tuple[int, int], checkpoint: str) -> dict[str, Any]:
    """The report's section: comparisons, plots and notes."""
    return guided_section(Choice(path=path, version=version).dataset, checkpoint)


@st.cache_data(show_spinner=False, max_entries=8)
def figures_of(path: str, version: tuple[int, int], checkpoint: str) -> list[dict[str, Any]]:
    """Speed-ups by search, guide, beta and family."""
    return speed_table(Choice(path=path, version=version).dataset, checkpoint)


@st.cache_resource(show_spinner=False, max_entries=8)
def reruns(
    path: str, version: tuple[int, int], checkpoint: str, split: str, policy: str | None
) -> tuple[dict[str, list[SweptTask]], dict[str, list[float]]]:
    """Tasks that `prune` was rerun on, and at which betas, both by search."""
    choice = Choice(path=path, version=version, policy=policy)
    rows = read_evaluations(choice.dataset, checkpoint)
    scored = ask(choice, "task_scores", checkpoint_id=checkpoint, split=split)
    measured: dict[str, list[float]] = {}
    for search, guide, beta in settings(rows):
        if guide == "prune" and BETAS[0] <= beta <= BETAS[-1]:
            measured.setdefault(search, []).append(beta)
    return swept(rows, scored), measured


def working(choice: Choice) -> bool:
    """What the chosen beta keeps, of what is relevant, and saves; whether there are scores."""
    asked = {"checkpoint_id": choice.checkpoint, "split": choice.split}
    curve = ask(choice, "betas", betas=BETAS, **asked)
    if not curve or not curve[0]["goals"]:
        lacking(
            f"This checkpoint has not scored the {choice.split} split yet:",
            f"relevance evaluate {choice.path} --checkpoint {choice.checkpoint}",
        )
        return False
    now = ask(choice, "betas", betas=[choice.beta], **asked)[0]
    tasks, measured = reruns(
        choice.path, choice.version, str(choice.checkpoint), choice.split, choice.policy
    )
    searches = [search for search in sorted(tasks, reverse=True) if tasks[search]]
    shown = [
        (
            "Relevant queries kept",
            percent(now["recall"]),
            f"recall at beta {choice.beta:.2f}, of {now['goals']:,} goals",
        ),
        ("Goals kept whole", percent(now["whole"]), "prune can solve these as they are"),
        ("Objects kept", percent(now["kept"]), "the goal's own two always"),
    ]
    point = working_point(tasks[searches[0]], choice.beta) if searches else None
    if point and point.n_tasks:
        interval = point.speedup
        shown.append(
            (
                "Speed-up of prune",
                f"{interval.value:.2f}{TIMES}",
                f"{interval.low:.2f} to {interval.high:.2f}; {point.misses} of {point.n_tasks} "
                f"goals missed and planned again; {percent(point.exact, 0)} measured with just "
                "these objects",
            )
        )
    else:
        shown.append(("Speed-up of prune", DASH, "no reruns with prune of these goals yet"))
    figures(*shown)
    one, two = st.columns(2, gap="large")
    with one:
        plot("keeping", charts.keeping, curve=curve, now=now, size=(4.8, 3.0))
    with two:
        if point and point.n_tasks:
            plot(
                "saving",
                charts.saving,
                betas=BETAS,
                speedups=saved(tasks[searches[0]], BETAS),
                beta=choice.beta,
                reruns=measured.get(searches[0], []),
                size=(4.8, 3.0),
            )
    st.caption(
        "An object is kept when its score is over -beta; prune plans over what is kept. A beta "
        "that keeps as many objects of a goal as one at which it was rerun costs what that run "
        "did; between two such, time is read off between theirs."
    )
    return True


def missed(choice: Choice) -> None:
    """Pictures of the goals whose relevant objects are most surely left out."""
    rows = ask(
        choice,
        "misses",
        checkpoint_id=choice.checkpoint,
        split=choice.split,
        beta=choice.beta,
        rows=WORST,
    )
    st.subheader("Worst misses", anchor=False)
    if not rows:
        st.write("At this beta no relevant object is left out.")
        return
    st.caption(
        f"In {rows[0]['found']:,} goals a relevant object is left out; these are the ones that the "
        "checkpoint is surest of."
    )
    legend(scored=True)
    answered = tasks_with_answers(choice, rows)
    for start in range(0, len(answered), 3):
        row = zip(st.columns(3, gap="medium"), answered[start : start + 3], strict=False)
        for column, (task, sample) in row:
            with column:
                st.image(picture(task, sample, choice.beta), width="stretch")
                scored = [
                    f"{name} (score {task['scores'][name]:+.1f})" for name in task["left_out"]
                ]
                st.markdown(f"**{plain(goal_of(task))}** left out: {plain(', '.join(scored))}")


choice = chosen()
st.header("What guidance saves the planner")
if without_predictions(choice):
    st.stop()
known = (choice.path, choice.version, str(choice.checkpoint))
found = guided(*known)
for note in found["notes"]:
    st.warning(note)
st.subheader("At this beta", anchor=False)
scored = working(choice)
st.subheader("Guided against unguided", anchor=False)
if found["searches"]:
    names = {section["search"]: section for section in found["searches"]}
    search = next(iter(names))
    if len(names) > 1:
        search = st.segmented_control("Search", list(names), default=search, key="pick_search")
    section = names[search or next(iter(names))]
    _, comparisons = section["comparisons"][-1]
    shown = []
    for c in comparisons:
        if c.n_solvable:
            spread = f"{c.speedup.low:.2f} to {c.speedup.high:.2f}; "
            note = f"{spread}{c.misses} of {c.n_solvable} goals missed, beta {c.beta:g}"
            shown.append((f"Speed-up of {c.guide}", f"{c.speedup.value:.2f}{TIMES}", note))
    figures(*shown, columns=4)
    if "runtimes" in section["plots"]:
        drawing(section["plots"]["runtimes"], width=1200)
        one, two = st.columns(2, gap="large")
        with one:
            st.markdown("**Growth with the number of objects**")
            drawing(section["plots"]["objects"])
        with two:
            st.markdown("**Goal by goal**")
            drawing(section["plots"]["pairs"])
    if "sweep" in section["plots"]:
        st.markdown("**Reruns over beta**")
        drawing(section["plots"]["sweep"], width=1200)
    with st.expander("All figures"):
        table(figures_of(*known), TITLES)
        st.caption(
            "CPU seconds a solvable goal, network and fallbacks included; a missed goal costs the "
            "guided attempt and then the unguided run. Intervals: 67% confidence."
        )
else:
    lacking(
        "The planner was not rerun with this checkpoint yet:",
        f"relevance evaluate {choice.path} --checkpoint {choice.checkpoint}",
    )
if scored:
    missed(choice)
