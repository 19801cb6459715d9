"""The dashboard's pages run by Streamlit's own test driver over a real dataset."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from evaluated import DATA, evaluated, labelled
from streamlit.testing.v1 import AppTest

from relevance.evaluation import (
    BREAKDOWNS,
    read_evaluations,
    read_predictions,
    settings,
    summarise,
)
from relevance.pipeline import describe
from relevance.report.style import TIMES
from relevance.store import Dataset

APP = Path(__file__).parent.parent / "dashboards" / "app.py"


@pytest.fixture
def page(monkeypatch):
    """Runs a page on a dataset folder."""
    # Streamlit leaves the page as the main module; processes spawned later would run it.
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])

    def run(dataset: Path, name: str = "labels") -> AppTest:
        monkeypatch.setattr("sys.argv", ["app.py", str(dataset)])
        app = AppTest.from_file(str(APP), default_timeout=60).run()
        return app if name == "labels" else app.switch_page(f"views/{name}.py").run()

    return run


def values(app: AppTest) -> dict[str, str]:
    assert not app.exception
    return {metric.label: metric.value for metric in app.metric}


def test_figures_are_those_of_the_rows(page) -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    shown = values(page(root, "accuracy"))
    assert shown["Scenes"] == str(len(dataset.read_rows("scenes")))
    found = read_predictions(dataset, checkpoint.stem).queries()
    for group in ("same-plane", "on"):
        accuracy = found.of(group).accuracy()
        assert shown[f"Total, {group}"] == f"{100 * accuracy.total:.1f}%"
    frames = [frame.value for frame in page(root, "accuracy").dataframe]
    assert len(frames) == 2 + len(BREAKDOWNS)
    for frame, by in zip(frames[1:-1], BREAKDOWNS, strict=True):
        assert frame["objects"].sum() == len(found)
        assert frame[by].is_unique or by != "predicate"
    rows = settings(read_evaluations(dataset, checkpoint.stem))["tree", "prune-then-full", 0.0]
    expected = summarise(rows).speedup.value
    shown = values(page(root, "speed"))
    assert shown["prune-then-full, tree search"] == f"{expected:.2f}{TIMES}"


def test_table_and_report_agree_on_the_speed_up(page) -> None:
    root, checkpoint = evaluated()
    app = page(root, "speed")
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
    app = page(root, "accuracy")
    app.slider[0].set_value(8.0).run()
    everything = values(app)
    app.slider[0].set_value(-8.0).run()
    nothing = values(app)
    assert everything["True relevant, on"] == "100.0%"
    assert nothing["True relevant, on"] == "0.0%"


def test_the_grid_follows_split_and_predicate(page) -> None:
    root, _ = evaluated()
    app = page(root, "scenes")
    app.toggle(key="blocked").set_value(False).run()
    app.multiselect(key="predicates").set_value(["behind"]).run()
    goals = [m.value for m in app.markdown]  # and no stray text of the source
    rows = Dataset.open(root).read_rows("plans", split="test", predicate="behind")
    solved = {f"**behind({r['subject']}, {r['reference']})**" for r in rows if r["moved"]}
    assert set(goals) == solved
    app.selectbox(key="split").set_value("validation").run()
    assert not app.exception
    assert {m.value for m in app.markdown if m.value.startswith("**")} != set(goals)


def test_without_a_checkpoint_it_says_so(page) -> None:
    for name, command in (("accuracy", "relevance train"), ("speed", "relevance evaluate")):
        app = page(labelled(), name)
        assert not app.exception
        assert command in " ".join(info.value for info in app.info)
    assert any("relevant_share" in frame.value.columns for frame in page(labelled()).dataframe)


def test_a_folder_that_is_no_dataset_is_named_and_helped(page, tmp_path) -> None:
    app = page(tmp_path)
    assert not app.exception
    assert [error.value for error in app.error] == [
        f"{tmp_path}: no dataset.json there, expected a dataset folder"
    ]
    assert f"relevance generate {tmp_path}" in app.code[0].value


@pytest.mark.parametrize("name", ["labels", "accuracy", "speed", "scenes"])
def test_an_empty_or_half_made_dataset_says_what_comes_next(page, tmp_path, name) -> None:
    Dataset.create(tmp_path / "empty", describe(DATA, []))
    app = page(tmp_path / "empty", name)
    assert not app.exception
    assert "relevance generate" in app.code[0].value
    half = tmp_path / "half"
    shutil.copytree(labelled(), half, ignore=shutil.ignore_patterns("plans", "labels", "timings"))
    app = page(half, name)
    assert not app.exception
    assert app.info


def test_a_broken_file_gets_a_page_that_says_how_to_mend_it(page, tmp_path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(labelled(), broken)
    file = Dataset.open(broken).files("plans")[0]
    file.write_bytes(file.read_bytes()[:-100])
    app = page(broken)
    assert not app.exception
    assert file.name in app.error[0].value
    assert "relevance repair" in app.code[0].value


def test_policy_of_the_labels_is_said(page) -> None:
    root, _ = evaluated()
    assert "Labels: policy found, which the checkpoint learned." in [
        caption.value for caption in page(root).sidebar.caption
    ]


def test_a_link_straight_to_a_page_has_the_side_bar_too(page) -> None:
    root, _ = evaluated()
    assert not (APP.parent / "pages").exists()  # Streamlit would run its files by themselves
    app = page(root, "scenes")
    assert {box.key for box in app.sidebar.selectbox} == {"split", "checkpoint"}


def test_every_query_is_asked_and_no_icon_is_fetched() -> None:
    files = [*APP.parent.rglob("*.py")]
    text = "".join(file.read_text() for file in files)
    for query in (APP.parent / "sql").glob("*.sql"):
        assert f'"{query.stem}"' in text
    assert "page_icon" not in text
    assert ":material" not in text
    assert "SELECT" not in text.upper().replace("SELECTBOX", "").replace("MULTISELECT", "")
