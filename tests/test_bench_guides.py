"""`relevance bench guides`: paired reruns that survive a kill, their figures, tables and plots."""

from __future__ import annotations

import csv
import gc
import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from relevance.benchmarks import (
    BenchmarkError,
    Rerun,
    Settings,
    figures,
    guides,
    measured_guides,
    measured_peer,
    read_reruns,
    rerun_guides,
)
from relevance.benchmarks.guides import ROWS, Tasks
from relevance.cli import main
from relevance.errors import RelevanceError
from relevance.evaluation.pairing import timed
from relevance.planner import PLANNERS, Counts, PlannerConfig, PlanResult, Seconds, ask
from relevance.planner.guides import rounds
from relevance.scene import Box, Scene

SETTINGS = Settings(
    seed=5,
    goals=2,
    priors=("swept",),
    guides=("order", "prune"),
    planner=PlannerConfig(max_actions=4, node_limit=2_000),
)


def run(folder, settings=SETTINGS, **more):
    folder.mkdir(parents=True, exist_ok=True)
    turns = list(rerun_guides(settings, folder, **({"tasks": 3, "sizes": (4, 3)} | more)))
    return turns[-1], len(turns)


def steady(rows):
    """All that no clock decides."""

    def key(row):
        return row.size, row.task, row.search, row.prior, row.guide

    plain = {f"seconds_{name}": 0.0 for name in ("unguided", "guided", "inference", "encoding")}
    return [replace(row, **plain) for row in sorted(rows, key=key)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    rows, turns = run(folder)
    return folder, rows, turns


def test_every_task_is_rerun_in_every_way_beside_true_labels(whole):
    folder, rows, turns = whole
    assert turns == 2  # two scenes of each size
    keys = {(r.size, r.task, r.search, r.prior, r.guide) for r in rows}
    assert len(keys) == len(rows) == 2 * 3 * 2 * 2 * 2
    assert {r.prior for r in rows} == {"swept", "true"}
    for size in (3, 4):
        assert len({r.scene_id for r in rows if r.size == size}) == 2
        assert {r.task for r in rows if r.size == size} == {0, 1, 2}
    for r in rows:
        assert r.stop == {"order": "first", "prune": "level"}[r.guide]
        assert r.solved_guided or r.guide == "prune" or not r.solved_unguided
        assert r.looked
        if r.prior == "true" and r.solved_guided:
            assert r.sequences <= max(r.sequences_unguided, 1)
    assert read_reruns(folder) == rows


def test_a_killed_run_goes_on_with_what_it_has(whole, tmp_path):
    _, rows, _ = whole
    folder = tmp_path / "killed"
    fewer, _ = run(folder, tasks=1, sizes=(3,))
    assert len(fewer) == 8
    half = (folder / ROWS).read_text()
    (folder / ROWS).write_text(half + half[: len(half) // 2])  # cut off within a line
    drawn = []
    found, _ = run(folder, scenes=drawn.extend)
    assert steady(found) == steady(rows)
    assert found[: len(fewer)] == fewer  # its times, too
    assert len(drawn) == 5
    assert read_reruns(folder) == found
    again, _ = run(folder, progress=lambda done, total: drawn.append((done, total)))
    assert again == found
    assert drawn[5:] == [(6, 6)]


def test_a_folder_of_other_settings_is_refused_and_stays(whole):
    folder, rows, _ = whole
    for other, named in (
        (replace(SETTINGS, seed=6), "seed 5, asked was 6"),
        (replace(SETTINGS, guides=("order",)), "guides"),
        (replace(SETTINGS, planner=PlannerConfig()), "planner"),
    ):
        with pytest.raises(BenchmarkError, match=named):
            run(folder, other)
    assert read_reruns(folder) == rows


def test_more_tasks_keep_the_earlier_ones():
    def drawn(count):
        some, found = Tasks(5, count, SETTINGS), []
        while some.left:
            found += some.scene()
        return found

    assert drawn(3) == drawn(8)[:3]
    assert [task.index for task in drawn(8)] == list(range(8))
    assert all(task.n_objects == 5 for task in drawn(8))


def test_impossible_settings_are_refused():
    with pytest.raises(BenchmarkError, match="none asks for no scores"):
        Settings(seed=1, guides=("none",))
    with pytest.raises(BenchmarkError, match="expected distinct ones"):
        Settings(seed=1, priors=("swept", "swept"))
    with pytest.raises(RelevanceError, match="unknown guide 'best'"):
        Settings(seed=1, guides=("best",))


def rerun(task, prior, *, u, g, look=0.0, solved=(True, True), scene="s", **more):
    return Rerun(
        size=10, task=task, scene_id=scene, goal=f"on(r{task}, blue)", search="tree", prior=prior,
        guide="order", stop="first", patience=0, looked=True,
        status_unguided="solved" if solved[0] else "limit",
        status_guided="solved" if solved[1] else "limit",
        seconds_unguided=u, seconds_guided=g, seconds_inference=look, seconds_encoding=look / 2,
        work_unguided=10_000, work_guided=4_000 if prior == "true" else 5_000,
        nodes_unguided=100, nodes_guided=10, nlps_unguided=6, nlps_guided=3,
        sequences_unguided=4, sequences=1,
        n_actions_unguided=4, n_actions_guided=4,
        solved_unguided=solved[0], solved_guided=solved[1], **{"truth": True, **more},
    )  # fmt: skip


def test_figures_by_hand():
    rows = [
        rerun(0, "glimpse", u=0.010, g=0.006, look=0.002),
        rerun(0, "true", u=0.010, g=0.002),
        rerun(1, "glimpse", u=0.030, g=0.008, look=0.002),
        rerun(1, "true", u=0.030, g=0.004),
        # a miss costs the unguided run; at the limit a task counts as it ran
        rerun(2, "glimpse", u=0.020, g=0.001, look=0.001, solved=(True, False), scene="t"),
        rerun(2, "true", u=0.020, g=0.006, scene="t"),
        rerun(3, "glimpse", u=0.100, g=0.020, look=0.001, solved=(False, True), scene="t"),
        rerun(3, "true", u=0.100, g=0.008, solved=(False, True), scene="t"),
    ]
    network, oracle = figures(rows)
    assert (network.prior, oracle.prior) == ("glimpse", "true")
    assert (network.tasks, network.scenes) == (4, 2)
    assert network.u.value == pytest.approx(40.0)
    assert network.g.value == pytest.approx((6 + 8 + 21 + 20) / 4)
    assert network.o.value == oracle.g.value == pytest.approx(5.0)
    assert network.look == pytest.approx(1.5)
    assert network.gain.value == pytest.approx(160 / 55)
    assert network.reached.value == pytest.approx((160 - 55) / (160 - 20))
    assert network.free.value == pytest.approx((160 - 49) / (160 - 20))
    assert oracle.reached.value == pytest.approx(1.0)
    # one encoding for the two goals of a scene: half of it is saved
    assert network.amortised.value == pytest.approx((55 - 1 - 0.5) / 4)
    assert network.solved == (3, 3, 4)
    assert network.limit == (1, 1, 0)
    assert network.sequences == (4.0, 1.0, 1.0)
    assert network.work == pytest.approx((10.0, 5.0, 4.0))
    assert network.worked.value == pytest.approx(5 / 6)
    assert network.gain_wide.low <= network.gain.low <= network.gain.value
    [limit] = [t for t in measured_guides(rows).tables if t.name == "guides-limit"]
    assert [line[4] for line in limit.rows] == [2, 3, 3]


def test_tasks_without_a_plan_count_beside():
    none = {"solved": (False, False), "truth": False, "scene": "t"}
    rows = [
        rerun(0, "glimpse", u=0.010, g=0.006, look=0.002),
        rerun(0, "true", u=0.010, g=0.002),
        rerun(1, "glimpse", u=0.050, g=0.064, **none),
        rerun(1, "true", u=0.050, g=0.055, **none),
    ]
    tables = {table.name: table for table in measured_guides(rows).tables}
    times, every = (tables[name] for name in ("guides-times", "guides-all"))
    line = dict(zip(times.columns, times.rows[0], strict=True))
    assert line["tasks (scenes)"] == "1 (1)"
    assert (line["u"][:4], line["g, look in"][:3]) == ("10.0", "6.0")
    line = dict(zip(every.columns, every.rows[0], strict=True))
    assert (line["tasks"], line["u"], line["g, look in"]) == (2, "30.0", "35.0")
    assert (line["without a plan"], line["their u"], line["their g"]) == (1, "50.0", "64.0")
    assert (line["solved u / g"], line["at the limit"]) == ("1 / 1", "1 / 1")


def test_what_has_no_oracle_yet_is_left_out():
    assert figures([rerun(0, "glimpse", u=0.010, g=0.006)]) == []
    measured = measured_guides([])
    assert [table.rows for table in measured.tables] == [()] * 5
    assert measured.plots == ()


def test_the_command_writes_rows_tables_and_plots_and_goes_on(tmp_path, capsys):
    words = ["bench", "guides", "--sizes", "4", "--priors", "geometry", "--guides", "lazy"]
    words += ["--searches", "informed", "--goals", "2", "--seed", "3", "--out", str(tmp_path)]
    assert main([*words, "--tasks", "1"]) == 0
    before = (tmp_path / ROWS).read_text()
    assert main([*words, "--tasks", "2"]) == 0
    assert (tmp_path / ROWS).read_text().startswith(before)
    assert "true labels, no look" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "guides.csv").open()))
    assert len(rows) == 2 * 2
    assert {row["prior"] for row in rows} == {"geometry", "true"}
    tables = json.loads((tmp_path / "summary.json").read_text())["tables"]
    assert {table["name"] for table in tables} >= {"guides-times", "guides-saving"}
    assert len((tmp_path / "scenes.jsonl").read_text().splitlines()) == 2
    for name in ("time", "gain", "solved"):
        assert (tmp_path / f"guides-{name}.svg").stat().st_size > 1000
    assert main([*words[:-2], "--max-actions", "4", "--out", str(tmp_path)]) == 2
    assert main(["bench", "guides", "--sizes", "2"]) == 2


