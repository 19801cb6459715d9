"""The benchmark: its tasks, its figures, its parts, and the command."""

import csv
import json
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from conftest import small_dataset

from relevance.benchmarks import (
    MAX_EDGE,
    BenchmarkError,
    draw,
    find_unsolved,
    measure_against,
    measure_completeness,
    measure_planning,
    measure_scaling,
    measure_searches,
    measure_stability,
    measure_versus,
    save,
)
from relevance.benchmarks.completeness import Compared, completeness_table
from relevance.benchmarks.runs import Measured, interval, ratio, share
from relevance.benchmarks.stability import (
    JITTER,
    JITTERS,
    Jittered,
    equal_plans,
    jitter,
    jittered,
    stability_table,
)
from relevance.benchmarks.versus import ROOT
from relevance.cli import main
from relevance.cli.bench import hand_over
from relevance.planner import Counts, PlannerConfig, PlanResult, Seconds, plan
from relevance.scene import Box, Scene, goal_holds, read_scenes
from relevance.training import RECIPES, steps_within

RED, GREEN, BLUE = (0.8, 0.1, 0.1), (0.1, 0.7, 0.1), (0.1, 0.1, 0.8)


def box(name, x, y, color=RED, size=(0.05, 0.05, 0.06), **rest):
    height = rest.pop("bottom", 0.0) + size[2] / 2
    return Box(name=name, size=size, position=(x, y, height), color=color, **rest)


def found(table):
    return {str(row[0]): row[1] for row in table.rows}


FREE = (box("red", 0.0, 0.25), box("blue", 0.0, -0.1, BLUE))


@pytest.fixture(scope="module")
def tasks():
    return draw(40, 17)


# -- tasks -----------------------------------------------------------------------------------------


def test_tasks_depend_on_the_seed_alone_and_a_longer_draw_keeps_the_earlier(tasks):
    assert draw(7, 17) == tasks[:7]
    assert draw(7, 18) != tasks[:7]
    assert draw(7, 17, stream="another") != tasks[:7]


def test_predicates_and_sizes_come_in_equal_shares_and_no_goal_is_true_yet(tasks):
    assert set(Counter(task.goal.predicate for task in tasks).values()) == {8}
    assert Counter(task.n_objects for task in tasks) == dict.fromkeys(range(3, 11), 5)
    assert not any(goal_holds(task.scene.objects, task.goal, task.scene.robot) for task in tasks)


def test_thirty_boxes_can_be_drawn():
    drawn = draw(5, 3, boxes=(30, 30), max_edge=MAX_EDGE)
    assert [task.n_objects for task in drawn] == [30] * 5
    assert max(max(b.size[:2]) for task in drawn for b in task.scene.objects) <= MAX_EDGE


def test_foreign_tasks_are_three_to_two_and_depend_on_the_seed_alone():
    drawn = draw(200, 4, scenes="foreign")
    assert Counter(task.goal.predicate.stacked for task in drawn) == {False: 120, True: 80}
    beside = Counter(task.goal.predicate.name for task in drawn if not task.goal.predicate.stacked)
    assert set(beside.values()) == {30}
    assert draw(3, 4, scenes="foreign", first=5) == drawn[5:8]
    assert draw(3, 5, scenes="foreign") != drawn[:3]
    for task in drawn:
        edges = [edge for b in task.scene.objects for edge in b.size]
        assert 0.04 <= min(edges) <= max(edges) <= 0.12
        assert min(task.scene[task.goal.subject].size[:2]) <= 0.07
        assert not goal_holds(task.scene.objects, task.goal, task.scene.robot)
    assert any(b.on for task in drawn for b in task.scene.objects)


def test_impossible_settings_name_what_is_wrong():
    for words, count, seed, boxes in (
        ("tasks = 0", 0, 1, (3, 5)),
        ("seed = -1", 1, -1, (3, 5)),
        (r"boxes = \(2, 5\)", 1, 1, (2, 5)),
    ):
        with pytest.raises(BenchmarkError, match=words):
            draw(count, seed, boxes=boxes)


