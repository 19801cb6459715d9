"""What the dataset holds: scenes, labels beside the paper's, plans, failures, speed of making."""

import streamlit as st

from dashboards.asking import ask, chosen
from dashboards.showing import command, figures, lacking, plot, table
from relevance.scene import FAMILIES, PREDICATES
from relevance.store import SPLITS

choice = chosen()
st.header("What this dataset holds")
left, right, _ = st.columns([2, 2, 1])
splits = left.pills("Splits", SPLITS, selection_mode="multi", key="only_splits")
families = right.pills(
    "Families of scenes",
    FAMILIES,
    selection_mode="multi",
    key="only_families",
    help="same-plane: boxes beside each other, asked for directions; on: boxes to be stacked.",
)
where = {"splits": splits, "families": families}

scenes = ask(choice, "scene_totals", **where)[0]
if not scenes["scenes"]:
    st.info("No scene of these splits and families is there. Choose others above.")
    st.stop()
places = st.columns(4)
size = f"{scenes['boxes']:,} boxes, {scenes['fewest']} to {scenes['most']} a scene"
with places[0]:
    figures(("Scenes", f"{scenes['scenes']:,}", size))

from relevance.report import charts, plots  # noqa: E402 - matplotlib: after the first figure
from relevance.report.style import named, percent, seconds  # noqa: E402

goals = ask(choice, "goal_totals", **where)[0]
times = ask(choice, "planning_seconds", **where)
if goals["goals"]:
    with places[1]:
        solved = f"of {goals['goals']:,} asked; {goals['plans']:,} plans hold and make labels"
        figures(("Goals solved", percent(goals["solved"]), solved))
    with places[2]:
        replayed = f"of {goals['replayed']:,} plans run again in a simulator"
        figures(("Replays within 1 mm", percent(goals["replay_ok"]), replayed))
    with places[3]:
        middle = max(times, key=lambda row: row["n"])["quantiles"][100] if times else None
        family = f"of a goal, {max(times, key=lambda row: row['n'])['family']}" if times else ""
        figures(("Median planning time", seconds(middle), family))

dataset = choice.dataset
if {"scenes", *PREDICATES} - {*dataset.description.get("finished", ())}:
    from relevance.pipeline import shards_of  # the planner comes with it

    specs = shards_of(dataset)
    wanted = len(specs), sum(len(spec.predicates) for spec in specs)
    made = len(dataset.files("scenes")), len(dataset.files("labels"))
    if made[0] < wanted[0] or made[1] < wanted[1]:
        what = ("shards have scenes", "shards (one a predicate) have labels")
        for column, have, need, said in zip(st.columns(2), made, wanted, what, strict=True):
            column.progress(min(have / max(need, 1), 1.0), f"{have} of {need} {said}")
        st.caption("It is being made, or was stopped half-way. The same commands go on:")
        command(f"relevance generate {choice.path}", f"relevance label {choice.path}")
if not goals["goals"]:
    lacking("No goal was planned yet, so there are no labels:", f"relevance label {choice.path}")

one, two = st.columns(2, gap="large")
balance = named(ask(choice, "label_balance", **where))
if balance:
    with one:
        st.subheader("How many objects matter")
        plot("labels", plots.label_shares, rows=balance, size=(4.8, 0.9 + 0.4 * len(balance)))
        st.caption("A goal's queries are the objects other than its subject and reference.")
lengths = ask(choice, "plan_lengths", **where)
if lengths:
    with two:
        st.subheader("How long plans are")
        plot("lengths", plots.lengths, rows=lengths)
failures = ask(choice, "failures", **where)
if goals["goals"]:
    with one:
        st.subheader("Why goals have no plan")
        for row in failures:
            row["label"] = ": ".join(part for part in (row["status"], row["reason"]) if part)
        if failures:
            height = 0.75 + 0.42 * min(len(failures), 8)
            plot("reasons", plots.reasons, rows=failures[:8], size=(4.8, height))
        else:
            st.write("Every goal has a plan that holds.")
if times:
    with two:
        st.subheader("How long planning takes")
        plot("times", plots.times, rows=times, size=(4.8, 3.1))
visible = ask(choice, "visibility", **where)
with one:
    st.subheader("How much of the objects shows")
    plot("visibility", charts.visibility, rows=visible)
throughput = ask(choice, "throughput", **where)
if throughput:
    with two:
        st.subheader("How fast shards were made")
        stages = len({row["stage"] for row in throughput})
        plot("throughput", charts.throughput, rows=throughput, size=(4.8, 1.2 + 0.33 * stages))
        st.caption("A dot is a shard; one process. Dots far to the left were slow to make.")
if balance:
    with st.expander("The same in figures"):
        titles = {
            "family": "family",
            "predicate": "predicate",
            "plans": "plans",
            "queries": "queries",
            "relevant": "relevant",
            "relevant_share": "relevant among queries",
            "ambiguous_share": "another answer would do",
        }
        table(balance, titles, "relevant_share ambiguous_share")
        table(failures, {"status": "status", "reason": "reason", "goals": "goals"})
