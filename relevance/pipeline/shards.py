"""How one shard of each kind is made, and which ones are finished.

A shard's file appears whole, last, by a rename; so a finished shard is one whose file is there,
and a re-run skips it. Scenes and images are made once (`generate_shard`); planning and
labelling read the stored scenes and never render (`label_shard`). Plans and labels that were
made otherwise than asked for now are kept beside the new ones.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from relevance.hashing import content_hash
from relevance.labels import (
    POLICIES,
    Verdict,
    label_rows,
    necessary,
    plan_row,
    scene_row,
    stored_scene,
    timing_row,
)
from relevance.pipeline.settings import (
    DatasetConfig,
    ShardReport,
    ShardSpec,
    refuse_merged,
    settings_of_family,
)
from relevance.planner import plan, warm_up
from relevance.sampling import SceneConfig, sample_goals, sample_scene
from relevance.scene import PREDICATES, Predicate, Scene, scene_to_json
from relevance.simulation import Renderer, Rendering, rejects, replay
from relevance.store import Dataset, DatasetError, Labelling, copy_file

ATTEMPTS = 1000
"""Draws of one scene before the settings count as impossible."""

Progress = Callable[[int, int], None]


class _Stopwatch:
    """Wall and processor seconds of this process since it was made."""

    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def read(self) -> dict[str, float]:
        return {
            "seconds": time.perf_counter() - self.wall,
            "seconds_cpu": time.process_time() - self.cpu,
        }


def generated(dataset: Dataset, spec: ShardSpec) -> bool:
    """Whether the scenes and images of a shard are there."""
    where: dict[str, Any] = {"split": spec.split, "shard": spec.shard}
    return dataset.has("scenes", **where) and dataset.images_path(**where).is_file()


def labelled(
    dataset: Dataset,
    config: DatasetConfig,
    spec: ShardSpec,
    predicate: Predicate | str,
    policy: str | None = None,
) -> bool:
    """Whether the labels of a shard are there, made by this config, planner and policy."""
    own = config.labelling
    where = _where(spec, predicate)
    if not _planned(dataset, own, where):
        return False
    aim = replace(own, policy=policy or own.policy)
    return _made_by(dataset, "labels", aim.made_by, where, None if aim == own else aim)


def generate_shard(
    root: str | Path,
    config: DatasetConfig,
    spec: ShardSpec,
    progress: Progress | None = None,
) -> ShardReport:
    """Draw and render the scenes of one shard; writes its tar, then its row file.

    Skips a finished shard. Raises DatasetError when the settings admit no scene.
    """
    dataset = Dataset.open(root)
    refuse_merged(dataset)
    if generated(dataset, spec):
        return ShardReport(spec=spec, predicate=None, skipped=True, rows=spec.count)
    _compile(_draw_one)
    watch = _Stopwatch()
    where: dict[str, Any] = {"split": spec.split, "shard": spec.shard}
    rows: list[dict[str, Any]] = []
    config_hash = config.scenes_hash

    def pictures(renderer: Renderer) -> Iterator[tuple[str, Rendering, str]]:
        for index in range(spec.first, spec.first + spec.count):
            scene, rendering, attempt = draw(config, spec, index, renderer)
            rows.append(
                scene_row(
                    scene,
                    rendering,
                    split=spec.split,
                    shard=spec.shard,
                    family=spec.family,
                    seed=config.seed,
                    index=index,
                    attempt=attempt,
                    config_hash=config_hash,
                )
            )
            yield scene.id, rendering, scene_to_json(scene)
            if progress:
                progress(len(rows), spec.count)

    with Renderer() as renderer:
        made = dataset.write_images(samples=pictures(renderer), **where)
    dataset.write_rows("scenes", rows, made_by=made, **where)
    taken = watch.read()
    _took(dataset, "scenes", spec, len(rows), taken)
    return ShardReport(
        spec=spec, predicate=None, skipped=False, rows=len(rows), seconds=taken["seconds"]
    )


def draw(
    config: DatasetConfig, spec: ShardSpec, index: int, renderer: Renderer
) -> tuple[Scene, Rendering, int]:
    """Scene `index` of a shard with its rendering, and how many draws were rejected before it."""
    settings = settings_of_family(config.scene, spec.family)
    reason = "no room"
    for attempt in range(ATTEMPTS):
        scene = sample_scene(
            settings, seed=config.seed, index=index, split=spec.split, attempt=attempt
        )
        if scene is None:
            continue
        rendering = renderer.render(scene)
        reason = rejects(rendering)
        if reason is None:
            return scene, rendering, attempt
    raise DatasetError(
        f"scene {index} of {spec.split}: no draw in {ATTEMPTS} was accepted (last: {reason}); "
        "expected scene settings that leave room for the boxes"
    )


def label_shard(
    root: str | Path,
    config: DatasetConfig,
    spec: ShardSpec,
    predicate: Predicate | str,
    progress: Progress | None = None,
    *,
    policy: str | None = None,
) -> ShardReport:
    """Plan the goals of one shard's stored scenes; writes timings, plans, then labels.

    Skips what was made with this config, planner version and policy; makes anything else anew
    and keeps the old files beside. `policy` asks for labels of another policy than the
    dataset's own, beside those. Raises DatasetError when the scenes are not there, ValueError
    for an unknown policy or a predicate of another family.
    """
    predicate = PREDICATES[str(predicate)]
    if predicate not in spec.predicates:
        raise ValueError(f"{predicate.name}: expected a predicate of family {spec.family}")
    own = config.labelling
    aim = replace(own, policy=policy or own.policy)
    if aim.policy not in POLICIES:
        raise ValueError(f"policy {aim.policy!r}: expected one of {', '.join(POLICIES)}")
    dataset = Dataset.open(root)
    refuse_merged(dataset)
    where = _where(spec, predicate)
    if labelled(dataset, config, spec, predicate, policy):
        rows = dataset.read_rows("plans", **where)
        return _labelling_report(spec, predicate, rows, skipped=True)
    scenes = {"split": spec.split, "shard": spec.shard}
    if not dataset.has("scenes", **scenes):
        file = dataset.shard_path("scenes", **scenes)
        raise DatasetError(f"{file}: does not exist, expected its scenes to be made first")
    _put_aside(dataset, own, where)
    _bring_back(dataset, own, where)
    if labelled(dataset, config, spec, predicate, policy):
        rows = dataset.read_rows("plans", **where)
        return _labelling_report(spec, predicate, rows, skipped=False)
    planned = _planned(dataset, own, where)
    if not planned or aim.policy == "necessary":
        _compile(warm_up)
    watch = _Stopwatch()
    rows = dataset.read_rows("scenes", **scenes)
    if planned:
        plans = dataset.read_rows("plans", **where)
    else:
        plans, timings = _plans(config, predicate, rows, progress)
        # Plans after timings and labels last: a finished plan file is never planned again.
        dataset.write_rows("timings", timings, made_by=own.planned_by, **where)
        dataset.write_rows("plans", plans, made_by=own.planned_by, **where)
    labels = list(_labels(config, aim.policy, rows, plans))
    of = None if aim == own else aim
    dataset.write_rows("labels", labels, made_by=aim.made_by, of=of, **where)
    taken = watch.read()
    if not planned:
        _took(dataset, predicate.name, spec, len(plans), taken)
    return _labelling_report(spec, predicate, plans, skipped=False, seconds=taken["seconds"])


def _labelling_report(
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
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    plans: list[dict[str, Any]] = []
    timings: list[dict[str, Any]] = []
    config_hash = config.plans_hash
    for done, row in enumerate(rows, 1):
        scene = stored_scene(row)
        share = config.test_replay_share if row["split"] == "test" else config.replay_share
        drawn_by, count = config.drawn_by, config.goals_per_scene
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


def _labels(
    config: DatasetConfig,
    policy: str,
    scenes: list[dict[str, Any]],
    plans: list[dict[str, Any]],
) -> Iterator[dict[str, Any]]:
    by_id = {row["scene_id"]: row for row in scenes}
    for row in plans:
        verdicts: Mapping[str, Verdict] | None = None
        if policy == "necessary" and row["holds"]:
            verdicts = necessary(stored_scene(by_id[row["scene_id"]]), row, config.planner)
        yield from label_rows(by_id[row["scene_id"]], row, policy, verdicts)


def _chosen(scene_id: str, goal: str, share: float) -> bool:
    """Whether a plan is among the replayed share: drawn by its task, so that order is nothing."""
    return int(content_hash(["replay", scene_id, goal])[:8], 16) < share * 2**32


# what is there ---------------------------------------------------------------------------------


def _where(spec: ShardSpec, predicate: Predicate | str) -> dict[str, Any]:
    return {"split": spec.split, "shard": spec.shard, "predicate": str(predicate)}


def _planned(dataset: Dataset, own: Labelling, where: dict[str, Any]) -> bool:
    return _made_by(dataset, "plans", own.planned_by, where) and dataset.has("timings", **where)


def _made_by(
    dataset: Dataset,
    table: str,
    expected: dict[str, str],
    where: dict[str, Any],
    of: Labelling | None = None,
) -> bool:
    file = dataset.shard_path(table, of=of, **where)
    try:
        found = dataset.metadata(file) if file.is_file() else None
    except DatasetError:
        return False  # cut short, or of an older schema: made anew
    return found is not None and all(found.get(key) == value for key, value in expected.items())


def _put_aside(dataset: Dataset, own: Labelling, where: dict[str, Any]) -> None:
    """Copy a shard's plans and labels that were made otherwise to their place beside."""
    for table in ("labels", "timings", "plans"):
        file = dataset.shard_path(table, **where)
        with suppress(DatasetError):  # what cannot be read is not worth keeping
            made = dataset.metadata(file) if file.is_file() else {}
            policy = made.get("policy") if table == "labels" else own.policy
            if policy is None or not {"planner", "config"} <= set(made):
                continue
            old = Labelling(planner=made["planner"], config=made["config"], policy=policy)
            if old != own and not dataset.has(table, of=old, **where):
                copy_file(file, dataset.shard_path(table, of=old, **where))


