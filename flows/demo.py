"""The whole pipeline in one go, through the flows: what `make demo` runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.evaluate import evaluate
from flows.generate import generate
from flows.head import find_server
from flows.label import label
from flows.parameters import Overrides, Preset, absolute
from flows.train import train


@dataclass(frozen=True, slots=True, kw_only=True)
class Demo:
    """What a run of the pipeline left behind."""

    dataset: Path
    checkpoint: Path
    report: Path
    seconds: dict[str, float]
    """Wall time of each stage, s."""


def run(
    dataset: str = "data/demo",
    *,
    preset: Preset = "demo",
    overrides: Overrides | None = None,
    training: Overrides | None = None,
    evaluation: Overrides | None = None,
    max_workers: int | None = None,
) -> Demo:
    """Generate, label, train, evaluate and report; what was finished before is not repeated."""
    find_server()
    root, seconds = str(absolute(dataset)), dict[str, float]()

    def stage(flow: Callable[..., Any], **parameters: Any) -> Any:
        start = time.monotonic()
        result = flow(dataset=root, **parameters)
        seconds[flow.__name__] = time.monotonic() - start
        return result

    stage(generate, preset=preset, overrides=overrides, max_workers=max_workers)
    stage(label, max_workers=max_workers)
    checkpoint = stage(train, preset=preset, overrides=training)
    report = stage(
        evaluate,
        checkpoint=checkpoint,
        preset=preset,
        overrides=evaluation,
        max_workers=max_workers,
    )
    return Demo(
        dataset=Path(root), checkpoint=Path(checkpoint), report=Path(report), seconds=seconds
    )
