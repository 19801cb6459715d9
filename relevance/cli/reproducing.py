"""The subcommand `reproduce`: the paper's tables and figures from a dataset and its checkpoints."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
from collections.abc import Callable
from typing import Annotated

import tyro

from relevance.cli.arguments import Command, DatasetArg, OptionalPath, Preset
from relevance.cli.terminal import bar


def _reproduce(preset: Preset) -> Callable[..., int]:
    from relevance.evaluation import EvaluationConfig

    start: EvaluationConfig = getattr(EvaluationConfig, preset)()

    def reproduce(
        dataset: DatasetArg,
        checkpoint: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CHECKPOINT")] = (),
        out: OptionalPath = None,
        rerun: bool = True,
        preset: Preset = preset,
        config: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Write the paper's tables and figures, ours beside its own; prints the path of the page.

        Nothing is trained. Predictions and reruns that are missing are made first and kept in the
        dataset, as `relevance evaluate` does, at the betas of the figures too.

        Args:
            dataset: Folder of a labelled dataset.
            checkpoint: The models, files or ids, several; all of the dataset when not given.
            out: Folder of page, tables (CSV, JSON) and figures (PNG, SVG); DATASET/paper when not
                given.
            rerun: Whether to make what is missing; else the page says what is.
            preset: Where the other settings start from: how many tasks are rerun.
        """
        from relevance.report import reproduction

        if rerun:
            reproduction.prepare(dataset, checkpoint, config, bar)
        print(reproduction.build(dataset, out, checkpoints=checkpoint))
        return 0

    return reproduce


COMMANDS = {
    "reproduce": Command(
        make=_reproduce,
        about="the paper's tables and figures, ours beside",
        examples=(
            "relevance reproduce data/tables",
            "relevance reproduce data/tables --checkpoint glimpse model.pt --sweep-tasks 60",
            "relevance reproduce data/tables --no-rerun --out out/paper",
        ),
    ),
}
