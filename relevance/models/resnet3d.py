"""The paper's 3D-ResNet: the patches of the image stacked with the three views, convolved.

Everything meets from the first layer on, so nothing is shared between queries.

Shape suffixes: B scenes, N objects (padded), G goals, T trios of subject, reference and query,
P image patches, X = 3 x 32 x 32 numbers of a picture, D width, E = 3 x D.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from relevance.configs import config
from relevance.models.config import PATCH, Answer, Encoding, ModelConfig
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

_AT_ONCE = 64
"""Trios that are convolved at once, to bound the memory."""


@config
class Resnet3dConfig(ModelConfig):
    """Depth and widths; by default what a CPU can train. The paper names none."""

    body: Literal["resnet3d"] = "resnet3d"
    """The body that these settings are of."""
    blocks: Annotated[
        tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1, max_length=4)
    ] = (1, 1, 1)
    """Residual blocks of each stage; each stage halves stack and pictures."""
    channels: Annotated[int, Field(ge=8, multiple_of=8)] = 8
    """Channels of the first stage; each stage doubles them."""
    width: Annotated[int, Field(ge=1)] = 128
    """D, width of the embeddings of subject, reference and query."""
    hidden: Annotated[int, Field(ge=1)] = 512
    """Width of the two hidden layers of each predicate's extractor (the paper's)."""
    taught: bool = False
    """Whether embeddings say where their objects are, so that masks and poses can teach them."""

    @classmethod
    def smoke(cls) -> Self:
        """The smallest that runs."""
        return cls(blocks=(1,), width=16, hidden=32)

    @classmethod
    def fair(cls) -> Self:
        """Sizes that a CPU can train, taught by masks and poses."""
        return cls(taught=True)

    @classmethod
    def paper(cls) -> Self:
        """The usual size of 18 layers, the ViT's width."""
        return cls(blocks=(2, 2, 2, 2), channels=64, width=768)


class Resnet3dBody(Body):
    """One 3D ResNet, a dense layer to three embeddings, an extractor for each predicate."""

    traced = False  # trios are drawn by what is asked

    def __init__(self, config: Resnet3dConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        self.width = config.width
        self.net, channels = residual(3, config.blocks, config.channels)
        self.dense = nn.Linear(channels, 3 * config.width)
        self.taught = Taught(config.width, config.camera) if config.taught else None
        self.heads = nn.ModuleDict(
            {name: Extractor(config.width, config.hidden) for name in predicates}
        )

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, pictures float in 0..1; only cuts the patches out."""
        patches = F.unfold(image - 0.5, PATCH, stride=PATCH).transpose(1, 2)
        return Encoding(tokens=(views - 0.5).flatten(2), present=present, scene=patches)

    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Answer:
        """As `RelevanceModel.answer`."""
        head = extractor(self.heads, predicate.name)
        patches_BPX, views_BNX = encoding.scene, encoding.tokens
        assert patches_BPX is not None

        def look(scene_T: Tensor, trios_T3: Tensor) -> Answer:
            stack = torch.cat([patches_BPX[scene_T], views_BNX[scene_T[:, None], trios_T3]], dim=1)
            pictures = stack.unflatten(-1, (3, PATCH, PATCH)).transpose(1, 2)
            dense_TE = F.relu(self.dense(self.net(pictures)))
            tokens_T3D = dense_TE.unflatten(-1, (3, self.width))
            return answer_trios(head, self.taught, tokens_T3D, scene_T, trios_T3)

        return each_trio(look, goals, asked, _AT_ONCE)


BODIES.register("resnet3d", BodyKind(config=Resnet3dConfig, make=Resnet3dBody, version="1"))
