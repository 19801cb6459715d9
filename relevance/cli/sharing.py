"""Subcommands that make other forms of a dataset: merge, compact, export."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from relevance.cli.arguments import Command, DatasetArg, Preset
from relevance.cli.terminal import bar, say


def _merge(_: Preset) -> Callable[..., int]:
    def merge(
        datasets: Annotated[
            tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="DATASET...")
        ],
        into: Path,
    ) -> int:
        """Make a dataset of others by reference: no file is copied, every command works on it.

        Args:
            datasets: The datasets; labelled alike, no scene in common.
            into: Folder of the new one.
        """
        from relevance.pipeline import merge, shards_of

        merged = merge(datasets, into)
        say(f"{into}: {len(shards_of(merged))} shards of {len(merged.sources)} datasets")
        return 0

    return merge


def _compact(_: Preset) -> Callable[..., int]:
    def compact(dataset: DatasetArg) -> int:
        """Gather many small label files into few large ones, which queries then read.

        The shards stay; when they change, queries read them again until the next compaction.

        Args:
            dataset: Folder of the dataset.
        """
        from relevance.store import Dataset, compact

        rows = compact(Dataset.open(dataset))
        say(f"{dataset}: {sum(rows.values())} rows gathered")
        return 0

    return compact


def _export(_: Preset) -> Callable[..., int]:
    def export(
        dataset: DatasetArg,
        out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
    ) -> int:
        """Write a dataset for Hugging Face `datasets`: Parquet with image bytes, and a card.

        Args:
            dataset: Folder of the dataset.
            out: Folder to write, empty or not there yet.
        """
        from relevance.store import Dataset, export

        with bar("files") as progress:
            path = export(Dataset.open(dataset), out, progress)
        print(path)
        return 0

    return export


COMMANDS = {
    "merge": Command(
        make=_merge,
        about="several datasets as one, by reference",
        examples=("relevance merge data/tables data/more --into data/both",),
    ),
    "compact": Command(
        make=_compact,
        about="gather small label files, for fast queries",
        examples=("relevance compact data/tables",),
    ),
    "export": Command(
        make=_export,
        about="for Hugging Face datasets",
        examples=("relevance export data/tables out/tables",),
    ),
}