class Slow:
    """A planner of somebody else: moves the subject, and `mint` in tasks of 4 boxes; gives up on
    every third task."""

    name = "slow"
    Config = PlannerConfig

    def __init__(self):
        self.asked = []

    def require(self): ...

    def warm_up(self): ...

    def plan(self, scene, goal, *, config=None, guide=None, movable=None, replay=True):
        scores = ask(guide, scene, goal)
        [*_, allowed] = rounds(frozenset(scene.names), goal, guide, scores)
        other = next(n for n in scene.names if n not in (goal.subject, goal.reference))
        moved = (goal.subject, other) if len(scene.objects) == 4 else (goal.subject,)
        hopeless = len({key for key, _ in self.asked} | {str((scene.id, goal))}) % 3 == 0
        self.asked.append((str((scene.id, goal)), guide))
        status = "solved" if set(moved) <= allowed and not hopeless else "limit"
        seconds = Seconds(total=0.1 if guide else 1.0, guide=0.01 if guide else 0.0)
        return PlanResult(
            goal=goal, status=status, moved=moved, final={}, counts=Counts(sequences=len(allowed)),
            seconds=seconds, looked=bool(scores),
        )  # fmt: skip


@pytest.fixture
def slow(monkeypatch):
    planner = PLANNERS.register(Slow.name, Slow())
    monkeypatch.setattr(guides, "replay", lambda *a: SimpleNamespace(ok=True))
    yield planner
    PLANNERS.unregister(Slow.name)


