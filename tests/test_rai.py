"""rai as another planner behind the same interface."""

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest

from relevance.cli import main
from relevance.planner import Guide
from relevance.planner.rai import planner as peer
from relevance.planner.rai import problem
from relevance.planner.rai.planner import PeerError, RaiConfig, plan_rai
from relevance.planner.rai.problem import rai_problem
from relevance.scene import Box, Scene, SceneError, goal_holds, scene_to_json
from relevance.simulation import replay

RED, GREEN, BLUE = (0.8, 0.1, 0.1), (0.1, 0.7, 0.1), (0.1, 0.1, 0.8)
installed = pytest.mark.skipif(
    importlib.util.find_spec("robotic") is None, reason="needs the extra [rai]"
)


def box(name, x, y, color, size=(0.05, 0.07, 0.06), **rest):
    height = rest.pop("bottom", 0.0) + size[2] / 2
    return Box(name=name, size=size, position=(x, y, height), color=color, **rest)


SCENE = Scene(
    objects=(
        box("red", 0.0, 0.22, RED, yaw=0.4),
        box("blue", 0.02, -0.12, BLUE),
        box("green", 0.02, -0.12, GREEN, size=(0.045, 0.045, 0.05), bottom=0.06, on="blue"),
    )
)


@pytest.fixture
def texts(monkeypatch, tmp_path):
    """A problem in rai's words, where rai need not be installed."""
    monkeypatch.setattr(problem, "_models", lambda: tmp_path)
    return lambda text, movable=SCENE.names: rai_problem(SCENE, SCENE.goal(text), movable=movable)


def facts(problem, name):
    line = next(x for x in problem.configuration.splitlines() if x.startswith(f"{name} "))
    return line.partition("logical: {")[2].partition("}")[0].replace(",", " ").split()


def test_facts_say_who_can_be_moved_and_where_to(texts):
    beside = texts("on-the-left(red, blue)")
    assert facts(beside, "box0") == ["clear", "is_object", "is_subject"]
    assert facts(beside, "box1") == []  # carries green, and is the landmark
    assert facts(beside, "box2") == ["clear", "is_object", "is_blocker"]
    assert facts(beside, "table") == ["is_table", "clear", "is_base"]
    on = texts("on(red, blue)")
    assert facts(on, "box1") == ["is_object", "is_blocker"]  # there may be room beside green
    assert facts(on, "table") == ["is_table", "clear", "is_base"]
    assert "target (box1)" in on.configuration
    pruned = texts("on(red, blue)", movable={"red", "blue"})
    assert facts(pruned, "box2") == ["clear"]


def test_what_carries_the_subject_has_to_be_gone_from_the_reference(monkeypatch, tmp_path):
    monkeypatch.setattr(problem, "_models", lambda: tmp_path)
    tower = Scene(
        objects=(
            box("blue", 0.0, 0.0, BLUE),
            box("green", 0.0, 0.0, GREEN, size=(0.045, 0.045, 0.05), bottom=0.06, on="blue"),
            box("red", 0.0, 0.0, RED, size=(0.04, 0.04, 0.04), bottom=0.11, on="green"),
        )
    )
    found = rai_problem(tower, tower.goal("on(red, blue)"), movable=tower.names)
    assert "is_base" in facts(found, "box0")
    assert "is_base" not in facts(found, "table")


def test_boxes_turn_so_that_rai_takes_them_across_their_narrow_edge(texts):
    problem = texts("on-the-left(red, blue)")
    assert problem.turn == {"red": np.pi / 2, "blue": np.pi / 2, "green": 0.0}
    line = next(x for x in problem.configuration.splitlines() if x.startswith("box0 "))
    assert "size: [0.070000000, 0.050000000, 0.060000000" in line


def test_every_part_of_the_hand_keeps_clear_of_every_box_and_carriers_are_left_out(texts):
    pairs = texts("on-the-left(red, blue)").pairs
    parts = {part for part, _ in pairs["hand"]}
    assert len(pairs["hand"]) == 3 * len(parts)
    between = {frozenset(pair[2:]) for pair in pairs["boxes"] if pair[2] != pair[3]}
    assert between == {frozenset({"box0", "box1"}), frozenset({"box0", "box2"})}
    few = texts("on-the-left(red, blue)", movable={"red", "blue"}).pairs
    assert few["hand"] == pairs["hand"]  # what stays is an obstacle
    assert few["boxes"] == [pair for pair in pairs["boxes"] if "box0" in pair[2:]]
    none = texts("on-the-left(red, blue)", movable={"blue"}).pairs
    assert none["boxes"] == []  # two that stay never come any nearer


