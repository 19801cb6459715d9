"""What a dataset survives: processes killed at random moments, a full disk, broken files.

Real processes make a real dataset and are killed with SIGKILL, the pipeline's own process, its
workers or its Prefect server. After each kill every file that a reader could see must be the
file of an undisturbed run, byte for byte; at the end the whole dataset must be.
"""

from __future__ import annotations

import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from relevance.pipeline import (
    DatasetConfig,
    finish,
    generate_shard,
    label_shard,
    missing,
    prepare,
)
from relevance.pipeline.checking import check

CLOCKS = ("timings", "durations")
"""Tables outside the promise of equal bytes."""
ENDING = 90.0
"""Seconds that everybody has to end after a kill."""
WHOLE_RUN = 900.0
"""Seconds that an undisturbed run may take."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One disturbance and what became of it."""

    number: int
    what: str
    """Who was killed, or what was done to the files."""
    after: float
    """Seconds from the first sign of work to the kill."""
    shards: int
    """Finished files when it struck."""
    wrong: int
    """Visible files that are not those of an undisturbed run: none, or the promise is broken."""
    left: int
    """Processes that were still alive when everybody should have ended."""
    recovered: bool
    """The run went on by itself to a good end (a worker may die)."""


def undisturbed(root: Path, config: DatasetConfig) -> dict[str, str]:
    """Make a dataset in this process; the hash of every file that must be equal."""
    for spec in prepare(root, config):
        generate_shard(root, config, spec)
        for predicate in spec.predicates:
            label_shard(root, config, spec, predicate)
    finish(root)
    return hashes(root)


def hashes(root: Path) -> dict[str, str]:
    """SHA-256 of every visible file, by name; clocks left out."""
    found = {}
    for file in sorted(root.rglob("*")):
        name = file.relative_to(root)
        if file.is_file() and not file.name.startswith(".") and name.parts[0] not in CLOCKS:
            with suppress(FileNotFoundError):
                found[str(name)] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


class Pipeline:
    """The command that makes the dataset, as processes of their own session."""

    def __init__(self, root: Path, flags: Mapping[str, int], *, workers: int, flows: bool) -> None:
        self.root, self.flows = root, flows
        if flows:
            overrides = dict(flags)
            self.program = (
                "from flows.generate import generate\nfrom flows.label import label\n"
                f"generate(dataset={str(root)!r}, preset='smoke', overrides={overrides},"
                f" max_workers={workers})\nlabel(dataset={str(root)!r}, max_workers={workers})\n"
            )
        else:
            named = [f"--{k.replace('_', '-')}={v}" for k, v in flags.items()]
            made = ["generate", str(root), "--preset=smoke", f"--workers={workers}", *named]
            labelled = ["label", str(root), f"--workers={workers}"]
            self.program = (
                "import sys\nfrom relevance.cli import main\n"
                # the guard: worker processes import the main module again
                "if __name__ == '__main__':\n"
                f"    sys.exit(main({made}) or main({labelled}))\n"
            )

    def start(self, home: Path, *, most_bytes: int | None = None) -> subprocess.Popen[bytes]:
        """Start it; `most_bytes` is the size at which its files hit a full disk."""
        kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT")}

        def limit() -> None:
            if most_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

        return subprocess.Popen(
            [sys.executable, "-c", self.program],
            env=kept | {"PREFECT_HOME": str(home), "OMP_NUM_THREADS": "1"},
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=limit,
        )

    def complete(self, home: Path) -> None:
        """Run it to its end; raises AssertionError when that is not a good one."""
        process = self.start(home)
        try:
            assert process.wait(WHOLE_RUN) == 0, "expected an undisturbed run to end well"
        finally:
            kill_all(process.pid)


