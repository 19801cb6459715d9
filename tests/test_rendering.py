"""Rendering against a full pybullet render."""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pybullet
import pytest

from relevance.sampling import Randomisation, SceneConfig, sample_scene
from relevance.scene import (
    Box,
    Camera,
    Light,
    Scene,
    Table,
    Texture,
    scene_from_json,
    scene_to_json,
)
from relevance.simulation import Renderer, Rendering, rejects
from relevance.simulation.painting import pattern

SCENE = Scene(
    objects=(
        Box(
            name="red",
            size=(0.05, 0.06, 0.08),
            position=(0.0, 0.2, 0.04),
            yaw=0.3,
            color=(0.8, 0.1, 0.1),
        ),
        Box(
            name="blue", size=(0.05, 0.06, 0.08), position=(0.0, -0.05, 0.04), color=(0.1, 0.2, 0.8)
        ),
        Box(
            name="green", size=(0.05, 0.06, 0.08), position=(0.1, -0.2, 0.04), color=(0.1, 0.7, 0.2)
        ),
    )
)


def box(name: str, x: float, y: float, size=(0.05, 0.06, 0.08), **more) -> Box:
    color = {"red": (0.8, 0.1, 0.1), "blue": (0.1, 0.2, 0.8), "green": (0.1, 0.7, 0.2)}
    fields = {"position": (x, y, size[2] / 2), "color": color.get(name, (0.8, 0.6, 0.1))}
    return Box(name=name, size=size, **(fields | more))


