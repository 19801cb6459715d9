"""Our own body: find each object by its view, look at it closely, then reason about the goal.

Shape suffixes: B scenes, N objects (padded), G goals, P cells of the feature map,
D width, E channels, K looks, H and W height and width in pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import convert_conv2d_weight_memory_format

from relevance.configs import config
from relevance.models.config import PATCH, Encoding, ModelConfig, Sight, divides
from relevance.models.edges import Looker
from relevance.models.layers import Attention, columns, small_cnn, unshuffled
from relevance.models.poses import half_extents
from relevance.models.reasoning import APART, BETWEEN, Between, apart
from relevance.models.registry import BODIES, BodyKind
from relevance.models.tracing import sums, tracing, windows
from relevance.networks import DECIMETRE, GEOMETRY
from relevance.scene import Camera, camera_up

_CELL = 8
"""Edge of a cell of the feature map, pixels: there objects are found; windows place them."""
_AROUND = 28
"""How far from its likeliest place an object is looked for, in pixels either way."""
_NOBODY = -1e4
"""What contends for no cell."""
_LOOK = 8, 16, 32
"""Channels of the glimpse."""
_OFF = 0.1
"""What a box's middle may well be off from where it is seen, in u and v."""
_GROUND = 0.035
"""Height at which a sight line is cut for a first guess of the position, m: half a box."""


@config
class GlimpseConfig(ModelConfig):
    """Sizes of the matching, the glimpses and the layers over the objects."""

    body: Literal["glimpse"] = "glimpse"
    """The body that these settings are of."""
    width: Annotated[int, Field(ge=1)] = 128
    """D, width of the object tokens."""
    heads: Annotated[int, Field(ge=1)] = 4
    """Attention heads; divides width."""
    layers: Annotated[int, Field(ge=1)] = 2
    """Attention layers over the objects given the goal."""
    channels: Annotated[int, Field(ge=2)] = 32
    """E, channels of the feature map."""
    window: Annotated[int, Field(ge=1)] = 64
    """Edge of the image window around a matched object, pixels; looked at by 32 samples."""

    @model_validator(mode="after")
    def _even(self) -> Self:
        divides(self.width, self.heads)
        return self

    @classmethod
    def smoke(cls) -> Self:
        """The smallest that runs."""
        return cls(width=32, heads=2, layers=1, channels=8)


