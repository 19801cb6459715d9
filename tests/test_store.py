"""Schemas, Parquet files, image tars and DuckDB views, on small hand-made scenes."""

from __future__ import annotations

import dataclasses
import io
import os
import re
import signal
import subprocess
import sys
import tarfile
import time
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from stored import KEYS, LABELS, fill, label_values, pictures, scene, scene_values

from relevance.scene import Box, Camera, Light, Robot, Table
from relevance.store import (
    SCHEMAS,
    TABLES,
    Dataset,
    DatasetError,
    differences,
    replacing,
    sql,
    table_schema,
    type_name,
)
from relevance.store.images import MEMBERS, undecoded


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset.create(tmp_path / "it's [1]*", {"config": {"seed": 0}})


# schemas ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", TABLES)
def test_schema_files_are_complete(table: str) -> None:
    raw = tomllib.loads((SCHEMAS / f"{table}.toml").read_text())
    assert raw["table"] == table
    assert isinstance(raw["version"], int)
    assert raw["description"].endswith(".")
    assert raw["path"].startswith(f"{table}/")
    schema = table_schema(table)
    assert schema.arrow.names == [column.name for column in schema.columns]
    assert len(set(schema.arrow.names)) == len(schema.columns)
    for column in schema.columns:
        assert column.meaning.endswith("."), column.name
        kind = schema.arrow.field(column.name).type
        while pa.types.is_list(kind):
            kind = kind.value_type
        inner = [field.name for field in kind] if pa.types.is_struct(kind) else []
        assert [field["name"] for field in column.fields] == inner, column.name
        assert all(field["meaning"] for field in column.fields)


def test_scene_schema_equals_the_domain_types() -> None:
    arrow = table_schema("scenes").arrow
    boxes = [field.name for field in arrow.field("objects").type.value_type]
    names = [field.name for field in dataclasses.fields(Box)]  # type: ignore[arg-type]
    assert boxes == [*names, "visible_pixels", "visible_fraction"]
    for column, kind in (
        ("table_top", Table),
        ("camera", Camera),
        ("light", Light),
        ("robot", Robot),
    ):
        fields = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
        assert [field.name for field in arrow.field(column).type] == fields


@pytest.mark.parametrize("table", TABLES)
def test_type_names_survive_duckdb(table: str) -> None:
    for column in table_schema(table).columns:
        found = type_name(table_schema(table).arrow.field(column.name).type)
        assert found == column.type.replace('"', "")


def test_unknown_table() -> None:
    with pytest.raises(DatasetError, match=r"unknown table 'nope', expected one of checkpoints, "):
        table_schema("nope")


# the folder ------------------------------------------------------------------------------------


def test_open_without_a_dataset(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nowhere: no dataset.json there, expected a dataset f"):
        Dataset.open(tmp_path / "nowhere")
    (tmp_path / "dataset.json").write_text("{broken")
    with pytest.raises(DatasetError, match=r"dataset.json: expected a JSON object"):
        Dataset.open(tmp_path)
    (tmp_path / "dataset.json").write_text('{"layout": 99}')
    with pytest.raises(DatasetError, match=r"dataset.json: layout: expected 1, found 99"):
        Dataset.open(tmp_path)


def test_create_twice(tmp_path: Path) -> None:
    Dataset.create(tmp_path, {"config": {"seed": 0, "planner": {"limit": 3}}})
    before = (tmp_path / "dataset.json").read_bytes()
    again = Dataset.create(tmp_path, {"config": {"planner": {"limit": 3}, "seed": 0}})
    assert again.description == {"config": {"seed": 0, "planner": {"limit": 3}}}
    assert (tmp_path / "dataset.json").read_bytes() == before
    with pytest.raises(DatasetError, match=r"config.planner.limit: .* made with 3, found 4"):
        Dataset.create(tmp_path, {"config": {"seed": 0, "planner": {"limit": 4}}})


def test_differences_name_the_key() -> None:
    found = list(differences({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}, "d": 4}))
    assert found == [("a.c", 2, 3), ("d", None, 4)]
    assert list(differences({"a": {"b": 1}}, {"a": {"b": 2}}, ignore=["a.b"])) == []


