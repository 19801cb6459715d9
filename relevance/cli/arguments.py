"""Arguments that several subcommands take."""

import os
from pathlib import Path
from typing import Annotated, Literal

import tyro

Preset = Literal["smoke", "demo", "laptop", "paper"]
DatasetArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATASET")]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
Workers = Annotated[int, tyro.conf.arg(metavar="N")]

CORES = len(os.sched_getaffinity(0))