# -- figures ---------------------------------------------------------------------------------------


def test_intervals_cover_and_shrink_with_the_sample():
    rng = np.random.default_rng(1)
    widths = []
    for count in (50, 5000):
        sample = rng.exponential(size=count)
        here = interval(sample, "median")
        assert here.value == np.median(sample)
        assert here.low <= here.value <= here.high
        widths.append(here.high - here.low)
    assert widths[1] < widths[0] / 4
    assert here.low < math.log(2) < here.high
    assert math.isnan(interval([], "mean").value)
    assert interval([2.0], "p99").high == 2.0


@pytest.mark.parametrize("statistic", ["median", "mean"])
def test_ratios_pair_the_tasks(statistic):
    times = np.random.default_rng(2).lognormal(size=200)
    found = ratio(100 * times, times, statistic)
    assert found.value == pytest.approx(100)
    assert found.high - found.low < 1e-9  # the same tasks are drawn for both


def test_shares_say_how_many_of_how_many():
    assert share(995, 1000) == "995 of 1000 = 99.5% (98.8 to 99.8)"
    assert share(0, 0) == "0 of 0"


# -- completeness ----------------------------------------------------------------------------------


def test_completeness_counts_what_is_refuted_and_what_is_longer():
    row = Compared(
        task=0, scene_id="", goal="", predicate="on", n_objects=3, status="solved", reason="",
        ambiguous=False, moved=("red",), reference=0, robust=0, alone=None,
    )  # fmt: skip
    refused = replace(row, status="infeasible", moved=(), alone=True)
    rows = [
        row,
        replace(row, moved=("a", "red")),
        replace(row, moved=("a", "red"), robust=1),
        refused,
        replace(refused, ambiguous=True, robust=None),
        replace(refused, reference=None, robust=None, alone=False),
        replace(refused, status="limit"),
        replace(row, reference=None, robust=None),
    ]
    lines = completeness_table(rows).rows
    assert [line[1].split(" = ")[0] for line in lines] == [
        "3 of 8", "2 of 3", "1 of 3", "1 of 3", "1 of 3", "1 of 1", "4 of 8", "2 of 4", "1 of 4",
        "1", "5 of 8", "2 of 5", "1",
    ]  # fmt: skip


# -- stability -------------------------------------------------------------------------------------


def test_jitter_moves_every_box_by_the_same_distance_and_carries_what_stands_on_it():
    top = box("green", 0.0, -0.1, GREEN, size=(0.04,) * 3, bottom=0.06, on="blue")
    scene = Scene(objects=(*FREE, top))
    moved = jitter(scene, np.random.default_rng(4))
    shift = {
        name: np.array(moved[name].position) - np.array(scene[name].position)
        for name in scene.names
    }
    for own in (shift["red"], shift["blue"], shift["green"] - shift["blue"]):
        assert np.linalg.norm(own) == pytest.approx(JITTER)
        assert own[2] == 0
    assert moved.id != scene.id


def test_equal_plans_notice_one_bit(tasks):
    result = plan(tasks[0].scene, tasks[0].goal)
    assert equal_plans(result, plan(tasks[0].scene, tasks[0].goal))
    phase = result.phases[0]
    q = phase.q.copy()
    q[3, 2] = np.nextafter(q[3, 2], 1.0)
    assert not equal_plans(
        result, replace(result, phases=(replace(phase, q=q), *result.phases[1:]))
    )


