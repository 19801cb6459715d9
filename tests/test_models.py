"""Models: shared encoding equals the naive one, geometry, loss, and what each score may see."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relevance.configs import ConfigError, config
from relevance.models import (
    ANGLES,
    BODIES,
    DECIMETRE,
    GEOMETRY,
    Answer,
    Body,
    BodyKind,
    Encoding,
    ModelConfig,
    ModelError,
    RelevanceModel,
    glimpse,
    half_extents,
    mirrored,
    model_config,
    reasoning,
)
from relevance.models.geometry import GeometryConfig
from relevance.models.glimpse import _CELL as CELL
from relevance.models.glimpse import GlimpseBody, GlimpseConfig
from relevance.models.resnet import ResnetConfig
from relevance.models.resnet3d import Resnet3dConfig
from relevance.models.vit import ViTBody, VitConfig
from relevance.scene import PREDICATES, Box, Camera, Predicate, Rectangle, Robot, project

torch.set_num_threads(1)  # threads that wait for each other crawl on a busy machine

SMALL: dict[str, ModelConfig] = {
    "glimpse": GlimpseConfig(width=32, heads=2, layers=2, channels=8),
    "vit": VitConfig(width=32, heads=2, layers=2, hidden=24),
    "vit-trio": VitConfig(width=32, heads=2, layers=2, hidden=24, attention="trio"),
    "vit-no-patches": VitConfig(width=32, heads=2, layers=2, hidden=24, attention="no-patches"),
    "resnet": ResnetConfig.smoke(),
    "resnet3d": Resnet3dConfig.smoke(),
    "geometry": GeometryConfig.smoke(),
}
PAPER = [body for body in SMALL if body not in ("glimpse", "geometry")]
"""What a score of these may see is the image and three views."""
ALL = pytest.mark.parametrize("body", list(SMALL))


def model(body: str) -> RelevanceModel:
    torch.manual_seed(1)
    made = RelevanceModel(SMALL[body])
    with torch.no_grad():  # away from zero, so that no term hides
        for weight in made.parameters():
            weight += 0.05 * torch.randn_like(weight)
    return made.eval()


def pictures(batch: int = 2, objects: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    image = torch.randint(0, 256, (batch, 3, 192, 320), dtype=torch.uint8, generator=generator)
    views = torch.randint(
        0, 256, (batch, objects, 3, 32, 32), dtype=torch.uint8, generator=generator
    )
    return image, views


def standing(batch: int = 2, objects: int = 5) -> torch.Tensor:
    """Made-up poses."""
    generator = torch.Generator().manual_seed(5)
    return torch.rand(batch, objects, GEOMETRY, generator=generator)


GOALS = torch.tensor([[[0, 1], [3, 2], [4, 0]], [[2, 4], [1, 0], [0, 3]]])


@pytest.mark.parametrize("body", PAPER)
@torch.inference_mode()
def test_one_encoding_equals_one_a_query(body: str) -> None:
    """The paper encodes subject, reference and query anew for every query."""
    network = model(body)
    image, views = pictures()
    encoding = network.encode(image, views)
    for predicate in ("on", "behind"):
        shared = network.decode(encoding, predicate, GOALS)
        for b, g, query in np.ndindex(2, 3, 5):
            trio = [*GOALS[b, g].tolist(), query]
            alone = network.encode(image[b : b + 1], views[b : b + 1, trio])
            score = network.decode(alone, predicate, torch.tensor([[[0, 1]]]))[0, 0, 2]
            assert abs(score - shared[b, g, query]) < 1e-5


@pytest.mark.parametrize("body", PAPER)
@torch.inference_mode()
def test_a_score_depends_on_the_image_and_three_views(body: str) -> None:
    network = model(body)
    image, views = pictures(batch=1)
    goals = torch.tensor([[[0, 1]]])
    before = network.decode(network.encode(image, views), "on", goals)[0, 0]
    darker = network.decode(network.encode(image // 2, views), "on", goals)[0, 0]
    assert (before - darker).abs().min() > 1e-6
    for changed in range(5):
        other = views.clone()
        other[:, changed] = 255 - other[:, changed]
        after = network.decode(network.encode(image, other), "on", goals)[0, 0]
        moved = (before - after).abs()
        # a subject or reference is seen by all queries, any other object by itself alone
        for query in range(5):
            assert (moved[query] > 1e-6) == (changed in (0, 1, query))


@torch.inference_mode()
def test_attention_of_the_vit() -> None:
    """Where a query's embedding is changed by the subject's view, and patches by each other."""
    image, views = pictures(batch=1)
    other = views.clone()
    other[:, 0] = 255 - other[:, 0]
    networks = {name: model(name).body for name in ("vit", "vit-trio", "vit-no-patches")}
    for name, body in networks.items():
        assert isinstance(body, ViTBody)
        patches = body.embed(image.float() / 255).flatten(2).transpose(1, 2)
        pair = [body.embed(v[0, :3].float() / 255).flatten(1)[None] for v in (views, other)]
        before, after = (body._transform(patches, three)[0][0, 2] for three in pair)
        assert ((before - after).abs().max() > 1e-4) == (name != "vit")


@torch.inference_mode()
def test_geometry_looks_at_poses_alone() -> None:
    network = model("geometry")
    image, views = pictures()
    poses = standing()
    plain = network.decode(network.encode(image, views, poses=poses), "on", GOALS)
    blind = network.decode(network.encode(image * 0, views * 0, poses=poses), "on", GOALS)
    assert torch.equal(plain, blind)
    moved = network.decode(network.encode(image, views, poses=poses + 1), "on", GOALS)
    assert (plain - moved).abs().max() > 1e-3
    with pytest.raises(ModelError, match="body geometry is told where objects are, expected pos"):
        network.encode(image, views)


@torch.inference_mode()
def test_glimpse_shared_encoding_equals_one_encoding_a_goal() -> None:
    network = model("glimpse")
    image, views = pictures()
    encoding = network.encode(image, views)
    for predicate in PREDICATES.values():
        shared = network.decode(encoding, predicate, GOALS)
        for b in range(2):
            for g in range(3):
                alone = network.encode(image[b : b + 1], views[b : b + 1])
                score = network.decode(alone, predicate, GOALS[b : b + 1, g : g + 1])
                torch.testing.assert_close(score[0, 0], shared[b, g], atol=1e-5, rtol=0)


@ALL
@torch.inference_mode()
def test_padding_changes_nothing(body: str) -> None:
    network = model(body)
    image, views = pictures()
    padded = torch.cat([views, torch.full_like(views[:, :3], 200)], dim=1)
    present = torch.arange(8).expand(2, -1) < 5
    poses = standing()
    wider = torch.cat([poses, torch.ones_like(poses[:, :3])], dim=1)
    plain = network.decode(network.encode(image, views, poses=poses), "behind", GOALS)
    wide = network.decode(network.encode(image, padded, present, wider), "behind", GOALS)
    torch.testing.assert_close(wide[..., :5], plain, atol=1e-5, rtol=0)


@ALL
@torch.inference_mode()
def test_order_of_objects_only_reorders_scores(body: str) -> None:
    network = model(body)
    image, views = pictures()
    order = torch.tensor([3, 0, 4, 2, 1])
    where = order.argsort()
    poses = standing()
    plain = network.decode(network.encode(image, views, poses=poses), "on", GOALS)
    turned = network.encode(image, views[:, order], poses=poses[:, order])
    shuffled = network.decode(turned, "on", where[GOALS])
    torch.testing.assert_close(shuffled, plain[..., order], atol=1e-5, rtol=0)


@torch.inference_mode()
def test_vit_tokens_do_not_see_other_objects() -> None:
    vit = model("vit")
    image, views = pictures()
    other = views.clone()
    other[:, 1] = 255 - other[:, 1]
    before, after = vit.encode(image, views).tokens, vit.encode(image, other).tokens
    torch.testing.assert_close(before[:, [0, 2, 3, 4]], after[:, [0, 2, 3, 4]], atol=1e-6, rtol=0)
    assert (before[:, 1] - after[:, 1]).abs().max() > 1e-3
    darker = vit.encode(image // 2, views).tokens
    assert (before - darker).abs().amax(-1).min() > 1e-4, "every token must see the image"


@ALL
def test_every_predicate_has_a_head_of_its_own(body: str) -> None:
    network = model(body)
    encoding = network.encode(*pictures(), poses=standing())
    network.decode(encoding, PREDICATES["behind"], GOALS).sum().backward()
    heads = network.body.heads
    moved = {
        name for name, head in heads.items() if any(w.grad is not None for w in head.parameters())
    }
    assert moved == {"behind"}
    assert set(heads) == {predicate.name for predicate in PREDICATES.values()}


@ALL
@torch.inference_mode()
def test_subject_and_reference_have_different_roles(body: str) -> None:
    network = model(body)
    encoding = network.encode(*pictures(), poses=standing())
    there = network.decode(encoding, "on", GOALS)
    back = network.decode(encoding, "on", GOALS.flip(-1))
    assert (there - back).abs().max() > 1e-3


@given(
    x=st.floats(0.04, 0.12),
    y=st.floats(0.04, 0.12),
    yaw=st.floats(-math.pi, math.pi),
)
def test_half_extents_are_those_of_the_corners(x: float, y: float, yaw: float) -> None:
    box = Box(name="a", size=(x, y, 0.1), position=(0, 0, 0.05), yaw=yaw, color=(1, 0, 0))
    found = half_extents(*(torch.tensor(v, dtype=torch.float64) for v in (x, y, yaw)))
    angles = np.arange(ANGLES) * math.pi / ANGLES
    axes = np.stack([np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(found.numpy(), (box.corners() @ axes).max(0), atol=1e-9)


def uv(camera: Camera, point: np.ndarray) -> torch.Tensor:
    """Where the camera sees a point, u and v in -1..1."""
    pixel, _ = project(camera, point)
    return torch.tensor(pixel / np.array([camera.width, camera.height]) * 2 - 1).float()


@settings(deadline=None)
@given(x=st.floats(-0.15, 0.25), y=st.floats(-0.3, 0.3), z=st.floats(0.0, 0.2))
def test_sight_lines_invert_the_projection(x: float, y: float, z: float) -> None:
    camera = Camera()
    _, depth = project(camera, np.array([x, y, z]))
    found = glimpse._cut(uv(camera, np.array([x, y, z])), z, camera)
    np.testing.assert_allclose(found[:2].numpy() * DECIMETRE, [x, y], atol=1e-4)
    assert float(found[2]) == pytest.approx(float(depth), abs=1e-4)


def test_sight_lines_of_a_camera_that_looks_straight_down() -> None:
    camera = Camera(eye=(0.1, 0.0, 0.9), target=(0.1, 0.0, 0.0))
    found = glimpse._cut(uv(camera, np.array([0.15, -0.1, 0.05])), 0.05, camera)
    np.testing.assert_allclose(found[:2].numpy() * DECIMETRE, [0.15, -0.1], atol=1e-4)


def test_a_box_that_stands_higher_is_nearer_and_smaller() -> None:
    """All of these are seen at the same place, with the same outline."""
    camera, centre = Camera(), torch.tensor([0.1, -0.2]).expand(3, 2)
    apparent = torch.ones(3, GEOMETRY)
    apparent[:, :2], apparent[:, 2] = 0, torch.tensor([0.0, 0.5, 1.0])
    placed = glimpse._placed(centre, apparent, camera)
    for row in placed:
        seen = uv(camera, row[:3].numpy() * DECIMETRE)
        torch.testing.assert_close(seen, centre[0], atol=1e-5, rtol=0)
    eye = torch.tensor(camera.eye) / DECIMETRE
    away = (placed[:, :3] - eye).norm(dim=1)
    torch.testing.assert_close(placed[:, 3] / placed[0, 3], away / away[0])
    assert (placed[1:, 3:] < placed[:-1, 3:]).all()


def test_objects_contend_for_cells_and_padding_does_not() -> None:
    body = model("glimpse").body
    assert isinstance(body, GlimpseBody)
    seen = []
    centre = body._centre
    body._centre = lambda where, rows: seen.append(where) or centre(where, rows)
    image, views = (x.float() / 255 if x.dtype == torch.uint8 else x for x in pictures())
    present = torch.ones(views.shape[:2], dtype=torch.bool)
    with torch.no_grad():
        body.encode(image, views, present)
        body.encode(image, views[:, :1], present[:, :1])
        present[:, 1:] = False
        body.encode(image, views, present)
    together, alone, padded = (where[:, 0] for where in seen)
    assert (together - alone).abs().max() > 1e-6
    torch.testing.assert_close(padded, alone)


def test_soft_argmax_and_windows_point_at_the_same_pixels() -> None:
    """A bright square in the image must be in the middle of the windows around its centre, and
    what looks alike elsewhere does not move it."""
    body = model("glimpse").body
    assert isinstance(body, GlimpseBody)
    image = torch.full((1, 3, 192, 320), 0.5)
    image[..., 80:96, 200:216] = 1.0  # centre at (208, 88)
    cells = torch.zeros(24, 40)
    cells[80 // CELL : 96 // CELL, 200 // CELL : 216 // CELL] = 1
    cells[2, 3] = 1
    where = (cells.flatten() / cells.sum())[None, None]
    centre = body._centre(where, 24)
    expected = torch.tensor([208 / 320, 88 / 192]) * 2 - 1
    torch.testing.assert_close(centre[0, 0], expected, atol=1e-6, rtol=0)
    colours, heat = body._windows(image, where, centre)
    for channel in (colours[0, 0], heat[0, 0]):
        weight, last = channel / channel.sum(), len(channel) - 1
        steps = torch.arange(last + 1)
        middle = (weight.sum(0) * steps).sum(), (weight.sum(1) * steps).sum()
        assert [float(m) for m in middle] == pytest.approx([last / 2] * 2, abs=0.1)
        assert channel[last // 2, last // 2] > 0.45
        assert channel[2, 2] == 0


def geometry(position: torch.Tensor, size: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    return torch.cat([position, size, half_extents(size[..., 0], size[..., 1], yaw)], dim=-1)


def test_mirror_is_the_geometry_of_the_mirrored_boxes() -> None:
    generator = torch.Generator().manual_seed(3)
    position, size = (torch.rand(1, 6, 3, generator=generator) for _ in range(2))
    yaw = torch.rand(1, 6, generator=generator) * 3
    flipped = geometry(position * torch.tensor([1.0, -1.0, 1.0]), size, -yaw)
    plain = geometry(position, size, yaw)
    torch.testing.assert_close(mirrored(plain), flipped, atol=1e-6, rtol=0)
    torch.testing.assert_close(mirrored(mirrored(plain)), plain)


@pytest.mark.parametrize("predicate", [p for p in PREDICATES.values() if p.direction(Robot())])
def test_goal_axes_turn_with_the_predicate(predicate: Predicate) -> None:
    """Turning the table by the angle between two predicates shows the heads the same thing."""
    generator = torch.Generator().manual_seed(4)
    position, size = (torch.rand(1, 5, 3, generator=generator) for _ in range(2))
    yaw = torch.rand(1, 5, generator=generator) * 3
    u = predicate.direction(Robot())
    assert u is not None
    turn = math.atan2(u[1], u[0])  # from `behind`, whose direction is +x
    c, s = math.cos(turn), math.sin(turn)
    turned = position @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    goals = torch.tensor([[[0, 1], [4, 2]]])
    plain = reasoning.goal_features(geometry(position, size, yaw), PREDICATES["behind"], goals)
    other = reasoning.goal_features(geometry(turned, size, yaw + turn), predicate, goals)
    torch.testing.assert_close(other, plain, atol=1e-5, rtol=0)
    assert plain.shape == (1, 2, 5, reasoning.GOAL_FEATURES)


def test_glimpse_reads_its_geometry() -> None:
    """Scores depend on the estimated geometry, so its loss teaches the heads what they use."""
    network = model("glimpse")
    encoding = network.encode(*pictures())
    assert encoding.geometry is not None
    assert encoding.geometry.shape == (2, 5, GEOMETRY)
    moved = Encoding(
        tokens=encoding.tokens, present=encoding.present, geometry=encoding.geometry + 1.0
    )
    with torch.no_grad():
        difference = network.decode(encoding, "on", GOALS) - network.decode(moved, "on", GOALS)
    assert difference.abs().max() > 1e-3


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (VitConfig, {"width": 30}, "VitConfig: width is 30, expected a multiple of heads 4"),
        (GlimpseConfig, {"layers": 0}, r"GlimpseConfig\.layers = 0: expected greater than"),
        (GlimpseConfig, {"body": "vit"}, r"GlimpseConfig\.body = 'vit': expected 'glimpse'"),
        (VitConfig, {"window": 30}, r"VitConfig\.window: unknown field"),
        (VitConfig, {"camera": Camera(width=300)}, "image is 300x192, expected multiples of 32"),
    ],
)
def test_config_refuses(kind: type[ModelConfig], change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        kind(**change)
    assert "\n" not in str(error.value)


def test_configs_come_back_from_plain_values() -> None:
    for kind in BODIES.values():
        for made in (kind.config(), kind.config.smoke(), kind.config.paper()):
            assert model_config(json.loads(json.dumps(asdict(made)))) == made
    with pytest.raises(ValueError, match="unknown body 'cnn', expected one of geometry, "):
        model_config({"body": "cnn"})


def test_image_of_another_size_is_refused() -> None:
    with pytest.raises(ModelError, match="image is 64x64, expected 320x192"):
        model("vit").encode(torch.zeros(1, 3, 64, 64), torch.zeros(1, 1, 3, 32, 32))


# --- heads ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Near(Predicate):
    """Anywhere within a hand's breadth: no direction."""

    def region(self, subject: Box, reference: Box, robot: Robot) -> Rectangle:
        x, y = reference.position[:2]
        return Rectangle(x=x, y=y, angle=0.0, half=(0.1, 0.1))


