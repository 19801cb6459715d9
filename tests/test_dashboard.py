"""The dashboard's pages run by Streamlit's own test driver over a real dataset."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import duckdb
import pytest
import yaml
from evaluated import DATA, evaluated, labelled
from streamlit.testing.v1 import AppTest

from dashboards.asking import SQL, Choice, ask, version_of
from dashboards.prefect_api import FLOWS
from relevance.evaluation import read_evaluations, read_predictions, settings, summarise
from relevance.networks import crown, settle
from relevance.pipeline import describe, merge
from relevance.report.style import TIMES, percent
from relevance.store import Dataset

ROOT = Path(__file__).parent.parent
APP = ROOT / "dashboards" / "app.py"
PAGES = ("data", "scenes", "models", "planning", "runs")
QUERIES = sorted(file.stem for file in SQL.glob("*.sql"))


@pytest.fixture
def page(monkeypatch):
    """Runs a page on a dataset folder."""
    # Streamlit leaves the page as the main module; processes spawned later would run it.
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")  # nobody is there

    def run(dataset: Path, name: str = "data") -> AppTest:
        monkeypatch.setattr("sys.argv", ["app.py", str(dataset)])
        app = AppTest.from_file(str(APP), default_timeout=120).run()
        return app if name == "data" else app.switch_page(f"views/{name}.py").run()

    return run


def values(app: AppTest) -> dict[str, str]:
    assert not app.exception
    return {metric.label: metric.value for metric in app.metric}


def all_of(root: Path) -> Choice:
    """The whole of a dataset, with the labels of its own policy."""
    dataset = Dataset.open(root)
    policy = dataset.labelling.policy if dataset.labelling else None
    return Choice(path=str(root), version=version_of(dataset), own_policy=policy, policy=policy)


# --- queries ----------------------------------------------------------------------------------


@pytest.mark.parametrize("query", QUERIES)
def test_every_query_runs_by_itself_in_plain_duckdb(query) -> None:
    root, checkpoint = evaluated()
    with duckdb.connect() as plain:
        plain.execute("SET VARIABLE dataset = ?", [str(root)])
        for file in ("tables.sql", "views.sql"):
            for view in duckdb.extract_statements((ROOT / "schemas" / file).read_text()):
                with suppress(duckdb.IOException):  # no files: nothing lies beside the labels
                    plain.execute(view)
        text = (SQL / f"{query}.sql").read_text()
        assert text.startswith("-- ")
        by_itself = plain.execute(text).fetchall()
        assert by_itself == [tuple(row.values()) for row in ask(all_of(root), query)]
        for name, value in asked_by_pages(checkpoint.stem).items():
            plain.execute(f"SET VARIABLE {name} = ?", [value])
        assert plain.execute(text).fetchall() or query == "failures"  # there may be none


def asked_by_pages(checkpoint: str) -> dict[str, Any]:
    """Variables under which every query finds something."""
    plans = Dataset.open(evaluated()[0]).read_rows("plans", split="test")
    return {
        "splits": ["test"],
        "split": "test",
        "statuses": None,
        "checkpoint_id": checkpoint,
        "beta": -50.0,
        "coverage": 0.5,
        "plan_ids": [row["plan_id"] for row in plans],
        "scene_ids": [row["scene_id"] for row in plans],
        "shards": sorted({row["shard"] for row in plans}),
    }


def test_every_query_is_asked_and_no_icon_is_fetched() -> None:
    files = [*APP.parent.rglob("*.py")]
    text = "".join(file.read_text() for file in files)
    for query in QUERIES:
        assert f'"{query}"' in text
    assert "page_icon" not in text
    assert ":material" not in text
    assert not re.search(r"\bselect\s", text, re.IGNORECASE)
    assert not (APP.parent / "pages").exists()  # Streamlit would run its files by themselves


def test_a_changed_file_is_read_again(tmp_path) -> None:
    root = tmp_path / "changed"
    shutil.copytree(labelled(), root)
    choice = all_of(root)
    before = ask(choice, "goal_totals")[0]["goals"]
    dataset = choice.dataset
    file = dataset.files("plans")[0]
    rows = dataset.read_file(file).to_pylist()
    keys = {key: rows[0][key] for key in ("split", "shard", "predicate")}
    dataset.write_rows("plans", rows[1:], **keys, made_by={"config": "c", "planner": "p"})
    assert choice.dataset.metadata(file)["config"] == "c"
    assert ask(all_of(root), "goal_totals")[0]["goals"] == before - 1


def test_a_changed_source_of_a_merged_dataset_is_read_again(tmp_path) -> None:
    roots = [shutil.copytree(labelled(), tmp_path / name) for name in ("one", "two")]
    shutil.rmtree(roots[1] / "scenes")  # no scene may be there twice
    both = merge(roots, tmp_path / "both")
    before = version_of(both)
    assert before[0] == sum(version_of(Dataset.open(root))[0] for root in roots) > 0
    next(roots[0].rglob("*.parquet")).touch()
    assert version_of(both) > before


def test_some_shards_of_each_family_stand_for_a_large_split() -> None:
    shards = {0: "on", 1: "same-plane", 2: "on", 3: "stacks", 5: "on", 6: "same-plane", 8: "on"}
    with duckdb.connect() as plain:
        plain.execute("CREATE TABLE scenes (split VARCHAR, shard INTEGER, family VARCHAR)")
        for shard, family in shards.items():
            plain.execute("INSERT INTO scenes VALUES ('test', ?, ?)", [shard, family])
        plain.execute("INSERT INTO scenes VALUES ('train', 4, 'apart'), ('train', 2, 'apart')")
        plain.execute(
            "CREATE VIEW shard_families AS SELECT DISTINCT split, shard, family FROM scenes"
        )
        text = (SQL / "judged_shards.sql").read_text()
        for every, expected in ((1, list(shards)), (2, [0, 1, 3, 5]), (9, [0, 1, 3])):
            plain.execute("SET VARIABLE every = ?", [every])
            assert [row[0] for row in plain.execute(text).fetchall()] == expected


def test_what_is_not_looked_at_is_not_seen() -> None:
    root, checkpoint = evaluated()
    whole = Dataset.open(root)
    shards = whole.shards("test")
    assert len(shards) > 1
    given = replace(all_of(root), split="test", checkpoint=checkpoint.stem)
    every, some = (replace(given, shards=tuple(these)) for these in (shards, shards[:1]))
    assert some.dataset.shards("test") == shards[:1]
    assert not some.dataset.files("labels", split="train")
    asked = {"checkpoint_id": checkpoint.stem, "split": "test"}
    goals = [ask(choice, "betas", **asked)[0]["goals"] for choice in (given, every, some)]
    assert goals[0] == goals[1] > goals[2] > 0
    assert len(read_predictions(some.dataset, checkpoint.stem)) < len(
        read_predictions(whole, checkpoint.stem)
    )


def test_pages_that_judge_look_at_some_shards_of_a_large_split(page, monkeypatch, tmp_path) -> None:
    root = Path(shutil.copytree(evaluated()[0], tmp_path / "large"))
    dataset = Dataset.open(root)
    shards = dataset.shards("test")
    rows = dataset.read_rows("scenes", split="test")
    scenes = len(rows)
    more = [
        row | {"scene_id": f"{row['scene_id']}-2", "shard": 99}
        for row in rows
        if row["shard"] == shards[0]
    ]
    dataset.write_rows("scenes", more, split="test", shard=99, made_by={"config": "c"})
    app = page(root, "models")
    assert set(app.session_state["choice"].shards) == {*shards, 99}
    assert not any("one shard in" in said.value for said in app.caption)
    monkeypatch.setattr("dashboards.asking.SCENES", 1)
    app = page(root, "models")
    assert not app.exception
    assert app.session_state["choice"].shards == tuple(shards)
    said = f"{scenes} of {scenes + len(more)} scenes"
    assert any(said in caption.value for caption in app.caption)


def test_the_first_figure_waits_for_nothing_heavy() -> None:
    script = "import sys, dashboards.asking, dashboards.showing; print(*sys.modules)"
    done = [sys.executable, "-c", script]
    loaded = subprocess.run(done, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    heavy = {"matplotlib", "numba", "casadi", "torch", "onnxruntime", "prefect", "pybullet"}
    assert not heavy & {*loaded.split()}


# --- pages ------------------------------------------------------------------------------------


def test_data_counts_what_is_chosen(page) -> None:
    root, _ = evaluated()
    dataset = Dataset.open(root)
    app = page(root)
    assert values(app)["Scenes"] == str(len(dataset.read_rows("scenes")))
    plans = dataset.read_rows("plans")
    solved = sum(row["status"] == "solved" for row in plans) / len(plans)
    assert values(app)["Goals solved"] == percent(solved)
    app.button_group(key="only_splits").set_value(["test"]).run()
    assert values(app)["Scenes"] == str(len(dataset.read_rows("scenes", split="test")))
    app.button_group(key="only_splits").set_value([]).run()
    assert not app.exception
    assert not app.metric
    assert app.info


def test_accuracies_are_those_of_the_rows(page) -> None:
    root, checkpoint = evaluated()
    found = read_predictions(Dataset.open(root), checkpoint.stem).queries()
    app = page(root, "models")
    shown = values(app)
    for group in ("same-plane", "on"):
        assert shown[f"Judged rightly, {group}"] == percent(found.of(group).accuracy().total)
    parts = [frame.value for frame in app.dataframe if "part" in frame.value.columns]
    assert len(parts) == 5
    assert all(frame["objects"].sum() == len(found) for frame in parts)


def test_beta_moves_what_is_kept_on_every_page(page) -> None:
    root, checkpoint = evaluated()
    found = read_predictions(Dataset.open(root), checkpoint.stem).queries()
    app = page(root, "models")
    for beta, expected in ((8.0, "100.0%"), (-8.0, "0.0%")):
        app.slider(key="pick_beta").set_value(beta).run()
        assert values(app)["Relevant ones found, on"] == expected
    app.switch_page("views/planning.py").run()
    assert app.slider(key="pick_beta").value == -8.0  # as it was left
    assert values(app)["Relevant queries kept"] == "0.0%"
    app.slider(key="pick_beta").set_value(0.5).run()
    assert values(app)["Goals kept whole"] == percent(found.accuracy(0.5).tasks_whole)


@pytest.mark.parametrize("coverage", [60, 100])
def test_coverage_finds_the_beta_that_covers(page, coverage) -> None:
    app = page(evaluated()[0], "planning")
    app.radio(key="pick_how").set_value("coverage").run()
    app.slider(key="pick_coverage").set_value(coverage).run()
    assert float(values(app)["Goals kept whole"].rstrip("%")) >= coverage


def test_planning_has_the_speed_ups_of_the_reruns(page) -> None:
    root, checkpoint = evaluated()
    app = page(root, "planning")
    by_setting = settings(read_evaluations(Dataset.open(root), checkpoint.stem))
    expected = summarise(by_setting["tree", "prune-then-full", 0.0]).speedup.value
    assert values(app)["Speed-up of prune-then-full"] == f"{expected:.2f}{TIMES}"
    table = next(f.value for f in app.dataframe if "speed-up" in f.value.columns)
    for (search, guide, beta), rows in by_setting.items():
        for family in ("same-plane", "on"):
            found = summarise(rows, family)
            line = table[
                (table.search == search)
                & (table.guide == guide)
                & (table.beta == beta)
                & (table.family == family)
            ].iloc[0]
            assert line["speed-up"] == pytest.approx(found.speedup.value)
            assert (line.goals, line.missed) == (found.n_tasks, found.misses)


def test_scenes_follow_the_filters_and_the_list(page) -> None:
    root, _ = evaluated()
    app = page(root, "scenes")
    app.toggle(key="only_blocked").set_value(False).run()
    app.multiselect(key="only_predicates").set_value(["behind"]).run()
    rows = Dataset.open(root).read_rows("plans", split="test", predicate="behind")
    solved = {f"behind({row['subject']}, {row['reference']})" for row in rows if row["moved"]}
    number = app.number_input(key="pick_place")
    assert (number.min, number.max) == (1, len(solved))
    seen = {app.subheader[0].value}
    for _ in range(len(solved) - 1):
        app.button(key="next").click().run()
        seen.add(app.subheader[0].value)
    assert {text.replace("\\", "") for text in seen} == solved
    app.multiselect(key="only_predicates").set_value(["on"]).run()
    assert not app.exception
    assert app.subheader[0].value.startswith("on(")
    assert any("relevance view" in code.value for code in app.code)


def test_a_link_straight_to_a_page_has_the_side_bar_too(page) -> None:
    app = page(evaluated()[0], "scenes")
    assert {box.key for box in app.sidebar.selectbox} == {"pick_split", "pick_checkpoint"}


# --- what is not there ------------------------------------------------------------------------


def test_without_a_checkpoint_it_says_what_makes_one(page) -> None:
    for name in ("models", "planning", "runs"):
        app = page(labelled(), name)
        assert not app.exception
        assert "relevance train" in " ".join(code.value for code in app.code)
    assert page(labelled(), "scenes").number_input(key="pick_place").max > 1


def test_a_folder_that_is_no_dataset_is_named_and_helped(page, tmp_path) -> None:
    app = page(tmp_path)
    assert not app.exception
    said = [error.value.replace("\\", "") for error in app.error]
    assert said == [f"{tmp_path}: no dataset.json there, expected a dataset folder"]
    assert f"relevance generate {tmp_path}" in app.code[0].value


@pytest.mark.parametrize("name", PAGES)
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
    assert "relevance " in app.code[0].value


def test_a_dataset_that_is_being_made_shows_how_far_it_is(page, tmp_path) -> None:
    half = tmp_path / "half"
    shutil.copytree(labelled(), half)
    shutil.rmtree(half / "labels" / "predicate=on")
    app = page(half)
    assert not app.exception
    dataset = Dataset.open(half)
    texts = [bar.proto.text for bar in app.get("progress")]
    assert texts[1].startswith(f"{len(dataset.files('labels'))} of ")
    assert "relevance label" in app.code[0].value


@pytest.mark.parametrize("what", ["plans", "dataset.json"])
def test_a_broken_file_gets_a_page_that_says_how_to_mend_it(page, tmp_path, what) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(labelled(), broken)
    found = Dataset.open(broken).files("plans")[0]
    file = broken / what if what == "dataset.json" else found
    file.write_bytes(file.read_bytes()[:-100])
    app = page(broken)
    assert not app.exception
    assert file.name in app.error[0].value.replace("\\", "")
    assert "relevance repair" in app.code[-1].value


def test_runs_say_which_checkpoint_stands_and_what_became_of_others(page, tmp_path) -> None:
    root, checkpoint = evaluated()
    shutil.copytree(root, tmp_path / "d")
    there = Dataset.open(tmp_path / "d")
    app = page(there.path, "runs")
    assert any(f"**{checkpoint.stem}**, the newest" in text.value for text in app.markdown)
    assert len(app.dataframe) == 1
    crown(there, checkpoint.stem, "by hand")
    settle(there, "later", before=checkpoint.stem, promoted=False, why="no less work")
    app = page(there.path, "runs")
    assert not app.exception
    assert any(f"**{checkpoint.stem}**, the champion" in text.value for text in app.markdown)
    history = app.dataframe[1].value
    assert [*history["what"]] == ["refused", "promoted"]
    assert [*history["why"]] == ["no less work", "by hand"]


# --- Prefect ----------------------------------------------------------------------------------

ANSWERS: dict[str, Any] = {
    "/api/flows/filter": [{"id": "f1", "name": "label"}],
    "/api/flow_runs/filter": [
        {
            "id": f"r{number}",
            "name": f"run-{number}",
            "flow_id": flow,
            "state": {"message": "disk is full" if state == "Failed" else None},
            "state_name": state,
            "start_time": "2026-01-02T03:04:05Z",
            "total_run_time": 90.0,
            "parameters": {"dataset": "data/x"},
        }
        for number, (flow, state) in enumerate(
            (("f1", "Completed"), ("f1", "Failed"), ("someone-else", "Completed"))
        )
    ],
    "/api/artifacts/latest/filter": [
        {
            "key": "balance",
            "type": "markdown",
            "description": "Label balance",
            "data": "# all well",
            "updated": "2026-01-02T03:04:05Z",
        }
    ],
}


@contextmanager
def prefect(answers: dict[str, Any]) -> Iterator[str]:
    """Answers as Prefect's API does; its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            of = asked.get("flows", {}).get("id", {}).get("any_")
            found = [one for one in answers[self.path] if not of or one["flow_id"] in of]
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(found).encode())

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/api"
        finally:
            server.shutdown()


def test_runs_are_of_the_flows_that_are_deployed() -> None:
    deployed = yaml.safe_load((ROOT / "prefect.yaml").read_text())["deployments"]
    assert {one["name"] for one in deployed} == {*FLOWS}


def test_runs_come_from_the_server(page, monkeypatch) -> None:
    root, checkpoint = evaluated()
    app = page(root, "runs")
    assert "prefect server start" in app.code[-1].value
    assert any(checkpoint.stem in text.value for text in app.markdown)
    with prefect(ANSWERS) as url:
        monkeypatch.setenv("PREFECT_API_URL", url)
        app = AppTest.from_file(str(APP), default_timeout=120).run()
        app.switch_page("views/runs.py").run()
        shown = values(app)
        assert (shown["Runs"], shown["Completed"], shown["Failed or crashed"]) == ("2", "1", "1")
        table = app.dataframe[-1].value
        assert [*table["run"]] == ["run-0", "run-1"]
        assert [*table["said"]] == ["", "disk is full"]
        assert any("all well" in text.value for text in app.markdown)
        app.multiselect(key="runs_states").set_value(["Failed"]).run()
        assert [*app.dataframe[-1].value["run"]] == ["run-1"]