class Reference:
    """A plain pybullet render of everything, table and floor included."""

    def __init__(self, scene: Scene, only: str | None = None, table: bool = True) -> None:
        self.scene = scene
        self.client = pybullet.connect(pybullet.DIRECT)
        self.ids: dict[str, int] = {}
        half_x, half_y = np.array(scene.table.size) / 2
        if table and only is None:
            self.table = self._add(
                pybullet.createVisualShape(
                    pybullet.GEOM_MESH,
                    vertices=[
                        [-half_x, -half_y, 0],
                        [half_x, -half_y, 0],
                        [half_x, half_y, 0],
                        [-half_x, half_y, 0],
                    ],
                    indices=[0, 1, 2, 0, 2, 3],
                    normals=[[0, 0, 1]] * 4,
                    uvs=[[0, 0]] * 4,
                    rgbaColor=[*scene.table.color, 1],
                    specularColor=[0, 0, 0],
                    physicsClientId=self.client,
                ),
                (0, 0, 0),
                0.0,
                (1e-3, 1e-3, 1e-3),
            )
        for item in scene.objects:
            if only in (None, item.name):
                half = [edge / 2 for edge in item.size]
                shape = pybullet.createVisualShape(
                    pybullet.GEOM_BOX,
                    halfExtents=half,
                    rgbaColor=[*item.color, 1],
                    specularColor=[0, 0, 0],
                    physicsClientId=self.client,
                )
                self.ids[item.name] = self._add(shape, item.position, item.yaw, half)

    def _add(self, shape: int, position, yaw: float, half) -> int:
        solid = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self.client
        )
        return pybullet.createMultiBody(
            0,
            solid,
            shape,
            position,
            (0, 0, math.sin(yaw / 2), math.cos(yaw / 2)),
            physicsClientId=self.client,
        )

    def picture(self) -> tuple[np.ndarray, np.ndarray]:
        camera, light = self.scene.camera, self.scene.light
        aspect = camera.width / camera.height
        fov = 2 * math.degrees(math.atan(math.tan(math.radians(camera.fov / 2)) / aspect))
        _, _, rgba, _, ids = pybullet.getCameraImage(
            camera.width,
            camera.height,
            pybullet.computeViewMatrix(camera.eye, camera.target, (0, 0, 1)),
            pybullet.computeProjectionMatrixFOV(fov, aspect, camera.near, camera.far),
            lightDirection=light.direction,
            lightColor=light.color,
            lightDistance=light.distance,
            shadow=0,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        shape = (camera.height, camera.width)
        return np.reshape(rgba, (*shape, 4))[..., :3].astype(int), np.reshape(ids, shape)

    def close(self) -> None:
        pybullet.disconnect(physicsClientId=self.client)


def scenes(count: int, family: str = "on") -> list[Scene]:
    config = SceneConfig(family=family)
    drawn = [sample_scene(config, seed=5, index=i) for i in range(count)]
    return [scene for scene in drawn if scene is not None]


def digest(rendering: Rendering) -> str:
    parts = (rendering.image, rendering.mask, rendering.views, rendering.visible_fraction)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    with Renderer() as made:
        yield made


def test_render_equals_a_full_pybullet_render_without_shadows(renderer):
    for scene in scenes(4):
        scene = replace(scene, id="", light=Light(shadow=False))
        mine = renderer.render(scene)
        reference = Reference(scene)
        image, ids = reference.picture()
        reference.close()
        mask = np.zeros(ids.shape, dtype=int)
        for i, name in enumerate(scene.names):
            mask[ids == reference.ids[name]] = i + 1
        assert (mine.mask == mask).all()
        assert (mine.image[mask > 0] == image[mask > 0]).all()
        # The table's border is drawn, not computed, over there: a row of pixels may differ.
        ground = (mask == 0) & (np.abs(mine.image.astype(int) - image).max(axis=-1) > 0)
        assert (ground & (ids == reference.table)).sum() <= scene.camera.width


def test_shadows_equal_rays_to_the_light(renderer):
    """A pixel is darkened exactly where a ray from its point to the light hits a box."""
    rng = np.random.default_rng(0)
    for scene in scenes(3):
        bright = renderer.render(replace(scene, id="", light=Light(shadow=False))).image
        dark = (renderer.render(scene).image < bright).any(axis=-1)
        reference = Reference(scene, table=False)
        light, eye = scene.light, np.array(scene.camera.eye)
        source = np.array(light.direction) / np.linalg.norm(light.direction) * light.distance
        focal = scene.camera.width / 2 / math.tan(math.radians(scene.camera.fov) / 2)
        rows = rng.integers(10, scene.camera.height, 1500)
        columns = rng.integers(0, scene.camera.width, 1500)
        wrong = tested = 0
        for row, column in zip(rows, columns, strict=True):
            u = (column - scene.camera.width / 2) / focal
            v = (row + 1 - scene.camera.height / 2) / focal
            s = math.sqrt(0.5)
            ray = np.array([s, 0, -s]) + u * np.array([0, -1, 0]) + v * np.array([-s, 0, -s])
            hit = pybullet.rayTest(eye, eye + 3 * ray, physicsClientId=reference.client)[0]
            ground = eye - ray * eye[2] / ray[2]
            point = np.array(hit[3]) if hit[0] >= 0 else ground
            toward = (source - point) / np.linalg.norm(source - point)
            start = point + 1e-4 * toward + (1e-4 * np.array(hit[4]) if hit[0] >= 0 else 0)
            blocked = pybullet.rayTest(start, source, physicsClientId=reference.client)[0]
            if hit[0] >= 0 and blocked[0] == hit[0]:
                continue  # A face that looks away from the light has no shadow on it.
            tested += 1
            wrong += (blocked[0] >= 0) != bool(dark[row, column])
        reference.close()
        assert tested > 1000
        assert wrong <= 0.005 * tested


def test_visible_fraction_equals_rendering_alone(renderer):
    for scene in scenes(3):
        mine = renderer.render(scene)
        for i, item in enumerate(scene.objects):
            reference = Reference(scene, only=item.name)
            alone = int((reference.picture()[1] >= 0).sum())
            reference.close()
            assert mine.visible_pixels[i] == (mine.mask == i + 1).sum()
            assert mine.visible_fraction[i] == mine.visible_pixels[i] / alone


@pytest.mark.parametrize("eye", [(-0.3, 0.0, 0.2), (0.05, 0.02, 0.3), (-0.05, 0.3, 0.04)])
def test_visible_fraction_from_odd_cameras(renderer, eye):
    """Boxes cut by the image border, beside or behind the camera."""
    camera = Camera(eye=eye, target=(0.2, 0.0, 0.0), fov=90)
    scene = replace(SCENE, id="", camera=camera)
    mine = renderer.render(scene)
    for i, item in enumerate(scene.objects):
        reference = Reference(scene, only=item.name)
        alone = int((reference.picture()[1] >= 0).sum())
        reference.close()
        assert mine.visible_fraction[i] == pytest.approx(mine.visible_pixels[i] / max(alone, 1))


def test_visible_fraction_of_a_box_partly_behind_the_camera(renderer):
    camera = Camera(eye=(0.0, 0.0, 0.05), target=(0.3, 0.0, 0.05), fov=90)
    long = box("red", 0.05, 0.1, size=(0.3, 0.04, 0.1))
    small = box("blue", 0.12, 0.05, size=(0.03, 0.03, 0.05))
    scene = Scene(objects=(long, small), camera=camera)
    mine = renderer.render(scene)
    for i, item in enumerate(scene.objects):
        reference = Reference(scene, only=item.name)
        alone = int((reference.picture()[1] >= 0).sum())
        reference.close()
        assert alone > 500
        assert mine.visible_fraction[i] == pytest.approx(mine.visible_pixels[i] / alone)
    assert mine.visible_fraction[0] < 1


def test_image_left_is_robot_left(renderer):
    scene = Scene(objects=(box("red", 0.0, 0.2), box("blue", 0.0, -0.2), box("green", 0.25, 0.0)))
    mask = renderer.render(scene).mask
    centre = [np.argwhere(mask == i + 1).mean(axis=0) for i in range(3)]
    assert centre[0][1] < centre[2][1] < centre[1][1]
    assert centre[2][0] < centre[0][0]


def test_rendering_does_not_depend_on_what_came_before(renderer):
    drawn = scenes(4)
    first = [digest(renderer.render(scene)) for scene in drawn]
    assert [digest(renderer.render(scene)) for scene in reversed(drawn)] == first[::-1]
    with Renderer() as other:
        assert digest(other.render(drawn[2])) == first[2]


def test_rendering_is_equal_in_another_process(renderer):
    scene = scenes(1)[0]
    program = (
        "import sys, test_rendering as t; from relevance.scene import scene_from_json\n"
        "with t.Renderer() as r: print(t.digest(r.render(scene_from_json(sys.argv[1]))))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program, scene_to_json(scene)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.split()[-1] == digest(renderer.render(scene))


def test_views_depend_on_size_and_color_alone(renderer):
    here = box("red", 0.0, 0.0)
    there = replace(here, position=(0.1, 0.2, 0.04), yaw=1.0)
    larger = box("red", 0.0, 0.0, size=(0.06, 0.08, 0.1))
    views = [
        renderer.render(Scene(objects=(item, box("blue", 0.2, -0.2)))).views
        for item in (here, there, larger)
    ]
    assert views[0].shape == (2, 32, 32, 3)
    assert (views[0] == views[1]).all()
    grey = [(view[0] == 128).all(axis=-1) for view in views]
    # One metric scale: the larger box covers more; both lie well inside the view.
    assert grey[2].sum() < grey[0].sum()
    for frame in grey:
        assert frame[0].all()
        assert frame[-1].all()
        assert frame[:, 0].all()
        assert frame[:, -1].all()
    # Red at least twice as strong as the rest, on all three faces.
    red = views[0][0][~grey[0]].astype(int)
    inner = red[(red[:, 0] > red[:, 1] + 30)]
    assert len(inner) > 0.7 * len(red)


def test_views_are_taken_under_a_nominal_light(renderer):
    """They are taken before anybody knows the scene; its own light would be a tell."""
    scene = replace(SCENE, id="")
    dim = replace(scene, light=Light(direction=(0.5, -0.6, 0.7), color=(0.9, 1, 0.8), ambient=0.4))
    bright, dark = renderer.render(scene), renderer.render(dim)
    assert (bright.views == dark.views).all()
    assert (bright.image != dark.image).any()


def test_the_largest_box_fits_its_view(renderer):
    cube = box("red", 0.0, 0.0, size=(0.12, 0.12, 0.12))
    view = renderer.render(Scene(objects=(cube,))).views[0]
    grey = (view == 128).all(axis=-1)
    assert grey[0].all()
    assert grey[-1].all()
    assert grey[:, 0].all()
    assert grey[:, -1].all()
    assert (~grey).sum() > 250


def test_rejects_what_cannot_be_seen(renderer):
    small = box("red", 0.3, 0.0, size=(0.04, 0.04, 0.04))
    tall = box("blue", 0.24, 0.0, size=(0.05, 0.1, 0.12))
    assert rejects(renderer.render(Scene(objects=(small,)))) is None
    reason = rejects(renderer.render(Scene(objects=(small, tall))))
    assert reason is not None
    assert "object 0" in reason
    far = Camera(eye=(-3.0, 0, 3.0))
    reason = rejects(renderer.render(Scene(objects=(small,), camera=far)))
    assert reason is not None
    assert "pixels" in reason


def test_mask_values_follow_the_order_of_objects(renderer):
    """The same picture whatever the order; only the labels are permuted."""
    order = (box("b", 0.0, 0.2), box("a", 0.0, 0.0), box("c", 0.0, -0.2))
    turned = renderer.render(Scene(objects=order[::-1]))
    straight = renderer.render(Scene(objects=order))
    swapped = np.array([0, 3, 2, 1])[straight.mask]
    assert (turned.mask == swapped).all()
    assert (turned.image == straight.image).all()


# ---------------------------------------------------------------- randomised looks

KINDS = ("checks", "stripes", "noise")


@pytest.fixture(scope="module")
def dressed() -> list[Scene]:
    scenes = [
        sample_scene(
            SceneConfig(family=family, randomisation=Randomisation(texture_share=1.0)),
            seed=4,
            index=index,
        )
        for family in ("same-plane", "on")
        for index in range(6)
    ]
    return [scene for scene in scenes if scene is not None]


def test_a_randomised_scene_renders_again_to_equal_pixels_in_another_process(
    renderer, dressed, tmp_path
):
    assert {s.table.texture.kind for s in dressed if s.table.texture} == set(KINDS)
    stored = [scene_from_json(scene_to_json(scene)) for scene in dressed]
    here = [digest(renderer.render(scene)) for scene in dressed]
    assert [digest(renderer.render(scene)) for scene in reversed(stored)][::-1] == here
    assert len(set(here)) == len(here)
    (tmp_path / "scenes.jsonl").write_text("\n".join(map(scene_to_json, dressed)))
    program = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from test_rendering import Renderer, digest\n"
        "from relevance.scene import read_scenes\n"
        "with Renderer() as renderer:\n"
        "    print(*[digest(renderer.render(s)) for s in read_scenes(sys.argv[1])])"
    )
    arguments = [str(tmp_path / "scenes.jsonl"), str(Path(__file__).parent)]
    run = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == here


def test_light_and_table_change_the_picture_but_not_what_is_seen(renderer, dressed):
    for scene in dressed:
        plain = replace(scene, id="", light=Light(), table=Table())
        before, after = renderer.render(plain), renderer.render(scene)
        assert (before.mask == after.mask).all()
        assert (before.visible_pixels == after.visible_pixels).all()
        assert (before.visible_fraction == after.visible_fraction).all()
        assert (before.image != after.image).any(axis=-1).mean() > 0.5


def test_a_texture_paints_the_table_alone(renderer):
    texture = Texture(kind="checks", color=(0.2, 0.4, 0.2), scale=0.07, angle=0.4, seed=3)
    table = Table(texture=texture)
    plain, textured = renderer.render(SCENE), renderer.render(replace(SCENE, id="", table=table))
    changed = (plain.image != textured.image).any(axis=-1)
    assert not changed[plain.mask > 0].any()
    assert (plain.views == textured.views).all()
    floor = (plain.image == (176, 180, 188)).all(axis=-1)
    assert floor.any()
    assert not changed[floor].any()
    assert 0.4 < changed[(plain.mask == 0) & ~floor].mean() < 0.6


def test_the_two_colours_of_a_texture_are_those_of_plain_tables(renderer):
    """Lit and shadowed: a checked pixel is what it would be on a table of that one colour."""
    first, second = (0.9, 0.8, 0.7), (0.2, 0.4, 0.2)
    texture = Texture(kind="checks", color=second, scale=0.07)
    scenes = [
        replace(SCENE, id="", table=table)
        for table in (Table(color=first), Table(color=second), Table(color=first, texture=texture))
    ]
    one, other, both = (renderer.render(scene).image for scene in scenes)
    is_one, is_other = (both == one).all(axis=-1), (both == other).all(axis=-1)
    assert (is_one | is_other).all()
    assert is_one.mean() > 0.3
    assert is_other.mean() > 0.3


def test_a_texture_of_the_table_s_own_colour_is_no_texture(renderer):
    table = Table()
    for kind in KINDS:
        same = Table(texture=Texture(kind=kind, color=table.color, scale=0.05, seed=2))
        again = renderer.render(replace(SCENE, id="", table=same))
        assert (again.image == renderer.render(SCENE).image).all()


@pytest.mark.parametrize("kind", KINDS)
def test_patterns_are_shares_with_the_size_that_was_asked_for(kind):
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 401), np.linspace(-0.6, 0.6, 601))

    def make(**more) -> np.ndarray:
        return pattern(Texture(**({"kind": kind, "color": (0, 0, 0), "scale": 0.05} | more)), x, y)

    first = make()
    assert first.min() >= 0
    assert first.max() <= 1
    assert 0.3 < first.mean() < 0.7
    assert first.std() > 0.08
    assert (make() == first).all()
    assert (make(seed=1) != first).mean() > 0.2
    assert (make(angle=0.5) != first).mean() > 0.2

    def roughness(values: np.ndarray) -> float:
        return float(
            np.abs(np.diff(values, axis=0)).mean() + np.abs(np.diff(values, axis=1)).mean()
        )

    assert roughness(make(scale=0.02)) > 1.8 * roughness(first)