def members(leader: int) -> dict[int, str]:
    """The living processes of a session, and what each one is."""
    found = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it ended while we looked
            fields = status.read_text().rpartition(")")[2].split()
            if int(fields[3]) != leader or fields[0] == "Z":
                continue
            process = int(status.parent.name)
            line = (status.parent / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            if process == leader:
                found[process] = "pipeline"
            elif "prefect.server" in line or "uvicorn" in line:
                found[process] = "server"
            elif "spawn_main" in line:
                found[process] = "worker"
            else:
                found[process] = "helper"
    return found


def kill_all(leader: int) -> int:
    """SIGKILL for a session's living processes; how many there were."""
    alive = members(leader)
    for process in alive:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return len(alive)


def _wait(done: Callable[[], object], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def _signs(root: Path) -> set[tuple[str, int]]:
    """Changes when anything is written in a dataset."""
    found = set()
    for file in root.rglob("*"):
        with suppress(FileNotFoundError):
            found.add((str(file), file.stat().st_mtime_ns))
    return found


def kill_once(
    pipeline: Pipeline,
    home: Path,
    expected: Mapping[str, str],
    rng: random.Random,
    *,
    number: int,
    longest: float,
) -> Trial | None:
    """Start the pipeline and kill one of its processes, or all, at a random moment.

    None when it had ended before the moment came.
    """
    before = _signs(pipeline.root)
    process = pipeline.start(home)
    try:
        _wait(lambda: _signs(pipeline.root) != before or process.poll() is not None, 300)
        after = rng.uniform(0, longest)
        _wait(lambda: process.poll() is not None, after)
        alive = members(process.pid)
        kinds = sorted(set(alive.values()) & {"pipeline", "worker", "server"})
        if process.poll() is not None or not kinds:
            return None
        what = rng.choice([*kinds, "all"])
        shards = len(hashes(pipeline.root))
        if what == "all":
            kill_all(process.pid)
        else:
            victim = rng.choice([one for one, kind in alive.items() if kind == what])
            with suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL)
        # without a worker the run goes on, by itself and to the end
        patience = WHOLE_RUN if what == "worker" else ENDING
        _wait(lambda: process.poll() is not None and not members(process.pid), patience)
        return Trial(
            number=number,
            what=f"kill {what}",
            after=after,
            shards=shards,
            wrong=len(wrong(pipeline.root, expected)),
            left=len(members(process.pid)),
            recovered=process.poll() == 0,
        )
    finally:
        kill_all(process.pid)
        process.wait(30)


def fill_disk(
    pipeline: Pipeline, home: Path, expected: Mapping[str, str], *, number: int, most_bytes: int
) -> Trial:
    """Run the pipeline on a disk that is full once a file has that many bytes."""
    process = pipeline.start(home, most_bytes=most_bytes)
    try:
        process.wait(300)
        return Trial(
            number=number,
            what="full disk",
            after=0.0,
            shards=len(hashes(pipeline.root)),
            wrong=len(wrong(pipeline.root, expected)),
            left=len(members(process.pid)),
            recovered=process.returncode == 0,
        )
    finally:
        kill_all(process.pid)
        process.wait(30)


def break_file(
    root: Path, expected: Mapping[str, str], rng: random.Random, *, number: int
) -> Trial:
    """Flip a byte of a file, cut it short or delete it; `check` must name it; make it good."""
    name = rng.choice([name for name in expected if name != "dataset.json"])
    file = root / name
    content = bytearray(file.read_bytes())
    how = rng.choice(["flip", "cut", "delete"])
    if how == "flip":
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        file.write_bytes(content)
    elif how == "cut":
        file.write_bytes(content[: rng.randrange(len(content))])
    else:
        file.unlink()
    named = [breach.file for breach in check(root, render=False)]
    for work in missing(root, named):
        for job in work.jobs:
            job.run()
        work.finish()
    return Trial(
        number=number,
        what=f"{how} {Path(name).parts[0]}",
        after=0.0,
        shards=len(expected),
        wrong=len(wrong(root, expected)),
        left=0,
        recovered=name in named,
    )


def wrong(root: Path, expected: Mapping[str, str]) -> list[str]:
    """Visible files that an undisturbed run has not, or not like this.

    dataset.json says which stages are finished, so it is only compared at the end.
    """
    return [
        name
        for name, found in hashes(root).items()
        if name != "dataset.json" and expected.get(name) != found
    ]


def lose_some(root: Path, expected: Mapping[str, str], rng: random.Random) -> None:
    """Delete about half of a finished dataset's files, so that there is work again."""
    for name in expected:
        if name != "dataset.json" and rng.random() < 0.5:
            (root / name).unlink(missing_ok=True)


def disturb(
    folder: Path,
    flags: Mapping[str, int],
    *,
    kills: int,
    seed: int,
    flows: bool,
    workers: int = 2,
    longest: float = 6.0,
    progress: Progress | None = None,
) -> list[Trial]:
    """Disturb the making of a small dataset that often, then complete it and compare.

    `flags` are settings of the smoke preset, like `train.on`. Every eighth disturbance is a full
    disk, every other eighth a broken file, the others are kills. Raises AssertionError when the
    completed dataset differs from an undisturbed one or breaks a contract.
    """
    from pydantic import TypeAdapter

    rng = random.Random(seed)
    settings = TypeAdapter(DatasetConfig)
    raw = settings.dump_python(DatasetConfig.smoke(), mode="json")
    for key, value in flags.items():
        place = raw
        *way, last = key.split(".")
        for step in way:
            place = place[step]
        place[last] = value
    config = settings.validate_python(raw)
    expected = undisturbed(folder / "calm", config)
    root, home = folder / "disturbed", folder / "home"
    pipeline = Pipeline(root, flags, workers=workers, flows=flows)
    plain = Pipeline(root, flags, workers=workers, flows=False)
    trials: list[Trial] = []
    while len(trials) < kills:
        number = len(trials) + 1
        if number % 8 == 4:
            plain.complete(home)
            trials.append(break_file(root, expected, rng, number=number))
            continue
        if root.exists() and hashes(root).keys() >= expected.keys():
            lose_some(root, expected, rng)
        if number % 8 == 0:
            most = 4_000  # bytes; less than any file of a shard has
            trials.append(fill_disk(plain, home, expected, number=number, most_bytes=most))
        else:
            made = kill_once(pipeline, home, expected, rng, number=number, longest=longest)
            trials += [made] if made else []
        if progress:
            progress(len(trials), kills)
    pipeline.complete(home)
    different = {
        name for name in {*expected, *hashes(root)} if hashes(root).get(name) != expected.get(name)
    }
    assert not different, f"expected the bytes of an undisturbed run, found others: {different}"
    leftovers = [str(file) for file in root.rglob(".*.tmp")]
    assert not leftovers, f"expected no half-made file to stay, found {leftovers}"
    breaches = check(root, render=False)
    assert not breaches, f"expected every contract to hold, found {breaches[0]}"
    return trials
