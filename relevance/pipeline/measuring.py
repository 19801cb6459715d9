"""What making a shard takes, and the compiling before it, which does not count."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

from relevance.pipeline.settings import ShardSpec
from relevance.store import Dataset

Progress = Callable[[int, int], None]
"""Hears (scenes done, scenes in all)."""


class Stopwatch:
    """Wall and processor seconds of this process since it was made."""

    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def read(self) -> dict[str, float]:
        """Seconds so far, as `durations` has them."""
        return {
            "seconds": time.perf_counter() - self.wall,
            "seconds_cpu": time.process_time() - self.cpu,
        }


def took(dataset: Dataset, stage: str, spec: ShardSpec, rows: int, taken: dict[str, float]) -> None:
    """Write what a shard's stage took to `durations`."""
    row = {"stage": stage, "split": spec.split, "shard": spec.shard, "rows": rows, **taken}
    dataset.write_rows("durations", [row], stage=stage, split=spec.split, shard=spec.shard)


@cache
def compiled(kernels: Callable[[], None]) -> None:
    """Compile kernels, or load them; on each machine the first process does it for all."""
    file = Path(tempfile.gettempdir()) / f"relevance-{os.getuid()}-compile.lock"
    with file.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_SH)  # until the first one is done; then all go on
            fcntl.flock(lock, fcntl.LOCK_UN)
        kernels()
