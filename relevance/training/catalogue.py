"""What of a dataset is trained on: its labelled shards, listed and counted when a run begins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, groupby
from operator import itemgetter
from typing import Self

from relevance.scene import PREDICATES, Predicate
from relevance.store import Dataset, DatasetError, Files, locate
from relevance.training.examples import Answer, Example
from relevance.training.polling import groups_of
from relevance.training.settings import TrainConfig
from relevance.training.soft import target, tied_sets

MOST_OBJECTS = 255
"""Objects that a mask of 8 bits can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """Where the labels of one shard are."""

    number: int
    family: str
    """The kind of its scenes."""
    scenes: int
    """How many it has."""
    labels: Mapping[str, tuple[str, str]]
    """By predicate: the file and its hash."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Catalogue:
    """The labelled shards of a split; shards that come later are not in it."""

    root: str
    split: str
    policy: str
    ambiguous: bool
    soft: bool
    """Whether answers are shares of the sets that tie."""
    goals: int
    """Most goals of a scene and predicate: those whose plans have the first ids; all with 0."""
    shards: tuple[Shard, ...]
    groups: tuple[tuple[Predicate, ...], ...]
    """The predicates with a label, those that look at scenes together beside each other."""
    counts: tuple[Mapping[int, int], ...]
    """For each group: how many examples (scenes; single queries where those are drawn) each
    shard has."""

    @classmethod
    def of(cls, dataset: Dataset, split: str, config: TrainConfig) -> Self:
        """List what these settings learn from.

        Raises DatasetError for labels that were not all made in one way and for scenes with more
        objects than a mask can tell apart.
        """
        one_labelling(dataset, split, config.policy)
        learning = split == "train"
        most = {"train": config.scene_goals, "validation": config.validation_goals}
        goals = most.get(split, 0)
        files: dict[int, dict[str, tuple[str, str]]] = {}
        for file in dataset.files_under("labels", config.policy, split=split):
            keys = dataset.file_keys(file)
            mark = str(file), dataset.metadata(file)["sha256"]
            files.setdefault(keys["shard"], {})[keys["predicate"]] = mark
        limit = "dense_rank() over (partition by scene_id, predicate order by plan_id)"
        learned = f"""
            from (
                select shard, scene_id, predicate, is_goal_object
                from labels
                where split = $split and policy = $policy and ($ties or not ambiguous)
                    and ($all or predicate in (select unnest($names::varchar[])))
                    and shard in (select unnest($shards::integer[]))
                {f"qualify {limit} <= {goals}" if goals else ""}
            )
        """
        names = ("labels", "scenes")
        with dataset.connect(policy=config.policy, names=names) as connection:
            scenes = connection.execute(
                "select shard, any_value(family), count(*), max(n_objects) from scenes "
                "where split = ? group by shard order by shard",
                [split],
            ).fetchall()
            listed = [
                Shard(number=number, family=family, scenes=count, labels=files[number])
                for number, family, count, _ in scenes
                if number in files and (not config.families or family in config.families)
            ]
            shards = _share(listed, config.scene_share) if learning else listed
            asked = {
                "split": split, "policy": config.policy, "ties": config.ambiguous,
                "shards": [shard.number for shard in shards],
            }  # fmt: skip
            some = {"all": not config.predicates, "names": list(config.predicates)}
            found = connection.execute(f"select distinct predicate {learned}", asked | some)
            names = {name for (name,) in found.fetchall()}
            groups = groups_of([p for p in PREDICATES.values() if p.name in names], config)
            count = "count(distinct scene_id)"
            if config.queries_per_batch:
                count = "count(*)" + " filter (not is_goal_object)" * (not config.goal_objects)
            counts = [
                connection.execute(
                    f"select shard, {count} as n {learned} group by shard having n > 0",
                    asked | {"all": False, "names": [p.name for p in group]},
                ).fetchall()
                for group in groups
            ]
        for shard, _, _, most in scenes:
            if most > MOST_OBJECTS:
                raise DatasetError(
                    f"{dataset.path}: shard {shard} of split {split} has a scene of {most} "
                    f"objects, expected at most {MOST_OBJECTS}"
                )
        return cls(
            root=str(dataset.path),
            split=split,
            policy=config.policy,
            ambiguous=config.ambiguous,
            soft=config.soft_labels and learning,
            goals=goals,
            shards=tuple(shards),
            groups=tuple(groups),
            counts=tuple(map(dict, counts)),
        )

    @property
    def predicates(self) -> tuple[Predicate, ...]:
        """Those with a label, in the order of a round."""
        return tuple(predicate for group in self.groups for predicate in group)

    def some(self, scenes: int) -> Self:
        """With the first shards of each family alone that have so many scenes together, and a goal
        of each scene and predicate: to be read whole."""
        return replace(self, shards=tuple(_first(self.shards, lambda _: scenes)), goals=1)

    def read(self, shard: Shard, predicates: Sequence[Predicate]) -> Iterator[Example]:
        """The examples of a shard that have a label of one of the predicates, in stored order.

        Raises DatasetError for a broken file, for labels that are not those that were listed,
        and for a label about a scene that is not there.
        """
        dataset = Dataset.open(self.root)  # anew: connections to object stores survive no fork
        found: dict[str, dict[Predicate, list[Answer]]] = {}
        for predicate in predicates:
            for scene, answer in self._answers(dataset, shard, predicate):
                found.setdefault(scene, {}).setdefault(predicate, []).append(answer)
        for members in dataset.undecoded(self.split, shard.number) if found else ():
            if answers := found.pop(members["__key__"], None):
                yield Example(members=members, family=shard.family, answers=answers)
        if found:
            raise DatasetError(
                f"{dataset.path}: labels of split {self.split} name scene {min(found)}, "
                f"which no image shard holds (labels of shard {shard.number})"
            )

    def _answers(
        self, dataset: Dataset, shard: Shard, predicate: Predicate
    ) -> Iterator[tuple[str, Answer]]:
        if predicate.name not in shard.labels:
            return
        file, listed = shard.labels[predicate.name]
        path = locate(file)
        if (now := dataset.metadata(path)["sha256"]) != listed:
            raise DatasetError(
                f"{file}: content hash: expected {listed[:16]} as when training began, found "
                f"{now[:16]}; the labels were made anew meanwhile"
            )
        rows = dataset.read_file(path)
        names = ("policy", "ambiguous", "scene_id", "plan_id")
        names += ("subject", "reference", "query", "relevant")
        policies, ties, *columns = (rows[name].to_pylist() for name in names)
        learned = [
            policy == self.policy and (self.ambiguous or not tie)
            for policy, tie in zip(policies, ties, strict=True)
        ]
        scenes, plans, *asked, relevant = ([*compress(each, learned)] for each in columns)
        if self.soft:
            sets = self._sets(dataset, shard, predicate)
            tied = (sets.get(plan, ()) for plan in plans)
            relevant = map(target, asked[-1], relevant, tied)
        kept = _first_plans(scenes, plans, self.goals) if self.goals else None
        by_goal = groupby(
            zip(scenes, plans, *asked, map(float, relevant), strict=True), itemgetter(0, 1, 2, 3)
        )
        for (scene, plan, subject, reference), found in by_goal:
            if kept is None or plan in kept:
                *_, queries, answers = zip(*found, strict=True)
                yield scene, Answer(subject, reference, queries, answers)

    def _sets(
        self, dataset: Dataset, shard: Shard, predicate: Predicate
    ) -> dict[str, set[frozenset[str]]]:
        where = {"split": self.split, "shard": shard.number, "predicate": predicate.name}
        return tied_sets(dataset.read_rows("plans", **where))


def _share(shards: Sequence[Shard], share: float) -> list[Shard]:
    """The first shards of each family that have that share of its scenes, or a little more."""
    total: Counter[str] = Counter()
    for shard in shards:
        total[shard.family] += shard.scenes
    return _first(shards, lambda family: share * total[family])


def _first(shards: Sequence[Shard], enough: Callable[[str], float]) -> list[Shard]:
    """The shards of each family up to that with which it has enough scenes."""
    before: Counter[str] = Counter()
    kept = []
    for shard in shards:
        if before[shard.family] < enough(shard.family):
            kept.append(shard)
        before[shard.family] += shard.scenes
    return kept


def _first_plans(scenes: Sequence[str], plans: Sequence[str], most: int) -> set[str]:
    """Of the plans of each scene, those with the first ids, which are hashes: any ones."""
    found: dict[str, set[str]] = {}
    for scene, plan in zip(scenes, plans, strict=True):
        found.setdefault(scene, set()).add(plan)
    return {plan for some in found.values() for plan in sorted(some)[:most]}


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