def test_paths_follow_the_layout(dataset: Dataset) -> None:
    def within(path: Path) -> str:
        return str(path.relative_to(dataset.path))

    assert within(dataset.shard_path("scenes", **KEYS)) == (
        "scenes/split=train/shard-000000.parquet"
    )
    assert within(dataset.shard_path("labels", split="test", shard=12, predicate="on")) == (
        "labels/predicate=on/split=test/shard-000012.parquet"
    )
    assert within(dataset.images_path("train", 3)) == "images/split=train/shard-000003.tar"
    with pytest.raises(DatasetError, match=r"expected predicate, split, shard.*found split, shard"):
        dataset.shard_path("plans", **KEYS)
    with pytest.raises(DatasetError, match=r"split 'tset': expected one of train, validation"):
        dataset.shard_path("scenes", split="tset", shard=0)
    with pytest.raises(DatasetError, match=r"name '../x'"):
        dataset.shard_path("checkpoints", name="../x")


# rows ------------------------------------------------------------------------------------------


def test_rows_come_back(dataset: Dataset) -> None:
    scenes = fill(dataset)
    rows = [scene_values(s, i) for i, s in enumerate(scenes)]
    assert dataset.read_rows("scenes") == rows
    assert dataset.read_rows("scenes", split="train", index=2) == rows[2:3]
    assert dataset.read_rows("scenes", split="test") == []
    assert dataset.has("scenes", **KEYS)
    assert not dataset.has("scenes", split="train", shard=1)
    assert dataset.shards("train") == [0]
    with pytest.raises(DatasetError, match="has no column 'colour'"):
        dataset.read_rows("scenes", colour="red")


def test_equal_rows_give_equal_bytes(dataset: Dataset, tmp_path: Path) -> None:
    fill(dataset)
    other = Dataset.create(tmp_path / "other", {})
    time.sleep(1.1)  # a clock in a header would show
    fill(other)
    for path in ("scenes/split=train/shard-000000.parquet", "images/split=train/shard-000000.tar"):
        assert (dataset.path / path).read_bytes() == (other.path / path).read_bytes(), path
    rows = dataset.read_rows("scenes")
    rows[0]["seed"] = 1
    changed = other.write_rows("scenes", rows, **KEYS)
    assert changed.read_bytes() != dataset.shard_path("scenes", **KEYS).read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": "first"}, r"column index: expected BIGINT, found .*'first'"),
        ({"n_objects": 2.5}, r"column n_objects: expected INTEGER, found"),
        ({"seed": None}, r"column seed: expected BIGINT, found null in row 1"),
        ({"colour": "red"}, r"row 1: column colour: not in schema scenes"),
        ({"robot": {"base": [0.0, 0.0, 0.0], "yaw": float("nan")}}, r"column robot.*NaN.*\(yaw\)"),
        ({"robot": {"yaw": 0.0}}, r"column robot: expected STRUCT.*null inside \(base\)"),
        ({"robot": {"base": [0.0, 0.0], "yaw": 0.0}}, r"column robot: expected STRUCT"),
        ({"robot": 3}, r"column robot: expected STRUCT"),
    ],
)
def test_bad_rows_are_refused(dataset: Dataset, change: dict, message: str) -> None:
    rows = [scene_values(scene(), 0), {**scene_values(scene(), 1), **change}]
    with pytest.raises(DatasetError, match=message) as caught:
        dataset.write_rows("scenes", rows, **KEYS)
    assert str(dataset.shard_path("scenes", **KEYS)) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not dataset.has("scenes", **KEYS)


def test_missing_key_is_null_only_where_null_is_allowed(dataset: Dataset) -> None:
    row = label_values(scene(), "red", True)
    del row["query"]
    with pytest.raises(DatasetError, match="column query: expected VARCHAR, found null in row 0"):
        dataset.write_rows("labels", [row], **LABELS)
    rows = [{**scene_values(scene(), 0)}]
    assert rows[0]["objects"][0]["on"] is None  # a nullable field of a struct
    dataset.write_rows("scenes", rows, **KEYS)


