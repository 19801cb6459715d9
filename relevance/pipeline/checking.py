"""Whether a dataset keeps its contracts.

`check` reads every byte: hashes and schemas of all files, the rules of `schemas/checks.sql`
between rows, and what SQL cannot say (a scene is possible and is what its id says, a plan's
last poses fulfil its goal, a stored scene renders again to equal pixels).
"""

from __future__ import annotations

import contextlib
import io
import re
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from relevance.labels import stored_scene
from relevance.pipeline.mining import leaks, mined_of
from relevance.pipeline.settings import ShardSpec, shards_of
from relevance.pipeline.upkeep import integrity, refused
from relevance.scene import (
    Pose,
    Scene,
    SceneError,
    goal_holds,
    scene_from_json,
)
from relevance.simulation import Renderer
from relevance.store import (
    MEMBERS,
    SCHEMAS,
    TABLES,
    Dataset,
    DatasetError,
    altered,
    table_schema,
)

PER_RULE = 20
"""Breaches of one rule that are listed; the rest is counted."""
IN_MEMORY = 100_000_000
"""Bytes of Parquet up to which `check` copies the tables before it queries them."""

_STRAY = "expected the name of a shard, found another; nothing reads it: move or delete it"

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breach:
    """One broken contract."""

    file: str
    """Within the dataset."""
    row: int | None = None
    """From 0; None when it is about the whole file."""
    column: str | None = None
    message: str

    def __str__(self) -> str:
        row = None if self.row is None else f"row {self.row}"
        column = None if self.column is None else f"column {self.column}"
        return ": ".join(part for part in (self.file, row, column, self.message) if part)


def check(
    root: str | Path,
    *,
    render: bool = True,
    strict: bool = False,
    progress: Progress | None = None,
) -> list[Breach]:
    """Every contract of a dataset; an empty list when it keeps them all.

    `render` renders one scene of each shard again and compares pixels. `strict` names files of
    older schema versions too, which are read with nulls for younger columns. Raises DatasetError
    only when there is no dataset at all.
    """
    dataset = Dataset.open(root)
    if dataset.sources:
        return _merged(dataset, render, strict, progress)
    breaches = list(_description(dataset))
    found = (*integrity(dataset), *altered(dataset))
    breaches += [Breach(file=file, message=message) for file, message in found]
    files = [file for table in TABLES for file in dataset.files(table)]
    files += dataset.files_beside()
    breaches += [Breach(file=_name(dataset, file), message=_STRAY) for file in dataset.strays()]
    unreadable: set[Path] = set()
    odd: set[Path] = set()
    for done, file in enumerate(files, 1):
        try:
            found = list(_file(dataset, file, dataset.read_file(file)))
            if strict:
                found += _version(dataset, file)
        except DatasetError as error:
            found = [_unreadable(dataset, file, error)]
            unreadable.add(file)
        breaches += found
        if found:
            odd.add(file)
        if progress:
            progress(done, len(files))
    # Every row that refers to an unreadable file would look wrong: leave its shard out.
    left_out = {file for file in files for bad in unreadable if _same_shard(dataset, file, bad)}
    breaches += _rules(dataset, left_out)
    whole = [file for file in dataset.files("scenes") if file not in odd]
    breaches += _scenes(dataset, whole, render)
    breaches += _goals(dataset, left_out)
    if not unreadable and (problem := refused(dataset)):
        breaches.append(Breach(file="plans", column="replay_ok", message=problem))
    return breaches


def _merged(
    dataset: Dataset, render: bool, strict: bool, progress: Progress | None
) -> list[Breach]:
    """Every contract of a merged dataset: those of its sources, and those between them."""
    breaches: list[Breach] = []
    for source in dataset.sources:
        there = source.dataset
        for breach in check(there.path, render=render, strict=strict, progress=progress):
            name = dataset.name_of(there.path / breach.file)
            breaches.append(replace(breach, file=name))
    # a file that cannot be read stops every query; it has been named
    if breaches:
        return breaches
    copied = [Breach(file=file, message=message) for file, message in leaks(dataset)]
    return copied + list(_rules(dataset, set()))


