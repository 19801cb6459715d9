"""First use: the kernels are compiled by two processes at once, and by one caller at a time.

One half is compiled here, the other by a child. What both need, each finds in the cache when the
other was first, so they begin at different ends: the child with the pose bound, which looks at no
distances in space, then with the retreat, whose kernels the motions need last.
"""

from __future__ import annotations

import fcntl
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import llvmlite.binding
import numba
import numpy as np
from numba.core import config

from relevance.planner.grasps import bodies, grasps, leaning_grasps, pick_target
from relevance.planner.kernels.kinematics import TARGET, functions
from relevance.planner.kernels.motions import ROWS, VERTICAL, motion, retreat
from relevance.planner.keyframes import KeyframeBound
from relevance.planner.pose import Placement, PoseBound
from relevance.planner.problem import Problem
from relevance.robot import HOME
from relevance.scene import Box, Scene

SECONDS = 25
"""About how long it takes on two cores, s."""


def compile_once(rest: Callable[[], None]) -> None:
    """Have the kernels in the cache, then call `rest`, which loads them and compiles what is left.

    Processes that come meanwhile wait for the first and find its work.
    """
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    done = folder / f"complete-{numba.__version__}-{platform.python_version()}-{_processor()}"
    if config.DISABLE_JIT or done.exists():  # pyright: ignore[reportAttributeAccessIssue]
        rest()
        return
    with _alone(folder / "compiling.lock"):
        if not done.exists():
            print(
                f"compiling the planner's kernels, once on this machine: about {SECONDS} s",
                file=sys.stderr, flush=True,
            )  # fmt: skip
            functions()  # C, built once for both
            child = _child() if len(os.sched_getaffinity(0)) > 1 else None
            first_half()
            if child is not None:
                child.wait()
        rest()
        with suppress(OSError):
            done.touch()


def first_half() -> None:
    """Compile the motions of the path bound."""
    problem = _problem()
    grasp = grasps(problem.subject)[0]
    target, hand = pick_target(problem.subject, grasp), bodies(grasp.opening)
    rows = np.tile(HOME, (ROWS + 1, 1))
    around = problem.obstacles
    motion(rows, problem.arm, np.zeros(TARGET), False, target, hand, around, around)


def other_half() -> None:
    """Compile the pose bound, the path bound's retreat, the keyframe bound with a leaning hand."""
    problem = _problem()
    pose_bound = PoseBound(problem)
    next(pose_bound.place_all((problem.goal.subject,)), None)
    grasp, place = grasps(problem.subject)[0], problem.reference.position
    rows = np.tile(HOME, (2 * VERTICAL + 1, 1))
    retreat(rows, problem.arm, np.zeros(TARGET), bodies(grasp.opening), problem.obstacles)
    there = Placement(grasp=leaning_grasps(problem.subject)[0], pose=(*place[:2], 0.0))
    KeyframeBound(pose_bound).solve((problem.goal.subject,), [there])


def _problem() -> Problem:
    """A small task that needs everything."""
    boxes = [
        Box(
            name=name, size=(0.05, 0.05, 0.05), position=(0.0, y, 0.025), color=(0.5, 0.5, 0.5)
        )
        for name, y in (("a", 0.2), ("b", 0.0))
    ]  # fmt: skip
    scene = Scene(objects=tuple(boxes))
    return Problem(scene, scene.goal("on(a, b)"))


def _processor() -> str:
    """What code is made for: kernels of another processor are none."""
    return llvmlite.binding.get_host_cpu_name()


@contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Hold a lock among processes, as far as the folder can be written and locked."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        lock = file.open("w")
    except OSError:
        yield
        return
    with lock:
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _child() -> subprocess.Popen[bytes] | None:
    """The process that compiles the other half; None where none can be started.

    Should it fail, `rest` compiles what it leaves.
    """
    path = os.pathsep.join(entry for entry in sys.path if entry)
    with suppress(OSError):
        return subprocess.Popen(
            [sys.executable, "-P", "-c", f"import {__name__} as the; the.other_half()"],
            env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    return None