def test_a_write_that_fails_leaves_the_old_file(dataset: Dataset) -> None:
    fill(dataset)
    path = dataset.shard_path("scenes", **KEYS)
    before = path.read_bytes()
    with pytest.raises(DatasetError):
        dataset.write_rows("scenes", [{"scene_id": "x"}], **KEYS)

    def stop_half_way() -> None:
        with replacing(path) as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stop_half_way()
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_killed_writer_leaves_nothing_that_a_reader_sees(dataset: Dataset) -> None:
    fill(dataset)
    program = (
        "import sys, time\nfrom pathlib import Path\nfrom relevance.store import replacing\n"
        "with replacing(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_bytes(b'half')\n    print('ready', flush=True)\n    time.sleep(60)\n"
    )
    target = dataset.shard_path("scenes", split="train", shard=1)
    with subprocess.Popen(
        [sys.executable, "-c", program, str(target)], stdout=subprocess.PIPE
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"ready\n"
        writer.send_signal(signal.SIGKILL)
    left = [file for file in target.parent.iterdir() if file.suffix == ".tmp"]
    assert len(left) == 1, "the writer was killed while the temporary file was there"
    assert dataset.shards("train") == [0]
    with dataset.connect() as connection:
        assert connection.execute("SELECT count(*) FROM scenes").fetchone() == (4,)
    os.utime(left[0], (0, 0))
    Dataset.create(dataset.path, dataset.description)
    assert not left[0].exists(), "old temporary files are swept away"


def test_every_flipped_byte_is_noticed(dataset: Dataset) -> None:
    fill(dataset)
    path = dataset.shard_path("scenes", **KEYS)
    content = path.read_bytes()
    assert len(dataset.read_rows("scenes")) == 4
    for place in {*range(0, len(content), 61), *range(len(content) - 40, len(content))}:
        changed = bytearray(content)
        changed[place] ^= 0x04
        path.write_bytes(changed)
        with pytest.raises(DatasetError, match=re.escape(str(path))) as caught:
            dataset.read_rows("scenes")
        assert "\n" not in str(caught.value)


def broken_parquet(path: Path, how: str) -> None:
    content = pq.read_table(path)
    footer = {
        key.decode(): value.decode()
        for key, value in pq.read_metadata(path).metadata.items()
        if key.startswith(b"relevance.")
    }
    if how == "column":
        content = content.drop_columns(["seed"])
    elif how == "type":
        place = content.schema.get_field_index("seed")
        content = content.set_column(place, "seed", content["seed"].cast(pa.string()))
    elif how == "extra":
        content = content.append_column("note", pa.array(["x"] * len(content)))
    elif how == "version":
        footer["relevance.version"] = "99"
    elif how == "foreign":
        footer = {}
    with pq.ParquetWriter(path, content.schema) as writer:
        writer.write_table(content)
        writer.add_key_value_metadata(footer)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("column", r"column seed: expected BIGINT, found no such column"),
        ("type", r"column seed: expected BIGINT, found VARCHAR"),
        ("extra", r"column note: expected no such column, found VARCHAR"),
        (
            "version",
            r"version of the schema: expected 1 to \d+, found 99; it was made by",
        ),
        ("foreign", r"table of the schema: expected scenes, found none"),
        ("same", r"content hash: expected [0-9a-f]{16}, found [0-9a-f]{16}"),
    ],
)
def test_a_file_that_is_not_the_schemas(dataset: Dataset, how: str, message: str) -> None:
    fill(dataset)
    path = dataset.shard_path("scenes", **KEYS)
    broken_parquet(path, how)
    with pytest.raises(DatasetError, match=re.escape(str(path)) + ": " + message):
        dataset.read_rows("scenes")
    if how != "same":  # queries look at footers, not at every byte
        with pytest.raises(DatasetError, match=message):
            sql(dataset.path, "FROM scenes")


def test_truncated_and_missing_parquet(dataset: Dataset) -> None:
    fill(dataset)
    path = dataset.shard_path("scenes", **KEYS)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DatasetError, match=r"shard-000000.parquet: expected a whole Parquet file"):
        dataset.read_rows("scenes")
    path.unlink()
    with pytest.raises(DatasetError, match=r"shard-000000.parquet: .*(cannot be read|not exist)"):
        list(dataset.samples("train", [0]))


