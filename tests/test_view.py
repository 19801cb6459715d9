"""Plans to look at: motions, films, the viewer's page and the command."""

import itertools
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import httpx
import numpy as np
import pybullet
import pytest
from PIL import Image
from planning import OPEN, Says, box, tasks

from relevance.cli import main
from relevance.planner import Guide, PlannerConfig, plan
from relevance.report import movie, viewer
from relevance.report.shots import NoPlanError, Task, shoot, stored_task
from relevance.robot import HOME, panda_urdf
from relevance.scene import Robot, Scene, goal_holds, scene_to_json
from relevance.store import Dataset

GOAL = "on-the-right(red, blue)"
TURNED = Scene(
    objects=(box("red", 0.2, -0.05), box("blue", 0.0, -0.15)),
    robot=Robot(base=(0.0, -0.6, 0.0), yaw=math.pi / 2),
)
SMALL = (96, 72)
GOLDEN = Path(__file__).parent.parent / "data" / "golden"


def task(scene=OPEN, goal=GOAL):
    return Task(scene=scene, goal=scene.goal(goal), config=PlannerConfig())


def shot(scene=OPEN, goal=GOAL):
    [found], reasons = shoot(task(scene, goal), {"unguided": None})
    assert reasons == []
    return found


def stands(scene, poses):
    """The boxes of a scene where poses have them, upright, on the table."""
    boxes = []
    for one in scene.objects:
        T = poses[one.name]
        assert abs(T[2, 2] - 1) < 1e-3
        yaw = math.atan2(T[1, 0], T[0, 0])
        boxes.append(replace(one, position=tuple(T[:3, 3].tolist()), yaw=yaw))
    return boxes


@pytest.mark.parametrize(("scene", "goal"), [(OPEN, GOAL), (TURNED, "behind(red, blue)")])
def test_a_motion_begins_with_the_scene_and_ends_at_the_goal(scene, goal):
    found = shot(scene, goal)
    motion = found.motion
    for one, T in motion.at(0.0).poses.items():
        assert np.allclose(T[:3, 3], scene[one].position)
    assert np.array_equal(motion.at(-1.0).joints, motion.at(0.0).joints)
    end = motion.at(motion.seconds + 1)
    assert goal_holds(stands(scene, end.poses), scene.goal(goal), scene.robot)
    for name, pose in found.result.final.items():
        assert np.allclose(end.poses[name][:3, 3], pose.position, atol=2e-3)
    assert motion.at(0.0).step == 0
    assert end.step == len(motion.actions) == len(motion.starts)
    for number, start in enumerate(motion.starts):
        assert motion.at(start + 0.05).step == number


def test_what_is_held_goes_with_the_hand_of_the_simulator():
    found, client = shot(TURNED, "behind(red, blue)"), pybullet.connect(pybullet.DIRECT)
    turn = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))
    robot = pybullet.loadURDF(
        str(panda_urdf()), TURNED.robot.base, turn, useFixedBase=True, physicsClientId=client
    )
    before, carried = None, 0
    for seconds in np.arange(0.0, found.motion.seconds, 0.13):
        now = found.motion.at(seconds)
        for joint, value in enumerate(now.joints):
            pybullet.resetJointState(robot, joint, value, physicsClientId=client)
        state = pybullet.getLinkState(
            robot, 8, computeForwardKinematics=True, physicsClientId=client
        )
        position = now.poses["red"][:3, 3]
        if before is not None and np.linalg.norm(position - before) > 1e-6:
            carried += 1  # it moves: its centre is between the pads, 0.1 m under the hand's origin
            assert 0.05 < np.linalg.norm(position - state[4]) < 0.15
        before = position
    pybullet.disconnect(client)
    assert carried > 5


