"""pybullet, imported without the line about its build time that it writes to standard error."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

__all__ = ["pybullet"]


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Send what C code writes to standard error nowhere; errors in Python are raised as ever."""
    try:
        kept = os.dup(2)
    except OSError:  # a process without standard error: nothing to keep quiet
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _quiet_stderr():
    import pybullet  # pyright: ignore[reportMissingImports]  (compiled, has no stubs)
