"""The paper's tables and figures from a dataset: its own, ours from the rows, what is missing."""

from __future__ import annotations

import csv
import json
import shutil
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from evaluated import EVALUATION, evaluated, labelled
from test_report import Page

from relevance.cli import main
from relevance.evaluation import EvaluationError, Predictions, read_predictions
from relevance.report import reproduction
from relevance.report.paper import paper
from relevance.report.reproduction.models import (
    POINTS,
    Evidence,
    best,
    models_of,
    our_betas,
    papers_betas,
    rerun_config,
    transformer,
)
from relevance.report.reproduction.sheets import MISSING, OURS, PAPER, RULE
from relevance.report.reproduction.tables import planning_times, time_saved
from relevance.store import Dataset

FEW = replace(EVALUATION, tasks=2, sweep_tasks=2, betas=(), guides=("prune",), priors=())
_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


def nobody(_: str):
    return nullcontext(lambda done, total: None)


@cache
def reproduced() -> tuple[Path, Path]:
    """A dataset whose checkpoint was rerun as the figures need it, and what was written."""
    _FOLDERS.append(tempfile.TemporaryDirectory())
    root = Path(_FOLDERS[-1].name) / "dataset"
    shutil.copytree(evaluated()[0], root)
    reproduction.prepare(root, (), FEW, nobody)
    return root, reproduction.build(root)


def rows_of(page: Path, name: str) -> list[dict]:
    return json.loads((page.parent / "tables" / f"{name}.json").read_text())["rows"]


def well_formed(text: str) -> Page:
    page = Page(text)
    assert page.open == []
    assert all(name.startswith("tables/") for name in page.fetched)
    assert len(page.ids) == len(set(page.ids))
    assert set(page.links) <= set(page.ids)
    return page


def test_without_a_checkpoint_the_page_says_so(tmp_path) -> None:
    path = reproduction.build(labelled(), tmp_path)
    page = well_formed(path.read_text())
    assert "no checkpoint of it was given" in page.text
    assert "No checkpoint that looks at a picture" in page.text
    ours = [row for row in rows_of(path, "table-3") if row["whose"] != PAPER]
    assert {row["whose"] for row in ours} == {MISSING}
    drawn = {file.name for file in (tmp_path / "figures").iterdir()}
    assert {"figure-1.png", "figure-1.svg"} <= drawn


def test_every_table_is_whole_as_page_csv_and_json() -> None:
    _, path = reproduced()
    page = well_formed(path.read_text())
    names = [file.stem for file in (path.parent / "tables").glob("*.csv")]
    assert {"table-1", "table-2-accuracy", "table-2-time", "table-3"} <= set(names)
    for name in names:
        assert f"tables/{name}.csv" in page.fetched
        rows = rows_of(path, name)
        with (path.parent / "tables" / f"{name}.csv").open() as stream:
            table = list(csv.DictReader(stream))
        assert [list(row) for row in table] == [list(row) for row in rows]
        for written, row in zip(table, rows, strict=True):
            assert list(written.values()) == ["" if v is None else str(v) for v in row.values()]
    drawn = sorted(file.name for file in (path.parent / "figures").iterdir())
    assert [name for name in drawn if "figure-8" in name]
    assert [name.removesuffix(".png") for name in drawn if name.endswith(".png")] == [
        name.removesuffix(".svg") for name in drawn if name.endswith(".svg")
    ]


def test_the_papers_rows_are_the_papers_figures() -> None:
    _, path = reproduced()
    theirs = {r["predicate"]: r for r in rows_of(path, "table-1") if r["whose"] == PAPER}
    for name, queries in paper().train.items():
        if name in theirs:
            assert theirs[name]["train_relevant"] == queries.relevant
            assert theirs[name]["train_share"] == pytest.approx(queries.share)
    times = {r["group"]: r for r in rows_of(path, "table-2-time") if r["whose"] == PAPER}
    assert times.keys() == paper().runtime.keys()
    for group, row in times.items():
        assert row["saved"] == paper().runtime[group].saved
    assert [r["body"] for r in rows_of(path, "table-3")[:3]] == list(paper().bodies)


def test_our_rows_are_those_of_the_dataset() -> None:
    root, path = reproduced()
    dataset, [model] = Dataset.open(root), models_of(Dataset.open(root))
    with dataset.connect() as connection:
        known = connection.execute(
            "select predicate, count_if(relevant), count_if(not relevant) from labels "
            "where split = 'train' and not is_goal_object group by predicate"
        ).fetchall()
    ours = {r["predicate"]: r for r in rows_of(path, "table-1") if r["whose"] == OURS}
    for predicate, relevant, irrelevant in known:
        row = ours[predicate]
        assert (row["train_relevant"], row["train_irrelevant"]) == (relevant, irrelevant)
    queries = read_predictions(dataset, model.name).queries()
    for row in rows_of(path, "table-2-accuracy"):
        if row["whose"] == OURS:
            found = queries.of(row["group"])
            assert row["total"] == pytest.approx(found.accuracy().total)
            assert row["true_relevant"] == pytest.approx(found.accuracy().true_relevant)
            trained = np.mean((found.raw_score > 0) == found.relevant)
            assert row["trained_total"] == pytest.approx(trained)
    rules = [r for r in rows_of(path, "table-3") if r["whose"] == RULE]
    assert rules[-1]["total"] == pytest.approx(np.mean(~queries.of("on").relevant))


