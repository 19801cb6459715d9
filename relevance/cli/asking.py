"""Subcommands that ask a dataset: check, sql, stats, diff, suites, report."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

from relevance.cli.arguments import Command, DatasetArg, OptionalName, OptionalPath, Preset
from relevance.cli.terminal import Format, bar, console, say, show, to_json


def _check(_: Preset) -> Callable[..., int]:
    def check(dataset: DatasetArg, render: bool = True, strict: bool = False) -> int:
        """Check every contract of a dataset; exit code 1 and a line for each breach.

        Args:
            dataset: Folder of the dataset.
            render: Also render one scene of each shard again and compare the pixels.
            strict: Also name the files whose table had fewer columns when they were written.
        """
        from relevance.pipeline.checking import check

        with bar("files") as progress:
            breaches = check(dataset, render=render, strict=strict, progress=progress)
        for breach in breaches:
            print(breach)
        say(
            f"{dataset}: {len(breaches)} breaches" if breaches else f"{dataset}: all contracts hold"
        )
        return 1 if breaches else 0

    return check


def _sql(_: Preset) -> Callable[..., int]:
    def sql(
        dataset: DatasetArg,
        query: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="QUERY")],
        format: Format = "table",
        policy: OptionalName = None,
    ) -> int:
        """Ask DuckDB about a dataset; there is a view for each table.

        Args:
            dataset: Folder of the dataset.
            query: SQL over scenes, objects, plans, labels, predictions, evaluations, checkpoints.
            format: How to print the rows.
            policy: The label policy that `labels` shows; the dataset's own when not given.
        """
        from relevance.store import sql

        show(*sql(dataset, query, policy=policy), format)
        return 0

    return sql


def _diff(_: Preset) -> Callable[..., int]:
    def diff(dataset: DatasetArg, old: OptionalPath = None, format: Format = "table") -> int:
        """Count what planning anew changed: goals by their plans, queries by their labels.

        Args:
            dataset: Folder of the dataset, with its labels of today.
            old: Folder of the same scenes, labelled before; else what the dataset keeps beside.
            format: How to print the rows.
        """
        from relevance.store import replanned

        columns, rows = replanned(dataset, old)
        if format == "table":  # few rows of many figures
            wide = [[name, *values] for name, *values in zip(columns, *rows, strict=True)]
            columns, rows = [wide[0][0], *map(str, wide[0][1:])], wide[1:]
        show(columns, rows, format, title=f"{dataset}: planned anew")
        return 0

    return diff


def _stats(_: Preset) -> Callable[..., int]:
    def stats(
        dataset: DatasetArg,
        format: Literal["table", "json"] = "table",
        card: Path | None = None,
    ) -> int:
        """Count a dataset: label balance, plan lengths, failures by reason, visibility, time.

        Args:
            dataset: Folder of the dataset.
            format: How to print the tables.
            card: Folder to write a dataset card to instead: a page of Markdown and its pictures.
        """
        from relevance.report.card import write_card
        from relevance.report.tables import statistics

        if card is not None:
            print(write_card(dataset, card))
            return 0
        found = statistics(dataset)
        if format == "json":
            print(to_json(dataclasses.asdict(found)))
        else:
            for table in found.tables:
                show(table.columns, table.rows, "table", title=table.title)
        return 0

    return stats


def _suites(_: Preset) -> Callable[..., int]:
    def suites(
        datasets: Annotated[
            tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="DATASET...")
        ] = (),
        checkpoint: Annotated[str, tyro.conf.arg(metavar="CHECKPOINT")] = "glimpse",
        format: Format = "table",
    ) -> int:
        """Say which test sets away from home there are, or what a checkpoint is worth on some.

        A row a dataset, of what it holds: `relevance evaluate DATASET --checkpoint ...` first.

        Args:
            datasets: Folders of labelled datasets, suites or any other; none lists the suites.
            checkpoint: A file, or the name of a model that comes with this package.
            format: How to print the rows.
        """
        from relevance.evaluation import SUITES, away

        if not datasets:
            rows = [
                [suite.name, ", ".join(suite.families), suite.about] for suite in SUITES.values()
            ]
            show(("suite", "families", "what differs"), rows, format)
            return 0
        found = away(datasets, checkpoint)
        columns = list(dict.fromkeys(key for row in found for key in row))
        rows = [[row.get(key) for key in columns] for row in found]
        if format == "table":  # few rows of many figures
            wide = [[name, *values] for name, *values in zip(columns, *rows, strict=True)]
            columns, rows = [str(value) for value in wide[0]], wide[1:]
        show(columns, rows, format, title=f"{checkpoint} away from home")
        return 0

    return suites


def _report(_: Preset) -> Callable[..., int]:
    def report(dataset: DatasetArg, out: OptionalPath = None) -> int:
        """Write the report, one HTML file that opens offline; prints its path.

        Args:
            dataset: Folder of the dataset.
            out: Where to; DATASET/report.html when not given.
        """
        from relevance.report import page

        with console.status("report"):
            path = page.build(dataset, out)
        print(path)
        return 0

    return report


COMMANDS = {
    "check": Command(
        make=_check,
        about="every contract of a dataset",
        examples=("relevance check data/tables", "relevance check data/tables --no-render"),
    ),
    "sql": Command(
        make=_sql,
        about="ask DuckDB about a dataset",
        examples=(
            'relevance sql data/tables "select relevant, count(*) from labels group by 1"',
            'relevance sql data/tables "from plans" --format csv > plans.csv',
            'relevance sql data/tables "select why, count(*) from label_changes group by all"',
        ),
    ),
    "diff": Command(
        make=_diff,
        about="what planning a dataset anew changed",
        examples=(
            "relevance diff data/tables",
            "relevance diff data/tables --old data/tables-before",
        ),
    ),
    "stats": Command(
        make=_stats,
        about="label balance, plan lengths, visibility",
        examples=("relevance stats data/tables", "relevance stats data/tables --card out/card"),
    ),
    "suites": Command(
        make=_suites,
        about="what a checkpoint is worth away from home",
        examples=("relevance suites", "relevance suites data/boxes-20 --checkpoint model.pt"),
    ),
    "report": Command(
        make=_report,
        about="tables and figures as one HTML file",
        examples=("relevance report data/tables",),
    ),
}
