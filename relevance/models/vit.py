"""The paper's vision transformer, in the three ways in which its attention can be read.

Shape suffixes: B scenes, N objects (padded), G goals, T trios of subject, reference and query,
P image patches, D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal, Self, get_args

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from relevance.configs import config
from relevance.models.config import PATCH, Encoding, ModelConfig, divides
from relevance.models.layers import Attention, Extractor, each_trio, extractor
from relevance.models.registry import BODIES, Body, BodyKind
from relevance.scene import Predicate

Reading = Literal["shared", "trio", "no-patches"]

_AT_ONCE = 256
"""Trios that go through the transformer at once, to bound the memory."""


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
    attention: Reading = "shared"
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

    def readings(self) -> dict[str, Self]:
        """Its three attentions."""
        return {name: replace(self, attention=name) for name in get_args(Reading)}

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

    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Tensor:
        """As `RelevanceModel.decode`."""
        head = extractor(self.heads, predicate.name)
        tokens, scene = encoding.tokens, encoding.scene
        if self.attention == "shared":
            return head(tokens, goals)
        assert scene is not None

        def score(scene_T: Tensor, trios_T3: Tensor) -> Tensor:
            views = tokens[scene_T[:, None], trios_T3]
            return head.of_trios(self._transform(scene[scene_T], views))

        return each_trio(score, goals, asked, _AT_ONCE)

    def _transform(self, patches: Tensor, views: Tensor) -> Tensor:
        """Views (B, N, D) after they and the patches (B, P, D) looked at what they may see."""
        x = torch.cat([patches, views], dim=1)
        allowed = self._allowed(x.shape[1], x.device)
        for layer in self.layers:
            x = layer(x, allowed)
        return self.norm(x[:, self.patches :])

    def _allowed(self, length: int, device: torch.device) -> Tensor | None:
        """Who may look at whom, (1, L, L): patches first, then views; None where all may."""
        if self.attention == "trio":
            return None
        allowed = torch.ones(1, length, length, dtype=torch.bool, device=device)
        itself = torch.eye(length, dtype=torch.bool, device=device)
        part = slice(self.patches, None) if self.attention == "shared" else slice(self.patches)
        rows = slice(None) if self.attention == "shared" else part
        allowed[:, rows, part] = itself[rows, part]
        return allowed


BODIES.register("vit", BodyKind(config=VitConfig, make=ViTBody, version="1"))
