"""The labelled scenes of a split, decoded once, and batches of them for training.

Scenes and labels come from the shards through `store.Dataset`; every scene is decoded once
and kept as uint8, in memory or, when it would not fit, in a file mapped into memory.

Shape suffixes: S scenes of a split, K goals of a predicate, B scenes and G goals of a batch,
N objects (padded), H and W height and width in pixels, h and w the same at stride 4.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from relevance.models import GEOMETRY, PATCH, STRIDE, mirrored, true_geometry
from relevance.scene import PREDICATES, Camera, Predicate
from relevance.store import Dataset, DatasetError, Files
from relevance.training.settings import TrainConfig
from relevance.training.soft import target, tied_sets


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Goals:
    """The labelled goals of one predicate, ordered by scene."""

    pairs: np.ndarray
    """(K, 2) int64: subject and reference, by place in the scene."""
    relevant: np.ndarray
    """(K, N) bool; float32 shares of the tied sets where labels are soft."""
    labelled: np.ndarray
    """(K, N) bool; False for padding and for objects without a label."""
    first: np.ndarray
    """(S + 1,) int64: the goals of scene i are first[i] to first[i + 1]."""

    def asked(self, *, goal_objects: bool) -> np.ndarray:
        """(K, N) bool: the labelled objects, with or without subject and reference."""
        if goal_objects:
            return self.labelled
        objects = np.arange(self.labelled.shape[1])
        return self.labelled & (objects != self.pairs[..., None]).all(1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Examples:
    """The labelled scenes of a split, decoded, and the goals of each predicate on them."""

    images: np.ndarray
    """(S, H, W, 3) uint8."""
    views: np.ndarray
    """(S, N, 32, 32, 3) uint8."""
    cells: np.ndarray
    """(S, H / 4, W / 4) uint8: the mask at the centres of the stride-4 cells."""
    geometry: np.ndarray
    """(S, N, GEOMETRY) float32, decimetres."""
    present: np.ndarray
    """(S, N) bool."""
    names: tuple[str, ...]
    """Ids of the scenes, S."""
    families: tuple[str | None, ...]
    """What kinds of scenes they are, S."""
    goals: dict[Predicate, Goals]

    def scenes(self, predicates: Sequence[Predicate], family: str | None = None) -> np.ndarray:
        """Indices of the scenes, of one family if it is given, that have a goal of a predicate."""
        counts = sum(np.diff(self.goals[predicate].first) for predicate in predicates)
        found = np.flatnonzero(counts)
        return found if family is None else found[[self.families[i] == family for i in found]]


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
    """(B, h, w) uint8."""
    names: tuple[str, ...]
    """Ids of the scenes, B."""
    geometry: Tensor
    """(B, N, GEOMETRY)."""
    turns: tuple[tuple[Predicate, Tensor, Tensor, Tensor], ...]
    """Predicate, goals (B, G, 2), relevant (B, G, N), labelled (B, G, N; False for padding)."""

    def to(self, device: torch.device) -> Batch:
        """The same, there."""
        return Batch(
            image=self.image.to(device),
            views=self.views.to(device),
            present=self.present.to(device),
            cells=self.cells.to(device),
            names=self.names,
            geometry=self.geometry.to(device),
            turns=tuple(
                (p, goals.to(device), relevant.to(device), labelled.to(device))
                for p, goals, relevant, labelled in self.turns
            ),
        )


def load_examples(
    dataset: Dataset,
    split: str,
    *,
    camera: Camera,
    policy: str = "found",
    ambiguous: bool = True,
    predicates: Sequence[str] = (),
    families: Sequence[str] = (),
    cache_bytes: int = 1_500_000_000,
    folder: Path | None = None,
    soft: bool = False,
) -> Examples:
    """Read the labels of a split and decode the scenes that they are about.

    Raises DatasetError for a broken file, labels that were not all made in one way, a label about
    a scene that is not there, or an image of another size than the camera's. Arrays over
    `cache_bytes` are mapped from a nameless file in `folder`. `predicates` and `families` are
    those whose labels are read, all when empty; `soft` gives the shares of the sets that tie.
    """
    one_labelling(dataset, split, policy)
    query = """
        select scene_id, predicate, subject, reference, list(query order by query),
            list(relevant order by query), plan_id, family
        from labels left join shard_families using (split, shard)
        where split = ? and policy = ? and (? or not ambiguous)
            and (? or predicate in (select unnest(?::varchar[])))
            and (? or family in (select unnest(?::varchar[])))
        group by all order by all
    """
    with dataset.connect(policy=policy) as connection:
        asked_for = [not predicates, list(predicates), not families, list(families)]
        rows = connection.execute(query, [split, policy, ambiguous, *asked_for]).fetchall()
    sets = tied_sets(dataset.read_rows("plans", split=split)) if soft else {}
    labels: dict[str, list[tuple[Any, ...]]] = {
        key: list(group) for key, group in groupby(rows, key=lambda row: row[0])
    }
    total = len(labels)
    with dataset.connect() as connection:
        ((widest,),) = connection.execute("select max(n_objects) from scenes").fetchall()
    objects = int(widest or 1)
    images = _array((total, camera.height, camera.width, 3), cache_bytes, folder)
    views = _array((total, objects, PATCH, PATCH, 3), cache_bytes, folder)
    cells = np.zeros((total, camera.height // STRIDE, camera.width // STRIDE), np.uint8)
    geometry = np.zeros((total, objects, GEOMETRY), np.float32)
    present = np.zeros((total, objects), bool)
    found: dict[Predicate, list[tuple[int, list[int], np.ndarray, np.ndarray]]] = {}
    names: list[str] = []
    kinds: list[str | None] = []
    done = 0
    for sample in dataset.samples(split) if total else ():
        asked = labels.pop(sample.scene.id, None)
        if asked is None:
            continue
        if sample.image.shape != images.shape[1:]:
            height, width = sample.image.shape[:2]
            raise DatasetError(
                f"{dataset.path}: scene {sample.scene.id}: image is {width}x{height}, "
                f"expected {camera.width}x{camera.height}"
            )
        count = len(sample.scene.objects)
        images[done], views[done, :count] = sample.image, sample.views
        cells[done] = sample.mask[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        geometry[done, :count] = true_geometry(sample.scene)
        present[done, :count] = True
        place = {name: i for i, name in enumerate(sample.scene.names)}
        for _, predicate, subject, reference, queries, answers, plan_id, _ in asked:
            relevant = np.zeros(objects, np.float32 if soft else bool)
            labelled = np.zeros(objects, bool)
            index = [place[query] for query in queries]
            tied = sets.get(plan_id, ())
            pairs = zip(queries, answers, strict=True)
            relevant[index] = [target(query, answer, tied) for query, answer in pairs]
            labelled[index] = True
            pair = [place[subject], place[reference]]
            found.setdefault(PREDICATES[predicate], []).append((done, pair, relevant, labelled))
        names.append(sample.scene.id)
        kinds.append(asked[0][-1])
        done += 1
    if labels:
        raise DatasetError(
            f"{dataset.path}: labels of split {split} name scene {min(labels)}, "
            "which no image shard holds"
        )
    goals = {p: _goals(found[p], total) for p in PREDICATES.values() if p in found}
    return Examples(
        images=images,
        views=views,
        cells=cells,
        geometry=geometry,
        present=present,
        names=tuple(names),
        families=tuple(kinds),
        goals=goals,
    )


def one_labelling(dataset: Files, split: str, policy: str) -> None:
    """Raise DatasetError unless the labels of a split were all made as the dataset says.

    While a dataset is planned anew, some are not.
    """
    for source in dataset.sources:
        one_labelling(source.dataset, split, policy)
    if dataset.sources:
        return
    current = dataset.labelling
    of = None if current is None or current.policy == policy else replace(current, policy=policy)
    wanted = {} if current is None else replace(current, policy=policy).made_by
    for file in dataset.files("labels", of=of, split=split):
        made = dataset.metadata(file)
        for key in ("planner", "config", "policy"):
            expected = wanted.setdefault(key, made.get(key, ""))
            if made.get(key, expected) != expected:
                raise DatasetError(
                    f"{file}: made by {key} {made[key]}, expected {expected} as all labels of "
                    f"split {split}; `relevance label` finishes what was begun"
                )


def _goals(items: list[tuple[int, list[int], np.ndarray, np.ndarray]], total: int) -> Goals:
    return Goals(
        pairs=np.array([item[1] for item in items]),
        relevant=np.stack([item[2] for item in items]),
        labelled=np.stack([item[3] for item in items]),
        first=np.searchsorted([item[0] for item in items], np.arange(total + 1)),
    )


def _array(shape: tuple[int, ...], limit: int, folder: Path | None) -> np.ndarray:
    """Zeros; in a nameless file, mapped, when larger than `limit` bytes."""
    if int(np.prod(shape)) <= limit or folder is None:
        return np.zeros(shape, np.uint8)
    folder.mkdir(parents=True, exist_ok=True)
    # The file has no name: it is gone with the process, however that ends.
    with tempfile.TemporaryFile(dir=folder) as stream:
        stream.truncate(int(np.prod(shape)))
        return np.memmap(stream, dtype=np.uint8, mode="r+", shape=shape)


def gather(
    examples: Examples,
    chosen: np.ndarray,
    predicates: Sequence[Predicate],
    *,
    limit: int | None = None,
    rng: np.random.Generator | None = None,
    only: Sequence[Sequence[np.ndarray]] | None = None,
) -> Batch:
    """These scenes and their goals; at most `limit` goals a scene, drawn by `rng`.

    `only` names the goals for each predicate and scene.
    """
    turns = []
    for number, predicate in enumerate(predicates):
        goals = examples.goals[predicate]
        first = goals.first.tolist()
        rows = [np.arange(first[i], first[i + 1]) for i in chosen.tolist()]
        if only is not None:
            rows = only[number]
        if limit is not None and rng is not None:
            rows = [r if len(r) <= limit else np.sort(rng.permutation(r)[:limit]) for r in rows]
        most = max(1, *(len(r) for r in rows))
        index = np.zeros((len(chosen), most), int)
        real = np.zeros((len(chosen), most), bool)
        for i, r in enumerate(rows):
            index[i, : len(r)], real[i, : len(r)] = r, True
        labelled = goals.labelled[index] & real[..., None]
        arrays = (goals.pairs[index] * real[..., None], goals.relevant[index], labelled)
        turns.append((predicate, *(torch.from_numpy(a) for a in arrays)))
    most = int(examples.present[chosen].sum(1).max())  # no wider than this batch needs
    return Batch(
        image=torch.from_numpy(examples.images[chosen]).permute(0, 3, 1, 2),
        views=torch.from_numpy(examples.views[chosen, :most]).permute(0, 1, 4, 2, 3),
        present=torch.from_numpy(examples.present[chosen, :most]),
        cells=torch.from_numpy(examples.cells[chosen]),
        names=tuple(examples.names[i] for i in chosen.tolist()),
        geometry=torch.from_numpy(examples.geometry[chosen, :most]),
        turns=tuple((p, g, r[..., :most], m[..., :most]) for p, g, r, m in turns),
    )


def in_the_mirror(batch: Batch) -> Batch:
    """The batch as a mirror shows it: y changes sign, left and right change places."""
    return replace(
        batch,
        image=batch.image.flip(-1),
        cells=batch.cells.flip(-1),
        geometry=mirrored(batch.geometry),
        turns=tuple((PREDICATES[turn[0].mirror], *turn[1:]) for turn in batch.turns),
    )


# --- polling: which scenes and goals a step sees ---------------------------------------


def polling(predicates: Sequence[Predicate], *, share: bool) -> list[tuple[Predicate, ...]]:
    """One round of turns p0, p1, ...: the predicates of each optimiser step, in order.

    With `share`, neighbours of one scene family make one step; the order stays the same.
    """
    if not share:
        return [(predicate,) for predicate in predicates]
    return [tuple(group) for _, group in groupby(predicates, key=lambda p: p.family)]


def draw_batches(examples: Examples, config: TrainConfig, step: int) -> list[Batch]:
    """What a step learns from: one batch, or one of each group of predicates in a round."""
    groups = polling(list(examples.goals), share=config.share_encodings)
    if config.polling == "rounds":
        return [_draw(examples, config, group, step, i, step) for i, group in enumerate(groups)]
    return [draw_batch(examples, config, step)]


def draw_batch(examples: Examples, config: TrainConfig, step: int) -> Batch:
    """The batch of a step: a pure function of the examples, the config and the step.

    In turns, step s takes group s mod n of the polling round; one by one, the steps are shared
    out evenly. Each group goes through its own scenes in an order of its own, all of them before
    any comes again.
    """
    groups = polling(list(examples.goals), share=config.share_encodings)
    if config.polling == "one-by-one":
        each = -(-config.steps // len(groups))
        return _draw(examples, config, groups[step // each], step % each, 0, step)
    return _draw(examples, config, groups[step % len(groups)], step // len(groups), 0, step)


def _draw(
    examples: Examples,
    config: TrainConfig,
    predicates: tuple[Predicate, ...],
    visit: int,
    stream: int,
    step: int,
) -> Batch:
    rng = _rng(config.seed, 2, stream, step)
    channels = rng.permutation(3) if config.recolor else None
    flip = config.mirror and bool(rng.integers(2))
    if config.queries_per_batch:
        batch = _queries(examples, config, predicates, rng)
    else:
        chosen = _scenes(examples, config, predicates, visit)
        batch = gather(examples, chosen, predicates, limit=config.goals_per_scene, rng=rng)
    if channels is not None:
        order = torch.from_numpy(channels)
        batch = replace(batch, image=batch.image[:, order], views=batch.views[:, :, order])
    return in_the_mirror(batch) if flip else batch


def _scenes(
    examples: Examples, config: TrainConfig, predicates: tuple[Predicate, ...], visit: int
) -> np.ndarray:
    """The scenes (B,) of a group's batch: its own, in an order of each epoch."""
    scenes = examples.scenes(predicates)
    stream = list(PREDICATES.values()).index(predicates[0])
    wanted = np.arange(visit * config.scenes_per_batch, (visit + 1) * config.scenes_per_batch)
    epochs, places = np.divmod(wanted, len(scenes))
    orders = {
        epoch: _rng(config.seed, 1, stream, epoch).permutation(len(scenes))
        for epoch in set(epochs.tolist())
    }
    return np.array([scenes[orders[e][p]] for e, p in zip(epochs, places, strict=True)])


