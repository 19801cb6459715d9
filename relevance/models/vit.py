"""The paper's vision transformer, with SORNet's mask that lets goals share one encoding.

Shape suffixes: B scenes, N objects (padded), G goals, P image patches, D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from relevance.configs import config
from relevance.models.config import PATCH, Encoding, ModelConfig, divides
from relevance.models.layers import Attention, Extractor
from relevance.models.registry import BODIES, Body, BodyKind
from relevance.scene import Predicate


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
        return cls(width=768, heads=12, layers=12)


class ViTBody(Body):
    """Patches and views through one convolutional embedding, all views at position zero.

    Each object token attends to the image tokens and to itself; image tokens attend to image
    tokens only. A query's token therefore does not depend on which other objects are asked
    about, and the score depends on the image and the three views alone, as in the paper.
    """

    def __init__(self, config: VitConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        width = config.width
        self.patches = (config.camera.height // PATCH) * (config.camera.width // PATCH)
        self.embed = nn.Conv2d(3, width, PATCH, stride=PATCH)
        self.positions = nn.Parameter(0.02 * torch.randn(1 + self.patches, width))
        self.layers = nn.ModuleList(Attention(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.heads = nn.ModuleDict({name: Extractor(width, config.hidden) for name in predicates})

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
        return self.heads[predicate.name](encoding.tokens, goals)


BODIES.register("vit", BodyKind(config=VitConfig, make=ViTBody, version="1"))
