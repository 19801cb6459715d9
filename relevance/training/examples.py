"""What a step learns from: scenes and the goals that are asked of them, as arrays.

Shape suffixes: B scenes and G goals of a batch, N objects (padded), H and W height and width in
pixels, h and w the same at stride 4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from relevance.models import GEOMETRY, PATCH, STRIDE, mirrored, true_geometry
from relevance.sampling import Randomisation, same_view, view_of
from relevance.scene import PREDICATES, Camera, Predicate, Scene, scene_from_json
from relevance.store import DatasetError, Sample, decode

_RANDOM = Randomisation(camera_shift=0.03, camera_fov=2.0)
"""As far as cameras can be drawn from the one that a model is told of."""


class Answer(NamedTuple):
    """One label."""

    subject: str
    reference: str
    query: str
    relevant: float
    """1 or 0; a share of the sets that tie where labels are soft."""

    @property
    def about_goal(self) -> bool:
        """Whether the goal itself names the object."""
        return self.query in (self.subject, self.reference)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """A scene of a shard, undecoded, and its labels."""

    members: Mapping[str, Any]
    """As `decode` takes them."""
    family: str
    """What kind of scene it is."""
    answers: Mapping[Predicate, Sequence[Answer]]
    """By predicate, in stored order."""

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
    samples = [decode(example.members) for example in examples] if pictures else []
    scenes = [sample.scene for sample in samples] or [_scene(example) for example in examples]
    for example, scene in zip(examples, scenes, strict=True):
        _check(example, scene, camera)
    count, most = len(scenes), max((len(scene.objects) for scene in scenes), default=1)
    geometry = np.zeros((count, most, GEOMETRY), np.float32)
    present = np.zeros((count, most), bool)
    for i, scene in enumerate(scenes):
        geometry[i, : len(scene.objects)] = true_geometry(scene)
        present[i, : len(scene.objects)] = True
    image, views, cells = _pictures(samples, camera, count, most)
    return Batch(
        image=image,
        views=views,
        present=torch.from_numpy(present),
        cells=cells,
        told=not pictures,
        names=tuple(example.name for example in examples),
        families=tuple(example.family for example in examples),
        objects=tuple(tuple(scene.names) for scene in scenes),
        geometry=torch.from_numpy(geometry),
        turns=tuple((p, *_goals(examples, scenes, p, most)) for p in predicates),
    )


def _scene(example: Example) -> Scene:
    members = example.members
    return scene_from_json(members["scene.json"], where=f"{members['__url__']}: {example.name}")


def _check(example: Example, scene: Scene, camera: Camera) -> None:
    its = scene.camera
    if (its.width, its.height) != (camera.width, camera.height):
        raise DatasetError(
            f"{example.members['__url__']}: scene {example.name}: image is "
            f"{its.width}x{its.height}, expected {camera.width}x{camera.height}"
        )
    if not same_view(its, camera, _RANDOM):
        raise DatasetError(
            f"{example.members['__url__']}: scene {example.name}: seen from {view_of(its)}, "
            f"expected the model's camera, {view_of(camera)}"
        )


def _pictures(
    samples: Sequence[Sample], camera: Camera, count: int, most: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Image, views and cells, see `Batch`; blank and without memory where nothing was decoded."""
    image = torch.zeros((), dtype=torch.uint8).expand(count, 3, camera.height, camera.width)
    views = image[:, :1, :1, :1].unsqueeze(1).expand(count, most, 3, PATCH, PATCH)
    cells = image[:, 0, ::STRIDE, ::STRIDE]
    if not samples:
        return image, views, cells
    images, masks = (
        np.stack([getattr(sample, what) for sample in samples]) for what in ("image", "mask")
    )
    padded = np.zeros((count, most, PATCH, PATCH, 3), np.uint8)
    for i, sample in enumerate(samples):
        padded[i, : len(sample.views)] = sample.views
    return (
        torch.from_numpy(images).permute(0, 3, 1, 2),
        torch.from_numpy(padded).permute(0, 1, 4, 2, 3),
        torch.from_numpy(masks[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].copy()),
    )


def _goals(
    examples: Sequence[Example], scenes: Sequence[Scene], predicate: Predicate, most: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The goals of a predicate: pairs, relevant and labelled, see `Batch.turns`."""
    asked = [goals_of(example.answers.get(predicate, ())) for example in examples]
    shape = len(examples), max([1, *map(len, asked)])
    pairs = np.zeros((*shape, 2), np.int64)
    relevant, labelled = (np.zeros((*shape, most), kind) for kind in (np.float32, bool))
    for i, (example, scene) in enumerate(zip(examples, scenes, strict=True)):
        place = {name: at for at, name in enumerate(scene.names)}
        for g, goal in enumerate(asked[i]):
            try:
                pairs[i, g] = place[goal[0].subject], place[goal[0].reference]
                queries = [place[answer.query] for answer in goal]
            except KeyError as error:
                raise DatasetError(
                    f"{example.members['__url__']}: scene {example.name}: labels of {predicate} "
                    f"name {error}, expected one of {', '.join(place)}"
                ) from None
            relevant[i, g, queries] = [answer.relevant for answer in goal]
            labelled[i, g, queries] = True
    return torch.from_numpy(pairs), torch.from_numpy(relevant), torch.from_numpy(labelled)


def goals_of(answers: Iterable[Answer]) -> list[list[Answer]]:
    """The answers of each goal."""
    found: dict[tuple[str, str], list[Answer]] = {}
    for answer in answers:
        found.setdefault((answer.subject, answer.reference), []).append(answer)
    return list(found.values())


def in_the_mirror(batch: Batch) -> Batch:
    """The batch as a mirror shows it: y changes sign, left and right change places."""
    return replace(
        batch,
        image=batch.image.flip(-1),
        cells=batch.cells.flip(-1),
        geometry=mirrored(batch.geometry),
        turns=tuple((PREDICATES[turn[0].mirror], *turn[1:]) for turn in batch.turns),
    )


def recolored(batch: Batch, channels: Tensor) -> Batch:
    """The batch with its colour channels in another order, image and views alike."""
    return replace(batch, image=batch.image[:, channels], views=batch.views[:, :, channels])
