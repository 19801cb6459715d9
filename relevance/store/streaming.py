"""Shards as streams: shuffled, polled and finished by worker processes, all by webdataset.

What comes out, and in which order, depends on the seed alone, never on how many processes work:
each of them goes through the same undecoded samples, which is cheap, and finishes its share.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import islice
from typing import Any, TypeVar, cast

from relevance.errors import RelevanceError

Shard = TypeVar("Shard")

BUFFER = 1000
"""Samples from which a shuffled one is drawn."""


def shuffled(
    shards: Sequence[Shard],
    taken_apart: Callable[[Shard], Iterable[Any]],
    seed: int,
    *,
    buffer: int = BUFFER,
) -> Iterator[Any]:
    """What is in the shards: these in an order of `seed`, then each drawn from a buffer."""
    # Here and not above: importing webdataset loads torch, which making shards does not need.
    from webdataset.filters import detshuffle
    from webdataset.pipeline import DataPipeline

    def samples(order: Iterable[Shard]) -> Iterator[Any]:
        return (sample for shard in order for sample in taken_apart(shard))

    shards_in_order = detshuffle(bufsize=len(shards), initial=len(shards), seed=seed)
    drawn = detshuffle(bufsize=buffer, initial=buffer, seed=seed)
    yield from DataPipeline(partial(iter, shards), shards_in_order, samples, drawn)


def polled(
    streams: Sequence[Iterator[Any]],
    finish: Callable[[Any], Any],
    *,
    count: int | None,
    workers: int,
) -> Generator[Any]:
    """One of each stream in turn until one ends, `count` in all, each finished by some worker.

    0 workers: all is done here. What a user can mend is raised here, where it would have come.
    """
    from webdataset.compat import WebLoader
    from webdataset.filters import map
    from webdataset.mix import RoundRobin
    from webdataset.pipeline import DataPipeline
    from webdataset.shardlists import split_by_worker

    def some(source: Iterable[Any]) -> Iterator[Any]:
        return islice(source, count)

    def named(source: Iterable[Any]) -> Iterator[Any]:
        try:
            yield from source
        except RelevanceError as error:  # torch would make a traceback of its one line
            yield error

    pipeline = DataPipeline(
        RoundRobin(cast(Any, streams)), some, split_by_worker, map(finish), named
    )
    # Forked, workers have all that is here; what is not safe in a fork they open anew.
    how: dict[str, Any] = {"multiprocessing_context": "fork"} if workers else {}
    loader = iter(WebLoader(pipeline, batch_size=None, num_workers=workers, **how))
    # closed here, not when nobody knows it any more: who is told twice to end would see the second
    # time as an error of a forgotten generator
    with closing(_taken_ahead(loader) if workers else (found for found in loader)) as source:
        for found in source:
            if isinstance(found, RelevanceError):
                raise found
            yield found


def _taken_ahead(source: Iterator[Any]) -> Generator[Any]:
    """The same, each taken from its process by a thread while the one before is in use."""
    end = object()
    found = next(source, end)  # here: processes fork, which they had better not do in a thread
    with ThreadPoolExecutor(1, "ahead") as thread:
        while found is not end:
            following = thread.submit(next, source, end)
            yield found
            found = following.result()