# images ----------------------------------------------------------------------------------------


def test_images_come_back_to_the_pixel(dataset: Dataset) -> None:
    scenes = fill(dataset)
    samples = list(dataset.samples("train"))
    assert [sample.key for sample in samples] == [s.id for s in scenes]
    for sample, expected in zip(samples, scenes, strict=True):
        stored = pictures(expected)
        assert sample.scene == expected
        np.testing.assert_array_equal(sample.image, stored.image)
        np.testing.assert_array_equal(sample.mask, stored.mask)
        np.testing.assert_array_equal(sample.views, stored.views)
    assert sample.views.shape == (3, 32, 32, 3)


def test_samples_of_some_shards_and_shuffled(dataset: Dataset) -> None:
    keys = {shard: [s.id for s in fill(dataset, shard)] for shard in range(3)}
    assert [s.key for s in dataset.samples("train", [2, 0])] == keys[2] + keys[0]
    everything = [key for shard in keys.values() for key in shard]
    orders = [[s.key for s in dataset.samples("train", shuffle_seed=seed)] for seed in (0, 0, 1, 2)]
    assert orders[0] == orders[1]
    assert len({tuple(order) for order in orders}) == 3
    assert all(sorted(order) == sorted(everything) for order in orders)
    assert all(order != everything for order in orders)


@pytest.mark.parametrize("size", [1000, 512 * 40, -512])
def test_truncated_tar(dataset: Dataset, size: int) -> None:
    fill(dataset)
    path = dataset.images_path("train", 0)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(DatasetError, match=r"shard-000000.tar: truncated: expected \d+ bytes"):
        list(dataset.samples("train"))


def test_changed_or_missing_tar(dataset: Dataset) -> None:
    fill(dataset)
    path = dataset.images_path("train", 0)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"shard-000000.tar: content hash: expected"):
        list(dataset.samples("train"))
    path.unlink()
    with pytest.raises(DatasetError, match=r"shard-000000.tar: cannot be read"):
        list(dataset.samples("train"))


def test_tar_members(dataset: Dataset) -> None:
    first = fill(dataset, count=1)[0]
    with tarfile.open(dataset.images_path("train", 0)) as tar:
        assert tar.getnames() == [
            f"{first.id}.{member}"
            for member in ("mask.png", "scene.json", "scene.webp", "views.webp")
        ]
        assert {(item.mtime, item.uid, item.gid, item.uname) for item in tar} == {(0, 0, 0, "")}


def test_webdataset_reads_the_same_members(dataset: Dataset) -> None:
    import webdataset

    scenes = fill(dataset)
    path = dataset.images_path("train", 0)
    theirs = list(webdataset.WebDataset(str(path), shardshuffle=False))
    ours = list(undecoded(path.read_bytes(), str(path)))
    assert [item["__key__"] for item in ours] == [scene.id for scene in scenes]
    assert all(set(item) == {"__key__", "__url__", *MEMBERS} for item in ours)
    assert [{k: item[k] for k in ("__key__", *MEMBERS)} for item in theirs] == [
        {k: item[k] for k in ("__key__", *MEMBERS)} for item in ours
    ]


def test_a_tar_that_is_not_ours() -> None:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        info = tarfile.TarInfo("s1.scene.json")
        info.size = 600
        tar.addfile(info, io.BytesIO(bytes(600)))
    good = content.getvalue()
    [item] = undecoded(good, "a.tar")
    assert item == {"__key__": "s1", "__url__": "a.tar", "scene.json": bytes(600)}
    for broken, message in (
        (good[:1000], "a.tar: s1.scene.json: expected 600 bytes, the tar ends before"),
        (good.replace(b"s1.scene.json", b"s1scenejson\0\0"), "a.tar: byte 0: expected the ustar"),
        (good.replace(b"ustar", b"gnu  "), "a.tar: byte 0: expected the ustar header"),
        (good[:124] + b"00000000999" + good[135:], "a.tar: byte 0: expected the ustar header"),
    ):
        with pytest.raises(DatasetError, match=re.escape(message)):
            list(undecoded(broken, "a.tar"))
