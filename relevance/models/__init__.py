"""Vision models that score how relevant each object is to a goal, two bodies, one interface.

`encode` looks at a scene once; `decode` scores every object for any number of goals from
that one encoding. Bodies: `vit` is the paper's (32x32 patches, one shared convolutional
embedding, all views at position zero) with image tokens that never see object tokens, which
is what makes the sharing exact; `glimpse` first finds each object by matching its canonical
view with the image, then looks at a window around it. Every predicate has its own head.

Shape suffixes: B scenes, N objects (padded), G goals, P image tokens, D width, E channels,
H and W height and width in pixels, h and w height and width of the stride-4 feature map.
Images and views are RGB. Geometry is in decimetres, so that its numbers are near 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from relevance.scene import PREDICATES, Camera, Predicate, Robot, camera_up

PATCH = 32
"""Edge of image patches and canonical views, pixels (the paper's)."""
STRIDE = 4
"""Image pixels per cell of the matching feature map."""
ANGLES = 8
"""Directions over a half turn along which footprint half-extents are regressed."""
GEOMETRY = 3 + 3 + ANGLES
"""Position (3), size (3), half-extents (ANGLES), all in decimetres."""
DECIMETRE = 0.1
"""Metres per unit of the geometry vectors."""
_GROUND = 0.035
"""Height at which a sight line is cut for a first guess of the position, m: half a box."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """Body and sizes of a model; raises ValueError for sizes that do not fit together."""

    body: Literal["glimpse", "vit"] = "glimpse"
    width: int = 128
    """D, width of the object tokens (and of the ViT's image tokens)."""
    heads: int = 4
    """Attention heads; divides width."""
    layers: int = 2
    """ViT: transformer layers. Glimpse: attention layers over the objects given the goal."""
    hidden: int = 512
    """Width of the two hidden layers of each predicate's extractor (ViT; the paper's 512)."""
    channels: int = 32
    """E, channels of the stride-4 feature map (glimpse)."""
    window: int = 56
    """Edge of the image window around a matched object, pixels (glimpse)."""
    camera: Camera = field(default_factory=Camera)
    """Image size, and the sight lines that give the first guess of a position."""

    def __post_init__(self) -> None:
        if self.body not in BODIES:
            raise ValueError(f"body is {self.body!r}, expected one of {', '.join(BODIES)}")
        for name in ("width", "heads", "layers", "hidden", "channels", "window"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")
        if self.width % self.heads:
            raise ValueError(f"width is {self.width}, expected a multiple of heads {self.heads}")
        if self.camera.height % PATCH or self.camera.width % PATCH:
            raise ValueError(
                f"image is {self.camera.width}x{self.camera.height}, "
                f"expected multiples of {PATCH} pixels"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and dicts; `from_dict` gives an equal config back."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ModelConfig:
        """Read what `to_dict` wrote; raises ValueError or TypeError on anything else."""
        return cls(**{**values, "camera": Camera(**values["camera"])})


def vit_small() -> ModelConfig:
    """A ViT of the paper's kind that a CPU can train: width 192, 4 layers."""
    return ModelConfig(body="vit", width=192, heads=6, layers=4, hidden=512)


def vit_paper() -> ModelConfig:
    """The paper's ViT: width 768, 12 layers, 12 heads."""
    return ModelConfig(body="vit", width=768, heads=12, layers=12, hidden=512)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Encoding:
    """A batch of scenes, seen once; all that `decode` and the auxiliary losses need."""

    tokens: Tensor
    """(B, N, D), one token an object."""
    present: Tensor
    """(B, N) bool; False for padding."""
    geometry: Tensor | None = None
    """(B, N, GEOMETRY) estimated geometry, decimetres (glimpse)."""
    match: Tensor | None = None
    """(B, N, h*w) logits of where the object is in the feature map (glimpse)."""


class RelevanceModel(nn.Module):
    """Scores objects for goals; positive means relevant (DESIGN section 2: beta = 0)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.body = BODIES[config.body](config)

    def encode(self, image: Tensor, views: Tensor, present: Tensor | None = None) -> Encoding:
        """See a batch of scenes once, for all goals.

        image (B, 3, H, W) and views (B, N, 3, 32, 32), uint8 or float in 0..1; present
        (B, N) bool, default all. Raises ValueError for an image of another size.
        """
        camera = self.config.camera
        if tuple(image.shape[-2:]) != (camera.height, camera.width):
            raise ValueError(
                f"image is {image.shape[-1]}x{image.shape[-2]}, "
                f"expected {camera.width}x{camera.height}"
            )
        if present is None:
            present = torch.ones(views.shape[:2], dtype=torch.bool, device=views.device)
        return self.body.encode(_unit(image), _unit(views), present)

    def decode(self, encoding: Encoding, predicate: Predicate | str, goals: Tensor) -> Tensor:
        """Scores (B, G, N), float32 logits, for goals (B, G, 2): subject and reference index."""
        return self.body.decode(encoding, PREDICATES[str(predicate)], goals).float()

    @torch.inference_mode()
    def encode_scene(self, image: np.ndarray, views: np.ndarray) -> Encoding:
        """One scene from arrays: image (H, W, 3) and views (N, 32, 32, 3), uint8."""
        pictures = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)
        each = torch.from_numpy(np.ascontiguousarray(views)).permute(0, 3, 1, 2)
        return self.encode(pictures[None], each[None])

    @torch.inference_mode()
    def score_goals(
        self, encoding: Encoding, goals: Sequence[tuple[Predicate, int, int]]
    ) -> np.ndarray:
        """Scores (G, N) for (predicate, subject, reference) goals of one encoded scene."""
        scores = np.empty((len(goals), encoding.tokens.shape[1]), np.float32)
        for predicate in {goal[0] for goal in goals}:
            rows = [i for i, goal in enumerate(goals) if goal[0] == predicate]
            pairs = torch.tensor([goals[i][1:] for i in rows])
            scores[rows] = self.decode(encoding, predicate, pairs[None])[0].numpy()
        return scores


def relevance_loss(scores: Tensor, relevant: Tensor, mask: Tensor, eta: float) -> Tensor:
    """-mean(eta z log p + (1 - eta) (1 - z) log(1 - p)) over `mask`, p = sigmoid(score).

    All of one shape; z = relevant in 0..1. The paper's formula read literally would give the
    rarer class the smaller weight; here the relevant objects weigh eta (DESIGN section 2).
    Zero when the mask is empty.
    """
    z = relevant.to(scores.dtype)
    terms = eta * z * F.logsigmoid(scores) + (1 - eta) * (1 - z) * F.logsigmoid(-scores)
    weight = mask.to(scores.dtype)
    return -(terms * weight).sum() / weight.sum().clamp(min=1)


class Attention(nn.Module):
    """Pre-norm transformer layer on `scaled_dot_product_attention`, with our own masks."""

    def __init__(self, width: int, heads: int, expansion: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.norm_in, self.norm_mid = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.Linear(width, expansion * width), nn.GELU(), nn.Linear(expansion * width, width)
        )

    def forward(self, x: Tensor, allowed: Tensor) -> Tensor:
        """x (B, L, D); allowed (B or 1, L, L) bool: row may look at column."""
        batch, length, width = x.shape
        qkv = self.qkv(self.norm_in(x)).view(batch, length, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        seen = F.scaled_dot_product_attention(q, k, v, attn_mask=allowed[:, None])
        x = x + self.out(seen.transpose(1, 2).reshape(batch, length, width))
        return x + self.mlp(self.norm_mid(x))


class ViTBody(nn.Module):
    """The paper's ViT, with the attention mask that lets all goals share one encoding.

    Each object token attends to the image tokens and to itself; image tokens attend to image
    tokens only. A query's token therefore does not depend on which other objects are asked
    about, and the score depends on the image and the three views alone, as in the paper.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        width = config.width
        self.patches = (config.camera.height // PATCH) * (config.camera.width // PATCH)
        self.embed = nn.Conv2d(3, width, PATCH, stride=PATCH)
        self.positions = nn.Parameter(0.02 * torch.randn(1 + self.patches, width))
        self.layers = nn.ModuleList(Attention(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.extractors = nn.ModuleDict(
            {predicate.name: _Extractor(width, config.hidden) for predicate in PREDICATES.values()}
        )

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, inputs float in 0..1."""
        objects = views.shape[1]
        image_BPD = self.embed(image - 0.5).flatten(2).transpose(1, 2) + self.positions[1:]
        views_BND = self.embed((views - 0.5).flatten(0, 1)).view(-1, objects, image_BPD.shape[-1])
        x = torch.cat([image_BPD, views_BND + self.positions[0]], dim=1)
        allowed = torch.eye(x.shape[1], dtype=torch.bool, device=x.device)
        allowed[:, : self.patches] = True
        for layer in self.layers:
            x = layer(x, allowed[None])
        return Encoding(tokens=self.norm(x[:, self.patches :]), present=present)

    def decode(self, encoding: Encoding, predicate: Predicate, goals: Tensor) -> Tensor:
        """As `RelevanceModel.decode`."""
        return self.extractors[predicate.name](encoding.tokens, goals)


class _Extractor(nn.Module):
    """The paper's predicate extractor: [subject, reference, query] -> two hidden layers -> score.

    The first layer is three matrices, one a role, so each object goes through each only once.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.subject = nn.Linear(width, hidden)
        self.reference = nn.Linear(width, hidden, bias=False)
        self.query = nn.Linear(width, hidden, bias=False)
        self.second, self.score = nn.Linear(hidden, hidden), nn.Linear(hidden, 1)

    def forward(self, tokens: Tensor, goals: Tensor) -> Tensor:
        pair = _pick(self.subject(tokens), goals[..., 0])
        pair = pair + _pick(self.reference(tokens), goals[..., 1])
        hidden = F.relu(pair[:, :, None] + self.query(tokens)[:, None])
        return self.score(F.relu(self.second(hidden))).squeeze(-1)


class GlimpseBody(nn.Module):
    """Find each object, look at it closely, then reason about the goal over all objects.

    Match: dot product of the view's embedding with a stride-4 feature map; softmax and
    soft-argmax in float32 say where the object is. Glimpse: the image window there,
    resampled to 32x32, goes through a small CNN together with the match map of the same
    window. Geometry (position, size, footprint half-extents) is estimated from both and
    given to the goal layers in the goal's own axes: along and across the predicate's
    direction, from the reference and from the subject.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        width, channels = config.width, config.channels
        self.window, self.camera = config.window, config.camera
        # Space-to-depth first: at stride 4 a 3x3 convolution is cheap and no pixel is lost.
        self.scene = nn.Sequential(
            nn.PixelUnshuffle(STRIDE),
            nn.Conv2d(3 * STRIDE**2, channels, 1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 1),
        )
        self.view = _small_cnn(3, (channels // 2, channels, channels), width)
        self.view_key = nn.Linear(width, channels)
        self.sharpness = nn.Parameter(torch.tensor(2.5))
        self.look = _small_cnn(4, (24, 48, 64), width)
        seen = 2 * width + 4
        self.estimate = nn.Sequential(nn.Linear(seen, width), nn.GELU(), nn.Linear(width, GEOMETRY))
        self.token = nn.Sequential(nn.Linear(seen + GEOMETRY, width), nn.GELU())
        self.among = Attention(width, config.heads, expansion=2)
        self.place = nn.Sequential(
            nn.Linear(_GOAL_FEATURES, width), nn.GELU(), nn.Linear(width, width)
        )
        self.predicate = nn.ParameterDict(
            {predicate.name: nn.Parameter(torch.zeros(width)) for predicate in PREDICATES.values()}
        )
        self.goal_layers = nn.ModuleList(
            Attention(width, config.heads, expansion=2) for _ in range(config.layers)
        )
        self.heads = nn.ModuleDict(
            {
                predicate.name: nn.Sequential(
                    nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1)
                )
                for predicate in PREDICATES.values()
            }
        )
        self.cells_P2: Tensor
        self.register_buffer("cells_P2", _cell_centres(config.camera), persistent=False)

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, inputs float in 0..1."""
        batch, objects = views.shape[:2]
        features_BEP = self.scene(image - 0.5).flatten(2)
        view_BND = self.view((views - 0.5).flatten(0, 1)).view(batch, objects, -1)
        key_BNE = self.view_key(view_BND)
        with torch.autocast(image.device.type, enabled=False):
            # Cosine similarity; positions are read to a fraction of a pixel, hence float32.
            features_BEP = features_BEP.float()
            norm_B1P = features_BEP.square().sum(1, keepdim=True).clamp(min=1e-6).rsqrt()
            key_BNE = F.normalize(key_BNE.float(), dim=-1) * self.sharpness.exp()
            match_BNP = key_BNE @ features_BEP * norm_B1P
            where_BNP = match_BNP.softmax(-1)
            centre_BN2 = where_BNP @ self.cells_P2
        window = self._window(image, where_BNP.detach(), centre_BN2.detach())
        look_BND = self.look(window).view(batch, objects, -1)
        ground_BN2 = _on_the_ground(centre_BN2, self.camera)
        seen = torch.cat([view_BND, look_BND, centre_BN2, ground_BN2], dim=-1)
        geometry = self.estimate(seen).float()
        geometry = torch.cat([geometry[..., :2] + ground_BN2, geometry[..., 2:]], dim=-1)
        tokens = self.token(torch.cat([seen, geometry], dim=-1))
        tokens = self.among(tokens, _columns(present))
        return Encoding(tokens=tokens, present=present, geometry=geometry, match=match_BNP)

    def _window(self, image: Tensor, where_BNP: Tensor, centre_BN2: Tensor) -> Tensor:
        """Windows around the centres, (B*N, 4, 32, 32): colours and match map."""
        batch, objects = where_BNP.shape[:2]
        height, width = image.shape[-2:]
        step = (torch.arange(PATCH, device=image.device) + 0.5) / PATCH * 2 - 1
        offset = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1)
        offset = offset * torch.tensor([self.window / width, self.window / height])
        grid = centre_BN2[:, :, None, None] + offset
        colours = F.grid_sample(
            image - 0.5, grid.view(batch, objects * PATCH, PATCH, 2), align_corners=False
        )
        colours = colours.view(batch, 3, objects, PATCH, PATCH).transpose(1, 2)
        shape = (batch * objects, 1, height // STRIDE, width // STRIDE)
        peak = (where_BNP / where_BNP.amax(-1, keepdim=True)).view(shape)
        heat = F.grid_sample(peak, grid.view(-1, PATCH, PATCH, 2), align_corners=False)
        return torch.cat([colours.reshape(-1, 3, PATCH, PATCH), heat], dim=1)

    def decode(self, encoding: Encoding, predicate: Predicate, goals: Tensor) -> Tensor:
        """As `RelevanceModel.decode`."""
        assert encoding.geometry is not None
        tokens, present = encoding.tokens, encoding.present
        batch, objects = present.shape
        features = _goal_features(encoding.geometry, predicate, goals)
        x = tokens[:, None] + self.place(features) + self.predicate[predicate.name]
        x = x.flatten(0, 1)
        allowed = _columns(present).repeat_interleave(goals.shape[1], dim=0)
        for layer in self.goal_layers:
            x = layer(x, allowed)
        return self.heads[predicate.name](x).view(batch, -1, objects)


BODIES: dict[str, type[ViTBody] | type[GlimpseBody]] = {"glimpse": GlimpseBody, "vit": ViTBody}


def half_extents(size_x: Tensor, size_y: Tensor, yaw: Tensor) -> Tensor:
    """Half-extents of a rotated rectangle along ANGLES directions k pi / ANGLES, (..., ANGLES).

    Same unit as the sizes. Unlike the yaw itself they are continuous under the symmetries of
    a rectangle, so they can be regressed.
    """
    angle = torch.arange(ANGLES, dtype=yaw.dtype) * (math.pi / ANGLES) - yaw[..., None]
    return (angle.cos().abs() * size_x[..., None] + angle.sin().abs() * size_y[..., None]) / 2


def mirrored(geometry: Tensor) -> Tensor:
    """The geometry (..., GEOMETRY) of the scene seen in a mirror: y changes sign."""
    sign = torch.ones(GEOMETRY)
    sign[1] = -1
    order = [*range(6), *(6 + (ANGLES - k) % ANGLES for k in range(ANGLES))]
    return (geometry * sign)[..., order]


_GOAL_FEATURES = 3 * GEOMETRY + 2 + 2 * 8


def _goal_features(geometry: Tensor, predicate: Predicate, goals: Tensor) -> Tensor:
    """Where every object is as the goal sees it, (B, G, N, _GOAL_FEATURES).

    Axes: along and across the predicate's direction (x and y for `on`). Own geometry, the
    subject's, the reference's, two role flags, and for subject and reference the distance
    and the signed clearance of the footprints along both axes: what "beside" turns on.
    """
    u = predicate.direction(Robot()) or (1.0, 0.0)
    axes = torch.tensor([[u[0], u[1]], [-u[1], u[0]]])
    # Extents along the goal's axes: a quarter turn is half of the regressed directions.
    extents = geometry[..., 6:].roll(0 if u[0] else ANGLES // 2, dims=-1)
    place = torch.cat([geometry[..., :2] @ axes.T, geometry[..., 2:6], extents], dim=-1)
    objects, count = place.shape[1], goals.shape[1]
    own = place[:, None].expand(-1, count, -1, -1)
    roles = torch.arange(objects)[:, None] == goals[..., None, :]
    features = [own, roles.to(place.dtype)]
    for role in range(2):
        anchor = _pick(place, goals[..., role])[:, :, None]
        delta = own[..., :3] - anchor[..., :3]
        reach = (own + anchor)[..., [6, 6 + ANGLES // 2]]
        apart = delta[..., :2].abs()
        clear = apart - reach
        features += [anchor.expand_as(own), delta, apart, clear, clear.amax(-1, keepdim=True)]
    return torch.cat(features, dim=-1)


def _pick(x: Tensor, index: Tensor) -> Tensor:
    """Rows of x (B, N, D) at index (B, G): (B, G, D)."""
    return x.gather(1, index[..., None].expand(-1, -1, x.shape[-1]))


def _columns(present: Tensor) -> Tensor:
    """Attention mask (B, N, N): everyone may look at the objects that exist, and at itself."""
    itself = torch.eye(present.shape[1], dtype=torch.bool, device=present.device)
    return present[:, None, :] | itself


def _unit(x: Tensor) -> Tensor:
    return x.float() / 255 if x.dtype == torch.uint8 else x


def _small_cnn(channels: int, widths: tuple[int, int, int], width: int) -> nn.Sequential:
    """A 32x32 picture to a vector of `width`."""
    a, b, c = widths
    return nn.Sequential(
        nn.Conv2d(channels, a, 4, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(a, b, 4, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(b, c, 4, stride=2, padding=1),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(c * (PATCH // 8) ** 2, width),
        nn.ReLU(),
    )


def _cell_centres(camera: Camera) -> Tensor:
    """Centres of the stride-4 cells, (h*w, 2): u right and v down, each in -1..1."""
    u = (torch.arange(camera.width // STRIDE) + 0.5) * (2 * STRIDE / camera.width) - 1
    v = (torch.arange(camera.height // STRIDE) + 0.5) * (2 * STRIDE / camera.height) - 1
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)


def _on_the_ground(centre: Tensor, camera: Camera) -> Tensor:
    """Where the sight lines through (u, v) cut the plane z = _GROUND: x, y in decimetres."""
    eye = torch.tensor(camera.eye)
    forward = F.normalize(torch.tensor(camera.target) - eye, dim=0)
    right = F.normalize(torch.linalg.cross(forward, torch.tensor(camera_up(camera))), dim=0)
    up = torch.linalg.cross(right, forward)
    tangent = math.tan(math.radians(camera.fov) / 2)
    u = centre[..., :1] * tangent
    v = centre[..., 1:] * (tangent * camera.height / camera.width)
    ray = forward + u * right - v * up
    # Sight lines at or above the horizon hit nothing; they are cut far away instead.
    along = (_GROUND - camera.eye[2]) / ray[..., 2:].clamp(max=-0.1)
    return (eye[:2] + along * ray[..., :2]) / DECIMETRE
