"""The paper's vision transformer, in the three ways in which its attention can be read.

Shape suffixes: B scenes, N objects (padded), G goals, T trios of subject, reference and query,
P image patches, D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from relevance.configs import config
from relevance.models.config import PATCH, Encoding, ModelConfig, divides
from relevance.models.layers import Attention, Extractor, each_trio, extractor, pick_trios
from relevance.models.registry import BODIES, Body, BodyKind
from relevance.scene import Predicate

_AT_ONCE = 64
"""Trios of a scene that go through the transformer at once, to bound the memory."""


@config
class VitConfig(ModelConfig):
    """Sizes of the transformer; by default one that a CPU can train."""

    body: Literal["vit"] = "vit"
    """The body that these settings are of."""
    width: Annotated[int, Field(ge=1)] = 192
    """D, width of all tokens."""
    heads: Annotated[int, Field(ge=1)] = 4
    """Attention heads; divides width."""
    layers: Annotated[int, Field(ge=1)] = 4
    """Transformer layers."""
    attention: Literal["shared", "trio", "no-patches"] = "shared"
    """Who sees whom. shared: patches see patches, a view sees patches and itself, so that one
    encoding serves all goals (SORNet's mask). trio: patches and the three views of a query all
    see each other (the paper's standard transformer). no-patches: as trio, but patches do not
    see each other."""
    hidden: Annotated[int, Field(ge=1)] = 512
    """Width of the two hidden layers of each predicate's extractor (the paper's)."""

    @model_validator(mode="after")
    def _even(self) -> Self:
        divides(self.width, self.heads)
        return self

    @classmethod
    def smoke(cls) -> Self:
        """The smallest that runs."""
        return cls(width=32, heads=2, layers=1, hidden=32)

    @classmethod
    def paper(cls) -> Self:
        """The paper's width of 768; depth and heads, which it does not say, as ViT-B."""
        return cls(width=768, heads=12, layers=12, attention="trio")


class ViTBody(Body):
    """Patches and views through one convolutional embedding, all views at position zero.

    With `shared` attention a query's token does not depend on which other objects are asked
    about. In all three ways the score depends on the image and the three views alone.
    """

    def __init__(self, config: VitConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        width = config.width
        self.attention = config.attention
        self.patches = (config.camera.height // PATCH) * (config.camera.width // PATCH)
        self.embed = nn.Conv2d(3, width, PATCH, stride=PATCH)
        self.positions = nn.Parameter(0.02 * torch.randn(1 + self.patches, width))
        self.layers = nn.ModuleList(Attention(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.heads = nn.ModuleDict({name: Extractor(width, config.hidden) for name in predicates})

    def encode(
        self, image: Tensor, views: Tensor, present: Tensor, poses: Tensor | None
    ) -> Encoding:
        """As `RelevanceModel.encode`, pictures float in 0..1."""
        objects = views.shape[1]
        image_BPD = self.embed(image - 0.5).flatten(2).transpose(1, 2) + self.positions[1:]
        views_BND = self.embed((views - 0.5).flatten(0, 1)).view(-1, objects, image_BPD.shape[-1])
        views_BND = views_BND + self.positions[0]
        if self.attention == "shared":
            views_BND = self._transform(image_BPD, views_BND)
        return Encoding(tokens=views_BND, present=present, scene=image_BPD)

    def decode(self, encoding: Encoding, predicate: Predicate, goals: Tensor) -> Tensor:
        """As `RelevanceModel.decode`."""
        head = extractor(self.heads, predicate.name)
        tokens, scene = encoding.tokens, encoding.scene
        if self.attention == "shared":
            return head(tokens, goals)
        assert scene is not None

        def score(trios_BT3: Tensor) -> Tensor:
            views = pick_trios(tokens, trios_BT3)
            patches = scene[:, None].expand(-1, views.shape[1], -1, -1)
            seen = self._transform(patches.flatten(0, 1), views.flatten(0, 1))
            return head.of_trios(seen).view(views.shape[:2])

        return each_trio(score, goals, tokens.shape[1], _AT_ONCE)

    def _transform(self, patches: Tensor, views: Tensor) -> Tensor:
        """Views (B, N, D) after they and the patches (B, P, D) looked at what they may see."""
        x = torch.cat([patches, views], dim=1)
        allowed = torch.ones(x.shape[1], x.shape[1], dtype=torch.bool, device=x.device)
        count = self.patches
        itself = torch.eye(len(allowed), dtype=torch.bool, device=x.device)
        if self.attention == "shared":
            allowed[:, count:] = itself[:, count:]
        elif self.attention == "no-patches":
            allowed[:count, :count] = itself[:count, :count]
        for layer in self.layers:
            x = layer(x, allowed[None])
        return self.norm(x[:, count:])


BODIES.register("vit", BodyKind(config=VitConfig, make=ViTBody, version="1"))