def test_stability_counts_flips_and_what_the_flag_foretells():
    row = Jittered(
        task=0, jitter=0, scene_id="", goal="", predicate="on", n_objects=4, status="solved",
        status_moved="solved", moved=("a",), moved_moved=("a",), ambiguous=False,
        ambiguous_moved=False, same_again=True, labels=2, flips=0,
    )  # fmt: skip
    rows = [
        row,
        replace(row, moved_moved=("b", "a"), flips=1),
        replace(row, moved_moved=("b", "a"), flips=1, ambiguous=True),
        replace(row, ambiguous=True),
        replace(row, status_moved="infeasible", moved_moved=(), labels=0, ambiguous=True),
    ]
    lines = found(stability_table(rows))
    counts = {name: value.split(" = ")[0] for name, value in lines.items()}
    assert counts["labels that flip (both solved)"] == "2 of 8"
    assert counts["labels that flip, rows not flagged"] == "1 of 4"
    assert counts["goals whose moved set flips (both solved)"] == "2 of 4"
    assert counts["goals that turn from solved to not or back"] == "1 of 5"
    assert counts["precision: flagged goals that flip"] == "2 of 3"
    assert counts["recall: flipped goals that were flagged"] == "2 of 3"
    assert counts["goals that flip unflagged"] == "1 of 2"


def test_jittered_tasks_are_planned_on_moved_scenes(tasks):
    for k, row in enumerate(jittered(tasks[1], 3, PlannerConfig())):
        assert row.same_again
        assert row.status == plan(tasks[1].scene, tasks[1].goal).status
        moved = jitter(
            tasks[1].scene, np.random.Generator(np.random.Philox(key=3, counter=[0, 0, k, 1]))
        )
        assert row.moved_moved == plan(moved, tasks[1].goal).moved


# -- the parts -------------------------------------------------------------------------------------


def test_planning_measures_every_task_and_replays_every_plan(tasks, tmp_path):
    heard = []
    measured = measure_planning(tasks[:10], progress=lambda *step: heard.append(step))
    assert heard == [(done, 30) for done in range(1, 31)]
    for row, task in zip(measured.rows, tasks, strict=False):
        assert (row.task, row.scene_id) == (task.index, task.scene.id)
        assert 0 < row.cpu_pose + row.cpu_keyframe + row.cpu_path < row.cpu < 5
        assert (row.replay_ok is None) == (not row.solved)
    solved = sum(row.solved for row in measured.rows)
    tables = {table.name: table for table in measured.tables}
    truth = found(tables["truth"])["plans that replay"]
    assert truth.startswith(f"{solved} of {solved}")
    everything = next(row for row in tables["outcomes"].rows if row[0] == "all")
    assert everything[1:3] == (10, solved)
    for plot in measured.plots:
        for file in save(plot, tmp_path):
            assert file.stat().st_size > 1000
    assert {file.name for file in tmp_path.iterdir()} == {
        "speed.png", "speed.svg", "truth.png", "truth.svg",
    }  # fmt: skip


def test_searches_and_scaling_run_both(tasks):
    measured = measure_searches(tasks[:5])
    assert all(row.nodes_tree >= row.nodes_informed for row in measured.rows)
    sizes = {n: draw(2, 1, boxes=(n, n)) for n in (3, 6)}
    scaled = measure_scaling(sizes, config=PlannerConfig(node_limit=3))
    assert [(row.n_objects, row.search) for row in scaled.rows] == [
        (n, search) for n in (3, 6) for _ in range(2) for search in ("informed", "tree")
    ]
    assert any(row.status == "limit" for row in scaled.rows)


def test_against_counts_both_and_lets_the_replay_judge(tasks):
    def peer(scene, goal):
        """A peer that solves the third task only, and says nonsense on the second."""
        mine = plan(scene, goal)
        nothing = PlanResult(
            goal=goal, status="limit", final={}, counts=Counts(), seconds=Seconds(total=1.0)
        )
        if scene == tasks[1].scene:
            return replace(mine, phases=mine.phases[:-1])
        return mine if scene == tasks[2].scene else nothing

    assert all(plan(task.scene, task.goal).status == "solved" for task in tasks[1:3])
    measured = measure_against(tasks[:3], peer, name="other")
    assert [row.replay_ok_peer for row in measured.rows] == [None, False, True]
    lines = found(measured.tables[1])
    assert lines["solved by other"].startswith("2 of 3")
    assert lines["plans that replay, other"].startswith("1 of 2")
    assert lines["stopped at the limit, other"].startswith("1 of 3")
    assert not measured.exceptions


