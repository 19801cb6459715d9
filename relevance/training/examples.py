"""What a step learns from: scenes and the goals that are asked of them, as arrays.

Shape suffixes: B scenes and G goals of a batch, N objects (padded), H and W height and width in
pixels, h and w the same at stride 4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from relevance.models import GEOMETRY, PATCH, STRIDE, mirrored, true_geometry
from relevance.sampling import Randomisation, same_view, view_of
from relevance.scene import PREDICATES, Camera, Predicate, scene_from_json
from relevance.store import DatasetError, decoded, scene_text

_RANDOM = Randomisation(camera_shift=0.03, camera_fov=2.0)
"""As far as cameras can be drawn from the one that a model is told of."""


class Answer(NamedTuple):
    """The labels of one goal, or some of them."""

    subject: str
    reference: str
    queries: tuple[str, ...]
    relevant: tuple[float, ...]
    """Of each query 1 or 0; a share of the sets that tie where labels are soft."""

    def extended(self, more: Answer) -> Answer:
        """This one and some more labels of its goal."""
        return self._replace(
            queries=self.queries + more.queries, relevant=self.relevant + more.relevant
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """A scene of a shard, undecoded, and its labels."""

    members: Mapping[str, Any]
    """As `decoded` takes them."""
    family: str
    """What kind of scene it is."""
    answers: Mapping[Predicate, Sequence[Answer]]
    """By predicate, of each goal in stored order."""

    @property
    def name(self) -> str:
        """Id of the scene."""
        return self.members["__key__"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """Some scenes and some of their goals, for one or more predicates in turn."""

    image: Tensor
    """(B, 3, H, W) uint8."""
    views: Tensor
    """(B, N, 3, 32, 32) uint8."""
    present: Tensor
    """(B, N) bool."""
    cells: Tensor
    """(B, h, w) uint8: the mask at the centres of the stride-4 cells."""
    names: tuple[str, ...]
    """Ids of the scenes, B."""
    told: bool = False
    """Whether it is for being told of, not shown: the pictures are blank."""
    families: tuple[str, ...] = ()
    """What kinds of scenes they are, B."""
    objects: tuple[tuple[str, ...], ...] = ()
    """Names of their objects, B."""
    geometry: Tensor
    """(B, N, GEOMETRY)."""
    turns: tuple[tuple[Predicate, Tensor, Tensor, Tensor], ...]
    """Predicate, goals (B, G, 2), relevant (B, G, N; 0 to 1), labelled (B, G, N; False for
    padding)."""

    def to(self, device: torch.device) -> Batch:
        """The same, there."""
        return replace(
            self,
            image=self.image.to(device),
            views=self.views.to(device),
            **_numbers(self, lambda tensor: tensor.to(device)),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # From worker to trainer: torch shares tensors by a file each, which pays for pictures.
        return _received, (self.image, self.views, _numbers(self, Tensor.numpy))


def _received(image: Tensor, views: Tensor, numbers: dict[str, Any]) -> Batch:
    batch = Batch(image=image, views=views, **numbers)
    return replace(batch, **_numbers(batch, torch.from_numpy))


def _numbers(batch: Batch, change: Callable[[Any], Any]) -> dict[str, Any]:
    """What of a batch is no picture, each tensor changed."""
    return {
        "present": change(batch.present),
        "cells": change(batch.cells),
        "told": batch.told,
        "names": batch.names,
        "families": batch.families,
        "objects": batch.objects,
        "geometry": change(batch.geometry),
        "turns": tuple((turn[0], *map(change, turn[1:])) for turn in batch.turns),
    }


def batch_of(
    examples: Sequence[Example],
    predicates: Sequence[Predicate],
    camera: Camera,
    *,
    pictures: bool = True,
) -> Batch:
    """Examples, decoded, and their goals of these predicates; no wider than they need.

    Without `pictures` those are blank. Raises DatasetError for a picture of another size than the
    camera's, another view, and for a label about an object that its scene has not.
    """
    known = [_known(*scene_text(example.members), camera) for example in examples]
    count, most = len(known), max((len(one.names) for one in known), default=1)
    geometry = np.zeros((count, most, GEOMETRY), np.float32)
    present = np.zeros((count, most), bool)
    for i, one in enumerate(known):
        geometry[i, : len(one.names)] = one.geometry
        present[i, : len(one.names)] = True
    image, views, cells = _pictures(examples if pictures else (), known, camera, most)
    return Batch(
        image=image,
        views=views,
        present=torch.from_numpy(present),
        cells=cells,
        told=not pictures,
        names=tuple(example.name for example in examples),
        families=tuple(example.family for example in examples),
        objects=tuple(one.names for one in known),
        geometry=torch.from_numpy(geometry),
        turns=tuple((p, *_goals(examples, known, p, most)) for p in predicates),
    )


class _Known(NamedTuple):
    """What of a scene is learned from, besides its pictures."""

    names: tuple[str, ...]
    geometry: np.ndarray
    """(N, GEOMETRY)."""


@lru_cache(maxsize=2**16)
def _known(text: bytes, where: str, camera: Camera) -> _Known:
    """Read a scene and check that the camera saw it: once, since every epoch has it again."""
    scene = scene_from_json(text, where=where)
    its = scene.camera
    if (its.width, its.height) != (camera.width, camera.height):
        raise DatasetError(
            f"{where}: image is {its.width}x{its.height}, expected {camera.width}x{camera.height}"
        )
    if not same_view(its, camera, _RANDOM):
        raise DatasetError(
            f"{where}: seen from {view_of(its)}, expected the model's camera, {view_of(camera)}"
        )
    return _Known(scene.names, true_geometry(scene))


def _pictures(
    examples: Sequence[Example], known: Sequence[_Known], camera: Camera, most: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Image, views and cells, see `Batch`; blank and without memory without examples."""
    count = len(known)
    if not examples:
        image = torch.zeros((), dtype=torch.uint8).expand(count, 3, camera.height, camera.width)
        views = image[:, :1, :1, :1].unsqueeze(1).expand(count, most, 3, PATCH, PATCH)
        return image, views, image[:, 0, ::STRIDE, ::STRIDE]
    images = np.zeros((count, camera.height, camera.width, 3), np.uint8)
    views = np.zeros((count, most, PATCH, PATCH, 3), np.uint8)
    masks = np.zeros((count, camera.height, camera.width), np.uint8)
    for i, (example, one) in enumerate(zip(examples, known, strict=True)):
        images[i], views[i, : len(one.names)], masks[i] = decoded(example.members, len(one.names))
    return (
        torch.from_numpy(images).permute(0, 3, 1, 2),
        torch.from_numpy(views).permute(0, 1, 4, 2, 3),
        torch.from_numpy(masks[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].copy()),
    )