PEER = replace(SETTINGS, goals=1, priors=("none",), guides=("prune",), by="slow", peer=None)


def test_another_planner_is_asked_further_where_it_solves_unguided(slow, tmp_path):
    rows, _ = run(tmp_path, PEER)
    unsolved = [row for row in rows if not row.solved_unguided]
    assert [(row.prior, row.guide) for row in unsolved] == [("none", "none")] * 2
    solved = [row for row in rows if row.solved_unguided]
    assert len(solved) == 4 * 3
    assert {row.prior for row in solved} == {"none", "true", "own plan"}
    for row in solved:
        assert (row.search, row.stop, row.seconds_unguided) == ("slow", "first", 1.0)
        assert row.replays_unguided
        knows = row.prior == "own plan" or row.size == 3  # there the subject is all that moves
        assert row.prior == "true" or row.solved_guided == knows
        assert row.replays_guided == (True if row.solved_guided else None)
    # unguided first, then the guided ones, who takes turns at going first
    assert [bool(guide) for _, guide in slow.asked].count(False) == 6
    asked = len(slow.asked)
    again, _ = run(tmp_path, PEER)
    assert again == rows
    assert len(slow.asked) == asked  # those without a plan are known, too


def test_a_miss_of_another_planner_costs_its_unguided_run(slow, tmp_path):
    rows, _ = run(tmp_path, PEER)
    times, counts, plans, drawn = measured_peer(rows).tables
    of = {line[:2]: line for line in times.rows}
    assert of["all", "own plan"][5].startswith("0.10 (")
    assert of["4", "none"][5].startswith("1.10 (")
    assert of["3", "none"][6].startswith("10.00 (")
    missed = {line[:2]: line[3] for line in plans.rows}
    assert missed["3", "none"].startswith("0 of 2")
    assert missed["4", "none"].startswith("2 of 2")
    assert [line[1][:6] for line in drawn.rows] == ["2 of 3", "2 of 3"]
    assert len(counts.rows) == len(plans.rows) == len(times.rows) == 9
    assert [table.rows for table in measured_peer([]).tables] == [()] * 4


def test_guides_that_order_our_search_are_refused_for_another_planner():
    with pytest.raises(BenchmarkError, match="order orders our search"):
        Settings(seed=1, by="rai", guides=("order",))


def test_no_garbage_is_collected_while_the_time_runs() -> None:
    ours, collecting = PLANNERS["ours"], []

    def plan(*asked, **more):
        collecting.append(gc.isenabled())
        if len(collecting) > 1:
            raise RelevanceError("broken")
        return ours.plan(*asked, **more)

    box = {"size": (0.05, 0.05, 0.06), "yaw": 0.0, "color": (0.5, 0.5, 0.5)}
    near, far = ((0.05, y, 0.03) for y in (-0.1, 0.2))
    boxes = (Box(name="red", position=near, **box), Box(name="blue", position=far, **box))
    scene = Scene(id="s", objects=boxes)
    goal = scene.goal("on-the-left(red, blue)")
    assert timed(SimpleNamespace(plan=plan), scene, goal, PlannerConfig()).solved
    assert gc.isenabled()
    with pytest.raises(RelevanceError, match="broken"):
        timed(SimpleNamespace(plan=plan), scene, goal, PlannerConfig())
    assert collecting == [False, False]
    assert gc.isenabled()
    gc.disable()
    try:
        with pytest.raises(RelevanceError, match="broken"):
            timed(SimpleNamespace(plan=plan), scene, goal, PlannerConfig())
        assert not gc.isenabled()
    finally:
        gc.enable()