def test_against_lists_the_tasks_in_which_the_peer_does_better(tasks):
    """Ours may take too few actions here: the peer solves what ours leaves, in both kinds."""
    short = PlannerConfig(max_actions=2)
    hard = find_unsolved(2, 1, config=short)
    assert all(plan(task.scene, task.goal, config=short).status != "solved" for task in hard)
    measured = measure_against(tasks[:2], plan, name="other", unsolved=hard, config=short)
    assert [row.kind for row in measured.rows] == ["random"] * 2 + ["unsolved"] * 2
    beaten = [row for row in measured.rows if row.status != "solved" and row.replay_ok_peer]
    assert beaten
    assert [task.scene.id for task in measured.exceptions] == [row.scene_id for row in beaten]
    tables = {table.name: table for table in measured.tables}
    assert len(tables["exceptions"].rows) == len(beaten)
    assert set(tables) == {"against", "outcomes", "unsolved", "exceptions"}
    row = measured.rows[0]
    both = replace(row, status="solved", replay_ok=True, moved=("a", "b", "c"), moved_peer=("c",))
    assert not replace(both, replay_ok_peer=False).longer
    assert replace(both, replay_ok_peer=True).longer
    assert not replace(both, replay_ok_peer=True).lost


def test_versus_needs_a_checkout(tasks, tmp_path):
    with pytest.raises(BenchmarkError, match="expected a checkout"):
        measure_versus(tasks[:1], tmp_path)


@pytest.mark.slow  # a process starts and warms up
def test_versus_says_when_the_other_planner_stops(tasks, tmp_path):
    broken = tmp_path / "relevance" / "planner"
    broken.mkdir(parents=True)
    (broken.parent / "__init__.py").touch()
    (broken / "__init__.py").touch()
    with pytest.raises(BenchmarkError, match="its planner stopped"):
        measure_versus(tasks[:1], tmp_path)


@pytest.mark.slow  # two processes start and warm up
def test_versus_itself_nothing_differs(tasks):
    measured = measure_versus(tasks[:3], ROOT, growth=tasks[3:4])
    assert [row.part for row in measured.rows] == ["tasks"] * 3 + ["growth"]
    for row, task in zip(measured.rows, tasks, strict=False):
        ours = plan(task.scene, task.goal)
        assert (row.status, row.moved) == (row.status_other, row.moved_other)
        assert (row.status, row.moved) == (ours.status, ours.moved)
        assert row.cpu > 0 < row.cpu_other
    assert not measured.exceptions
    assert found(measured.tables[1])["same moved set where both solve"].startswith("3 of 3")


def test_completeness_and_stability_cover_every_task(tasks):
    small = draw(4, 2, boxes=(3, 4))
    assert [row.task for row in measure_completeness(small).rows] == [0, 1, 2, 3]
    rows = measure_stability(tasks[:3], seed=1).rows
    assert [row.task for row in rows] == [i for i in range(3) for _ in range(JITTERS)]
    assert all(row.same_again for row in rows)


# -- the command -----------------------------------------------------------------------------------