def _queries(
    examples: Examples,
    config: TrainConfig,
    predicates: tuple[Predicate, ...],
    rng: np.random.Generator,
) -> Batch:
    """Queries drawn uniformly among all of the group's, and the scenes that they are about."""
    asked = [examples.goals[p].asked(goal_objects=config.goal_objects) for p in predicates]
    places = [np.argwhere(mask) for mask in asked]
    drawn = np.sort(rng.choice(sum(map(len, places)), config.queries_per_batch))
    bounds = np.cumsum([0, *map(len, places)])
    parts = [
        place[drawn[(drawn >= low) & (drawn < high)] - low]
        for place, low, high in zip(places, bounds[:-1], bounds[1:], strict=True)
    ]
    owners = [
        np.searchsorted(examples.goals[p].first, part[:, 0], side="right") - 1
        for p, part in zip(predicates, parts, strict=True)
    ]
    chosen = np.unique(np.concatenate(owners))
    batch = gather(
        examples,
        chosen,
        predicates,
        only=[
            [np.unique(part[owner == scene, 0]) for scene in chosen]
            for part, owner in zip(parts, owners, strict=True)
        ],
    )
    turns = []
    for turn, part, owner in zip(batch.turns, parts, owners, strict=True):
        wanted = torch.zeros_like(turn[3])
        for (goal, query), scene in zip(part.tolist(), owner.tolist(), strict=True):
            mine = np.unique(part[owner == scene, 0])
            at = int(np.searchsorted(chosen, scene)), int(np.searchsorted(mine, goal))
            wanted[(*at, query)] = True
        turns.append((*turn[:3], wanted))
    return replace(batch, turns=tuple(turns))


def _rng(seed: int, purpose: int, stream: int, index: int) -> np.random.Generator:
    return np.random.Generator(
        np.random.Philox(key=seed, counter=[0, int(index), int(stream), purpose])
    )
