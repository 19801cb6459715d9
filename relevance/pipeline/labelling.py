"""Plans and labels: how those of one shard and predicate are made, and which are finished.

Planning and labelling read the stored scenes and never render. What is made with the labelling
that dataset.json names is in place, everything else is beside; so readers of what is in place
see one labelling, whatever is under way.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from relevance.errors import RelevanceError
from relevance.hashing import content_hash
from relevance.labels import POLICIES, label_rows, plan_row, stored_scene, timing_row
from relevance.pipeline.measuring import Progress, Stopwatch, compiled, took
from relevance.pipeline.mining import Mined, mined_of
from relevance.pipeline.preparing import set_aside
from relevance.pipeline.settings import DatasetConfig, ShardReport, ShardSpec, refuse_merged
from relevance.planner import plan, warm_up
from relevance.sampling import sample_goals
from relevance.scene import PREDICATES, Predicate
from relevance.simulation import replay
from relevance.store import Dataset, DatasetError, Labelling


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shard:
    """The files of one shard and predicate."""

    dataset: Dataset
    spec: ShardSpec
    predicate: str

    @property
    def where(self) -> dict[str, Any]:
        """What names its files."""
        return {
            "split": self.spec.split,
            "shard": self.spec.shard,
            "predicate": self.predicate,
        }

    def place(self, table: str, way: Labelling) -> Path:
        """Where a table of a labelling is: in place if it is the dataset's own, else beside."""
        own = self.dataset.labelling
        mine = own is not None and (
            way == own or (table != "labels" and way.planned_by == own.planned_by)
        )
        return self.dataset.shard_path(table, of=None if mine else way, **self.where)

    def planned(self, way: Labelling) -> bool:
        """Whether its plans of that labelling are there, and their timings."""
        there = self.place("timings", way).is_file()
        return there and self.made("plans", way, way.planned_by)

    def labelled(self, way: Labelling) -> bool:
        """Whether its labels of that labelling are there, and the plans that they are read from."""
        return self.planned(way) and self.made("labels", way, way.made_by)

    def made(self, table: str, way: Labelling, expected: Mapping[str, str]) -> bool:
        """Whether a file is there that says it was made like that."""
        file = self.place(table, way)
        try:
            found = self.dataset.metadata(file) if file.is_file() else {}
        except DatasetError:
            return False  # cut short: made anew
        return all(found.get(key) == value for key, value in expected.items())

    def write(self, table: str, rows: Sequence[Mapping[str, Any]], way: Labelling) -> None:
        """Write a table to its place as dataset.json has it now; what is there is kept beside."""
        now = replace(self, dataset=Dataset.open(self.dataset.path))
        file = now.place(table, way)
        beside = file == now.dataset.shard_path(table, of=way, **self.where)
        if not beside and file.is_file():
            set_aside(now.dataset, table, file, way)
        made_by = way.made_by if table == "labels" else way.planned_by
        of = way if beside else None
        now.dataset.write_rows(table, rows, made_by=made_by, of=of, **self.where)


def labelled(
    dataset: Dataset,
    config: DatasetConfig,
    spec: ShardSpec,
    predicate: Predicate | str,
    policy: str | None = None,
) -> bool:
    """Whether the labels of a shard are there, made by this config, planner and policy."""
    way = replace(config.labelling, policy=policy or config.policy)
    return labelled_as(dataset, way, spec, predicate)


def labelled_as(
    dataset: Dataset, way: Labelling, spec: ShardSpec, predicate: Predicate | str
) -> bool:
    """Whether the labels of a shard are there, made by this labelling."""
    return _Shard(dataset=dataset, spec=spec, predicate=str(predicate)).labelled(way)


