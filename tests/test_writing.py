"""Where nothing can be written: one line, and nothing half-written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from stored import LABELS, fill, label_values

from relevance.store import Dataset, DatasetError, compact, export, replacing


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = Dataset.create(tmp_path / "dataset", {})
    rows = [label_values(scene, "red", True) for scene in fill(made)]
    made.write_rows("labels", rows, made_by={"policy": "found"}, **LABELS)
    return made


def contents(root: Path) -> dict[str, bytes]:
    return {str(f.relative_to(root)): f.read_bytes() for f in root.rglob("*") if f.is_file()}


def test_a_file_where_a_folder_belongs(dataset: Dataset, tmp_path: Path) -> None:
    before = contents(dataset.path)
    file = tmp_path / "file"
    file.write_text("mine")
    for act in (
        lambda: Dataset.create(file, {}),
        lambda: Dataset.create(file / "within", {}),
        lambda: export(dataset, file),
        lambda: export(dataset, file / "within"),
        lambda: Dataset.open(file),
    ):
        with pytest.raises(DatasetError, match=str(file)) as caught:
            act()
        assert "\n" not in str(caught.value)
    (dataset.path / "compacted").write_text("mine")
    with pytest.raises(DatasetError, match=r"compacted.*cannot be written"):
        compact(dataset)
    (dataset.path / "compacted").unlink()
    assert contents(dataset.path) == before
    assert contents(tmp_path)["file"] == b"mine"


FULL = """
import resource, sys
from relevance.store import Dataset, DatasetError, compact, export
dataset = Dataset.open(sys.argv[1])
rows = dataset.read_rows("scenes")
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))  # no file takes more, as on a full disk
for act in (
    lambda: dataset.write_rows("scenes", rows, split="train", shard=5),
    lambda: compact(dataset),
    lambda: export(dataset, sys.argv[2]),
):
    try:
        act()
    except DatasetError as error:
        print(str(error).count(chr(10)), error)
"""


def test_a_full_disk_leaves_nothing_half_written(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "out")
    before, exported = contents(dataset.path), contents(tmp_path / "out")
    arguments = [sys.executable, "-c", FULL, str(dataset.path), str(tmp_path / "out")]
    said = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [line[:2] for line in said] == ["0 "] * 3
    assert all("cannot be written" in line for line in said)
    assert contents(dataset.path) == before
    assert contents(tmp_path / "out") == exported


def test_an_error_of_what_is_read_is_no_error_of_writing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "target"):
        (tmp_path / "nowhere").read_bytes()
