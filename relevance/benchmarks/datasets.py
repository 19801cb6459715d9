"""How fast datasets are made, read and asked, and what they survive: `relevance bench dataset`.

Rates are of this machine as it is now; the tables say how many processor seconds and how many
wall seconds they rest on.
"""

from __future__ import annotations

import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from relevance.benchmarks.crashes import Trial, disturb
from relevance.benchmarks.runs import Measured, Progress
from relevance.pipeline import (
    Counts,
    DatasetConfig,
    ShardSpec,
    generate_shard,
    label_shard,
    prepare,
)
from relevance.report.tables import Table
from relevance.sampling import sample_goals
from relevance.scene import PREDICATES
from relevance.store import Dataset, compact, decode, sql, synthetic_labels
from relevance.training import Catalogue, Reader, TrainConfig, Trainer

SCENES_A_SECOND = 60.0
"""Wanted of one core, without planning, 320 x 192."""
GOALS_A_SECOND = 70.0
"""Wanted of one core."""
TWO_OVER_ONE = 1.85
"""Wanted of two processes over one."""
READING_SHARE = 0.5
"""Wanted of the reader that trains, labels and batches included, over decoding alone."""
WAITING_SHARE = 0.05
"""Most of its time that a trainer should wait for data."""
PROCESSES = 2
"""How many are measured against one."""
READING_ROUNDS, QUERY_ROUNDS = 15, 3
"""How often each is timed; the best counts."""
QUERY_SECONDS = 1.0
"""Wanted of the label balance of 50 million rows."""
FEWER = ("s", "of the time")
"""Units of which less is better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """One measured rate and what was wanted."""

    what: str
    value: float
    unit: str
    wanted: float | None
    count: int
    seconds: float
    """Wall."""
    seconds_cpu: float | None

    @property
    def reached(self) -> bool | None:
        """Whether it is what was wanted; of `FEWER` less is better, of everything else more."""
        if self.wanted is None:
            return None
        return self.value <= self.wanted if self.unit in FEWER else self.value >= self.wanted


def measure_making(
    folder: Path, *, scenes: int, seed: int, progress: Progress | None = None
) -> Measured:
    """Scenes and labelled goals a second of one core, and of several processes over one.

    Each process makes a small shard first, so that nothing is compiled or loaded in the time
    that counts. Settings are those of the laptop preset. How much several processes do of plain
    arithmetic, which shares neither memory nor files, tells what this machine has to give.
    """
    nothing = {"validation": Counts(), "test": Counts()}
    preset = replace(DatasetConfig.laptop(), seed=seed, **nothing)
    whole = PROCESSES * preset.scenes_per_shard  # shards as the preset has them: each starts anew
    drawn = replace(preset, train=Counts(same_plane=whole, on=whole))
    planned = replace(
        preset,
        train=Counts(same_plane=scenes, on=scenes),
        scenes_per_shard=max(1, scenes // (8 * PROCESSES)),  # short, so that all end at once
    )
    rates: list[Rate] = []
    stages: dict[str, tuple[Callable[[Any], tuple[int, float]], list[Any]]] = {}
    for processes in (1, PROCESSES):
        roots = [folder / f"{what}-by-{processes}" for what in ("drawn", "planned")]
        with _pool(processes, folder / f"warm-{processes}", planned) as pool:
            first, second = (
                [(root, config, spec) for spec in prepare(root, config)]
                for root, config in zip(roots, (drawn, planned), strict=True)
            )
            list(pool.map(_make, [(*job, None) for job in second]))
            stages = {
                "sums": (_add_up, [10_000_000] * 16),
                "scenes": (_make, [(*job, None) for job in first]),
                "goals": (_make, [(*job, p.name) for job in second for p in job[2].predicates]),
            }
            for stage, (work, jobs) in stages.items():
                start = time.perf_counter()
                made: list[tuple[int, float]] = []
                for done, result in enumerate(pool.map(work, jobs), 1):
                    made.append(result)
                    if progress:
                        progress(done, len(jobs))
                wall = time.perf_counter() - start
                rows, cpu = sum(n for n, _ in made), sum(seconds for _, seconds in made)
                wanted = {"scenes": SCENES_A_SECOND, "goals": GOALS_A_SECOND}.get(stage)
                rates.append(
                    Rate(
                        what=f"{stage}, {processes} process" + "es" * (processes > 1),
                        value=rows / (cpu if processes == 1 else wall),
                        unit=f"{stage} a core second" if processes == 1 else f"{stage} a second",
                        wanted=wanted if processes == 1 else None,
                        count=rows,
                        seconds=wall,
                        seconds_cpu=cpu,
                    )
                )
    half = len(rates) // 2
    for stage, one, several in zip(stages, rates[:half], rates[half:], strict=True):
        rates.append(
            Rate(
                what=f"{stage}, {PROCESSES} processes over 1",
                value=one.seconds / several.seconds,
                unit="times",
                wanted=TWO_OVER_ONE if stage != "sums" else None,
                count=one.count,
                seconds=one.seconds + several.seconds,
                seconds_cpu=None,
            )
        )
    return _measured("making", "Making", rates)


def measure_reading(folder: Path, *, seed: int) -> Measured:
    """The reader that trains against decoding alone, and how long a trainer waits for it.

    One shard of the laptop preset, made for the purpose, labelled anyhow. Decoding alone has the
    bytes of the scenes in memory already; the reader opens shards and labels, checks their
    hashes, takes samples apart, shuffles, decodes and makes batches, in one process: scenes a
    processor second, the best of a few rounds each, taken in turns. A trainer then takes the
    steps of the demo preset from it, as `train` does, with a worker that reads ahead.
    """
    preset = DatasetConfig.laptop()
    counts = {"train": Counts(on=preset.scenes_per_shard), "validation": Counts(), "test": Counts()}
    config = replace(preset, seed=seed, **counts)
    split, root = "train", folder / "read"
    for spec in prepare(root, config):
        generate_shard(root, config, spec)
    dataset = Dataset.open(root)
    _label_anyhow(dataset, split, config.goals_per_scene)
    items = [item for shard in dataset.shards(split) for item in dataset.undecoded(split, shard)]
    demo = replace(TrainConfig.demo(), seed=seed, steps=len(items) // 4)
    catalogue = Catalogue.of(dataset, split, demo)
    reader = Reader(catalogue=catalogue, config=demo)
    alone, read = [], []
    for _ in range(READING_ROUNDS):
        start = time.process_time()
        for item in items:
            decode(item)
        alone.append(time.process_time() - start)
        start = time.process_time()
        found = sum(len(batch.names) for step in reader.steps() for batch in step)
        read.append(time.process_time() - start)
        assert found == len(items) // 4 * 4, f"expected {len(items)} samples, read {found}"
    trainer = Trainer(demo, catalogue.predicates)
    with closing(replace(reader, workers=1).steps()) as steps:
        for _ in range(demo.steps):
            trainer.take(steps)
    unit = "scenes a core second"
    rates = [
        _rate("decoding alone", len(items), min(alone), unit=unit),
        _rate("the reader that trains", found, min(read), unit=unit),
        Rate(
            what="reader over decoding",
            value=min(alone) / min(read) * found / len(items),
            unit="times",
            wanted=READING_SHARE,
            count=len(items),
            seconds=sum(alone) + sum(read),
            seconds_cpu=None,
        ),
        _rate("trained on, demo preset", found, trainer.seconds, unit="scenes a second"),
        Rate(
            what="waiting for data",
            value=trainer.waited / trainer.seconds,
            unit="of the time",
            wanted=WAITING_SHARE,
            count=found,
            seconds=trainer.seconds,
            seconds_cpu=None,
        ),
    ]
    return _measured("reading", "Reading", rates)


def _label_anyhow(dataset: Dataset, split: str, goals: int) -> None:
    """As many rows as labelling makes, without a plan: the first object is relevant to all."""
    for shard in dataset.shards(split):
        rows = [
            {
                "plan_id": f"{sample.key}-{goal}",
                "scene_id": sample.key,
                "split": split,
                "shard": shard,
                "predicate": goal.predicate.name,
                "subject": goal.subject,
                "reference": goal.reference,
                "query": box.name,
                "relevant": box is sample.scene.objects[0],
                "is_goal_object": box.name in (goal.subject, goal.reference),
                "ambiguous": False,
                "policy": "found",
                "visible_fraction": 1.0,
                "planner_version": "none",
                "config_hash": "none",
            }
            for sample in dataset.samples(split, [shard])
            for goal in sample_goals(sample.scene, PREDICATES["on"], goals, seed=0)
            for box in sample.scene.objects
        ]
        dataset.write_rows("labels", rows, split=split, shard=shard, predicate="on")


def measure_queries(
    folder: Path, *, rows: int, shards: int, progress: Progress | None = None
) -> Measured:
    """The label balance over synthetic rows, from small shards and from gathered files.

    Times include opening the dataset and making its views, as `relevance sql` does.
    """
    root = folder / "synthetic"
    start = time.perf_counter()
    dataset = synthetic_labels(root, rows, shards=shards, progress=progress)
    rates = [_rate("rows written", rows, time.perf_counter() - start, unit="rows a second")]

    def ask() -> tuple[float, Any]:
        found, seconds = None, []
        for _ in range(QUERY_ROUNDS):
            start = time.perf_counter()
            found = sql(root, "from label_balance")
            seconds.append(time.perf_counter() - start)
        return min(seconds), found

    seconds, before = ask()
    files = len(dataset.files("labels"))
    rates.append(_took(f"label balance, {files} shards", rows, seconds, None))
    start = time.perf_counter()
    compact(dataset)
    rates.append(_rate("rows gathered", rows, time.perf_counter() - start, unit="rows a second"))
    seconds, after = ask()
    assert after == before, "gathered rows answer as the shards do"
    wanted = QUERY_SECONDS if rows >= 50_000_000 else None
    rates.append(_took("label balance, gathered", rows, seconds, wanted))
    return _measured("queries", "Queries", rates)


def measure_crashes(
    folder: Path, *, kills: int, seed: int, flows: bool = True, progress: Progress | None = None
) -> Measured:
    """Kill, fill and break that often; see `disturb`, which raises when a byte is lost."""
    flags = {
        "train.same_plane": 8,
        "train.on": 16,
        "validation.same_plane": 0,
        "validation.on": 0,
        "test.same_plane": 0,
        "test.on": 4,
        "scenes_per_shard": 2,
        "goals_per_scene": 1,
    }
    trials = disturb(folder, flags, kills=kills, seed=seed, flows=flows, progress=progress)
    return Measured(name="crashes", rows=tuple(trials), tables=(_crash_table(trials),))


def _crash_table(trials: Sequence[Trial]) -> Table:
    kinds = Counter(trial.what for trial in trials)
    rows = [
        (
            what,
            count,
            sum(t.wrong for t in trials if t.what == what),
            sum(t.left for t in trials if t.what == what),
            sum(t.recovered for t in trials if t.what == what),
        )
        for what, count in sorted(kinds.items())
    ]
    rows.append(
        (
            "all",
            len(trials),
            sum(trial.wrong for trial in trials),
            sum(trial.left for trial in trials),
            sum(trial.recovered for trial in trials),
        )
    )
    return Table(
        name="crashes",
        title="Disturbed, then completed to the bytes of an undisturbed run",
        columns=("what", "times", "wrong files seen", "processes left", "recovered or named"),
        rows=tuple(rows),
    )


def _make(job: tuple[Path, DatasetConfig, ShardSpec, str | None]) -> tuple[int, float]:
    """Rows and processor seconds of one unit of work."""
    root, config, spec, predicate = job
    start = time.process_time()
    if predicate is None:
        report = generate_shard(root, config, spec)
    else:
        report = label_shard(root, config, spec, predicate)
    return report.rows, time.process_time() - start


def _warm(job: tuple[Path, DatasetConfig]) -> None:
    folder, config = job
    root = folder / multiprocessing.current_process().name
    few = replace(config, train=Counts(same_plane=1, on=1), scenes_per_shard=1)
    for spec in prepare(root, few):
        generate_shard(root, few, spec)
        for predicate in spec.predicates:
            label_shard(root, few, spec, predicate)
    time.sleep(1.0)  # so that no process takes the work of another


def _add_up(terms: int) -> tuple[int, float]:
    start, total = time.process_time(), 0
    for term in range(terms):
        total += term
    return terms, time.process_time() - start


def _pool(processes: int, folder: Path, config: DatasetConfig) -> ProcessPoolExecutor:
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))
    list(pool.map(_warm, [(folder, config)] * processes))
    return pool


def _rate(what: str, count: int, seconds: float, unit: str) -> Rate:
    return Rate(
        what=what,
        value=count / seconds,
        unit=unit,
        wanted=None,
        count=count,
        seconds=seconds,
        seconds_cpu=None,
    )


def _took(what: str, count: int, seconds: float, wanted: float | None) -> Rate:
    return Rate(
        what=what,
        value=seconds,
        unit="s",
        wanted=wanted,
        count=count,
        seconds=seconds,
        seconds_cpu=None,
    )


def _measured(name: str, title: str, rates: Sequence[Rate]) -> Measured:
    columns = ("what", "value", "unit", "wanted", "reached", "count", "wall s", "core s")
    rows = tuple(
        (r.what, r.value, r.unit, r.wanted, r.reached, r.count, r.seconds, r.seconds_cpu)
        for r in rates
    )
    table = Table(name=name, title=title, columns=columns, rows=rows)
    return Measured(name=name, rows=tuple(rates), tables=(table,))
