"""Near copies of scenes: near, possible, pure, and of the same story."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from relevance.robot import GRASPABLE_EDGE
from relevance.sampling import Jitter, Randomisation, SceneConfig, near_copy, sample_scene
from relevance.scene import FAMILIES, Box, Scene, footprint_gap, project, vertices

NONE = Jitter(position=0, yaw=0, size=0, color=0, light=0)
ROUNDING = 1.1e-4


def scenes(family: str, count: int = 12, **more) -> tuple[SceneConfig, list[Scene]]:
    config = SceneConfig(family=family, **more)
    drawn = (sample_scene(config, seed=8, index=i) for i in range(3 * count))
    return config, [scene for scene in drawn if scene is not None][:count]


def copied(scene: Scene, config: SceneConfig, jitter: Jitter = Jitter(), number: int = 0) -> Scene:  # noqa: B008
    tries = (
        near_copy(scene, config, jitter, seed=1, number=number, attempt=attempt)
        for attempt in range(50)
    )
    return next(copy for copy in tries if copy is not None)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("ranges", [None, Randomisation()])
def test_a_copy_is_near_and_of_the_same_story(family: str, ranges: Randomisation | None) -> None:
    config, originals = scenes(family, randomisation=ranges)
    jitter = Jitter()
    for scene in originals:
        copy = copied(scene, config)
        assert copy.id != scene.id
        assert (copy.table, copy.camera, copy.robot) == (scene.table, scene.camera, scene.robot)
        assert [(b.name, b.on) for b in copy.objects] == [(b.name, b.on) for b in scene.objects]
        for now, before in zip(copy.objects, scene.objects, strict=True):
            below = [scene[name] for name in before.supports]
            shift = np.zeros(2)
            if below:
                shift = np.subtract(copy[below[0].name].position, below[0].position)[:2]
            moved = np.subtract(now.position, before.position)[:2] - shift
            assert (abs(moved) <= jitter.position + 2 * ROUNDING).all()
            turn = math.remainder(now.yaw - before.yaw, math.tau)
            assert abs(turn) <= jitter.yaw + ROUNDING
            assert np.abs(np.subtract(now.size, before.size)).max() <= jitter.size + ROUNDING
            assert np.abs(np.subtract(now.color, before.color)).max() <= jitter.color + ROUNDING
            for edge, other in zip(now.size[:2], before.size[:2], strict=True):
                assert (edge <= GRASPABLE_EDGE) == (other <= GRASPABLE_EDGE)
        light = jitter.light + ROUNDING
        assert abs(copy.light.ambient - scene.light.ambient) <= light
        assert abs(copy.light.diffuse - scene.light.diffuse) <= light
        assert np.abs(np.subtract(copy.light.color, scene.light.color)).max() <= light


@pytest.mark.parametrize("family", FAMILIES)
def test_a_copy_keeps_to_what_scenes_are_drawn_by(family: str) -> None:
    config, originals = scenes(family)
    wild = Jitter(position=0.05, yaw=1.0, size=0.01)
    found = [near_copy(s, config, wild, seed=2, number=n) for n, s in enumerate(originals)]
    copies = [copy for copy in found if copy is not None]
    assert len(copies) > len(originals) / 2
    for scene in copies:
        for a, b in itertools.combinations(scene.objects, 2):
            if a.bottom < b.top - 1e-6 and b.bottom < a.top - 1e-6:
                assert footprint_gap(a, b) >= config.spacing - 1e-9
        for box in scene.objects:
            pixels, _ = project(scene.camera, vertices(box))
            assert (pixels >= 2).all()
            assert (pixels <= (318, 190)).all()
            assert config.min_edge - 1e-9 <= min(box.size)
            assert max(box.size[:2]) <= config.max_edge


def test_no_jitter_is_no_change_and_copies_are_pure_and_distinct() -> None:
    config, originals = scenes("stacks", 4)
    for scene in originals:
        assert copied(scene, config, NONE).id == scene.id
        several = [copied(scene, config, number=number) for number in range(3)]
        assert len({copy.id for copy in several}) == 3
        assert [copied(scene, config, number=number) for number in range(3)] == several


def test_boxes_of_one_colour_stay_of_one_colour() -> None:
    boxes = tuple(
        Box(name=name, size=(0.05, 0.05, 0.05), position=(0.0, y, 0.025), color=(0.8, 0.1, 0.1))
        for name, y in (("a", -0.1), ("b", 0.1))
    )
    one, other = copied(Scene(objects=boxes), SceneConfig()).objects
    assert one.color == other.color != (0.8, 0.1, 0.1)


@pytest.mark.parametrize(
    ("field", "value"), [("position", -0.1), ("color", 0.5), ("light", 1), ("size", math.nan)]
)
def test_bad_jitter_is_named(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"^Jitter\.{field} = .*expected"):
        Jitter(**{field: value})
