"""What every body has in common: settings, the size of pictures, and what seeing a scene gives.

Shape suffixes: B scenes, N objects (padded), G goals, T queries, K looks, P cells of a
grid over the image, D width, E what lies between two objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

from pydantic import model_validator
from torch import Tensor

from relevance.configs import config
from relevance.errors import RelevanceError
from relevance.scene import Camera

PATCH = 32
"""Edge of image patches and canonical views, pixels (the paper's)."""
STRIDE = 4
"""Image pixels per cell of the grid on which masks are kept."""


class ModelError(RelevanceError):
    """A question that a model cannot answer: says which, and what it was made for."""


@config
class ModelConfig:
    """What a body is told; each has its own class of this kind, with its sizes."""

    body: str = ""
    """The body that these settings are of: glimpse, vit, ... (`relevance.models.BODIES`)."""
    camera: Camera = field(default_factory=Camera)
    """Image size, and the sight lines that give the first guess of a position."""

    @model_validator(mode="after")
    def _whole_patches(self) -> Self:
        if self.camera.height % PATCH or self.camera.width % PATCH:
            raise ValueError(
                f"image is {self.camera.width}x{self.camera.height}, "
                f"expected multiples of {PATCH} pixels"
            )
        return self

    def readings(self) -> dict[str, Self]:
        """The ways in which the paper's description of the body can be read, by name."""
        return {"": self}

    @classmethod
    def smoke(cls) -> Self:
        """The smallest that runs; the defaults where a body does not say."""
        return cls()

    @classmethod
    def fair(cls) -> Self:
        """Sizes that a CPU can train, with all the help that the fair recipe gives a body."""
        return cls()

    @classmethod
    def bare(cls) -> Self:
        """Sizes that a CPU can train; else what the paper has."""
        return cls()

    @classmethod
    def paper(cls) -> Self:
        """The paper's sizes; the defaults for a body that the paper does not have."""
        return cls()


def divides(width: int, heads: int) -> None:
    """Raise ValueError unless the attention heads share the width evenly."""
    if width % heads:
        raise ValueError(f"width is {width}, expected a multiple of heads {heads}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """Where objects were seen: what the auxiliary losses hold against masks and poses.

    K looks at an object, of the whole batch; an object may be looked at more than once.
    """

    scene: Tensor
    """(K,) the scene's place in the batch."""
    place: Tensor
    """(K,) the object's place in the scene."""
    geometry: Tensor
    """(..., K, GEOMETRY) estimated, decimetres; several guesses of which each is better."""
    match: Tensor
    """(K, P) logits of which cell of an even grid over the image shows it."""
    grid: tuple[int, int]
    """Rows and columns of the grid, P cells in all."""
    attention: Tensor | None = None
    """(K, P) the same as said by a layer's attention, for bodies with attention over the image."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Encoding:
    """A batch of scenes, seen once; all that `decode` and the auxiliary losses need."""

    tokens: Tensor
    """(B, N, D), one token an object; before it met the others where nothing can be shared."""
    present: Tensor
    """(B, N) bool; False for padding."""
    geometry: Tensor | None = None
    """(B, N, GEOMETRY) estimated or given geometry, decimetres (glimpse, geometry)."""
    between: Tensor | None = None
    """(B, N, N, E) what lies between every two objects, row from column (the same two)."""
    places: Tensor | None = None
    """(B, G, N, OBSTRUCTION) who is in the way at the goals that are asked, where it is reckoned
    outside (a graph that is traced)."""
    scene: Tensor | None = None
    """(B, ...) what was seen of the scene apart from its objects, for bodies that look at a
    subject, a reference and a query together."""
    sight: Sight | None = None
    """Where each object that is there was seen, in training."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """Scores, and what was seen on the way to them by a body that looks anew for each query."""

    scores: Tensor
    """(B, G, N) logits, or (T,) of T queries."""
    sight: Sight | None = None
    """Where subjects, references and queries were seen, in training."""
