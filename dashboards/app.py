"""The dashboard: what a dataset holds, what its networks say, what they save the planner.

    streamlit run dashboards/app.py -- DATASET

The dataset may also come from the environment variable RELEVANCE_DATASET, and from the field
in the side bar. Everything is asked of the dataset's DuckDB views with the SQL beside this
file, except for accuracies and intervals, which the report computes the same way.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import streamlit as st

from relevance.evaluation.comparisons import read_evaluations, read_predictions, settings, summarise
from relevance.report.gallery import outlined
from relevance.report.plots import DASH, GROUPS, PAPER_ACCURACY, PREDICATES, seconds
from relevance.store import SPLITS, Dataset, DatasetError, Sample

SQL = Path(__file__).parent / "sql"
PER_PAGE = 9


def stamp(dataset: Dataset) -> tuple[int, int]:
    """Changes whenever a table of the dataset does: number of files and newest change."""
    files = list(dataset.path.rglob("*.parquet"))
    return len(files), max((file.stat().st_mtime_ns for file in files), default=0)


@st.cache_data(show_spinner=False, max_entries=200)
def ask(
    path: str, version: tuple[int, int], query: str, given: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Rows of `sql/QUERY.sql`; `version` is there to notice that the dataset changed."""
    with Dataset.open(path).connect() as connection:
        found = connection.execute((SQL / f"{query}.sql").read_text(), dict(given))
        names = [column[0] for column in found.description or ()]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


@st.cache_data(show_spinner=False, max_entries=8)
def predictions_of(path: str, version: tuple[int, int], checkpoint_id: str, split: str) -> Any:
    """The predictions of a checkpoint on the queries of a split."""
    return read_predictions(Dataset.open(path), checkpoint_id, split=split).queries()


@st.cache_data(show_spinner=False, max_entries=8)
def comparisons_of(path: str, version: tuple[int, int], checkpoint_id: str) -> list[Any]:
    """Speed-ups with their intervals, by setting and family."""
    found = []
    for rows in settings(read_evaluations(Dataset.open(path), checkpoint_id)).values():
        found += [summarise(rows, group) for group in (*GROUPS, "all")]
    return [comparison for comparison in found if comparison.n_solvable]


@st.cache_data(show_spinner=False, max_entries=20)
def samples_of(
    path: str, version: tuple[int, int], split: str, wanted: Mapping[str, int]
) -> dict[str, Sample]:
    """Scenes with their images, by id; `wanted` gives each one's shard."""
    shards = sorted(set(wanted.values()))
    samples = Dataset.open(path).samples(split, shards) if shards else ()
    return {sample.key: sample for sample in samples if sample.key in wanted}


def main() -> None:
    """Draw the page."""
    st.set_page_config(page_title="relevance", page_icon=":material/category:", layout="wide")
    start = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("RELEVANCE_DATASET", "data/demo")
    with st.sidebar:
        st.title("relevance")
        path = st.text_input("Dataset folder", start, key="dataset")
        try:
            dataset = Dataset.open(path)
            version = stamp(dataset)
            checkpoints = ask(path, version, "checkpoints", {})
        except DatasetError as error:
            st.error(str(error))
            st.stop()
        split = st.selectbox("Split", SPLITS, index=SPLITS.index("test"), key="split")
        names = [row["checkpoint_id"] for row in checkpoints]
        checkpoint = st.selectbox("Checkpoint", names, key="checkpoint") if names else None
        beta = st.slider("beta: an object is kept when its score is over -beta", -8.0, 8.0, 0.0)
    top(ask(path, version, "totals", {})[0])
    labels, accuracy, speed, scenes = st.tabs(["Labels", "Accuracy", "Speed-up", "Scenes"])
    with labels:
        show_labels(path, version, split)
    with accuracy:
        show_accuracy(path, version, checkpoint, split, beta)
    with speed:
        show_speed(path, version, checkpoint)
    with scenes:
        show_scenes(path, version, checkpoint, split, beta)


def top(totals: Mapping[str, Any]) -> None:
    """The figures over the tabs."""
    median = totals["median_seconds"]
    figures = (
        ("Scenes", f"{totals['scenes']:,}", "all splits"),
        ("Goals solved", _percent(totals["solved"]), f"of {totals['goals']:,}"),
        ("Replays within 1 mm", _percent(totals["replay_ok"]), f"of {totals['replayed']:,}"),
        (
            "Median planning time",
            DASH if median is None else seconds(median),
            f"{totals['timed']:,} tasks",
        ),
    )
    for column, figure in zip(st.columns(len(figures)), figures, strict=True):
        show_figure(column, *figure)


def show_figure(column: Any, label: str, value: str, note: str) -> None:
    """One headline figure and what it rests on."""
    column.metric(label, value)
    column.caption(note)


def show_labels(path: str, version: tuple[int, int], split: str) -> None:
    """Label balance and failures of the split."""
    rows = ask(path, version, "label_balance", {"split": split})
    if not rows:
        st.info(f"No goal of the {split} split was planned yet: `relevance label` plans them.")
        return
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
        st.caption("The paper's datasets: 14% for same-plane, 30% for `on`.")
    with right:
        st.subheader("Goals without a label")
        failures = ask(path, version, "failures", {"split": split})
        if failures:
            st.dataframe(failures, hide_index=True)
        else:
            st.write("None: every goal of this split has a plan that holds.")


