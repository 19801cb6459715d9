"""The paper's default ResNet: a larger one for the scene, a smaller one for the views.

What a dense layer makes of the four feature vectors (scene, subject, reference, query) is
nobody's alone: it is made anew for each query, the vectors themselves are not.

Shape suffixes: B scenes, N objects (padded), G goals, T trios of subject, reference and query,
C channels, D width, E = 3 D: the three embeddings of a trio.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from relevance.configs import config
from relevance.models.config import Answer, Encoding, ModelConfig
from relevance.models.layers import (
    Extractor,
    Taught,
    answer_trios,
    each_trio,
    extractor,
    residual,
)
from relevance.models.registry import BODIES, Body, BodyKind
from relevance.scene import Predicate

Blocks = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1, max_length=4)]

_AT_ONCE = 16384
"""Trios that go through the dense layer at once, to bound the memory."""


@config
class ResnetConfig(ModelConfig):
    """Depths and widths; by default what a CPU can train. The paper names none."""

    body: Literal["resnet"] = "resnet"
    """The body that these settings are of."""
    scene_blocks: Blocks = (2, 2, 2, 2)
    """Residual blocks of each stage for the scene; each stage halves the picture."""
    scene_channels: Annotated[int, Field(ge=8, multiple_of=8)] = 16
    """Channels of the first stage for the scene; each stage doubles them."""
    view_blocks: Blocks = (1, 1, 1)
    """Residual blocks of each stage for a view."""
    view_channels: Annotated[int, Field(ge=8, multiple_of=8)] = 16
    """Channels of the first stage for a view."""
    width: Annotated[int, Field(ge=1)] = 256
    """D, width of the embeddings of subject, reference and query."""
    hidden: Annotated[int, Field(ge=1)] = 512
    """Width of the two hidden layers of each predicate's extractor (the paper's)."""
    taught: bool = False
    """Whether embeddings say where their objects are, so that masks and poses can teach them."""

    @classmethod
    def smoke(cls) -> Self:
        """The smallest that runs."""
        return cls(
            scene_blocks=(1, 1),
            scene_channels=8,
            view_blocks=(1,),
            view_channels=8,
            width=16,
            hidden=32,
        )

    @classmethod
    def fair(cls) -> Self:
        """Sizes that a CPU can train, taught by masks and poses."""
        return cls(taught=True)

    @classmethod
    def paper(cls) -> Self:
        """The usual sizes: 34 layers for the scene, 18 for the views, the ViT's width."""
        return cls(
            scene_blocks=(3, 4, 6, 3),
            scene_channels=64,
            view_blocks=(2, 2, 2, 2),
            view_channels=64,
            width=768,
        )


class ResnetBody(Body):
    """Two ResNets, a dense layer to three embeddings, an extractor for each predicate."""

    traced = False  # trios are drawn by what is asked

    def __init__(self, config: ResnetConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        self.width = config.width
        self.scene, scene_C = residual(2, config.scene_blocks, config.scene_channels)
        self.view, view_C = residual(2, config.view_blocks, config.view_channels)
        # The dense layer of four vectors end to end is a sum of four matrices.
        self.from_scene = nn.Linear(scene_C, 3 * config.width)
        self.from_role = nn.ModuleList(
            nn.Linear(view_C, 3 * config.width, bias=False) for _ in range(3)
        )
        self.taught = Taught(config.width, config.camera) if config.taught else None
        self.heads = nn.ModuleDict(
            {name: Extractor(config.width, config.hidden) for name in predicates}
        )

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, pictures float in 0..1."""
        views_BNC = self.view((views - 0.5).flatten(0, 1)).unflatten(0, views.shape[:2])
        return Encoding(tokens=views_BNC, present=present, scene=self.scene(image - 0.5))

    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Answer:
        """As `RelevanceModel.answer`."""
        head = extractor(self.heads, predicate.name)
        assert encoding.scene is not None
        scene_BE = self.from_scene(encoding.scene)
        roles_BNE = [part(encoding.tokens) for part in self.from_role]

        def look(scene_T: Tensor, trios_T3: Tensor) -> Answer:
            places = zip(roles_BNE, trios_T3.unbind(1), strict=True)
            parts = [scene_BE[scene_T], *(role[scene_T, place] for role, place in places)]
            dense_TE = F.relu(torch.stack(parts).sum(0))
            tokens_T3D = dense_TE.unflatten(-1, (3, self.width))
            return answer_trios(head, self.taught, tokens_T3D, scene_T, trios_T3)

        return each_trio(look, goals, asked, _AT_ONCE)


BODIES.register("resnet", BodyKind(config=ResnetConfig, make=ResnetBody, version="1"))