def _bring_back(dataset: Dataset, own: Labelling, where: dict[str, Any]) -> None:
    """Take plans and labels that were made like this before from their place beside."""
    beside = [t for t in ("timings", "plans", "labels") if dataset.has(t, of=own, **where)]
    if _planned(dataset, own, where):
        beside = [table for table in beside if table == "labels"]
    elif "plans" not in beside or "timings" not in beside:
        return
    for table in beside:
        file = dataset.shard_path(table, of=own, **where)
        dataset.read_file(file)  # raises for one that was changed
        copy_file(file, dataset.shard_path(table, **where))


def _took(
    dataset: Dataset, stage: str, spec: ShardSpec, rows: int, taken: dict[str, float]
) -> None:
    row = {"stage": stage, "split": spec.split, "shard": spec.shard, "rows": rows, **taken}
    dataset.write_rows("durations", [row], stage=stage, split=spec.split, shard=spec.shard)


@cache
def _compile(kernels: Callable[[], None]) -> None:
    """Compile kernels, or load them; on each machine the first process does it for all."""
    file = Path(tempfile.gettempdir()) / f"relevance-{os.getuid()}-compile.lock"
    with file.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_SH)  # until the first one is done; then all go on
            fcntl.flock(lock, fcntl.LOCK_UN)
        kernels()


def _draw_one() -> None:
    """Draw and render a scene, for what is compiled on the way."""
    drawn = (sample_scene(SceneConfig(), seed=0, index=index) for index in range(ATTEMPTS))
    with Renderer() as renderer:
        renderer.render(next(scene for scene in drawn if scene is not None))
