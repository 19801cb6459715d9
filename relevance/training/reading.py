"""The reader that trains: labelled scenes in an order of seed and step, from the shards themselves.

A look is what is decoded at once: some scenes, for predicates that take turns on them. Each group
of predicates goes through the shards that it has labels in, in an order of each epoch of its own;
after every few looks (`ALIKE`) the numbers of times that two examples came differ by one at most.
Which look a step takes is arithmetic, so a run that goes on begins where it was: what was consumed
is passed over undecoded.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count, islice

import numpy as np

from relevance.errors import RelevanceError
from relevance.scene import PREDICATES, Predicate
from relevance.store import polled, shuffled
from relevance.training.catalogue import Catalogue, Shard
from relevance.training.examples import (
    Answer,
    Batch,
    Example,
    batch_of,
    in_the_mirror,
    recolored,
)
from relevance.training.polling import looks_of, polling
from relevance.training.settings import TrainConfig


class TrainingError(RelevanceError):
    """A run that cannot go on: says at which step, on which scenes."""


SCENES, QUERIES = 1000, 20_000
"""Scenes, or single queries, from which a shuffled one is drawn."""
ALIKE = 8
"""Looks whose scenes are sorted by their number of objects, so that little is padding: a third of
all objects was, and costs as much as what is there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What is decoded at once, before it is."""

    predicates: tuple[Predicate, ...]
    number: int
    """How many looks these predicates took before."""
    examples: tuple[Example, ...]
    told: bool = False
    """Whether its pictures stay undecoded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Batches of what a catalogue lists, the same for any number of workers.

    Of several processes that train together, each reads its share of every batch.
    """

    catalogue: Catalogue
    config: TrainConfig
    pictures: bool = True
    """Whether images are decoded; else they are blank."""
    told: float = 0.0
    """Share of the looks of each group of predicates, its first ones, whose images are blank."""
    workers: int = 0
    """Processes that read and decode; 0: it is done where the batches are asked for."""
    rank: int = 0
    ranks: int = 1

    def __post_init__(self) -> None:
        size, what = self.config.scenes_per_batch, "scenes"
        if self.config.queries_per_batch:
            size, what = self.config.queries_per_batch, "queries"
        if size < self.ranks:
            raise TrainingError(
                f"{size} {what} a batch for {self.ranks} processes, expected at least one each"
            )

    def steps(self, first: int = 0) -> Generator[list[Batch]]:
        """What each step learns from, from step `first` to the last of the run."""
        groups = self.catalogue.groups
        begin = looks_of(first, groups, self.config)[0][0]
        end = self._looks_in_all
        looks = polled(self._streams(begin), self._learned, count=end - begin, workers=self.workers)
        with closing(looks):
            ahead = enumerate(looks, begin)
            at, batch = next(ahead)
            for step in range(first, self.config.steps):
                found = []
                for look, turns in looks_of(step, groups, self.config):
                    while at < look:
                        at, batch = next(ahead)
                    found.append(replace(batch, turns=batch.turns[turns]))
                yield found

    def whole(self, scenes: int = 16, *, most: int | None = None) -> Generator[Batch]:
        """Every labelled scene once, in stored order, with all its goals; of each shard the first
        `most`."""
        stream = chain.from_iterable(
            _cut(
                group,
                chain.from_iterable(
                    islice(self.catalogue.read(shard, group), most)
                    for shard in self.catalogue.shards
                ),
                scenes,
            )
            for group in polling(self.catalogue.predicates, share=True)
        )
        return polled([stream], self._asked, count=None, workers=self.workers)

    @property
    def _looks_in_all(self) -> int:
        """Looks of a run, of all groups."""
        last = looks_of(self.config.steps - 1, self.catalogue.groups, self.config)
        return last[-1][0] + 1

    # looks ------------------------------------------------------------------------------------

    def _streams(self, begin: int) -> list[Iterator[Look]]:
        """The looks of each group from the one that look `begin` of the run is, that one first."""
        total = len(self.catalogue.groups)
        if self.config.polling == "one-by-one":
            each = -(-self.config.steps // total)
            now, done = divmod(begin, each)
            rest = (islice(self._looks(group, 0), each) for group in range(now + 1, total))
            return [chain(islice(self._looks(now, done), each - done), chain.from_iterable(rest))]
        round_, now = divmod(begin, total)
        order = [*range(now, total), *range(now)]
        return [self._looks(group, round_ + (group < now)) for group in order]

    def _looks(self, group: int, first: int) -> Iterator[Look]:
        """The looks of a group from its number `first`, epoch after epoch."""
        size = self.config.queries_per_batch or self.config.scenes_per_batch
        into = 0 if self.config.queries_per_batch else first % ALIKE
        begin = first - into
        epoch, passed = divmod(begin * size, sum(self.catalogue.counts[group].values()))
        examples = chain.from_iterable(self._epoch(group, number) for number in count(epoch))
        looks = _cut(self.catalogue.groups[group], islice(examples, passed, None), size, begin)
        if not self.config.queries_per_batch:
            looks = islice(self._alike(looks), into, None)
        blank = int(self.told * self._looks_in_all / len(self.catalogue.groups))
        return (replace(look, told=look.number < blank) for look in looks)

    def _alike(self, looks: Iterator[Look]) -> Iterator[Look]:
        """The same scenes, those of a few looks sorted by their number of objects."""
        while some := tuple(islice(looks, ALIKE)):
            size, predicates, first = len(some[0].examples), some[0].predicates, some[0].number
            scenes = sorted(chain.from_iterable(look.examples for look in some), key=_objects)
            order = _rng(self.config.seed, 4, predicates, first).permutation(len(some))
            for number, place in enumerate(order, first):
                examples = tuple(scenes[place * size : (place + 1) * size])
                yield Look(predicates=predicates, number=number, examples=examples)

    def _epoch(self, group: int, number: int) -> Iterator[Example]:
        """All examples of a group, shuffled: scenes with their goals, or with one query each."""
        predicates = self.catalogue.groups[group]
        seed = int(_rng(self.config.seed, 1, predicates, number).integers(2**62))
        counts = self.catalogue.counts[group]
        shards = [shard for shard in self.catalogue.shards if shard.number in counts]
        if self.config.queries_per_batch:
            return shuffled(shards, partial(self._queries, predicates), seed, buffer=QUERIES)
        return shuffled(shards, partial(self._scenes, predicates), seed, buffer=SCENES)

    def _scenes(self, predicates: tuple[Predicate, ...], shard: Shard) -> Iterator[Example]:
        return self.catalogue.read(shard, predicates)

    def _queries(self, predicates: tuple[Predicate, ...], shard: Shard) -> Iterator[Example]:
        for example in self.catalogue.read(shard, predicates):
            for predicate, answers in example.answers.items():
                for answer in answers:
                    for query, relevant in zip(answer.queries, answer.relevant, strict=True):
                        if self.config.goal_objects or query not in answer[:2]:
                            alone = answer._replace(queries=(query,), relevant=(relevant,))
                            yield replace(example, answers={predicate: (alone,)})

    # batches ----------------------------------------------------------------------------------

    def _learned(self, look: Look) -> Batch:
        """This process's share of a look, with its goals drawn, as it is shown to the network."""
        config, size = self.config, len(look.examples)
        examples = look.examples[self.rank :: self.ranks]
        if config.queries_per_batch:
            examples = _together(examples)
        else:
            first = look.number * size + self.rank
            examples = [
                self._some_goals(example, _rng(config.seed, 3, look.predicates, place))
                for place, example in zip(count(first, self.ranks), examples, strict=False)
            ]
        pictures = self.pictures and not look.told
        batch = batch_of(examples, look.predicates, config.model.camera, pictures=pictures)
        rng = _rng(config.seed, 2, look.predicates, look.number)
        if config.recolor:
            batch = recolored(batch, rng.permutation(3).tolist())
        return in_the_mirror(batch) if config.mirror and rng.integers(2) else batch

    def _asked(self, look: Look) -> Batch:
        camera = self.config.model.camera
        return batch_of(look.examples, look.predicates, camera, pictures=self.pictures)

    def _some_goals(self, example: Example, rng: np.random.Generator) -> Example:
        """The example with at most `goals_per_scene` goals of each predicate."""
        most, kept = self.config.goals_per_scene, dict(example.answers)
        for predicate, answers in example.answers.items():
            if len(answers) > most:
                drawn = np.sort(rng.permutation(len(answers))[:most])
                kept[predicate] = [answers[goal] for goal in drawn]
        return replace(example, answers=kept)


