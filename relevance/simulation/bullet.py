"""pybullet, imported without the line about its build time that it writes to standard error; its
clients, and what it calls a camera."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Sequence
from typing import Self

from relevance.scene import Camera, camera_up

__all__ = ["Client", "lens", "pybullet"]


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


class Client:
    """A simulated world of its own; use as a context manager."""

    def __init__(self) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise RuntimeError("pybullet gave no client: too many are open in this process")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give it back; it cannot be used afterwards."""
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1


def lens(camera: Camera) -> tuple[Sequence[float], Sequence[float]]:
    """View and projection matrix of a camera, column by column."""
    aspect = camera.width / camera.height
    vertical = 2 * math.atan(math.tan(math.radians(camera.fov) / 2) / aspect)
    return (
        pybullet.computeViewMatrix(camera.eye, camera.target, camera_up(camera)),
        pybullet.computeProjectionMatrixFOV(
            math.degrees(vertical), aspect, camera.near, camera.far
        ),
    )
