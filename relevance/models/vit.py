"""The paper's vision transformer, in the three ways in which its attention can be read.

Shape suffixes: B scenes, N objects (padded), G goals, T trios of subject, reference and query,
P image patches, L = P + N tokens, D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal, Self, get_args

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from relevance.configs import config
from relevance.models.config import PATCH, Answer, Encoding, ModelConfig, divides
from relevance.models.layers import (
    Attention,
    Extractor,
    Taught,
    answer_trios,
    each_trio,
    extractor,
)
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
    stem: bool = False
    """Whether the one convolutional embedding is three convolutions deep; the paper's is one."""
    taught: bool = False
    """Whether embeddings say where their objects are, and attention is held against masks."""

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
    def fair(cls) -> Self:
        """Sizes that a CPU can train, a deeper embedding, taught by masks and poses."""
        return cls(stem=True, taught=True)

    @classmethod
    def bare(cls) -> Self:
        """Sizes that a CPU can train; the paper's attention."""
        return cls(attention="trio")

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
        self.traced = config.attention == "shared"  # else trios are drawn by what is asked
        self.patches = (config.camera.height // PATCH) * (config.camera.width // PATCH)
        self.embed = _stem(width) if config.stem else nn.Conv2d(3, width, PATCH, stride=PATCH)
        self.positions = nn.Parameter(0.02 * torch.randn(1 + self.patches, width))
        self.layers = nn.ModuleList(Attention(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.taught = Taught(width, config.camera) if config.taught else None
        self.heads = nn.ModuleDict({name: Extractor(width, config.hidden) for name in predicates})

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, pictures float in 0..1."""
        image_BPD = self.embed(image - 0.5).flatten(2).transpose(1, 2) + self.positions[1:]
        views_BND = self.embed((views - 0.5).flatten(0, 1)).view(*views.shape[:2], -1)
        views_BND = views_BND + self.positions[0]
        sight = None
        if self.attention == "shared":
            views_BND, attention = self._transform(image_BPD, views_BND)
            if self.taught is not None and self.training:
                at = present.nonzero(as_tuple=True)
                seen = None if attention is None else attention[at]
                sight = self.taught(views_BND[at], *at, seen)
        return Encoding(tokens=views_BND, present=present, scene=image_BPD, sight=sight)

    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Answer:
        """As `RelevanceModel.answer`."""
        head = extractor(self.heads, predicate.name)
        tokens, scene = encoding.tokens, encoding.scene
        if self.attention == "shared":
            return Answer(scores=head(tokens, goals))
        assert scene is not None

        def look(scene_T: Tensor, trios_T3: Tensor) -> Answer:
            views = tokens[scene_T[:, None], trios_T3]
            seen, attention = self._transform(scene[scene_T], views)
            return answer_trios(head, self.taught, seen, scene_T, trios_T3, attention)

        return each_trio(look, goals, asked, _AT_ONCE)

    def _transform(self, patches: Tensor, views: Tensor) -> tuple[Tensor, Tensor | None]:
        """Views (B, N, D) after they and the patches (B, P, D) looked at what they may see.

        And to which patches the views' attention went halfway, (B, N, P), where that is taught.
        """
        x = torch.cat([patches, views], dim=1)
        allowed = self._allowed(x.shape[1], x.device)
        attention = None
        for number, layer in enumerate(self.layers):
            assert isinstance(layer, Attention)
            if self.taught is not None and self.training and number == len(self.layers) // 2:
                attention = layer.looks(x, slice(self.patches, None), slice(self.patches))
            x = layer(x, allowed)
        return self.norm(x[:, self.patches :]), attention

    def _allowed(self, length: int, device: torch.device) -> Tensor | None:
        """Who may look at whom, (1, L, L): patches first, then views; None where all may."""
        if self.attention == "trio":
            return None
        place = torch.arange(length, device=device)
        itself, patch = place[:, None] == place, place < self.patches
        others = patch if self.attention == "shared" else ~(patch[:, None] & patch)
        return (itself | others)[None]


def _stem(width: int) -> nn.Sequential:
    """32x32 pixels to one embedding in three strides, the last convolution as the plain one's."""
    return nn.Sequential(
        nn.Conv2d(3, 32, 4, stride=4),
        nn.GELU(),
        nn.Conv2d(32, 64, 2, stride=2),
        nn.GELU(),
        nn.Conv2d(64, width, PATCH // 8, stride=PATCH // 8),
    )


BODIES.register("vit", BodyKind(config=VitConfig, make=ViTBody, version="1"))