def label_shard(
    root: str | Path,
    config: DatasetConfig,
    spec: ShardSpec,
    predicate: Predicate | str,
    progress: Progress | None = None,
    *,
    policy: str | None = None,
    anew: Collection[str] = (),
) -> ShardReport:
    """Plan the goals of one shard's stored scenes; writes timings, plans, then labels.

    Skips what was made with this config, planner version and policy, but for the tables that are
    to be made `anew`. What is not the dataset's own labelling lies beside: labels of another
    `policy`, and plans of other settings until `finish` finds them complete. Raises DatasetError
    when the scenes are not there, RelevanceError for an unknown policy or a predicate of another
    family.
    """
    predicate = PREDICATES[str(predicate)]
    if predicate not in spec.predicates:
        names = ", ".join(p.name for p in spec.predicates)
        raise RelevanceError(f"{predicate.name}: expected one that is asked there, {names}")
    by = POLICIES[policy or config.policy]
    dataset = Dataset.open(root)
    refuse_merged(dataset)
    way = config.labelling
    shard = _Shard(dataset=dataset, spec=spec, predicate=predicate.name)
    if labelled(dataset, config, spec, predicate, policy) and not anew:
        rows = dataset.read_file(shard.place("plans", way)).to_pylist()
        return _report(spec, predicate, rows, skipped=True)
    scenes = {"split": spec.split, "shard": spec.shard}
    if not dataset.has("scenes", **scenes):
        file = dataset.shard_path("scenes", **scenes)
        raise DatasetError(f"{file}: does not exist, expected its scenes to be made first")
    planned = shard.planned(way) and not {"plans", "timings"} & {*anew}
    if not planned or by.plans:
        compiled(warm_up)
    watch = Stopwatch()
    rows = dataset.read_rows("scenes", **scenes)
    if planned:
        plans = dataset.read_file(shard.place("plans", way)).to_pylist()
    else:
        plans, timings = _plans(config, predicate, rows, progress, mined_of(dataset, config))
        # Plans after timings and labels last: a finished plan file is never planned again.
        shard.write("timings", timings, way)
        shard.write("plans", plans, way)
    by_id = {row["scene_id"]: row for row in rows}
    aim = replace(way, policy=policy or way.policy)
    labels = [
        label
        for row in plans
        for label in label_rows(by_id[row["scene_id"]], row, aim.policy, config.planner)
    ]
    shard.write("labels", labels, aim)
    taken = watch.read()
    if not planned:
        took(dataset, predicate.name, spec, len(plans), taken)
    return _report(spec, predicate, plans, skipped=False, seconds=taken["seconds"])


def _report(
    spec: ShardSpec,
    predicate: Predicate,
    plans: list[dict[str, Any]],
    *,
    skipped: bool,
    seconds: float = 0.0,
) -> ShardReport:
    return ShardReport(
        spec=spec,
        predicate=predicate.name,
        skipped=skipped,
        rows=len(plans),
        holds=sum(row["holds"] for row in plans),
        seconds=seconds,
    )


def _plans(
    config: DatasetConfig,
    predicate: Predicate,
    rows: list[dict[str, Any]],
    progress: Progress | None,
    mined: Mined | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    plans: list[dict[str, Any]] = []
    timings: list[dict[str, Any]] = []
    config_hash = config.plans_hash
    for done, row in enumerate(rows, 1):
        scene = stored_scene(row)
        share = config.test_replay_share if row["split"] == "test" else config.replay_share
        drawn_by, count = config.drawn_by, config.goals_per_scene
        if mined is not None:
            goals = mined.goals(config, scene, predicate, row["index"])
        else:
            goals = sample_goals(scene, predicate, count, seed=drawn_by, config=config.goals)
        for goal in goals:
            result = plan(scene, goal, config=config.planner, replay=False)
            verdict, seconds = None, None
            if result.status == "solved" and _chosen(scene.id, str(goal), share):
                started = time.perf_counter()
                verdict = replay(scene, goal, result.phases)
                seconds = time.perf_counter() - started
            plans.append(
                plan_row(
                    scene,
                    row["split"],
                    row["shard"],
                    result,
                    verdict,
                    config_hash=config_hash,
                )
            )
            timings.append(timing_row(plans[-1], result, seconds_replay=seconds))
        if progress:
            progress(done, len(rows))
    return plans, timings


def _chosen(scene_id: str, goal: str, share: float) -> bool:
    """Whether a plan is among the replayed share: drawn by its task, so that order is nothing."""
    return int(content_hash(["replay", scene_id, goal])[:8], 16) < share * 2**32