def _description(dataset: Dataset) -> Iterator[Breach]:
    specs: list[ShardSpec] = []
    try:
        mined_of(dataset)
        specs = shards_of(dataset)
    except DatasetError as error:
        yield Breach(file="dataset.json", message=_message(dataset, error))
    listed = {(spec.split, spec.shard) for spec in specs}
    for table in ("scenes", "plans", "timings", "labels"):
        for file in dataset.files(table):
            keys = dataset.file_keys(file)
            if specs and (keys.get("split"), keys.get("shard")) not in listed:
                yield Breach(
                    file=_name(dataset, file),
                    message="expected a shard that dataset.json lists, found none such",
                )


def _unreadable(dataset: Dataset, file: Path, error: DatasetError) -> Breach:
    text = _message(dataset, error)
    column = re.match(r"column (\w+): ", text)
    return Breach(
        file=_name(dataset, file),
        column=column[1] if column else None,
        message=text[column.end() :] if column else text,
    )


def _version(dataset: Dataset, file: Path) -> Iterator[Breach]:
    stored = dataset.metadata(file)
    expected = str(table_schema(stored["table"]).version)
    if stored["version"] != expected:
        yield Breach(
            file=_name(dataset, file),
            message=f"expected version {expected} of the schema, found {stored['version']}",
        )


def _file(dataset: Dataset, file: Path, body: Any) -> Iterator[Breach]:
    """What one readable file shows by itself: made with the dataset's settings; its tar."""
    name = _name(dataset, file)
    table = name.split("/")[0]
    description = dataset.description
    expected = {
        "scenes": {"config_hash": description.get("hashes", {}).get("scenes")},
        "plans": {
            "config_hash": description.get("hashes", {}).get("plans"),
            "planner_version": description.get("planner_version"),
        },
    }
    for column, value in {**expected.get(table, {})}.items():
        for row, found in enumerate(body[column].to_pylist()):
            if value is not None and found != value:
                yield Breach(
                    file=name,
                    row=row,
                    column=column,
                    message=f"expected {value} as in dataset.json, found {found}",
                )
                break
    if table == "scenes":
        try:
            tar = dataset.read_images(**_where(dataset, file))
        except DatasetError as error:
            text = str(error)
            images = dataset.images_path(**_where(dataset, file))
            mine = text.startswith(str(images))
            yield Breach(
                file=_name(dataset, images if mine else file),
                message=_message(dataset, error),
            )
            return
        ids = body["scene_id"].to_pylist()
        with tarfile.open(fileobj=io.BytesIO(tar)) as archive:
            members = archive.getnames()
        wanted = [f"{key}.{member}" for key in ids for member in MEMBERS]
        if members != wanted:
            odd = next(iter({*wanted} ^ {*members}), "another order")
            yield Breach(
                file=_name(dataset, dataset.images_path(**_where(dataset, file))),
                message=f"expected the {len(wanted)} members of {len(ids)} scenes, "
                f"found {len(members)} ({odd})",
            )


def _rules(dataset: Dataset, left_out: set[Path]) -> Iterator[Breach]:
    """The breaches of every rule of `schemas/checks.sql`."""
    partial = any(file.relative_to(dataset.path).parts[0] == "scenes" for file in left_out)
    size = sum(file.stat().st_size for table in TABLES for file in dataset.files(table))
    with dataset.connect(origin=True, without=left_out, memory=size < IN_MEMORY) as connection:
        for rule, query in rules().items():
            if partial and rule.startswith("predictions"):
                continue  # their scenes may be among those left out
            found = connection.execute(f"FROM ({query}) ORDER BY ALL").fetchall()
            for file, row, column, message in found[:PER_RULE]:
                yield Breach(file=file, row=row, column=column, message=message)
            if len(found) > PER_RULE:
                more = len(found) - PER_RULE
                yield Breach(file=found[PER_RULE][0], message=f"and {more} more rows: {rule}")


def rules() -> dict[str, str]:
    """The rules between rows, by name, as queries (file, row, column, message)."""
    parts = re.split(r"^-- rule: (.*)$", (SCHEMAS / "checks.sql").read_text(), flags=re.MULTILINE)
    return {
        name: query.strip().rstrip(";")
        for name, query in zip(parts[1::2], parts[2::2], strict=True)
    }


