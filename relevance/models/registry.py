"""Bodies by name, and the model that is one of them with a head for each predicate.

A body is one file of this package: its settings (a `ModelConfig`), its network (a `Body`) and
the line that registers both. The files are found by being there.

Shape suffixes: B scenes, N objects (padded), G goals, H and W height and width in pixels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from relevance.models.config import Answer, Encoding, ModelConfig, ModelError
from relevance.registry import Registry
from relevance.scene import PREDICATES, Camera, Predicate


class Body(nn.Module, ABC):
    """A network that sees scenes and answers goals."""

    heads: nn.ModuleDict
    """What answers for each predicate, by its name. Made after all else, in the order that is
    given, so that one more head leaves the first weights of the rest as they are."""

    told = False
    """Whether it is told where the objects are instead of being shown them."""

    tellable = False
    """Whether it thinks of where objects are, so that it can learn that by being told."""

    among_all = False
    """Whether a score depends on all objects of the scene, not on the three views alone."""

    traced = True
    """Whether ONNX Runtime gets a graph of it, where one can be made."""

    @abstractmethod
    def encode(self, image: Tensor, views: Tensor, present: Tensor) -> Encoding:
        """As `RelevanceModel.encode`, pictures float in 0..1."""

    def told_of(self, present: Tensor, poses: Tensor) -> Encoding:
        """As `RelevanceModel.told_of`."""
        raise ModelError(f"{type(self).__name__} cannot be told where objects are")

    @abstractmethod
    def decode(
        self, encoding: Encoding, predicate: Predicate, goals: Tensor, asked: Tensor
    ) -> Answer:
        """As `RelevanceModel.answer`; what is not `asked` need not be scored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyKind:
    """What a body is registered as."""

    config: type[ModelConfig]
    """Its settings."""
    make: Callable[[Any, Sequence[str]], Body]
    """From settings and names of predicates to a network with fresh weights."""
    version: str
    """Raised when equal settings come to mean another network or another default."""
    advantage: str = ""
    """What it has beyond image and three views: said under every table that has it beside those
    that see no more."""


BODIES: Registry[BodyKind] = Registry("body")
"""Every body by name."""


def unequal(bodies: Iterable[str]) -> list[str]:
    """A line for each of the bodies that has more to go by than others of them."""
    names = sorted(set(bodies) & set(BODIES))
    told = [name for name in names if BODIES[name].advantage]
    return [f"{name} {BODIES[name].advantage}" for name in told] if told != names else []


class RelevanceModel(nn.Module):
    """Scores objects for goals; positive means relevant (CONTRIBUTING, The words)."""

    def __init__(self, config: ModelConfig, predicates: Sequence[str] | None = None) -> None:
        super().__init__()
        self.config = config
        self.predicates = tuple(PREDICATES if predicates is None else predicates)
        """Names of the predicates that it has a head for (None: all that there are)."""
        self.body = BODIES[config.body].make(config, self.predicates)

    @property
    def device(self) -> torch.device:
        """Where the weights are; every input is brought there."""
        return next(self.parameters()).device

    @property
    def camera(self) -> Camera:
        """The camera that it learns from."""
        return self.config.camera

    @property
    def body_name(self) -> str:
        """glimpse, vit, ..."""
        return self.config.body

    @property
    def told(self) -> bool:
        """Whether `encode` needs poses; the pictures are nothing to it then."""
        return self.body.told

    @property
    def tellable(self) -> bool:
        """Whether it sees pictures, and can be told poses instead (`told_of`)."""
        return self.body.tellable and not self.body.told

    def encode(
        self,
        image: Tensor,
        views: Tensor,
        present: Tensor | None = None,
        poses: Tensor | None = None,
    ) -> Encoding:
        """See a batch of scenes once, for all goals.

        image (B, 3, H, W) and views (B, N, 3, 32, 32), uint8 or float in 0..1; present
        (B, N) bool, default all; poses (B, N, GEOMETRY) as `true_geometry` gives them, looked at
        by the body `geometry` alone. Raises ModelError for an image of another size and for
        poses that are missing.
        """
        if self.told and poses is None:
            raise ModelError(f"body {self.config.body} is told where objects are, expected poses")
        camera = self.config.camera
        if tuple(image.shape[-2:]) != (camera.height, camera.width):
            raise ModelError(
                f"image is {image.shape[-1]}x{image.shape[-2]}, "
                f"expected {camera.width}x{camera.height}"
            )
        if present is None:
            present = torch.ones(views.shape[:2], dtype=torch.bool)
        device = self.device
        present = present.to(device)
        if self.told:
            assert poses is not None
            return self.body.told_of(present, poses.to(device))
        return self.body.encode(_unit(image.to(device)), _unit(views.to(device)), present)

    def told_of(self, present: Tensor, poses: Tensor) -> Encoding:
        """The same with the true poses in the place of pictures, for bodies that are `tellable`."""
        return self.body.told_of(present.to(self.device), poses.to(self.device))

    def decode(
        self,
        encoding: Encoding,
        predicate: Predicate | str,
        goals: Tensor,
        asked: Tensor | None = None,
    ) -> Tensor:
        """Scores (B, G, N), float32 logits, of what `answer` is asked."""
        return self.answer(encoding, predicate, goals, asked).scores

    def answer(
        self,
        encoding: Encoding,
        predicate: Predicate | str,
        goals: Tensor,
        asked: Tensor | None = None,
    ) -> Answer:
        """The answer to goals (B, G, 2): subject and reference, by place in the scene.

        `asked` (B, G, N) bool says which scores are wanted (None: of all objects that are
        there); the others mean nothing, and cost nothing where nothing is shared between queries.
        Raises ModelError for a predicate that has no head here.
        """
        name = str(predicate)
        if name not in self.predicates:
            known = ", ".join(self.predicates)
            raise ModelError(f"the model has no head for {name}, was trained on {known}")
        goals = goals.to(encoding.tokens.device)
        if asked is None:
            asked = encoding.present[:, None].expand(-1, goals.shape[1], -1)
        asked = asked.to(goals.device)
        answer = self.body.decode(encoding, PREDICATES[name], goals, asked)
        return replace(answer, scores=answer.scores.float())

    # --- as `relevance.networks.Network` has it, numpy in and out ---

    @torch.inference_mode()
    def look(self, image: np.ndarray, views: np.ndarray, poses: np.ndarray | None) -> Encoding:
        """As `Network.look`."""
        return self.encode(
            torch.from_numpy(image).permute(2, 0, 1)[None],
            torch.from_numpy(views).permute(0, 3, 1, 2)[None],
            poses=None if poses is None else torch.from_numpy(poses)[None],
        )

    @torch.inference_mode()
    def judge(self, seen: Encoding, predicate: Predicate, goals: np.ndarray) -> np.ndarray:
        """As `Network.judge`."""
        return self.decode(seen, predicate, torch.from_numpy(goals)[None])[0].cpu().numpy()

    def believed(self, seen: Encoding) -> np.ndarray | None:
        """As `Network.believed`."""
        return None if seen.geometry is None else seen.geometry[0].cpu().numpy()


def model_config(values: Any) -> Any:
    """The settings from the plain values that `asdict` gave, or an instance as it is.

    Raises ConfigError for a setting that the body does not have, RelevanceError for a body that
    is not there.
    """
    if isinstance(values, Mapping) and "body" in values:
        return BODIES[values["body"]].config(**values)
    return values


def _unit(x: Tensor) -> Tensor:
    return x.float().div_(255) if x.dtype == torch.uint8 else x
