"""The subcommand `predict`: what a model says of a picture from elsewhere."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from relevance.cli.arguments import Command, OptionalPath, Preset, Repeated, at_least
from relevance.cli.terminal import Format, UsageError, say, show

_CROP = re.compile(r"(?P<name>.+)=(?P<box>[0-9]{1,6}(,[0-9]{1,6}){3})")


def _predict(_: Preset) -> Callable[..., int]:
    def predict(
        image: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGE")],
        goal: Annotated[Repeated, tyro.conf.arg(metavar="GOAL")],
        checkpoint: Annotated[str, tyro.conf.arg(metavar="CHECKPOINT")] = "glimpse",
        views: OptionalPath = None,
        crop: Annotated[Repeated, tyro.conf.arg(metavar="NAME=X,Y,W,H")] = (),
        beta: float = 0.0,
        out: OptionalPath = None,
        format: Format = "table",
    ) -> int:
        """Say of a picture which objects matter for a goal.

        The picture has the size and the view of the camera that the model was trained with.

        Args:
            image: The picture; PNG, WebP or JPEG.
            goal: What is wanted, e.g. 'on-the-left(red, blue)'; may be given several times.
            checkpoint: A file, or the name of a model that comes with this package.
            views: Folder with a picture NAME.png of 32x32 pixels for each object, alone on grey as
                in a dataset's views.
            crop: Cuts the view of an object from the picture instead: left, top, width and height
                in pixels; may be given several times.
            beta: An object is relevant when its score exceeds -beta.
            out: Also write the picture with the answer drawn in.
            format: How to print the rows.
        """
        from relevance.evaluation import load_scorer
        from relevance.evaluation.pictures import draw, judge, look_at
        from relevance.scene import Goal
        from relevance.scene.words import named, shown

        at_least("--beta", beta, -math.inf)
        crops: dict[str, tuple[int, int, int, int]] = {}
        for text in crop:
            found = _CROP.fullmatch(text)
            if found is None:
                raise UsageError(f"--crop {shown(text)}: expected NAME=X,Y,W,H, in pixels")
            try:
                name = named(found["name"])
            except ValueError as error:
                raise UsageError(f"--crop {shown(text)}: name: {error}") from None
            if name in crops:
                raise UsageError(f"--crop {shown(text)}: expected each name once")
            x, y, w, h = map(int, found["box"].split(","))
            crops[name] = (x, y, w, h)
        goals = [Goal.parse(text) for text in goal]
        if not goals:
            raise UsageError("--goal: expected at least one")
        seen = look_at(image, views=views, crops=crops)
        scorer = load_scorer(checkpoint)
        judged = judge(scorer, seen, goals, beta=beta)
        show(
            ("goal", "object", "role", "score", "probability", "relevant"),
            [
                (
                    str(one.goal),
                    one.name,
                    one.role,
                    round(one.score, 4),
                    round(one.probability, 4),
                    one.relevant if format == "json" else "yes" if one.relevant else "no",
                )
                for one in judged
            ],
            format,
        )
        if out is not None:
            draw(out, scorer, seen, judged)
            say(f"the picture with the answer: {out}")
        return 0

    return predict


COMMANDS = {
    "predict": Command(
        make=_predict,
        about="which objects of a picture matter for a goal",
        examples=(
            "relevance predict table.png --views views --goal 'on-the-left(red, blue)' --out a.png",
            "relevance predict table.png --crop red=40,80,30,36 --crop blue=200,90,28,30 "
            "--goal 'on(red, blue)'",
        ),
    ),
}
