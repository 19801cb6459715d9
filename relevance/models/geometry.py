"""No picture: the boxes' true poses, as a planner that knows its world has them.

The ceiling of what the other bodies can reach with the same reasoning, and a guide that needs no
picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from torch import Tensor

from relevance.configs import config
from relevance.models.config import Encoding, ModelConfig, ModelError, divides
from relevance.models.reasoning import Thinker
from relevance.models.registry import BODIES, BodyKind


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


class GeometryBody(Thinker):
    """Tokens of the poses, attention among them, then reasoning."""

    told = True

    def __init__(self, config: GeometryConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        self.thinks(config.width, config.heads, config.layers, predicates)

    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """Never: it is told."""
        raise ModelError("body geometry is told where objects are, expected poses")


BODIES.register(
    "geometry",
    BodyKind(
        config=GeometryConfig,
        make=GeometryBody,
        version="4",
        advantage="is told the true poses of all objects, and reckons what is in the hand's way",
    ),
)
