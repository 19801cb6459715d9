"""No picture: the boxes' true poses, as a planner that knows its world has them.

The ceiling of what the other bodies can reach with the same reasoning, and a guide of half a
millisecond.

Shape suffixes: B scenes, N objects (padded), G goals, D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from torch import Tensor, nn

from relevance.configs import config
from relevance.models.config import Answer, Encoding, ModelConfig, divides
from relevance.models.layers import Attention, columns
from relevance.models.reasoning import Reasoning, object_heads
from relevance.models.registry import BODIES, Body, BodyKind
from relevance.networks import GEOMETRY
from relevance.scene import Predicate


@config
class GeometryConfig(ModelConfig):
    """Sizes of the layers over the objects."""

    body: Literal["geometry"] = "geometry"
    """The body that these settings are of."""
    width: Annotated[int, Field(ge=1)] = 128
    """D, width of the object tokens."""
    heads: Annotated[int, Field(ge=1)] = 4
    """Attention heads; divides width."""
    layers: Annotated[int, Field(ge=1)] = 2
    """Attention layers over the objects given the goal."""

    @model_validator(mode="after")
    def _even(self) -> Self:
        divides(self.width, self.heads)
        return self

    @classmethod
    def smoke(cls) -> Self:
        """The smallest that runs."""
        return cls(width=32, heads=2, layers=1)


class GeometryBody(Body):
    """Tokens of the poses, attention among them, then the reasoning that `glimpse` ends with."""

    told = True
    among_all = True

    def __init__(self, config: GeometryConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        width = config.width
        self.token = nn.Sequential(nn.Linear(GEOMETRY, width), nn.GELU())
        self.among = Attention(width, config.heads, expansion=2)
        self.reason = Reasoning(width, config.heads, config.layers, predicates)
        self.heads = object_heads(width, predicates)

    def encode(
        self, image: Tensor, views: Tensor, present: Tensor, poses: Tensor | None
    ) -> Encoding:
        """As `RelevanceModel.encode`; the pictures are not looked at."""
        assert poses is not None
        tokens = self.among(self.token(poses), columns(present))
        return Encoding(tokens=tokens, present=present, geometry=poses)

    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Answer:
        """As `RelevanceModel.answer`."""
        assert encoding.geometry is not None
        x = self.reason(encoding.tokens, encoding.present, encoding.geometry, predicate, goals)
        return Answer(scores=self.heads[predicate.name](x).squeeze(-1))


BODIES.register(
    "geometry",
    BodyKind(
        config=GeometryConfig,
        make=GeometryBody,
        version="2",
        advantage="is told the true poses of all objects and sees no picture",
    ),
)