def test_a_goal_that_is_true_already_stands_still():
    near = Scene(objects=(box("red", 0.0, -0.09), box("blue", 0.0, -0.15)))
    found = shot(near, "on-the-left(red, blue)")
    assert found.motion.actions == ()
    assert np.array_equal(found.motion.at(3.0).joints, HOME)
    assert movie.count_frames(found) == 1


def test_frames_of_a_gif_differ_and_the_last_is_the_goal(tmp_path):
    found, file = shot(), tmp_path / "plan.gif"
    movie.film([file], found, size=SMALL, rate=2)
    with Image.open(file) as read:
        assert read.n_frames == movie.count_frames(found, rate=2) > 5
        pictures = []
        for number in range(read.n_frames):
            read.seek(number)
            pictures.append(np.asarray(read.convert("RGB"), int))
    for one, other in itertools.pairwise(pictures):
        assert np.abs(one - other).max() > 30
    drawn = list(movie.frames(found, size=SMALL, rate=2))
    assert np.abs(pictures[-1] - drawn[-1]).mean() < 4  # colours of a palette
    assert np.abs(pictures[-1] - drawn[0]).mean() > np.abs(pictures[-1] - drawn[-1]).mean() + 1


def test_an_mp4_has_the_frames_of_the_film(tmp_path):
    found, file = shot(), tmp_path / "plan.mp4"
    movie.film([file], found, size=SMALL, rate=2)
    read = cv2.VideoCapture(str(file))
    assert read.get(cv2.CAP_PROP_FRAME_COUNT) >= movie.count_frames(found, rate=2)
    assert list(tmp_path.iterdir()) == [file]


def test_relevant_objects_are_outlined():
    found = shot()
    bare = replace(found, task=replace(found.task, relevant=frozenset()))
    assert found.relevant == {"red"}
    assert bare.relevant == set()
    with_outline, without = (next(movie.frames(one, size=SMALL)) for one in (found, bare))
    assert (with_outline != without).any()


def test_labels_say_what_is_relevant_in_a_stored_task():
    dataset = Dataset.open(GOLDEN)
    found = stored_task(dataset)
    rows = dataset.read_rows("labels", scene_id=found.scene.id)
    goal = (found.goal.predicate.name, found.goal.subject, found.goal.reference)
    mine = [r for r in rows if (r["predicate"], r["subject"], r["reference"]) == goal]
    assert found.relevant == {r["query"] for r in mine if r["relevant"]} != set()
    again = stored_task(dataset, found.scene.id, str(found.goal))
    assert again == found


def test_no_plan_is_one_error_and_a_guide_that_finds_none_is_told():
    wide = Scene(
        objects=(
            box("red", 0.0, 0.2, size=(0.1, 0.1, 0.05)),
            box("blue", 0.0, -0.15),
        )
    )
    with pytest.raises(NoPlanError, match="no plan to show"):
        shoot(task(wide), {"unguided": None})
    blind = Guide(scorer=Says(()), mode="prune")
    for scene, goal in tasks(40, seed=4):
        if plan(scene, goal, replay=False).status != "solved":
            continue
        if plan(scene, goal, guide=blind, replay=False).status != "solved":
            asked = Task(scene=scene, goal=goal, config=PlannerConfig())
            shots, reasons = shoot(asked, {"unguided": None, "guided": blind})
            assert [one.name for one in shots] == ["unguided"]
            assert "(guided)" in reasons[0]
            return
    raise AssertionError("no task with a blocker among them")


@pytest.fixture(scope="module")
def opened():
    pytest.importorskip("viser")
    pytest.importorskip("yourdfpy")
    first = shot()
    [second], _ = shoot(task(), {"guided": Guide(scorer=Says(("red",)), mode="order")})
    with viewer.Viewer([first, second], port=8460) as page:
        yield page


@pytest.fixture
def page(opened):
    opened.choose("unguided")
    return opened


def links(page):
    """Where the arm's links are on the page."""
    return np.array([[*frame.position, *frame.wxyz] for frame in page.arm._joint_frames])


