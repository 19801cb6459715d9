"""Small hand-made scenes, pictures and rows, for tests of the store."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from relevance.scene import Box, Scene, scene_to_json
from relevance.store import Dataset
from relevance.store.parquet import to_parquet
from relevance.store.tables import TableSchema, table_schema


@dataclass(frozen=True)
class Pictures:
    image: np.ndarray
    mask: np.ndarray
    views: np.ndarray


def scene(x: float = 0.0) -> Scene:
    return Scene(
        objects=(
            Box(name="red", size=(0.06, 0.06, 0.08), position=(x, 0.1, 0.04), color=(1, 0, 0)),
            Box(
                name="blue",
                size=(0.05, 0.05, 0.05),
                position=(x, 0.1, 0.105),
                color=(0, 0, 1),
                on="red",
            ),
            Box(name="green", size=(0.05, 0.05, 0.05), position=(x, -0.1, 0.025), color=(0, 1, 0)),
        )
    )


def pictures(of: Scene) -> Pictures:
    rng = np.random.default_rng(int(of.id[:8], 16))
    n = len(of.objects)
    return Pictures(
        image=rng.integers(0, 256, (192, 320, 3), dtype=np.uint8),
        mask=rng.integers(0, n + 1, (192, 320), dtype=np.uint8),
        views=rng.integers(0, 256, (n, 32, 32, 3), dtype=np.uint8),
    )


def scene_values(of: Scene, index: int, split: str = "train", shard: int = 0) -> dict:
    def plain(value: object) -> dict:
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}  # type: ignore[arg-type]

    return {
        "scene_id": of.id,
        "split": split,
        "shard": shard,
        "family": "same-plane",
        "seed": 0,
        "index": index,
        "attempt": 0,
        "n_objects": len(of.objects),
        "objects": [
            {**plain(box), "visible_pixels": 90, "visible_fraction": 0.9} for box in of.objects
        ],
        "table_top": plain(of.table),
        "camera": plain(of.camera),
        "light": plain(of.light),
        "robot": plain(of.robot),
        "config_hash": "c",
        "sampler_version": "1",
        "renderer_version": "1",
    }


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def label_values(of: Scene, query: str, relevant: bool, **more: object) -> dict:
    return {
        "plan_id": f"p{of.id}",
        "scene_id": of.id,
        "split": "train",
        "shard": 0,
        "predicate": "behind",
        "subject": "red",
        "reference": "green",
        "query": query,
        "relevant": relevant,
        "is_goal_object": query != "blue",
        "ambiguous": False,
        "policy": "found",
        "visible_fraction": 0.9,
        "planner_version": "1",
        "config_hash": "c",
        **more,
    }


KEYS = {"split": "train", "shard": 0}
LABELS = {**KEYS, "predicate": "behind"}


def fill(dataset: Dataset, shard: int = 0, count: int = 4) -> list[Scene]:
    scenes = [scene(0.01 * (count * shard + i)) for i in range(count)]
    made = dataset.write_images(
        "train", shard, ((s.id, pictures(s), scene_to_json(s)) for s in scenes)
    )
    rows = [scene_values(s, i, shard=shard) for i, s in enumerate(scenes)]
    dataset.write_rows("scenes", rows, split="train", shard=shard, made_by=made)
    return scenes


def plan_values(of: Scene, **more: object) -> dict:
    """A plan that moves `red`."""
    return {
        "plan_id": f"p{of.id}",
        "scene_id": of.id,
        "split": "train",
        "shard": 0,
        "predicate": "behind",
        "subject": "red",
        "reference": "green",
        "status": "solved",
        "reason": "",
        "actions": [["pick", "red"], ["place", "red", "table"]],
        "moved": ["red"],
        "final": [{"name": "red", "position": [0.0, 0.0, 0.04], "yaw": 0.0, "on": None}],
        "n_actions": 2,
        "cost": 1.0,
        "ambiguous": False,
        "nodes": 1,
        "pose_checks": 1,
        "keyframe_nlps": 1,
        "path_nlps": 1,
        "check_ok": True,
        "max_penetration": 0.0,
        "holds": True,
        "planner_version": "1",
        "config_hash": "c",
        **more,
    }


def aged(path: Path, *, without: tuple[str, ...]) -> None:
    """Make a file one of version 1 of its schema, whole and with its hash."""
    table = pq.read_table(path).drop_columns(list(without))
    footer = {
        key.decode().removeprefix("relevance."): value.decode()
        for key, value in pq.read_metadata(path).metadata.items()
        if key.startswith(b"relevance.")
    }
    if "table_top" in table.column_names:
        place = table.column_names.index("table_top")
        kind = pa.struct([f for f in table.schema.field(place).type if f.name != "texture"])
        rows = [{f.name: row[f.name] for f in kind} for row in table[place].to_pylist()]
        table = table.set_column(place, "table_top", pa.array(rows, type=kind))
    schema = table_schema(footer.pop("table"))
    values = {field.name: getattr(schema, field.name) for field in dataclasses.fields(TableSchema)}
    old = TableSchema(**{**values, "version": 1, "arrow": table.schema.remove_metadata()})
    made_by = {key: value for key, value in footer.items() if key not in ("version", "sha256")}
    path.write_bytes(to_parquet(old, table.cast(old.arrow), made_by, path))
