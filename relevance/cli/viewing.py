"""The subcommand `view`: a plan that runs on a page, or as a film."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from relevance.cli.arguments import (
    Command,
    OptionalCount,
    OptionalName,
    OptionalPath,
    Preset,
    at_least,
    check_file,
    one_of,
)
from relevance.cli.terminal import UsageError, bar, say

Goal = Annotated[str | None, tyro.conf.arg(metavar="GOAL")]


def _view(_: Preset) -> Callable[..., int]:
    def view(
        place: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATASET-OR-SCENES")],
        scene: OptionalName = None,
        goal: Goal = None,
        guide: str = "order",
        checkpoint: OptionalName = None,
        beta: float = 0.0,
        max_actions: OptionalCount = None,
        gif: OptionalPath = None,
        mp4: OptionalPath = None,
        port: int = 8080,
    ) -> int:
        """Watch a plan: the arm, the boxes and the steps, on a page that this machine serves.

        Without --gif and --mp4 there is a page for your browser (pip install 'relevance[view]')
        until Ctrl-C; what it shows never leaves this machine. With them the plan becomes a
        film: the unguided one, or the guided one where --checkpoint names a model.

        Args:
            place: Folder of a dataset, or a scene file.
            scene: Id of the scene; one with a long plan, or the file's first, when not given.
            goal: A goal of the scene, e.g. 'on-the-left(red, blue)'; one with a long plan, or the
                first, when not given.
            guide: How scores enter the guided plan, see `plan --help`; none for no guided plan.
            checkpoint: The model that guides: a file, an id of the dataset or the name of a model
                that comes with the package; the dataset's champion when not given, else glimpse.
            beta: An object is kept when its score exceeds -beta.
            max_actions: Most picks and places in a plan; the dataset's own, or 6.
            gif: Write a film to this file.
            mp4: Write a film to this file (VP9, which browsers play).
            port: Where the page is; the next that is free where that is taken.
        """
        from relevance.planner import GUIDES
        from relevance.report.shots import shoot, stored_task, written_task
        from relevance.report.viewer import Viewer, require_viser
        from relevance.store import Dataset, locate

        one_of("--guide", guide, GUIDES)
        at_least("--beta", beta, -math.inf)
        at_least("--max-actions", max_actions, 2)
        at_least("--port", port, 1, 65535)
        if checkpoint is not None and not GUIDES[guide].guided:
            raise UsageError("--guide and --checkpoint go together: none asks no model")
        for flag, file in (("gif", gif), ("mp4", mp4)):
            check_file(f"--{flag}", file, f".{flag}")
        films = [file for file in (gif, mp4) if file is not None]
        if not films:
            require_viser()
        if locate(place).is_file():
            dataset, task = None, written_task(place, scene, goal)
        else:
            dataset = Dataset.open(place)
            task = stored_task(dataset, scene, goal)
        if max_actions is not None:
            task = replace(task, config=replace(task.config, max_actions=max_actions))
        guides: dict[str, Any] = {"unguided": None}
        if GUIDES[guide].guided and (not films or checkpoint is not None):
            guides[f"guided ({guide})"] = _guide(dataset, checkpoint, guide, beta)
            if films:
                del guides["unguided"]  # a film is of one plan
        shots, reasons = shoot(task, guides)
        for reason in reasons:
            say(f"relevance view: {reason}")
        if films:
            from relevance.report.movie import film

            with bar("frames") as progress:
                film(films, shots[0], progress=progress)
            say(f"{task.goal} in scene {task.scene.id}: {', '.join(map(str, films))}")
            return 0
        with Viewer(shots, port=port) as viewer:
            print(viewer.url, flush=True)
            say(f"{task.goal} in scene {task.scene.id}; Ctrl-C ends it")
            viewer.run()
        return 0

    return view


def _guide(dataset: Any, checkpoint: str | None, mode: str, beta: float) -> Any:
    """The guide of a checkpoint, the one that is meant where none is named."""
    from relevance.evaluation import load_guide
    from relevance.networks import find_checkpoint

    path = checkpoint or "glimpse"
    if dataset is not None and (checkpoint is not None or dataset.files("checkpoints")):
        path = find_checkpoint(dataset.path, checkpoint)
    return load_guide(path, mode=mode, beta=beta)


COMMANDS = {
    "view": Command(
        make=_view,
        about="watch a plan on a page, or as a film",
        examples=(
            "relevance view data/demo",
            "relevance view scenes.jsonl --goal 'on(red, blue)' --checkpoint glimpse",
            "relevance view scenes.jsonl --gif plan.gif --mp4 plan.mp4",
        ),
    ),
}
