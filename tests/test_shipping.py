"""Models that come with the package: made by one command, half as large, found by name."""

from __future__ import annotations

import tomllib
from pathlib import Path
from shutil import copytree

import pytest
import torch
from ruled import ruled

import relevance
from relevance.cli import main
from relevance.evaluation import NetworkScorer
from relevance.networks import GraphNetwork
from relevance.training import (
    CheckpointError,
    TrainConfig,
    find_checkpoint,
    load_checkpoint,
    ship,
    shipped,
)
from relevance.training.shipping import command

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(copytree(ruled(), tmp_path_factory.mktemp("shipping") / "dataset"))


def test_shipped_models_are_halved_and_say_how_they_are_made(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--preset", "smoke", "--model.body", "geometry", "--steps", "2", "--no-mirror"]
    assert main(["ship", str(root), *flags, "--out", str(tmp_path / "m"), "--name", "mine"]) == 0
    path = Path(capsys.readouterr().out.strip())
    assert path == tmp_path / "m" / "mine.pt"
    model, meta = load_checkpoint(path, "cpu")
    whole, known = load_checkpoint(find_checkpoint(root, meta["checkpoint_id"]), "cpu")
    assert path.stat().st_size < 0.75 * find_checkpoint(root, meta["checkpoint_id"]).stat().st_size
    for name, weight in whole.state_dict().items():
        torch.testing.assert_close(model.state_dict()[name], weight.half().float())
    assert "history" not in meta
    calibration = meta.pop("calibration")
    assert calibration["needs"]
    assert {key: meta[key] for key in meta} == {key: known[key] for key in meta}
    page = path.with_suffix(".md").read_text()
    config = TrainConfig.from_dict(meta["config"])
    made = command(config, root, "mine")
    assert made == f"relevance ship {root} {' '.join(flags)} --name mine"
    assert made.startswith(f"{command(config, root, 'geometry')} ")
    assert all(part in page for part in (made, meta["dataset_hash"], "| same-plane |"))


def test_trained_models_are_not_trained_again(root: Path, tmp_path: Path) -> None:
    config = TrainConfig.smoke().with_body("geometry")
    first = ship(root, config, tmp_path / "a")
    before = first.read_bytes()
    steps: list[int] = []
    again = ship(root, config, tmp_path / "a", progress=lambda done, total: steps.append(done))
    assert again == first == tmp_path / "a" / "geometry.pt"
    assert again.read_bytes() == before
    assert steps == []


@pytest.mark.parametrize(
    ("name", "body"), [("glimpse", "glimpse"), ("crowd", "glimpse"), ("geometry", "geometry")]
)
def test_models_that_ship_are_found_by_name(name: str, body: str, root: Path) -> None:
    guide = relevance.load_guide(name)
    assert isinstance(guide.scorer, NetworkScorer)
    assert isinstance(guide.scorer.model, GraphNetwork)
    assert guide.scorer.model.body_name == body
    assert find_checkpoint(root, name) == shipped()[name]
    assert find_checkpoint(root, guide.scorer.checkpoint_id) == shipped()[name]
    assert shipped()[name].with_suffix(".md").exists()


def test_what_ships_is_small_and_in_the_wheel() -> None:
    assert sum(file.stat().st_size for file in shipped().values()) < 8e6
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = settings["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"data/models": "relevance/shipped"}


def test_a_file_comes_before_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("geometry").write_text("mine")
    with pytest.raises(CheckpointError, match="geometry: not a checkpoint"):
        load_checkpoint("geometry")
    with pytest.raises(CheckpointError, match="no-such: no such file"):
        load_checkpoint("no-such")
