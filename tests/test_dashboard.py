"""The dashboard's page run by Streamlit's own test driver over a real dataset."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from evaluated import evaluated, labelled
from streamlit.testing.v1 import AppTest

from relevance.evaluation.comparisons import read_evaluations, read_predictions, settings, summarise
from relevance.store import Dataset

APP = Path(__file__).parent.parent / "dashboards" / "app.py"


@pytest.fixture
def page(monkeypatch):
    """Runs the page on a dataset folder."""
    # Streamlit leaves the page as the main module; processes spawned later would run it.
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])

    def run(dataset: Path) -> AppTest:
        monkeypatch.setattr("sys.argv", ["app.py", str(dataset)])
        return AppTest.from_file(str(APP), default_timeout=60).run()

    return run


def values(app: AppTest) -> dict[str, str]:
    assert not app.exception
    return {metric.label: metric.value for metric in app.metric}


def test_figures_are_those_of_the_rows(page) -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    shown = values(page(root))
    assert shown["Scenes"] == str(len(dataset.read_rows("scenes")))
    found = read_predictions(dataset, checkpoint.stem).queries()
    for group in ("same-plane", "on"):
        accuracy = found.of(group).accuracy()
        assert shown[f"Total, {group}"] == f"{100 * accuracy.total:.1f}%"
    rows = settings(read_evaluations(dataset, checkpoint.stem))["tree", "prune-then-full", 0.0]
    expected = summarise(rows).speedup.value
    assert shown["prune-then-full, tree search"] == f"{expected:.2f} x"


def test_sql_and_report_agree_on_the_speed_up(page) -> None:
    root, checkpoint = evaluated()
    app = page(root)
    table = next(f.value for f in app.dataframe if "speedup" in f.value.columns)
    for (search, guide, beta), rows in settings(
        read_evaluations(Dataset.open(root), checkpoint.stem)
    ).items():
        for family in ("same-plane", "on"):
            found = summarise(rows, family)
            line = table[
                (table.search == search)
                & (table.guide == guide)
                & (table.beta == beta)
                & (table.family == family)
            ].iloc[0]
            assert line.speedup == pytest.approx(found.speedup.value)
            assert (line.tasks, line.missed) == (found.n_tasks, found.misses)


def test_beta_moves_the_accuracy(page) -> None:
    root, _ = evaluated()
    app = page(root)
    app.slider[0].set_value(8.0).run()
    everything = values(app)
    app.slider[0].set_value(-8.0).run()
    nothing = values(app)
    assert everything["True relevant, on"] == "100.0%"
    assert nothing["True relevant, on"] == "0.0%"


def test_the_grid_follows_split_and_predicate(page) -> None:
    root, _ = evaluated()
    app = page(root)
    app.toggle(key="blocked").set_value(False).run()
    app.multiselect(key="predicates").set_value(["behind"]).run()
    goals = [m.value for m in app.markdown if m.value.startswith("**")]
    rows = Dataset.open(root).read_rows("plans", split="test", predicate="behind")
    solved = {f"**behind({r['subject']}, {r['reference']})**" for r in rows if r["moved"]}
    assert set(goals) == solved
    app.selectbox(key="split").set_value("validation").run()
    assert not app.exception
    assert {m.value for m in app.markdown if m.value.startswith("**")} != set(goals)


def test_without_a_checkpoint_it_says_so(page) -> None:
    app = page(labelled())
    assert not app.exception
    told = " ".join(info.value for info in app.info)
    assert "relevance train" in told
    assert "relevance evaluate" in told
    assert any("relevant_share" in frame.value.columns for frame in app.dataframe)


def test_a_folder_that_is_no_dataset_is_named(page, tmp_path) -> None:
    app = page(tmp_path)
    assert not app.exception
    assert [error.value for error in app.error] == [
        f"{tmp_path}: no dataset.json there, expected a dataset folder"
    ]