def test_patterns_are_the_same_on_every_machine():
    x, y = np.array([-0.31, 0.02, 0.17, 0.33]), np.array([0.5, -0.24, 0.01, 0.42])
    texture = Texture(kind="noise", color=(0, 0, 0), scale=0.05, angle=0.25, seed=12345)
    assert pattern(texture, x, y) == pytest.approx(
        [0.535033906635, 0.343456982826, 0.701544156415, 0.385242574110], abs=1e-9
    )


def test_the_draw_itself_keeps_boxes_in_sight(renderer):
    """Hardly any scene is thrown away for hiding a box; without the check many are."""

    def hidden(least: float) -> int:
        scenes = [
            sample_scene(SceneConfig(family="stacks", visible=least), seed=3, index=i)
            for i in range(30)
        ]
        return sum(rejects(renderer.render(scene)) is not None for scene in scenes if scene)

    assert hidden(SceneConfig().visible) <= 1
    assert hidden(0.0) >= 3


def test_importing_the_simulation_says_nothing():
    """pybullet alone prints its build time; errors must still come through."""
    program = (
        "import sys, relevance.simulation; print('done');"
        "print('heard', file=sys.stderr, flush=True)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert (run.stdout, run.stderr) == ("done\n", "heard\n")
    closed = subprocess.run(
        f'"{sys.executable}" -c "import relevance.simulation; print(1)" 2>&-',
        shell=True,
        capture_output=True,
        text=True,
        check=True,
    )
    assert closed.stdout == "1\n"