def show_accuracy(
    path: str, version: tuple[int, int], checkpoint: str | None, split: str, beta: float
) -> None:
    """Accuracies of the checkpoint at the chosen beta, against the base rate."""
    if checkpoint is None:
        st.info("No checkpoint yet: `relevance train` makes one.")
        return
    predictions = predictions_of(path, version, checkpoint, split)
    if not len(predictions):
        st.info(f"No predictions on the {split} split yet: `relevance evaluate` makes them.")
        return
    groups = [g for g in ("same-plane", *PREDICATES) if len(predictions.of(g))]
    found = {group: predictions.of(group).accuracy(beta) for group in groups}
    columns = st.columns(len(GROUPS) * 2)
    for number, group in enumerate(g for g in GROUPS if g in found):
        a, paper = found[group], PAPER_ACCURACY[group]
        note = f"base rate {_percent(a.base_rate)}, paper {paper[2]:.0%}; {a.n_tasks} tasks"
        show_figure(columns[2 * number], f"Total, {group}", _percent(a.total), note)
        show_figure(
            columns[2 * number + 1],
            f"True relevant, {group}",
            _percent(a.true_relevant),
            f"paper {paper[0]:.0%}; {round(a.share_relevant * a.n_rows)} relevant queries",
        )
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
            for group, a in found.items()
        ],
        hide_index=True,
        column_config={
            name: st.column_config.NumberColumn(format="percent")
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
        "Base rate: the total of answering irrelevant always. Kept whole: tasks in which no "
        "relevant query is left out at this beta."
    )


def show_speed(path: str, version: tuple[int, int], checkpoint: str | None) -> None:
    """What the checkpoint saves the planner."""
    rows = ask(path, version, "speedup", {"checkpoint_id": checkpoint}) if checkpoint else []
    if not rows:
        st.info("The planner was not rerun with a checkpoint yet: `relevance evaluate` does.")
        return
    found = comparisons_of(path, version, str(checkpoint))
    best = [c for c in found if c.group == "all" and c.beta == 0]
    for column, c in zip(st.columns(max(len(best), 2)), best, strict=False):
        shown = c.speedup_both if c.guide == "prune" else c.speedup
        left_out = ", left out" if c.guide == "prune" else ""
        show_figure(
            column,
            f"{c.guide}, {c.search} search",
            f"{shown.value:.2f} x" if shown.n else DASH,
            (f"{shown.low:.2f} to {shown.high:.2f}; " if shown.n else "")
            + f"{c.misses} of {c.n_solvable} missed{left_out}",
        )
    st.dataframe(
        rows,
        hide_index=True,
        column_config={
            name: st.column_config.NumberColumn(title, format=format)
            for name, title, format in (
                ("seconds_unguided", "unguided, s", "%.4f"),
                ("seconds_guided", "guided, s", "%.4f"),
                ("seconds_network", "network, s", "%.4f"),
                ("speedup", "speed-up", "%.2f"),
                ("speedup_both", "speed-up, misses left out", "%.2f"),
                ("nlps_unguided", "NLPs unguided", "%.1f"),
                ("nlps_guided", "NLPs guided", "%.1f"),
            )
        },
    )
    st.caption(
        "CPU seconds a solvable task, network and fallbacks included; a missed task costs the "
        "guided attempt and then the unguided run. Intervals: 67% confidence."
    )


def show_scenes(
    path: str, version: tuple[int, int], checkpoint: str | None, split: str, beta: float
) -> None:
    """Scenes of the split with their goals, the relevant objects outlined."""
    one, two, three = st.columns([3, 2, 1])
    predicates = one.multiselect("Predicates", PREDICATES, list(PREDICATES), key="predicates")
    statuses = two.multiselect(
        "Status", ("solved", "infeasible", "limit"), ["solved"], key="statuses"
    )
    blocked = three.toggle(
        "With blockers", True, help="Only plans that move a query", key="blocked"
    )
    given = {
        "split": split,
        "predicates": list(predicates),
        "statuses": list(statuses),
        "checkpoint_id": checkpoint or "",
    }
    tasks = ask(path, version, "tasks", given)
    if blocked:
        tasks = [task for task in tasks if task["blockers"] or task["status"] != "solved"]
    if not tasks:
        st.info("No task fits.")
        return
    pages = -(-len(tasks) // PER_PAGE)
    page = int(three.number_input("Page", 1, pages, 1, key="page"))
    shown = tasks[(page - 1) * PER_PAGE : page * PER_PAGE]
    wanted = {task["scene_id"]: task["shard"] for task in shown}
    samples = samples_of(path, version, split, wanted)
    st.caption(
        f"{len(tasks)} tasks, page {page} of {pages}. S subject, R reference; green: relevant; "
        "dashed orange: kept, though irrelevant; dashed red: left out, though relevant."
    )
    for start in range(0, len(shown), 3):
        row = zip(st.columns(3, gap="medium"), shown[start : start + 3], strict=False)
        for column, task in row:
            with column.container(border=True):
                show_task(samples[task["scene_id"]], task, beta)


def show_task(sample: Sample, task: Mapping[str, Any], beta: float) -> None:
    """One scene with its goal and plan."""
    scores = task["scores"] or {}
    picture = outlined(
        sample,
        relevant=set(task["moved"]),
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


def _percent(value: float | None) -> str:
    return DASH if value is None or value != value else f"{100 * value:.1f}%"


main()