@pytest.fixture
def near() -> Iterator[Predicate]:
    predicate = Near(name="near", family="same-plane", mirror="near")
    yield PREDICATES.register("near", predicate)
    PREDICATES.unregister("near")


@ALL
@torch.inference_mode()
def test_one_more_head_leaves_the_others_as_they_are(body: str, near: Predicate) -> None:
    known = tuple(name for name in PREDICATES if name != "near")
    torch.manual_seed(3)
    before = RelevanceModel(SMALL[body], known).eval()
    torch.manual_seed(3)
    after = RelevanceModel(SMALL[body], (*known, "near")).eval()
    scenes = pictures()
    for name in known:
        scores = [
            m.decode(m.encode(*scenes, poses=standing()), name, GOALS) for m in (before, after)
        ]
        assert torch.equal(*scores)
    assert after.decode(after.encode(*scenes, poses=standing()), near, GOALS).isfinite().all()
    with pytest.raises(ModelError, match="has no head for near, was trained on on-the-left, on-th"):
        before.decode(before.encode(*scenes, poses=standing()), near, GOALS)
    after.load_state_dict({**after.state_dict(), **before.state_dict()})  # nothing is renamed


@torch.inference_mode()
def test_a_body_is_registered_from_outside() -> None:
    @config
    class MeanConfig(ModelConfig):
        body: Literal["mean"] = "mean"
        width: int = 4

    class MeanBody(Body):
        def __init__(self, config: MeanConfig, predicates: Sequence[str]) -> None:
            super().__init__()
            self.heads = torch.nn.ModuleDict({n: torch.nn.Linear(3, 1) for n in predicates})

        def encode(
            self, image: torch.Tensor, views: torch.Tensor, present: torch.Tensor
        ) -> Encoding:
            return Encoding(tokens=views.mean((-1, -2)), present=present)

        def decode(
            self,
            encoding: Encoding,
            predicate: Predicate,
            goals: torch.Tensor,
            asked: torch.Tensor,
        ) -> Answer:
            score = self.heads[predicate.name](encoding.tokens)[..., 0]
            return Answer(scores=score[:, None].expand(-1, goals.shape[1], -1))

    BODIES.register("mean", BodyKind(config=MeanConfig, make=MeanBody, version="1"))
    try:
        network = RelevanceModel(model_config({"body": "mean", "width": 5}))
        assert network.decode(network.encode(*pictures()), "on", GOALS).shape == (2, 3, 5)
    finally:
        BODIES.unregister("mean")


@pytest.mark.parametrize("angle", range(8))
def test_any_direction_in_steps_of_the_regressed_ones(angle: int) -> None:
    """A predicate may point anywhere; `behind`, turned along, shows the heads the same thing."""
    turn = angle * math.pi / ANGLES
    generator = torch.Generator().manual_seed(4)
    position, size = (torch.rand(1, 5, 3, generator=generator) for _ in range(2))
    yaw = torch.rand(1, 5, generator=generator) * 3
    c, s = math.cos(turn), math.sin(turn)
    turned = position @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    goals = torch.tensor([[[0, 1], [4, 2]]])
    slanted = replace(PREDICATES["behind"], name="slanted", toward=(c, s))
    plain = reasoning.goal_features(geometry(position, size, yaw), PREDICATES["behind"], goals)
    other = reasoning.goal_features(geometry(turned, size, yaw + turn), slanted, goals)
    torch.testing.assert_close(other, plain, atol=1e-5, rtol=0)