def test_the_time_slider_moves_the_arm_on_a_page_for_this_machine_only(page):
    answer = httpx.get(page.url)
    assert answer.status_code == 200
    assert "<html" in answer.text.lower()
    assert page.url.startswith("http://127.0.0.1:")
    assert page._server.get_host() == "127.0.0.1"
    home, marked = links(page), page.steps.content
    page.time.value = page.shot.motion.starts[1] + 1.0
    assert not np.allclose(links(page), home, atol=0.05)
    assert page.steps.content != marked
    assert "**place red on table** ◀" in page.steps.content
    page.time.value = 0.0
    assert np.allclose(links(page), home)
    assert page.steps.content == marked


def test_play_goes_on_from_where_it_is_and_begins_again_after_the_end(page):
    page.toggle()
    assert (page.playing, page.play.label) == (True, "pause")
    page.advance(1.0)
    page.advance(0.5)
    assert page.time.value == 1.5
    page.advance(page.shot.motion.seconds - 1.4)
    assert page.time.value == page.shot.motion.seconds
    page.advance(viewer._REST + 0.1)
    assert page.time.value == 0.0


def test_plans_are_switched(page):
    page.time.value = 3.0
    page.choose("guided")
    assert (page.shot.name, page.time.value) == ("guided", 0.0)
    assert page.shot.motion.seconds <= page.time.max < page.shot.motion.seconds + 0.1


def test_mistakes_are_one_line(tmp_path, capsys, monkeypatch):
    file, root = tmp_path / "scene.json", str(GOLDEN)
    file.write_text(scene_to_json(OPEN))

    def refused(*arguments):
        assert main(["view", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1, said
        return said

    film = ("--gif", tmp_path / "plan.gif")
    assert "has no goals, expected one by --goal" in refused(file, *film)
    assert "no scene 'x', expected one of" in refused(file, "--scene", "x", *film)
    assert "no planned goal of scene 'x'" in refused(root, "--scene", "x", *film)
    assert "no goal on(a, b), expected one like" in refused(root, "--goal", "on(a,b)", *film)
    assert "no dataset.json" in refused(tmp_path, *film)
    made = shutil.ignore_patterns("plans", "labels", "timings")
    bare = shutil.copytree(GOLDEN, tmp_path / "bare", ignore=made)
    assert "no plans there, expected `relevance label` first" in refused(bare, *film)
    assert "a file that ends in .gif" in refused(file, "--gif", tmp_path / "plan.mp4")
    assert "is no folder" in refused(file, "--gif", tmp_path / "no" / "plan.gif")
    (tmp_path / "folder.gif").mkdir()
    assert "is a folder, expected a file" in refused(file, "--gif", tmp_path / "folder.gif")
    (tmp_path / "folder.gif").rmdir()
    assert "expected one of none" in refused(file, "--guide", "x", *film)
    unguided = ("--guide", "none", "--checkpoint", "nosuch")
    assert "--guide and --checkpoint go together" in refused(file, *film, *unguided)
    find = viewer.importlib.util.find_spec
    monkeypatch.setattr(
        viewer.importlib.util, "find_spec", lambda name: None if name == "viser" else find(name)
    )
    assert "pip install 'relevance[view]'" in refused(file, "--goal", GOAL)
    assert {one.name for one in tmp_path.iterdir()} == {"scene.json", "bare"}


def test_the_command_films_a_scene_file(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(movie, "SIZE", SMALL)
    monkeypatch.setattr(movie, "film", lambda paths, shot, progress: None)
    file = tmp_path / "scene.json"
    file.write_text(scene_to_json(OPEN))
    films = ("--gif", str(tmp_path / "a.gif"), "--mp4", str(tmp_path / "a.mp4"))
    assert main(["view", str(file), "--goal", GOAL, *films]) == 0
    assert "a.gif" in capsys.readouterr().err
    assert main(["view", str(file), "--goal", GOAL, *films, "--guide", "none"]) == 0