def test_bench_writes_rows_tables_plots_and_scenes_that_plan_reads(tmp_path, capsys):
    assert main(["bench", "planner", "--tasks", "5", "--seed", "9", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert "--seed 9 remakes these tasks" in printed.err
    for title in ("Planning time", "Truth of plans", "Stability", "Tree against", "Completeness"):
        assert title in printed.out
    names = {file.name for file in tmp_path.iterdir()}
    stems = {"tasks", "stability", "searches", "completeness", "scaling"}
    assert {f"{stem}.csv" for stem in stems} <= names
    assert {"speed.png", "speed.svg", "scaling.png", "summary.json"} <= names
    with (tmp_path / "tasks.csv").open() as file:
        rows = list(csv.DictReader(file))
    scenes = read_scenes(tmp_path / "scenes.jsonl")
    assert [row["scene_id"] for row in rows] == [scene.id for scene in scenes]
    assert [task.scene.id for task in draw(5, 9)] == [scene.id for scene in scenes]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["seed"] == 9
    assert "truth" in {table["name"] for table in summary["tables"]}


def test_exceptions_are_scenes_that_plan_reads(tasks, tmp_path, capsys):
    row = Compared(
        task=0, scene_id="", goal="", predicate="on", n_objects=3, status="solved", reason="",
        ambiguous=False, moved=(), reference=0, robust=0, alone=None,
    )  # fmt: skip
    for some in (tasks[:1], tasks[1:3], []):  # of several parts, one of them without any
        part = Measured(name="part", rows=(row,), tables=(), exceptions=tuple(some))
        hand_over(part, tmp_path)
    scenes = read_scenes(tmp_path / "exceptions.jsonl")
    assert [(scene.id, scene.goals) for scene in scenes] == [
        (task.scene.id, (str(task.goal),)) for task in tasks[:3]
    ]


def test_parts_are_chosen_and_a_fresh_seed_is_told(tmp_path, capsys):
    out = str(tmp_path)
    assert main(["bench", "planner", "--tasks", "2", "--out", out, "--parts", "searches"]) == 0
    seed = capsys.readouterr().err.split("--seed ")[1].split()[0]
    first = (tmp_path / "searches.csv").read_text()
    assert not (tmp_path / "tasks.csv").exists()
    again = ["bench", "planner", "--tasks", "2", "--out", out, "--parts", "searches"]
    assert main([*again, "--seed", seed]) == 0
    assert [line.split(",")[:5] for line in first.splitlines()] == [
        line.split(",")[:5] for line in (tmp_path / "searches.csv").read_text().splitlines()
    ]


def test_bench_without_a_known_target_says_which_there_are(capsys):
    assert main(["bench"]) == 0
    assert "bench planner" in capsys.readouterr().out
    assert main(["bench", "nothing"]) == 2
    assert "bench planner" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--tasks", "0"], "--tasks 0: expected at least 1"),
        (["--seed", "-1"], "--seed -1: expected 0 to 2**63 - 1"),
        (["--unsolved", "3"], "--unsolved 3: expected --against as well"),
        (["--unsolved", "-3"], "--unsolved -3: expected at least 0"),
        (["--limit", "nan"], "--limit nan: expected a number over 0"),
        (["--versus", "/nowhere", "--tasks", "1"], "/nowhere: no relevance/planner in it"),
    ],
)
def test_wrong_options_are_one_line(flags, words, tmp_path, capsys):
    assert main(["bench", "planner", "--out", str(tmp_path / "out"), *flags]) == 2
    assert words in capsys.readouterr().err


def test_a_file_where_the_folder_belongs_is_one_line(tmp_path, capsys):
    (tmp_path / "taken").touch()
    assert main(["bench", "planner", "--out", str(tmp_path / "taken")]) == 2
    assert "taken: File exists, expected a folder" in capsys.readouterr().err


@pytest.mark.slow  # trains every body
def test_training_is_measured_for_every_reading(tmp_path, capsys):
    flags = ["--bodies", "vit", "geometry", "--scenes", "1", "--goals", "1", "--objects", "3"]
    flags += ["--queries", "1", "--seconds", "0", "--device", "cpu", "--out", str(tmp_path)]
    assert main(["bench", "training", *flags]) == 0
    printed = capsys.readouterr().out
    assert "geometry is told the true poses" in printed
    with (tmp_path / "training.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = [row["body"] for row in rows]
    assert names == ["vit shared", "vit trio", "vit no-patches", "geometry"]
    assert all(float(row["queries"]) > 0 for row in rows)
    assert main(["bench", "training", "--bodies", "cnn"]) == 2
    assert "--bodies cnn: expected one of geometry, glimpse" in capsys.readouterr().err


def test_steps_within_no_time_are_one_round():
    found = {
        recipe: [steps_within(small_dataset(), network, 0.0) for network in networks("geometry")]
        for recipe, networks in RECIPES.items()
    }
    shared = [2]  # the same-plane predicates look together, then `on` does
    assert found == {
        "fair": shared,
        "fair, alone": [1, 1],
        "bare": [4, 1],
        "long": shared,
    }
