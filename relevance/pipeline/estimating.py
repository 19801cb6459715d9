"""What a dataset will cost: rows, bytes and hours, from a sample that is really made.

The sample is made in a temporary folder with the dataset's own settings, by as many processes
at a time as will make the dataset, so that the measured rates are those of a busy machine.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from relevance.pipeline.labelling import label_shard
from relevance.pipeline.preparing import prepare
from relevance.pipeline.scenes import generate_shard
from relevance.pipeline.settings import (
    Counts,
    DatasetConfig,
    ShardReport,
    ShardSpec,
    shard_specs,
)
from relevance.scene import FAMILIES, group_of
from relevance.store import SPLITS, Dataset, DatasetError, empty_size, locate, replacing, sql

FILE = "estimate.json"
"""Within the dataset; it tells of a machine and a day, so it is no part of the promised bytes."""

Job = tuple[Callable[..., ShardReport], tuple[Any, ...]]
Run = Callable[[Sequence[Job]], Sequence[ShardReport]]
"""Makes units of work, one after the other or several at a time."""

_BYTES = ("images", "scenes", "plans", "timings", "labels", "durations")


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantities:
    """How much a dataset holds and took."""

    scenes: int
    goals: int
    plans: int
    """Goals with a plan that holds."""
    labels: int
    """Rows, goal objects included."""
    gigabytes: float
    """Of 1e9 bytes."""
    hours_scenes: float
    """Busy hours of one process, drawing and rendering."""
    hours_labels: float
    """Busy hours of one process, planning and replaying."""

    @property
    def hours(self) -> float:
        """Busy hours of one process in all."""
        return self.hours_scenes + self.hours_labels


@dataclass(frozen=True, slots=True, kw_only=True)
class Queries:
    """How many queries of a predicate a split will have, goal objects left out."""

    group: str
    """The predicate, or the family that borrows it (`scene.group_of`)."""
    split: str
    scenes: int
    relevant: int
    irrelevant: int

    @property
    def share(self) -> float:
        """Relevant among all."""
        return self.relevant / max(self.relevant + self.irrelevant, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What was foreseen for a config, and from how much."""

    quantities: Quantities
    queries: tuple[Queries, ...] = ()
    """By predicate, family and split."""
    workers: int
    """Processes at a time, in the sample and later."""
    sample_scenes: int
    sample_goals: int
    uncertainty: float
    """Two standard errors of the planning time, as a share of it."""
    config_hash: str
    """Of the settings that it is for."""

    def write(self, root: str | Path) -> None:
        """Keep it beside the dataset, to be compared with what came of it."""
        with replacing(locate(root) / FILE) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def read(cls, root: str | Path) -> Estimate | None:
        """The estimate that was kept with a dataset; None when there is none.

        Raises DatasetError for a file that says something else.
        """
        file = locate(root) / FILE
        if not file.is_file():
            return None
        try:
            raw = json.loads(file.read_text(encoding="utf-8"))
            queries = tuple(Queries(**row) for row in raw["queries"])
            return cls(**{**raw, "quantities": Quantities(**raw["quantities"]), "queries": queries})
        except (ValueError, TypeError, LookupError) as error:
            found = f"found something else ({type(error).__name__}: {error})"
            raise DatasetError(
                f"{file}: expected an estimate as `relevance estimate` keeps it, {found}; delete it"
            ) from None


def _one_by_one(jobs: Sequence[Job]) -> list[ShardReport]:
    return [stage(*arguments) for stage, arguments in jobs]