class GlimpseBody(Looker):
    """Find each object, look at it closely, then reason about the goal over all objects.

    Match: dot product of the view's embedding with a map of features, for whose cells the objects
    contend; softmax in float32 and the mean around its peak say where the object is. Glimpse: the
    image window there goes through a small CNN together with the match map of the same window.
    Both say how the box appears (how far its middle is from there, its height, its apparent sizes),
    which the camera makes geometry of; that is settled with what lies between the objects known:
    what a box stands on tells whether it is a small one near by or a large one behind. That is a
    few millimetres off, and put right by a closer look at where the edges should be. From there on
    it is the body `geometry`, told what was estimated and what was seen besides.
    """

    def __init__(self, config: GlimpseConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        width, channels = config.width, config.channels
        self.window, self.camera = config.window, config.camera
        # Space-to-depth first: on cells a 3x3 convolution is cheap and no pixel is lost.
        self.scene = nn.Sequential(
            nn.PixelUnshuffle(_CELL),
            nn.Conv2d(3 * _CELL**2, channels, 1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 1),
        )
        self.view = small_cnn(3, (channels // 2, channels, channels), width)
        self.view_key = nn.Linear(width, channels)
        self.sharpness = nn.Parameter(torch.tensor(2.5))
        # Begins with two convolutions, of the colours and of where the object was found. Small,
        # since what is precise is seen at the edges.
        self.look = small_cnn(1, _LOOK, width)
        colours = nn.Conv2d(3, _LOOK[0], 4, stride=2, padding=1)
        self.colours = convert_conv2d_weight_memory_format(colours, torch.channels_last)
        seen = 2 * width + 4
        self.estimate = nn.Sequential(nn.Linear(seen, width), nn.GELU(), nn.Linear(width, GEOMETRY))
        self.estimate[-1].bias.data = _cube()  # so that edges are looked for around objects
        self.seen = nn.Sequential(nn.Linear(seen + GEOMETRY, width), nn.GELU())
        self.between = Between(APART)
        self.settle = nn.ModuleList(
            Attention(width, config.heads, expansion=2, between=BETWEEN) for _ in range(2)
        )
        self.correct = nn.Linear(width, GEOMETRY)
        nn.init.zeros_(self.correct.weight)  # at first nothing is added to what was there
        nn.init.zeros_(self.correct.bias)
        self.looks(width)
        self.thinks(width, config.heads, config.layers, predicates)
        self.cells_P2: Tensor
        self.register_buffer("cells_P2", _cell_centres(config.camera), persistent=False)
        self.around_2: Tensor
        around = torch.tensor([1 / config.camera.width, 1 / config.camera.height]) * _AROUND * 2
        self.register_buffer("around_2", around, persistent=False)

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, inputs float in 0..1."""
        batch, objects = views.shape[:2]
        features_BEP = unshuffled(self.scene, image).flatten(2)
        view_BND = self.view((views - 0.5).flatten(0, 1)).view(batch, objects, -1)
        key_BNE = self.view_key(view_BND)
        with torch.autocast(image.device.type, enabled=False):
            # Cosine similarity; positions are read to a fraction of a pixel, hence float32.
            features_BEP = features_BEP.float()
            norm_B1P = sums(features_BEP.square()).clamp(min=1e-6).rsqrt()
            key_BNE = F.normalize(key_BNE.float(), dim=-1) * self.sharpness.exp()
            match_BNP = key_BNE @ features_BEP * norm_B1P
            # A cell shows one object: those that are alike contend for it.
            own = match_BNP.masked_fill(~present[..., None], _NOBODY).log_softmax(1)
            match_BNP = match_BNP + own
            where_BNP = match_BNP.softmax(2)
            centre_BN2 = self._centre(where_BNP, image.shape[-2] // _CELL)
        colours, heat = self._windows(image, where_BNP.detach(), centre_BN2.detach())
        found = self.look[0](heat) + self.colours(colours)
        look_BND = self.look[1:](found).view(batch, objects, -1)
        ground_BN2 = _cut(centre_BN2, _GROUND, self.camera)[..., :2]
        seen = torch.cat([view_BND, look_BND, centre_BN2, ground_BN2], dim=-1)
        apparent = self.estimate(seen).float()
        geometry = _placed(centre_BN2, apparent, self.camera)
        x = self.seen(torch.cat([seen, geometry], dim=-1))
        allowed, between = columns(present), self.between(apart(geometry))
        for layer in self.settle:
            x = layer(x, allowed, between)
        geometry = _placed(centre_BN2, apparent + self.correct(x).float(), self.camera)
        encoding, guesses = self.looked(image, x, geometry, present, self.camera)
        if self.training:
            at = scene_K, place_K = present.nonzero(as_tuple=True)
            grid = image.shape[-2] // _CELL, image.shape[-1] // _CELL
            sight = Sight(
                scene=scene_K,
                place=place_K,
                geometry=torch.stack([guess[at] for guess in guesses]),
                match=match_BNP[at],
                grid=grid,
            )
            encoding = replace(encoding, sight=sight)
        return encoding

    def _centre(self, where_BNP: Tensor, rows: int) -> Tensor:
        """Where objects are seen, (B, N, 2): the mean over what lies around the likeliest place,
        so that what looks alike elsewhere does not count."""
        maps = where_BNP.detach().flatten(0, 1).unflatten(1, (1, rows, -1))
        peak_BN = F.avg_pool2d(maps, 3, stride=1, padding=1).flatten(1).argmax(1)
        peak_BN2 = self.cells_P2[peak_BN].view(*where_BNP.shape[:2], 1, 2)
        off = (self.cells_P2 - peak_BN2).abs()
        near = (off <= self.around_2).all(-1)
        around = where_BNP * near
        return around @ self.cells_P2 / around.sum(2, keepdim=True).clamp(min=1e-6)

    def _windows(
        self, image: Tensor, where_BNP: Tensor, centre_BN2: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Windows around the centres: colours (B*N, 3, 32, 32) and match maps (B*N, 1, 32, 32)."""
        batch, objects = where_BNP.shape[:2]
        height, width = image.shape[-2:]
        if tracing():
            map_NHW = where_BNP[0].unflatten(-1, (height // _CELL, width // _CELL))
            peak = windows(map_NHW[:, None], centre_BN2[0], self.window / _CELL, own=True)
            colours = windows(image, centre_BN2[0], self.window, own=False)
            return colours - 0.5, peak / where_BNP[0].amax(-1)[:, None, None, None]
        edge = image.new_tensor([self.window / width, self.window / height])
        square_BNPP2 = centre_BN2[:, :, None, None] + _square(image.device) * edge
        colours = F.grid_sample(image, square_BNPP2.view(batch, -1, PATCH, 2), align_corners=False)
        colours = colours.view(batch, 3, objects, PATCH, PATCH).transpose(1, 2)
        shape = (batch * objects, 1, height // _CELL, width // _CELL)
        peak = (where_BNP / where_BNP.amax(-1, keepdim=True)).view(shape)
        heat = F.grid_sample(peak, square_BNPP2.flatten(0, 1), align_corners=False)
        return colours.flatten(0, 1) - 0.5, heat


def _cube() -> Tensor:
    """How a cube of 7 cm appears, GEOMETRY, that stands square where it is seen."""
    edge = torch.full((), 2 * _GROUND / DECIMETRE)
    extents = half_extents(edge, edge, torch.zeros(()))
    return torch.cat([torch.zeros(3), edge.expand(3), extents])


def _square(device: torch.device) -> Tensor:
    """Centres of 32 x 32 cells of a square, (32, 32, 2): u and v, each in -1..1."""
    step = (torch.arange(PATCH, device=device) + 0.5) / PATCH * 2 - 1
    return torch.stack(torch.meshgrid(step, step, indexing="xy"), -1)


def _cell_centres(camera: Camera) -> Tensor:
    """Centres of the cells, (P, 2): u right and v down, each in -1..1."""
    u = (torch.arange(camera.width // _CELL) + 0.5) * (2 * _CELL / camera.width) - 1
    v = (torch.arange(camera.height // _CELL) + 0.5) * (2 * _CELL / camera.height) - 1
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)


def _placed(centre: Tensor, apparent: Tensor, camera: Camera) -> Tensor:
    """Geometry (..., GEOMETRY) of boxes that appear so at (u, v): how far their middles are from
    there, their height, and what sizes they would have at a distance of a metre.

    So a box that turns out to stand higher comes nearer along its sight line, and smaller.
    """
    z = apparent[..., 2:3] + _GROUND / DECIMETRE
    place = _cut(centre + _OFF * apparent[..., :2], z * DECIMETRE, camera)
    return torch.cat([place[..., :2], z, apparent[..., 3:] * place[..., 2:]], dim=-1)


def _cut(centre: Tensor, height: Tensor | float, camera: Camera) -> Tensor:
    """Where the sight lines through (u, v) are at a height (m): x, y in decimetres, and how far
    from the camera along its axis, m."""
    eye, target, above = (
        centre.new_tensor(vector) for vector in (camera.eye, camera.target, camera_up(camera))
    )
    forward = F.normalize(target - eye, dim=0)
    right = F.normalize(torch.linalg.cross(forward, above), dim=0)
    up = torch.linalg.cross(right, forward)
    tangent = math.tan(math.radians(camera.fov) / 2)
    u = centre[..., :1] * tangent
    v = centre[..., 1:] * (tangent * camera.height / camera.width)
    ray = forward + u * right - v * up
    # Sight lines at or above the horizon hit nothing; they are cut far away instead.
    along = (height - camera.eye[2]) / ray[..., 2:].clamp(max=-0.1)
    return torch.cat([(eye[:2] + along * ray[..., :2]) / DECIMETRE, along], dim=-1)


BODIES.register(
    "glimpse",
    BodyKind(
        config=GlimpseConfig,
        make=GlimpseBody,
        version="6",
        advantage="sees the views of all objects, learned from masks and poses, looks for the "
        "edges of boxes where it expects them, and reckons what is in the hand's way there",
    ),
)
