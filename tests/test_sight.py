"""What seeing costs: one network is told what another one sees."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import pytest
import torch
from ruled import ruled

from relevance.benchmarks import sight
from relevance.benchmarks.sight import PARTS, TOLD, measure_sight
from relevance.cli import main
from relevance.networks import GEOMETRY
from relevance.store import Dataset
from relevance.training import (
    Catalogue,
    CheckpointError,
    Reader,
    TrainConfig,
    load_checkpoint,
    measure,
    train,
)

torch.set_num_threads(1)
CONFIG = replace(TrainConfig.smoke(), steps=2, threads=1, workers=0)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(copytree(ruled(), tmp_path_factory.mktemp("sight") / "dataset"))


@pytest.fixture(scope="module")
def eyes(root: Path) -> str:
    return train(root, CONFIG).stem


@pytest.fixture(scope="module")
def mind(root: Path) -> str:
    return train(root, CONFIG.with_body("geometry")).stem


def test_told_what_is_there_it_is_itself(root: Path, eyes: str, mind: str) -> None:
    measured = measure_sight(root, sees=eyes, told=mind, split="train", scenes=1000)
    model, meta = load_checkpoint(root / "checkpoints" / f"{mind}.pt")
    config = TrainConfig.from_dict(meta["config"])
    catalogue = Catalogue.of(Dataset.open(root), "train", config)
    whole = Reader(catalogue=catalogue, config=config, pictures=False).whole()
    own = measure(model, whole, meta["offsets"])
    there = {row.group: row for row in measured.rows if row.told == "what is there"}
    assert there
    for group, row in there.items():
        assert row.total == pytest.approx(own[group]["queries"]["total"])
        assert row.relevant == own[group]["queries"]["relevant"] > 0
    assert {row.told for row in measured.rows} == {"shown pictures", *TOLD}


def test_perfect_eyes_cost_nothing(
    root: Path, eyes: str, mind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sight, "_seen", lambda model, batch: batch.geometry)
    measured = measure_sight(root, sees=eyes, told=mind, split="train", scenes=4)
    told = [row for row in measured.rows if row.told != "shown pictures"]
    assert len({(row.group, row.total, row.auc) for row in told}) == len(told) / len(TOLD)
    _, distances = measured.tables
    assert {value for row in distances.rows for value in row[1:]} == {"0.00"}


def test_parts_are_all_of_a_geometry() -> None:
    places = [place for part in PARTS.values() for place in range(GEOMETRY)[part]]
    assert places == [*range(GEOMETRY)]


def test_who_cannot_see_or_be_told_is_refused(root: Path, eyes: str, mind: str) -> None:
    with pytest.raises(CheckpointError, match="body geometry, expected one that sees where obj"):
        measure_sight(root, sees=mind, told=mind, split="train")
    with pytest.raises(CheckpointError, match="body glimpse, expected one that is told where obj"):
        measure_sight(root, sees=eyes, told=eyes, split="train")


def test_the_command(
    root: Path, eyes: str, mind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["bench", "sight", str(root), "--sees", eyes, "--told", mind, "--scenes", "2"]
    assert main([*asked, "--split", "test", "--out", str(tmp_path)]) == 2
    assert "no labels of split test" in capsys.readouterr().err
    assert main([*asked, "--split", "train", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "all as it is seen" in printed
    assert "along the view (x)" in printed
    with (tmp_path / "sight.csv").open() as file:
        assert len([*csv.DictReader(file)]) > len(TOLD)
