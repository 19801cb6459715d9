"""Datasets that several tests share, each made once."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from filelock import FileLock
from hypothesis import settings

from relevance.pipeline import (
    Counts,
    DatasetConfig,
    Work,
    finish,
    generate_shard,
    label_shard,
    prepare,
)
from relevance.sampling import SceneConfig

# The same examples on every run of a change; whoever works on it meets fresh ones.
settings.register_profile("ci", derandomize=True, deadline=None)
if os.environ.get("CI"):
    settings.load_profile("ci")

# --- what the test processes share --------------------------------------------------------------

FOLDER = "RELEVANCE_TEST_FOLDER"
_MADE: list[str] = []


def pytest_configure() -> None:
    """Make the folder that the test processes share, in the first of them."""
    if FOLDER not in os.environ:
        _MADE.append(tempfile.mkdtemp(prefix="relevance-test-"))
        os.environ[FOLDER] = _MADE[0]


def pytest_unconfigure() -> None:
    """Remove it, in the process that made it."""
    for folder in _MADE:
        shutil.rmtree(folder, ignore_errors=True)  # somebody may write still
        del os.environ[FOLDER]
    _MADE.clear()


def shared(name: str, make: Callable[[Path], object]) -> Path:
    """A folder that is made by whichever test process asks first; read only."""
    folder = Path(os.environ[FOLDER]) / name
    done = folder.with_name(f"{name}.done")
    with FileLock(f"{folder}.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a process that died
            make(folder)
            done.touch()
    return folder


CONFIG = DatasetConfig(
    seed=3,
    train=Counts(same_plane=3, on=2),
    validation=Counts(same_plane=1),
    test=Counts(same_plane=1, on=1),
    scenes_per_shard=2,
    goals_per_scene=1,
    scene=SceneConfig(max_objects=6),
    replay_share=0.3,
)


def make(root: Path, config: DatasetConfig = CONFIG) -> Path:
    """Make a whole dataset in this process."""
    for spec in prepare(root, config):
        generate_shard(root, config, spec)
        for predicate in spec.predicates:
            label_shard(root, config, spec, predicate)
    return root


@cache
def small_dataset() -> Path:
    """A finished dataset of CONFIG, made once; copy it before you change it."""
    return shared("small", make)


GROWN = DatasetConfig(
    seed=5,
    train=Counts(same_plane=2, on=4),
    test=Counts(on=2),
    scenes_per_shard=2,
    goals_per_scene=3,
    scene=SceneConfig(max_objects=7),
    replay_share=0.0,
    test_replay_share=0.2,
)


def complete(root: Path, config: DatasetConfig = GROWN, policy: str | None = None) -> Path:
    """Generate and label whatever is missing, in this process."""
    for spec in prepare(root, config):
        generate_shard(root, config, spec)
        for predicate in spec.predicates:
            label_shard(root, config, spec, predicate, policy=policy)
    finish(root)
    return root


def done(*works: Work) -> None:
    """Do the jobs of some work one after the other."""
    for work in works:
        for job in work.jobs:
            job.run()
        work.finish()


@cache
def grown_dataset() -> Path:
    """A finished dataset of GROWN, made once; copy it before you change it."""
    return shared("grown", complete)


def contents(root: Path) -> dict[str, bytes]:
    """Every file that falls under the equal-bytes promise."""
    return {
        str(file.relative_to(root)): file.read_bytes()
        for file in sorted(root.rglob("*"))
        if file.is_file() and not {"timings", "durations"} & set(file.parts)
    }


@contextmanager
def untouched(*files: Path) -> Iterator[None]:
    before = [(file.stat().st_mtime_ns, file.stat().st_ino) for file in files]
    yield
    assert [(file.stat().st_mtime_ns, file.stat().st_ino) for file in files] == before