def test_the_curves_are_over_the_papers_betas_and_fall() -> None:
    root, path = reproduced()
    [model] = models_of(Dataset.open(root))
    rows = rows_of(path, f"beta-{model.body}")
    first, second = (
        [row for row in rows if row["panel"] == panel]
        for panel in dict.fromkeys(row["panel"] for row in rows)
    )
    assert [row["beta"] for row in first] == list(papers_betas())
    assert [row["paper_saved"] for row in first] == list(paper().curves["saved"])
    for panel in (first, second):
        lost = [row["false_irrelevant"] for row in panel]
        assert lost == sorted(lost, reverse=True)
        assert len({row["solvable"] for row in panel}) == 1
    assert second[-1]["true_relevant"] - second[0]["true_relevant"] >= POINTS


def test_what_is_there_is_not_made_again() -> None:
    root, _ = reproduced()
    files = [*root.glob("evaluations/**/*.parquet"), *root.glob("predictions/**/*.parquet")]
    before = {file: file.stat().st_mtime_ns for file in files}
    reproduction.prepare(root, (), FEW, nobody)
    assert before
    assert {file: file.stat().st_mtime_ns for file in files} == before


def test_time_saved_by_hand() -> None:
    def row(unguided: float, guided: float, solved: tuple[bool, bool], scene: str) -> dict:
        return {
            "scene_id": scene,
            "seconds_unguided": unguided,
            "seconds_guided": guided,
            "seconds_inference": 0.5,
            "solved_unguided": solved[0],
            "solved_guided": solved[1],
            "nlps_unguided": 6,
            "nlps_guided": 3,
        }

    rows = [
        row(8.0, 3.0, (True, True), "a"),
        row(2.0, 2.0, (True, True), "b"),
        row(4.0, 1.0, (True, False), "b"),
        row(9.0, 1.0, (False, True), "c"),
    ]
    found = time_saved(rows)
    assert (found["tasks"], found["solvable"], found["both"], found["missed"]) == (4, 3, 2, 1)
    assert (found["unguided"], found["guided"]) == (5.0, 2.5)
    assert found["saved"] == pytest.approx(1 - 5 / 10)
    assert found["saved_free"] == pytest.approx(1 - 4 / 10)
    assert found["saved_counted"] == pytest.approx(1 - (3 + 2 + 1 + 4) / 14)
    assert found["saved_nlps"] == pytest.approx(0.5)
    for name in ("unguided", "saved", "saved_counted"):
        low, high = found[f"{name}_low_95"], found[f"{name}_high_95"]
        assert low <= found[f"{name}_low"] <= found[name] <= found[f"{name}_high"] <= high


def test_our_range_is_the_least_that_moves_ten_points() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        scores = rng.normal(rng.uniform(-1, 3), rng.uniform(0.5, 4), 300)
        relevant = rng.uniform(size=300) < 0.4
        columns = {name: np.zeros(300) for name in Predictions.__dataclass_fields__}
        predictions = Predictions(**{**columns, "score": scores, "relevant": relevant})

        betas = our_betas(predictions)
        assert len(betas) == 11
        assert betas[0] == -betas[-1]
        asked = scores[relevant]
        moved = [np.mean(np.abs(asked) < half) for half in (betas[-1], betas[-1] - 0.051)]
        assert moved[0] >= POINTS > moved[1]
    nothing = {name: np.zeros(0) for name in Predictions.__dataclass_fields__}
    nothing["relevant"] = np.zeros(0, bool)
    assert our_betas(Predictions(**nothing)) == ()


def test_our_best_sees_the_picture_and_is_chosen_on_validation() -> None:
    [model] = models_of(Dataset.open(evaluated()[0]))
    told = replace(model, name="told", body="geometry", told=True, validation={"on": 1.0})
    worse = replace(model, name="worse", body="vit", validation={"on": 0.5})
    better = replace(model, name="better", body="resnet", validation={"on": 0.8})
    blind = replace(better, name="blind", heads=("behind",), validation={"on": 0.9})
    assert best([told, worse, better, blind], "on") == better
    assert transformer([told, worse, better], "on") == worse
    assert transformer([told, better], "on") is None
    assert best([told], "on") is None


def test_other_splits_are_refused() -> None:
    root, _ = reproduced()
    [model] = models_of(Dataset.open(root))
    with pytest.raises(EvaluationError, match="split validation: expected test"):
        rerun_config(Dataset.open(root), model, replace(FEW, split="validation"))


def test_weights_that_cannot_be_read_leave_the_rest(tmp_path) -> None:
    root, _ = reproduced()
    shutil.copytree(root, tmp_path / "copy")
    [model] = models_of(Dataset.open(tmp_path / "copy"))
    assert model.file
    model.file.write_bytes(b"broken")
    evidence = Evidence(Dataset.open(tmp_path / "copy"))
    assert any("copy" in line for line in evidence.warnings(evidence.models))
    assert any(row["whose"] == OURS for row in planning_times(evidence).rows)


def test_the_command_prints_the_page(tmp_path, capsys) -> None:
    root = labelled()
    assert main(["reproduce", str(root), "--no-rerun", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out.strip()
    assert printed == str(tmp_path / "out" / "index.html")
    assert Path(printed).is_file()
    assert main(["reproduce", str(root), "--checkpoint", "nobody", "--no-rerun"]) == 2
    assert "unknown checkpoint 'nobody'" in capsys.readouterr().err