def estimate(
    config: DatasetConfig, *, sample: int = 32, workers: int = 1, run: Run = _one_by_one
) -> Estimate:
    """Make a sample of that many scenes a family, and say what the whole of `config` will cost.

    Of that many a predicate, where each has its own. Goals of the test split are replayed more
    often than others, so a part of the sample is of that split. Nothing of it is kept.
    """
    if config.mined is not None:
        raise DatasetError("a mined dataset: expected settings by which scenes are drawn at random")
    split_sizes = {"train": sample - sample // 4, "validation": 0, "test": sample // 4}
    families = [f for f in FAMILIES if any(config.counts(split).of(f) for split in SPLITS)]
    counts = {s: Counts.by_family(dict.fromkeys(families, n)) for s, n in split_sizes.items()}
    # several units of work a process, so that all processes are busy nearly to the end
    size = max(1, math.ceil(split_sizes["train"] / (2 * workers)))
    small = replace(config, scenes_per_shard=size, **counts)
    with tempfile.TemporaryDirectory(prefix="relevance-estimate-") as folder:
        specs = prepare(folder, small)
        run([(generate_shard, (folder, small, spec)) for spec in specs])
        pairs = [(spec, predicate) for spec in specs for predicate in spec.predicates]
        run([(label_shard, (folder, small, spec, predicate)) for spec, predicate in pairs])
        rates = {
            (family, split): _Rates.measured(folder, specs, family, split)
            for family in FAMILIES
            for split in ("train", "test")
        }
        planned = shard_specs(config)
        queries = _queries(folder, specs, planned)
        _, [[mean, deviation, scenes]] = sql(
            folder,
            "select avg(s), stddev_samp(s), count(*) from (select scene_id, sum(seconds) as s"
            " from timings join plans using (plan_id) group by scene_id)",
        )
    total = _Rates()
    for family in FAMILIES:
        for split in SPLITS:
            mine = [s for s in planned if (s.split, s.family) == (split, family)]
            rate = rates[family, "test" if split == "test" else "train"]
            total += rate.times(sum(spec.count for spec in mine)).with_files(mine)
    return Estimate(
        quantities=Quantities(
            scenes=round(total.scenes),
            goals=round(total.goals),
            plans=round(total.plans),
            labels=round(total.labels),
            gigabytes=total.bytes / 1e9,
            hours_scenes=total.seconds_scenes / 3600,
            hours_labels=total.seconds_labels / 3600,
        ),
        queries=queries,
        workers=workers,
        sample_scenes=int(scenes),
        sample_goals=round(sum(rate.goals for rate in rates.values())),
        uncertainty=2 * deviation / math.sqrt(scenes) / mean if scenes > 1 and mean else 1.0,
        config_hash=config.content_hash,
    )


def _queries(
    root: str | Path, sample: Sequence[ShardSpec], planned: Sequence[ShardSpec]
) -> tuple[Queries, ...]:
    """What the labels of a sample come to in the splits of the whole."""
    _, rows = sql(
        root,
        "select split, shard, predicate, count(*), count_if(relevant) from labels"
        " where not is_goal_object group by all",
    )
    found = {(split, shard, predicate): counts for split, shard, predicate, *counts in rows}
    asked = {(s.family, predicate.name): None for s in planned for predicate in s.predicates}
    made = []
    for family, predicate in asked:
        drawn = [s for s in sample if _asks(s, family, predicate)]
        counts = [found.get((s.split, s.shard, predicate), (0, 0)) for s in drawn]
        queries, relevant = (sum(column) for column in zip(*counts, strict=True))
        for split in SPLITS:
            mine = [s for s in planned if s.split == split and _asks(s, family, predicate)]
            scenes = sum(s.count for s in mine)
            factor = scenes / sum(s.count for s in drawn)
            made.append(
                Queries(
                    group=group_of(predicate, family),
                    split=split,
                    scenes=scenes,
                    relevant=round(relevant * factor),
                    irrelevant=round((queries - relevant) * factor),
                )
            )
    return tuple(made)


def _asks(spec: ShardSpec, family: str, predicate: str) -> bool:
    return spec.family == family and predicate in (p.name for p in spec.predicates)


def actual(root: str | Path) -> Quantities:
    """What a dataset holds and took; shards whose time is not known count as the others' mean."""
    dataset = Dataset.open(root)
    _, [[scenes, goals, plans, labels]] = sql(
        root,
        "select (select count(*) from scenes), (select count(*) from plans),"
        " (select count(*) from plans where holds), (select count(*) from labels)",
    )
    _, rows = sql(
        root, "select stage = 'scenes', sum(seconds), sum(rows) from durations group by all"
    )
    seconds = {is_scenes: (taken, made) for is_scenes, taken, made in rows}

    def hours(is_scenes: bool, made: int) -> float:
        taken, known = seconds.get(is_scenes, (0.0, 0))
        return taken / 3600 * (made / known if known else 0.0)

    return Quantities(
        scenes=scenes,
        goals=goals,
        plans=plans,
        labels=labels,
        gigabytes=sum(_sizes(dataset).values()) / 1e9,
        hours_scenes=hours(True, scenes),
        hours_labels=hours(False, goals),
    )


def _sizes(dataset: Dataset, **where: Any) -> dict[str, int]:
    """Bytes of each part of a dataset."""
    sizes = {
        table: sum(file.stat().st_size for file in dataset.files(table, **where))
        for table in _BYTES[1:]
    }
    tars = [dataset.file_keys(file) for file in dataset.files("scenes", **where)]
    images = [dataset.images_path(keys["split"], keys["shard"]) for keys in tars]
    return {"images": sum(file.stat().st_size for file in images if file.is_file()), **sizes}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rates:
    """Sums over some scenes; divided by their number, rates."""

    scenes: float = 0
    goals: float = 0
    plans: float = 0
    labels: float = 0
    bytes: float = 0
    """Without what each file takes however few rows it has."""
    seconds_scenes: float = 0
    seconds_labels: float = 0

    @classmethod
    def measured(cls, root: str, specs: Sequence[ShardSpec], family: str, split: str) -> _Rates:
        dataset = Dataset.open(root)
        mine = [spec for spec in specs if (spec.split, spec.family) == (split, family)]
        listed = ", ".join(str(spec.shard) for spec in mine) or "-1"
        some = f"where split = '{split}' and shard in ({listed})"
        _, [[scenes, goals, plans, labels]] = sql(
            root,
            f"select (select count(*) from scenes {some}), (select count(*) from plans {some}),"
            f" (select count(*) from plans {some} and holds),"
            f" (select count(*) from labels {some})",
        )
        _, [[seconds_scenes, seconds_labels]] = sql(
            root,
            "select coalesce(sum(seconds) filter (stage = 'scenes'), 0),"
            f" coalesce(sum(seconds) filter (stage <> 'scenes'), 0) from durations {some}",
        )
        sizes = [_sizes(dataset, split=split, shard=spec.shard) for spec in mine]
        return cls(
            scenes=scenes,
            goals=goals,
            plans=plans,
            labels=labels,
            bytes=sum(sum(size.values()) for size in sizes) - _overhead(mine),
            seconds_scenes=seconds_scenes,
            seconds_labels=seconds_labels,
        )

    def times(self, scenes: int) -> _Rates:
        """What that many scenes come to."""
        factor = scenes / self.scenes if self.scenes else 0.0
        return _Rates(**{name: value * factor for name, value in asdict(self).items()})

    def with_files(self, specs: Sequence[ShardSpec]) -> _Rates:
        """With what the files of those shards take by themselves."""
        return replace(self, bytes=self.bytes + _overhead(specs))

    def __add__(self, other: _Rates) -> _Rates:
        mine, more = asdict(self), asdict(other)
        return _Rates(**{name: mine[name] + more[name] for name in mine})


def _overhead(specs: Sequence[ShardSpec]) -> int:
    once = empty_size("scenes") + empty_size("durations")
    each = sum(empty_size(table) for table in ("plans", "timings", "labels", "durations"))
    return sum(once + len(spec.predicates) * each for spec in specs)
