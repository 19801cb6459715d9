"""Studies: parts of a dataset, learning curves, sets of runs that survive a kill, their tables."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import small_dataset
from matplotlib.figure import Figure
from ruled import ruled

from relevance.benchmarks.studies import _more, at_share, markdown, tabulate
from relevance.cli import main
from relevance.errors import RelevanceError
from relevance.evaluation import (
    JUDGES,
    NETWORK,
    RULE,
    accuracy_table,
    breakdown_table,
    predict,
    read_predictions,
)
from relevance.metrics import Accuracy
from relevance.models import BODIES
from relevance.report.paper import Queries
from relevance.scene import group_of
from relevance.store import Dataset, DatasetError
from relevance.training import (
    STUDIES,
    Catalogue,
    Plan,
    Reader,
    Run,
    Study,
    TrainConfig,
    load_checkpoint,
    run_study,
    train,
)
from relevance.workers import Outcomes, Unit

CONFIG = replace(
    TrainConfig.smoke().with_body("geometry"),
    steps=6, save_every=1, threads=1, workers=0, scenes_per_batch=2, goals_per_scene=4,
)  # fmt: skip


def reader(root: Path, config: TrainConfig, split: str = "train") -> Reader:
    return Reader(catalogue=Catalogue.of(Dataset.open(root), split, config), config=config)


# --- parts of a dataset -------------------------------------------------------------------


def test_a_share_of_the_scenes_is_the_first_shards_of_each_family() -> None:
    """4 and 2 scenes of same-plane in two shards, 4 of `on` in one."""
    root = ruled()

    def shards(share: float, split: str = "train") -> list[tuple[str, int]]:
        found = reader(root, replace(CONFIG, scene_share=share), split).catalogue.shards
        return [(shard.family, shard.scenes) for shard in found]

    assert shards(1.0) == [("same-plane", 4), ("same-plane", 2), ("on", 4)]
    assert shards(0.6) == [("same-plane", 4), ("on", 4)]
    assert shards(0.7) == shards(1.0), "at least the share"
    assert shards(0.01) == shards(0.6), "and never nothing"
    assert shards(0.01, "validation") == shards(1.0, "validation"), "it is about learning alone"


def test_goals_that_are_learned_from_are_always_the_same() -> None:
    root, few = ruled(), replace(CONFIG, scene_goals=1, mirror=False, steps=40)
    rows = Dataset.open(root).read_rows("labels", split="train")
    plans: dict[tuple[str, str], set[str]] = {}
    for row in rows:
        plans.setdefault((row["scene_id"], row["predicate"]), set()).add(row["plan_id"])
    assert 2 in {len(some) for some in plans.values()}
    goal_of = {row["plan_id"]: (row["subject"], row["reference"]) for row in rows}
    seen: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for batches in reader(root, few).steps():
        for batch in batches:
            for predicate, goals, _, labelled in batch.turns:
                for b, g in labelled.any(-1).nonzero().tolist():
                    names = batch.objects[b]
                    subject, reference = (names[i] for i in goals[b, g].tolist())
                    key = batch.names[b], predicate.name
                    seen.setdefault(key, set()).add((subject, reference))
    assert seen == {key: {goal_of[min(some)]} for key, some in plans.items()}


@pytest.mark.parametrize("goal_objects", [True, False])
@pytest.mark.parametrize("goals", [0, 1])
@pytest.mark.parametrize("share", [0.5, 1.0])
@pytest.mark.parametrize("size", [0, 7])
def test_an_epoch_has_as_many_examples_as_are_counted(
    size: int, share: float, goals: int, goal_objects: bool
) -> None:
    """Which look a step takes is arithmetic on the counts."""
    config = replace(
        CONFIG, scene_share=share, scene_goals=goals, queries_per_batch=size,
        goal_objects=goal_objects, ambiguous=False,
    )  # fmt: skip
    own = reader(ruled(), config)
    assert own.catalogue.groups
    for group, counts in enumerate(own.catalogue.counts):
        assert sum(1 for _ in own._epoch(group, 0)) == sum(counts.values()) > 0


# --- the way of a run ---------------------------------------------------------------------


def copied(tmp_path: Path, name: str = "dataset", of: Callable[[], Path] = ruled) -> Path:
    return Path(shutil.copytree(of(), tmp_path / name))


def test_a_learning_curve_changes_no_weight_and_survives_a_kill(tmp_path: Path) -> None:
    config = replace(CONFIG, validations=4, validation_scenes=1)
    plain = load_checkpoint(train(copied(tmp_path, "plain"), CONFIG))
    curved = load_checkpoint(train(copied(tmp_path, "curved"), config))

    def stop(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    root = copied(tmp_path, "killed")
    with pytest.raises(KeyboardInterrupt):
        train(root, config, progress=stop)
    killed = load_checkpoint(train(root, config))
    weights = plain[0].state_dict()
    for model, meta in (curved, killed):
        assert all(torch.equal(weights[k], w) for k, w in model.state_dict().items())
        assert meta["checkpoint_id"] == plain[1]["checkpoint_id"]
        for name in ("history", "metrics", "offsets", "scenes", "asked"):
            assert meta[name] == plain[1][name], name
    points = curved[1]["validations"]
    assert killed[1]["validations"] == points
    assert plain[1]["validations"] == []
    assert [point["step"] for point in points] == [2, 3, 5, 6]
    assert {"same-plane", "on"} <= set(points[0]["queries"])
    asked = points[-1]["queries"]["on"]
    whole = curved[1]["metrics"]["on"]["queries"]
    assert 0 < asked["relevant"] + asked["irrelevant"] < whole["relevant"] + whole["irrelevant"]


@pytest.mark.parametrize("split", ["train", "validation"])
def test_goals_are_counted_where_they_are_wanted(split: str) -> None:
    """Goals of each scene and predicate that are read whole."""

    def most(config: TrainConfig) -> int:
        batches = reader(ruled(), config, split).whole()
        return max(int(turn[3].any(-1).sum(-1).max()) for batch in batches for turn in batch.turns)

    assert most(CONFIG) == 2
    assert most(replace(CONFIG, scene_goals=1)) == (1 if split == "train" else 2)
    assert most(replace(CONFIG, validation_goals=1)) == (1 if split == "validation" else 2)


def test_a_run_says_how_much_it_was_asked(tmp_path: Path) -> None:
    root = copied(tmp_path)
    _, meta = load_checkpoint(train(root, CONFIG))
    scenes, asked = 0, Counter()
    for batches in reader(root, CONFIG).steps():
        for batch in batches:
            scenes += len(batch.names)
            for predicate, goals, _, labelled in batch.turns:
                for b, g, query in labelled.nonzero().tolist():
                    if query not in goals[b, g]:
                        asked[group_of(predicate.name, batch.families[b])] += 1
    assert meta["scenes"] == scenes
    assert meta["asked"] == dict(asked)


# --- declared sets ------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(STUDIES))
def test_every_run_of_a_study_has_a_name_and_a_share_of_the_time(name: str) -> None:
    runs = list(STUDIES[name].runs())
    assert len({run.name for run in runs}) == len(runs)
    assert all(0 < run.share <= 1 for run in runs)
    told = {json.dumps(run.config.to_dict()) for run in runs}
    assert len(told) == len(runs) or name == "data", "no run twice"


def test_studies_hold_what_they_are_for() -> None:
    bodies = list(STUDIES["bodies"].runs())
    fair = Counter(run.config.model.body for run in bodies if run.recipe == "fair")
    assert set(fair) == set(BODIES)
    assert {run.config.polling for run in bodies} == {"turns", "rounds", "one-by-one"}
    bare = {(r.config.model.body, r.config.families) for r in bodies if r.recipe == "bare"}
    assert bare == {
        (body, (family,))
        for body in ("vit", "resnet", "resnet3d")
        for family in ("same-plane", "on")
    }
    data = Counter(run.config.model.body for run in STUDIES["data"].runs())
    assert data == {"geometry": 12, "glimpse": 3}
    assert [run.ship for run in STUDIES["ship"].runs()] == ["glimpse", "geometry"]
    with pytest.raises(RelevanceError, match="study best: no run has soup in its name, expected"):
        _ = Plan.of("x", "best", folder=Path("y"), only=("soup",)).runs
    with pytest.raises(RelevanceError, match="unknown study 'soup', expected one of bodies"):
        Plan.of("x", "soup", folder=Path("y"))


# --- running and judging ------------------------------------------------------------------


@pytest.fixture
def tiny() -> Generator[str]:
    """Four runs: two are alike but for the seed, two share a label, each with scenes of its own."""
    run = Run(label="small", recipe="smoke", config=CONFIG, curve="smoke")
    alone = replace(CONFIG, predicates=("on",), families=("on",))
    other = replace(CONFIG, predicates=("behind",), families=("same-plane",))
    runs = [
        run,
        replace(run, config=replace(CONFIG, seed=1)),
        replace(run, label="alone", config=alone),
        replace(run, label="alone", config=other),
    ]
    name = "tiny"
    STUDIES.register(name, Study(about="tests", minutes=1e-4, runs=lambda: iter(runs)))
    yield name
    STUDIES.unregister(name)


class Killed(BaseException):
    """As a kill: nothing handles it."""


def here(kill_at: int = 0) -> Callable[[str, int], Outcomes[Unit]]:
    """A pool in this process; it is killed at a step of all runs."""
    done = 0

    def progress(_: int, total: int) -> None:
        nonlocal done
        done += 1
        if done == kill_at:
            raise Killed

    def outcomes(units: Mapping[str, Unit]) -> Generator[tuple[str, Any], None, None]:
        for name, unit in units.items():
            yield name, unit.run(progress)

    return lambda what, total: outcomes


def nobody(what: str, total: int) -> Outcomes[Unit]:
    raise AssertionError("everything is done")


def without_times(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    times = ("core_seconds", "train_seconds", "wait_seconds")
    return [{key: value for key, value in row.items() if key not in times} for row in rows]


def test_a_killed_study_ends_with_the_same_table(tiny: str, tmp_path: Path) -> None:
    steps = tmp_path / "steps.json"
    tables = []
    for kill_at in (0, 5):
        root = copied(tmp_path, f"dataset-{kill_at}", small_dataset)
        plan = Plan.of(root, tiny, folder=tmp_path / f"out-{kill_at}")
        plan.folder.mkdir()
        if kill_at:  # clocks differ: how many steps fit is what the first study found
            shutil.copy(steps, plan.folder / "steps.json")
            with pytest.raises(Killed):
                run_study(plan, pooled=here(kill_at), told=lambda line: None)
            kept = plan.table.read_text().count("\n")
            assert kept < 3, "it was killed before the end"
        else:
            fitted = run_study(plan, pooled=here(), told=lambda line: None)
            shutil.copy(plan.folder / "steps.json", steps)
            assert [row["steps"] for row in fitted[:2]] == [fitted[0]["steps"]] * 2
        rows = run_study(plan, pooled=here(), told=lambda line: None)
        assert run_study(plan, pooled=nobody, told=lambda line: None) == rows
        assert [json.loads(line) for line in plan.table.read_text().splitlines()] == rows
        tables.append(without_times(rows))
    assert tables[0] == tables[1]
    assert [row["run"] for row in tables[0]] == [
        "small, seed 0", "small, seed 1", "alone, on, seed 0", "alone, same-plane, seed 0",
    ]  # fmt: skip


def test_predictions_that_were_lost_are_made_again(tiny: str, tmp_path: Path) -> None:
    root = copied(tmp_path, of=small_dataset)
    plan = Plan.of(root, tiny, folder=tmp_path / "out", only=("alone, on",))
    [row] = run_study(plan, pooled=here(), told=lambda line: None)
    folder = root / "predictions"
    shutil.rmtree(folder)
    assert run_study(plan, pooled=here(), told=lambda line: None) == [row]
    assert list(folder.rglob("*.parquet"))


def test_figures_are_those_of_an_evaluation(tiny: str, tmp_path: Path) -> None:
    root = copied(tmp_path, of=small_dataset)
    dataset, plan = Dataset.open(root), Plan.of(root, tiny, folder=tmp_path / "out")
    rows = run_study(plan, pooled=here(), told=lambda line: None)
    measured = tabulate(root, tiny, rows)
    names = ("true_relevant", "true_irrelevant", "total", "base_rate", "balanced", "tasks_right")
    for row in rows:
        name = row["checkpoint_id"]
        mine = read_predictions(dataset, name)
        predict(root, root / "checkpoints" / f"{name}.pt")
        its = read_predictions(dataset, name)
        np.testing.assert_allclose(mine.score, its.score, atol=1e-4)
        for column in ("relevant", "task", "predicate", "is_goal_object"):
            np.testing.assert_array_equal(getattr(mine, column), getattr(its, column))
        found = {
            (s.group, s.goals, s.stands, s.boxes): s
            for s in measured.rows
            if s.run == row["run"] and s.judge == NETWORK
        }
        for line in accuracy_table(its.queries()):
            if line["judge"] == NETWORK:
                one = found[line["family"], "all goals", "", ""]
                for figure in names:
                    assert getattr(one, figure) == pytest.approx(line[figure], nan_ok=True)
                metrics = row["test"][line["family"]]["queries"]
                assert metrics["total"] == pytest.approx(line["total"])
        for line in breakdown_table(its.queries(), "stands"):
            one = found[line["family"], "all goals", line["stands"], ""]
            assert one.total == pytest.approx(line["total"])
        sizes = [one for one in found.values() if one.boxes]
        assert sizes
        for one in sizes:
            n = its.queries().of(one.group).n_objects
            least, most = map(int, one.boxes.split(" to "))
            assert one.queries == ((n >= least) & (n <= most)).sum()
    ruled = [s for s in measured.rows if s.judge == RULE]
    rules = {(s.group, s.goals, s.stands, s.boxes): s for s in ruled}
    queries = read_predictions(dataset, rows[0]["checkpoint_id"]).queries()
    part = queries.of("on")
    expected = Accuracy.of(JUDGES[RULE](part), part.relevant, task=part.task)
    assert rules["on", "all goals", "", ""].total == expected.total
    assert len(rules) == len(ruled), "each group is judged once by a rule"
    text = markdown(measured.tables)
    assert "### tiny: mean over seeds (range)" in text
    assert all(f"| {label} |" in text for label in ("small", "alone", RULE, "always irrelevant"))


def test_a_total_is_weighed_anew_by_the_share_of_relevant_queries() -> None:
    relevant = np.array([True] * 2 + [False] * 8)
    found = Accuracy.of(np.array([1.0, -1, 1, 1, -1, -1, -1, -1, -1, -1]), relevant)
    assert at_share(found, Queries(2, 8)) == pytest.approx(found.total)
    assert at_share(found, Queries(1, 0)) == pytest.approx(found.true_relevant)
    assert at_share(found, Queries(139, 861)) == pytest.approx(0.139 * 0.5 + 0.861 * 0.75)


def test_without_test_labels_there_is_one_line(tiny: str, tmp_path: Path) -> None:
    plan = Plan.of(ruled(), tiny, folder=tmp_path / "out")
    with pytest.raises(DatasetError, match="no labels of split test"):
        run_study(plan, pooled=nobody)
    assert not plan.folder.exists()


def test_studies_run_where_planner_and_command_line_are_not(tmp_path: Path) -> None:
    absent = ("casadi", "pybullet", "prefect", "tyro", "rich", "streamlit", "matplotlib")
    code = f"import sys; sys.modules.update(dict.fromkeys({absent}))\n"
    code += "from relevance.training import Plan, run_study, STUDIES; print(*STUDIES)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[:2] == ["bodies", "data"]


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "inf"])
def test_a_study_takes_time(minutes: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["study", str(tmp_path), "data", "--minutes", minutes]) == 2
    assert f"--minutes {float(minutes)}: expected a number over 0" in capsys.readouterr().err


@pytest.mark.slow  # worker processes load torch
def test_the_command_writes_tables_and_pictures(tiny: str, tmp_path: Path, capsys: Any) -> None:
    root, out = copied(tmp_path, of=small_dataset), tmp_path / "out"
    command = ["study", str(root), tiny, "--out", str(out), "--workers", "2"]
    assert main(command) == 0
    names = {file.name for file in islice(out.iterdir(), 20)}
    assert {"tiny.md", "tiny.csv", "tiny.jsonl", "tiny-learning-smoke.png"} <= names
    assert "tiny-learning-smoke.svg" in names
    before = (out / "tiny.md").read_text()
    assert main(command) == 0
    assert (out / "tiny.md").read_text() == before
    assert main(["study", str(root), "soup"]) == 2
    assert "unknown study 'soup'" in capsys.readouterr().err


def test_more_of_something_is_drawn_where_three_amounts_are_known() -> None:
    def row(body: str, scenes: int, minutes: float, recipe: str = "long") -> dict[str, Any]:
        found = {"body": body, "scenes": scenes, "minutes": minutes, "recipe": recipe}
        return found | {"scene_goals": 0, "group": "on", "total": 0.9, "base_rate": 0.7}

    def drawn(rows: list[dict[str, Any]], by: str, same: str) -> dict[str, set[str]]:
        lines = {}
        for plot in _more("tried", rows, by, by, same=same):
            axes = Figure().subplots(1, plot.panels, squeeze=False)[0]
            plot.draw(*axes)
            lines[plot.name] = set(axes[0].get_legend_handles_labels()[1])
        return lines

    rows = [row("geometry", scenes, 10.0) for scenes in (100, 200, 400)]
    rows += [row("geometry", 400, 5.0), row("glimpse", 400, 10.0), row("vit", 100, 10.0, "fair")]
    ten = {"geometry, all goals of each, 10 minutes"}
    assert drawn(rows, "scenes", "minutes") == {"tried-by-scenes": ten}
    assert drawn(rows, "minutes", "scenes") == {}
    rows.append(row("geometry", 400, 2.5))
    all_of_them = {"geometry, all goals of each, 400 scenes"}
    assert drawn(rows, "minutes", "scenes") == {"tried-by-minutes": all_of_them}
