"""Export to the layout of Hugging Face `datasets`: Parquet with image bytes, and a card.

    OUT/README.md                              the card; its head names the files of each split
    OUT/scenes/train-00000-of-00004.parquet    one row a scene: image, mask, views, objects
    OUT/plans/train-00000-of-00004.parquet     one row a goal, failures too
    OUT/labels/train-00000-of-00004.parquet    one row an object of a plan that holds

`datasets.load_dataset("OUT", "scenes")` reads it; so does anything else that reads Parquet.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from relevance.store.dataset import Dataset
from relevance.store.files import SPLITS
from relevance.store.paths import DatasetError, absolute, is_remote, locate, replacing, writing
from relevance.store.tables import TABLES, table_schema

PICTURES = {"image": "scene.webp", "mask": "mask.png", "views": "views.webp"}
"""Columns of images, and the member of the tar that each is."""
_PICTURE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_ROWS = {
    schema.name: schema.exported
    for schema in sorted(map(table_schema, TABLES), key=lambda s: s.name != "scenes")
    if schema.exported
}
_HALF = ".half"
"""Where an export is made before it takes the place of an earlier one."""

Progress = Callable[[int, int], None]


def export(dataset: Dataset, out: str | Path, progress: Progress | None = None) -> Path:
    """Write a dataset's scenes, plans and labels for the `datasets` library; the folder's path.

    Every stored shard becomes one file; image bytes are the stored ones. Raises DatasetError
    when the folder holds anything else than an earlier export, or there are no scenes.
    """
    out = locate(out)
    if is_remote(out):
        raise DatasetError(f"{out}: expected a local folder to export to")
    if out.resolve().is_relative_to(dataset.path.resolve()):
        raise DatasetError(f"{out}: expected a folder outside the dataset {dataset.path}")
    with writing(out, out):
        if out.exists() and any(i.name not in {"README.md", _HALF, *_ROWS} for i in out.iterdir()):
            raise DatasetError(f"{out}: expected an empty folder or an earlier export")
    jobs = [
        (table, split, files)
        for table in _ROWS
        for split in _splits(dataset)
        if (files := dataset.files(table, split=split))
    ]
    if not any(table == "scenes" for table, _, _ in jobs):
        raise DatasetError(f"{dataset.path}: expected scenes to export, found none")
    half = out / _HALF
    shutil.rmtree(half, ignore_errors=True)
    try:
        rows = _write(dataset, half, jobs, progress)
        with replacing(half / "README.md") as temporary:
            temporary.write_text(_card(dataset, rows), encoding="utf-8")
        with writing(out, out):
            for name in (*_ROWS, "README.md"):
                if (out / name).is_dir():
                    shutil.rmtree(out / name)
                if (half / name).exists():
                    os.replace(half / name, out / name)
    finally:
        shutil.rmtree(half, ignore_errors=True)
    return out


def _write(
    dataset: Dataset,
    out: Path,
    jobs: list[tuple[str, str, list[Path]]],
    progress: Progress | None,
) -> dict[tuple[str, str], int]:
    """Write the files of each table and split; how many rows they have."""
    done, total = 0, sum(len(files) for _, _, files in jobs)
    rows: dict[tuple[str, str], int] = {}
    for table, split, files in jobs:
        for number, file in enumerate(files):
            body = dataset.read_file(file)
            if table == "scenes":
                body = _with_pictures(dataset, file, body)
            body = body.replace_schema_metadata(_features(table))
            target = out / table / f"{split}-{number:05d}-of-{len(files):05d}.parquet"
            with replacing(target) as temporary:
                pq.write_table(body, temporary, compression="zstd", row_group_size=10_000)
            rows[table, split] = rows.get((table, split), 0) + len(body)
            done += 1
            if progress:
                progress(done, total)
    return rows


def _splits(dataset: Dataset) -> list[str]:
    return [split for split in SPLITS if dataset.shards(split)]


def _with_pictures(dataset: Dataset, file: Path, body: pa.Table) -> pa.Table:
    keys = dataset.file_keys(file)
    content = dataset.read_images(keys["split"], keys["shard"])
    with tarfile.open(fileobj=io.BytesIO(content)) as tar:
        members = {member.name: member for member in tar.getmembers()}

        def picture(name: str) -> dict[str, bytes | str]:
            if name not in members:
                images = dataset.images_path(keys["split"], keys["shard"])
                raise DatasetError(f"{images}: expected member {name}, found none")
            stream = tar.extractfile(members[name])
            assert stream is not None, "members of an image tar are files"
            return {"bytes": stream.read(), "path": name}

        for column, member in PICTURES.items():
            pictures = [picture(f"{key}.{member}") for key in body["scene_id"].to_pylist()]
            body = body.append_column(column, pa.array(pictures, type=_PICTURE))
    return body


def _features(table: str) -> dict[str, str]:
    """What tells the `datasets` library that a column holds images."""
    if table != "scenes":
        return {}
    features = {column: {"_type": "Image"} for column in PICTURES}
    return {"huggingface": json.dumps({"info": {"features": features}})}


def _card(dataset: Dataset, rows: dict[tuple[str, str], int]) -> str:
    head = ["---", "license: mit", "task_categories:", "- robotics", "configs:"]
    for table in _ROWS:
        mine = [split for name, split in rows if name == table]
        if mine:
            head += [f"- config_name: {table}"]
            head += ["  default: true"] if table == "scenes" else []
            head += ["  data_files:"]
            for split in mine:
                head += [f"  - split: {split}", f"    path: {table}/{split}-*.parquet"]
    said = dataset.description
    lines = [
        *head,
        "---",
        "",
        f"# {absolute(dataset.path).name}",
        "",
        "Tabletop scenes, goals for a robot arm, the plans that a task-and-motion planner found,",
        "and which objects each plan has to move: the relevant ones.",
        "",
        "```python",
        "from datasets import load_dataset",
        "",
        'scenes = load_dataset("THIS FOLDER", "scenes", split="train")',
        'scenes[0]["image"]',
        "```",
        "",
        "`image` is the camera's picture, `mask` which object each pixel shows (0: none,",
        "i + 1: the i-th of `objects`), `views` one 32 x 32 picture of each object, side by side",
        "in their order. Lengths are metres, angles radians; `scene_id` and `plan_id` join tables.",
        "",
        "| rows | " + " | ".join(dict.fromkeys(split for _, split in rows)) + " |",
        "|---" * (1 + len({split for _, split in rows})) + "|",
    ]
    for table in _ROWS:
        counts = [str(rows.get((table, split), 0)) for split in dict.fromkeys(s for _, s in rows)]
        lines.append(f"| {table} | " + " | ".join(counts) + " |")
    labelling = dataset.labelling
    if labelling is not None:
        scenes = said.get("hashes", {}).get("scenes", "of several datasets")
        lines += [
            "",
            f"Planner version {labelling.planner}, label policy `{labelling.policy}`, plan",
            f"settings `{labelling.config}`, scene settings `{scenes}`.",
        ]
    for table, about in _ROWS.items():
        lines += ["", f"## {table}", "", about, "", "| column | type | unit | meaning |"]
        lines += ["|---|---|---|---|"]
        lines += [
            f"| {c.name} | `{c.type}` | {c.unit} | {c.meaning} |"
            for c in table_schema(table).columns
        ]
    return "\n".join(lines) + "\n"
