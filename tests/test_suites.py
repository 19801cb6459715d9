"""Suites: frozen, drawn as they say, and good for a checkpoint that was trained elsewhere."""

from __future__ import annotations

import colorsys
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import make
from evaluated import evaluated

from relevance.cli import main
from relevance.errors import RelevanceError, RelevanceWarning
from relevance.evaluation import (
    SUITES,
    EvaluationConfig,
    away,
    checkpoint_id,
    evaluate,
    predict,
    read_evaluations,
    suite_of,
)
from relevance.pipeline.settings import settings_of_family
from relevance.planner import GUIDES
from relevance.sampling import SceneConfig, sample_scene
from relevance.scene import Scene, lookalikes
from relevance.simulation import Renderer
from relevance.store import Dataset

FROZEN = {
    "boxes-20": "6aed068283e701c6",
    "boxes-30": "096625730bf23305",
    "unseen-sizes": "e2bebd6a7b1e6e1a",
    "unseen-colours": "d0113b9acf602a93",
    "camera-shifted": "b8c4ffdb460e2bdb",
    "lights-and-textures": "90f42a201df28138",
    "occluded": "681b3c99c866a948",
    "arm-camera": "dd6e31856728a223",
    "robot-elsewhere": "d87faa3aff019838",
}
"""Hash of what each draws; another sampler or renderer version renames them all."""


def drawn(config: SceneConfig, count: int = 4) -> list[Scene]:
    scenes = []
    for index in range(count):
        tries = (
            sample_scene(config, seed=14, index=index, split="test", attempt=n) for n in range(1000)
        )
        scenes.append(next(scene for scene in tries if scene is not None))
    return scenes


def test_suites_are_frozen() -> None:
    assert {name: suite.config(1).scenes_hash for name, suite in SUITES.items()} == FROZEN


def test_fewer_scenes_are_the_first_of_more() -> None:
    for suite in SUITES.values():
        few, more = suite.config(1), suite.config(60)
        assert few.scenes_hash == more.scenes_hash
        assert few.plans_hash == more.plans_hash
        assert {few.test.of(f) for f in suite.families} == {1}
        assert few.train == few.validation


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_draws_what_it_says(name: str) -> None:
    suite, home = SUITES[name], SceneConfig()
    for family in suite.families:
        config = settings_of_family(suite.scene, family)
        scenes = drawn(config, 2)
        assert scenes == drawn(config, 2)
        low, high = config.numbers
        assert all(low <= len(scene.objects) <= high for scene in scenes)
        ours = drawn(settings_of_family(home, family), 2)
        assert all(scene not in ours for scene in scenes)


def test_colours_nobody_saw_and_boxes_that_look_alike() -> None:
    alike = []
    for scene in drawn(SUITES["unseen-colours"].scene, 12):
        alike += lookalikes(scene)
        for box in scene.objects:
            _, saturation, value = colorsys.rgb_to_hsv(*box.color)
            assert saturation < 0.45 or value < 0.25
    assert len(alike) > 3
    assert not any(map(lookalikes, drawn(SceneConfig(), 12)))


def test_boxes_hide_each_other() -> None:
    config = SUITES["occluded"].scene
    with Renderer() as renderer:
        shown = [renderer.render(scene).visible_fraction for scene in drawn(config, 3)]
        plain = [renderer.render(scene).visible_fraction for scene in drawn(SceneConfig(), 6)]
    assert max(map(np.mean, shown)) < 0.75
    assert np.mean([np.mean(one) for one in plain]) > 0.75


def test_younger_settings_change_no_scene_that_was_drawn_before() -> None:
    """Their defaults draw nothing of their own, not even whether a box is a twin."""
    [plain] = drawn(SceneConfig(), 1)
    assert drawn(SceneConfig(saturation=(0.55, 1.0), occlusion=0.0), 1) == [plain]
    assert drawn(SceneConfig(twins=1e-9), 1) != [plain]


@pytest.mark.parametrize("field", ["saturation", "brightness"])
def test_settings_are_checked(field: str) -> None:
    with pytest.raises(RelevanceError, match=rf"SceneConfig\.{field} = .*0 <= from <= to <= 1"):
        SceneConfig(**{field: (0.5, 1.5)})


def test_a_checkpoint_from_elsewhere_is_judged_and_complete_guides_lose_nothing(
    tmp_path: Path,
) -> None:
    """On a suite whose robot stands elsewhere, with a network that learned next to nothing."""
    _, checkpoint = evaluated()
    root = make(tmp_path / "away", SUITES["robot-elsewhere"].config(1))
    dataset = Dataset.open(root)
    assert suite_of(dataset) == "robot-elsewhere"
    assert suite_of(Dataset.open(evaluated()[0])) is None
    [before] = away([root], checkpoint)
    assert (before["goals"], before["set_recall"], before["solved"]) == (0, None, None)
    complete = tuple(name for name, mode in GUIDES.items() if mode.guided and mode.complete)
    config = EvaluationConfig(tasks=1, betas=(), guides=complete, priors=())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RelevanceWarning)
        predict(root, checkpoint)
        assert evaluate(root, checkpoint, config) == 5 * len(complete)
    rows = read_evaluations(dataset, checkpoint_id(checkpoint))
    assert {row["suite"] for row in rows} == {"robot-elsewhere"}
    [row] = away([root], checkpoint)
    assert row["dataset"] == "robot-elsewhere"
    assert row["goals"] > 0
    assert row["tasks"] == 5
    assert row["solved_guided"] == row["solved"]
    assert {f"{name}, tree" for name in complete} <= set(row)
    assert row["covered_90"] is None  # never calibrated


def test_a_complete_guide_that_lost_a_task_would_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from relevance.evaluation import elsewhere

    root, checkpoint = evaluated()
    base = read_evaluations(Dataset.open(root), checkpoint_id(checkpoint))[0]
    base |= {"guide": "order", "solved_unguided": True}
    rows = [base | {"solved_guided": True}, base | {"solved_guided": False}]
    monkeypatch.setattr(elsewhere, "read_evaluations", lambda *_: rows)
    found = elsewhere._reruns(Dataset.open(root), "")
    assert (found["solved"], found["solved_guided"]) == (1.0, 0.5)


def test_commands(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["suites", "--format", "csv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(",")[0] for line in lines[1:]] == list(SUITES)
    root, checkpoint = evaluated()
    assert main(["suites", str(root), "--checkpoint", str(checkpoint), "--format", "csv"]) == 0
    header, _ = capsys.readouterr().out.splitlines()
    assert header.startswith("dataset,boxes,goals,total")
    assert main(["suite", "boxes-21", str(tmp_path / "x")]) == 2
    assert "unknown suite 'boxes-21', expected one of boxes-20" in capsys.readouterr().err
    assert main(["suite", "boxes-20", str(tmp_path / "x"), "--scenes", "0"]) == 2
    assert "--scenes 0: expected at least 1" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_a_suite_is_one_command(tmp_path: Path) -> None:
    root = tmp_path / "suite"
    assert main(["suite", "arm-camera", str(root), "--scenes", "1", "--workers", "1"]) == 0
    dataset = Dataset.open(root)
    assert suite_of(dataset) == "arm-camera"
    assert dataset.read_rows("labels", split="test")