def _goals(
    examples: Sequence[Example], known: Sequence[_Known], predicate: Predicate, most: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The goals of a predicate: pairs, relevant and labelled, see `Batch.turns`."""
    asked = [example.answers.get(predicate, ()) for example in examples]
    shape = len(examples), max([1, *map(len, asked)])
    pairs = np.zeros((*shape, 2), np.int64)
    relevant, labelled = (np.zeros((*shape, most), kind) for kind in (np.float32, bool))
    for i, (example, one) in enumerate(zip(examples, known, strict=True)):
        place = {name: at for at, name in enumerate(one.names)}
        for g, answer in enumerate(asked[i]):
            try:
                pairs[i, g] = place[answer.subject], place[answer.reference]
                queries = [place[query] for query in answer.queries]
            except KeyError as error:
                raise DatasetError(
                    f"{example.members['__url__']}: scene {example.name}: labels of {predicate} "
                    f"name {error}, expected one of {', '.join(place)}"
                ) from None
            relevant[i, g, queries] = answer.relevant
            labelled[i, g, queries] = True
    return torch.from_numpy(pairs), torch.from_numpy(relevant), torch.from_numpy(labelled)


def in_the_mirror(batch: Batch) -> Batch:
    """The batch as a mirror shows it: y changes sign, left and right change places."""
    turns = tuple((PREDICATES[turn[0].mirror], *turn[1:]) for turn in batch.turns)
    found = replace(batch, geometry=mirrored(batch.geometry), turns=turns)
    if batch.told:  # there is nothing to see
        return found
    return replace(found, image=batch.image.flip(-1), cells=batch.cells.flip(-1))


def recolored(batch: Batch, channels: Sequence[int]) -> Batch:
    """The batch with its colour channels in another order, image and views alike."""
    if batch.told:
        return batch
    image, views = (
        torch.stack([picture[..., channel, :, :] for channel in channels], dim=-3)
        for picture in (batch.image, batch.views)
    )
    return replace(batch, image=image, views=views)