def test_settings_and_input_are_refused_in_one_line(monkeypatch):
    with pytest.raises(ValueError, match="seconds = 0: expected"):
        RaiConfig(seconds=0)
    with pytest.raises(ValueError, match="rounds = 0: expected"):
        RaiConfig(rounds=0)
    monkeypatch.setattr(peer, "require_rai", lambda: None)
    with pytest.raises(SceneError, match="no object 'pink'"):
        plan_rai(SCENE, "on(red, blue)", movable={"pink"})


def test_without_the_extra_one_line_says_how_to_get_it(monkeypatch, tmp_path, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "robotic" else find(name, *a)
    )
    with pytest.raises(PeerError, match="pip install 'relevance\\[rai\\]'"):
        plan_rai(SCENE, "on(red, blue)")
    file = tmp_path / "scene.json"
    file.write_text(scene_to_json(SCENE))
    for arguments in (
        ["plan", str(file), "--goal", "on(red, blue)", "--planner", "rai"],
        ["bench", "planner", "--against", "rai", "--out", str(tmp_path / "out")],
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert "pip install 'relevance[rai]'" in error
        assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_sequences_are_counted_once_each():
    spent = peer._Spent()
    for line in ("+++ solving sub-plan a", "+++ solving sub-plan b", "+++ solving sub-plan a"):
        peer._count(line, spent)
    assert (spent.counts.keyframe, spent.counts.sequences) == (3, 2)


@installed
def test_rai_solves_and_its_plan_replays_with_the_same_seven_angles():
    result = plan_rai(SCENE, "on(red, blue)", config=RaiConfig(seconds=60))
    assert result.status == "solved"
    assert result.moved == ("green", "red")
    assert [action.to_list() for action in result.actions][-1] == ["place", "red", "blue"]
    assert goal_holds(SCENE.moved(result.final), result.goal, SCENE.robot, tolerance=2e-3)
    verdict = replay(SCENE, result.goal, result.phases)
    # The kinematics agree or every grasp would be refused; between steps rai may graze a box.
    assert verdict.ok or "penetrates" in verdict.reason
    assert verdict.max_penetration < 0.01
    assert result.seconds.total > 0
    assert result.counts.path >= 6  # four motions and two retreats


@installed
def test_no_plan_ends_at_the_limit_or_when_rai_runs_out():
    wide = Scene(
        objects=(box("red", 0.0, 0.2, RED, size=(0.1, 0.1, 0.05)), box("blue", 0.0, -0.1, BLUE))
    )
    nothing = plan_rai(wide, "behind(red, blue)", config=RaiConfig(seconds=20, rounds=2))
    assert nothing.status == "infeasible"
    assert nothing.reason == "the rules allow rai no action sequence"
    late = plan_rai(SCENE, "on(red, blue)", config=RaiConfig(seconds=0.01))
    assert late.status in ("limit", "solved")  # whole seconds are what the system counts
    assert late.seconds.total < 10


class Nothing:
    """Scores that keep only the goal's objects."""

    def scores(self, scene, goal):
        return dict.fromkeys(scene.names, -3.0)


@installed
def test_a_guide_restricts_what_rai_moves():
    guide = Guide(scorer=Nothing(), mode="prune")
    pruned = plan_rai(SCENE, "on(red, blue)", config=RaiConfig(seconds=20, rounds=1), guide=guide)
    assert pruned.status == "infeasible"  # green stands on blue and may not be moved
    assert pruned.looked
    assert pruned.seconds.total > pruned.seconds.guide > 0


@installed
def test_rai_stays_out_of_this_process():
    script = (
        "import sys; from relevance.cli import main; main(sys.argv[1:]); "
        "assert 'robotic' not in sys.modules"
    )
    near = Scene(objects=(box("red", 0.0, 0.1, RED), box("blue", 0.0, 0.0, BLUE)))
    done = subprocess.run(
        [sys.executable, "-c", script, "plan", "/dev/stdin", "--planner", "rai", "--json",
         "--goal", "on-the-left(red, blue)"],
        input=scene_to_json(near), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.strip().splitlines()[-1])["status"] == "solved"