def _scenes(dataset: Dataset, files: list[Path], render: bool) -> Iterator[Breach]:
    """Every scene is possible and what its id says; one a shard renders to equal pixels."""
    for file in files:
        name = _name(dataset, file)
        scenes: dict[str, Scene] = {}
        for row, values in enumerate(dataset.read_file(file).to_pylist()):
            try:
                scene = stored_scene(values, where="")
            except SceneError as error:
                yield Breach(file=name, row=row, column="objects", message=str(error))
                continue
            if scene.id != values["scene_id"]:
                yield Breach(
                    file=name,
                    row=row,
                    column="scene_id",
                    message=f"expected {scene.id}, the hash of the row, found {values['scene_id']}",
                )
            scenes[values["scene_id"]] = scene
        where = _where(dataset, file)
        images = _name(dataset, dataset.images_path(**where))
        with tarfile.open(fileobj=io.BytesIO(dataset.read_images(**where))) as archive:
            for key, scene in scenes.items():
                member = archive.extractfile(f"{key}.scene.json")
                if member is None or scene_from_json(member.read()).objects != scene.objects:
                    yield Breach(
                        file=images, message=f"{key}.scene.json: expected the scene of its row"
                    )
        if render and scenes:
            yield from _pixels(dataset, where, images)


def _pixels(dataset: Dataset, where: dict[str, Any], images: str) -> Iterator[Breach]:
    sample = next(dataset.samples(where["split"], [where["shard"]]))
    with Renderer() as renderer:
        again = renderer.render(sample.scene)
    for member in ("image", "mask", "views"):
        stored, rendered = getattr(sample, member), getattr(again, member)
        if not np.array_equal(stored, rendered):
            yield Breach(
                file=images,
                message=f"{sample.key}: {member}: expected equal pixels when rendered again, "
                "found others",
            )


def _goals(dataset: Dataset, left_out: set[Path]) -> Iterator[Breach]:
    """The last poses of every plan that holds fulfil its goal."""
    for file in dataset.files("plans"):
        keys = dataset.file_keys(file)
        scenes_file = dataset.shard_path("scenes", split=keys["split"], shard=keys["shard"])
        if file in left_out or not scenes_file.is_file():
            continue
        scenes = dict(_possible(dataset.read_file(scenes_file).to_pylist()))
        for row, plan in enumerate(dataset.read_file(file).to_pylist()):
            if not plan["holds"] or plan["scene_id"] not in scenes:
                continue
            scene = scenes[plan["scene_id"]]
            final = {
                item["name"]: Pose(position=tuple(item["position"]), yaw=item["yaw"], on=item["on"])
                for item in plan["final"]
            }
            try:
                goal = scene.goal(f"{plan['predicate']}({plan['subject']}, {plan['reference']})")
            except SceneError as error:
                yield Breach(
                    file=_name(dataset, file), row=row, column="subject", message=str(error)
                )
                continue
            fulfilled = goal_holds(scene.moved(final), goal, scene.robot)
            if not fulfilled:
                yield Breach(
                    file=_name(dataset, file),
                    row=row,
                    column="final",
                    message=f"expected {goal} to be true of the last poses, found that it is not",
                )


def _possible(rows: list[dict[str, Any]]) -> Iterator[tuple[str, Scene]]:
    for row in rows:
        with contextlib.suppress(SceneError):  # reported with the scenes
            yield row["scene_id"], stored_scene(row)


def _same_shard(dataset: Dataset, a: Path, b: Path) -> bool:
    if a == b:
        return True
    first, second = dataset.file_keys(a), dataset.file_keys(b)
    return (first.get("split"), first.get("shard")) == (second.get("split"), second.get("shard"))


def _where(dataset: Dataset, file: Path) -> dict[str, Any]:
    keys = dataset.file_keys(file)
    return {"split": keys["split"], "shard": keys["shard"]}


def _name(dataset: Dataset, file: Path) -> str:
    return str(file.relative_to(dataset.path))


def _message(dataset: Dataset, error: DatasetError) -> str:
    """The error without the file's name, which a Breach says by itself."""
    return re.sub(rf"^{re.escape(str(dataset.path))}/?[^:]*: ", "", str(error))