def _cut(
    predicates: tuple[Predicate, ...], examples: Iterator[Example], size: int, first: int = 0
) -> Iterator[Look]:
    for number in count(first):
        if not (some := tuple(islice(examples, size))):
            return
        yield Look(predicates=predicates, number=number, examples=some)


def _objects(example: Example) -> int:
    """How many objects the scene has: labels are about all of them."""
    (answers, *_) = example.answers.values()
    return len(answers[0].queries)


def _together(examples: tuple[Example, ...]) -> list[Example]:
    """One example a scene, with all the answers that were drawn of it."""
    found: dict[str, Example] = {}
    drawn: dict[str, dict[Predicate, dict[tuple[str, ...], Answer]]] = {}
    for example in examples:
        found.setdefault(example.name, example)
        own = drawn.setdefault(example.name, {})
        for predicate, answers in example.answers.items():
            goals = own.setdefault(predicate, {})
            for answer in answers:
                before = goals.get(answer[:2])
                goals[answer[:2]] = before.extended(answer) if before else answer
    return [
        replace(example, answers={p: [*goals.values()] for p, goals in drawn[name].items()})
        for name, example in found.items()
    ]


def _rng(
    seed: int, purpose: int, predicates: tuple[Predicate, ...], index: int
) -> np.random.Generator:
    """Random numbers of the looks of a group, counted by its first predicate."""
    stream = list(PREDICATES.values()).index(predicates[0])
    counter = [0, index, stream, purpose]
    return np.random.Generator(np.random.Philox(key=seed, counter=counter))
