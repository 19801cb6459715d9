"""Retraining: when it rests, what it learns from, who contends, and what it tells of trouble."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluated import evaluated

from relevance.networks import Learned, crown, read_record, settle
from relevance.store import Dataset
from relevance.training import TrainConfig

pytestmark = pytest.mark.slow  # a server, and trainings within flows

HASTE = {"steps": 4, "threads": 1}


@pytest.fixture(scope="module")
def prefect_server() -> Iterator[None]:
    """A temporary server with its own database for flows that run in this process."""
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=180):
        yield


@pytest.fixture(scope="module")
def told() -> Iterator[list[tuple[str, dict[str, Any]]]]:
    """Every event that flows emit, and its payload, as they come."""
    from flows import telling

    found: list[tuple[str, dict[str, Any]]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            telling, "emit_event", lambda event, *, payload, **_: found.append((event, payload))
        )
        yield found


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """A labelled dataset with a checkpoint."""
    shutil.copytree(evaluated()[0], tmp_path / "d")
    return Dataset.open(tmp_path / "d")


def artifact(key: str) -> str:
    import httpx
    from prefect.settings import get_current_settings

    url = f"{get_current_settings().api.url}/artifacts/{key}/latest"
    answer = httpx.get(url, timeout=30)
    answer.raise_for_status()
    return answer.json()["data"]


def run(dataset: Dataset, **more: Any) -> dict[str, Any]:
    from flows.retrain import retrain

    given = {"overrides": HASTE, "evaluation": {"tasks": 1}, "max_workers": 1, **more}
    return retrain(dataset=str(dataset.path), preset="smoke", **given)


@pytest.mark.slow  # reruns the planner and tries the model
def test_it_trains_evaluates_contends_and_then_rests(
    prefect_server: None, told: list[Any], dataset: Dataset
) -> None:
    first = run(dataset)
    assert first["new"]
    checkpoint, report = Path(first["checkpoint"]), Path(first["report"])
    assert checkpoint.parent == dataset.path / "checkpoints"
    assert "<html" in report.read_text()
    speed = json.loads(artifact("evaluation"))
    assert {row["guide"] for row in speed} >= {"prune", "prune-then-full"}
    assert all("missed" in row and row["tasks"] > 0 for row in speed)
    assert report.as_uri() in artifact("report")
    assert str(report) in artifact("evaluation-summary")
    assert "on" in {row["group"] for row in json.loads(artifact("train-metrics"))}
    verdict = "promoted" if first["promoted"] else "refused"
    said = artifact("champion")
    assert f"{checkpoint.stem}: {verdict}" in said
    assert "Trained from scratch." in said
    record = read_record(dataset)
    assert record.champion == (checkpoint.stem if first["promoted"] else None)
    [event] = record.history
    assert event.why in said
    rows = dataset.read_rows("labels")
    assert event.learned.labels == sum(row["split"] == "train" for row in rows)
    name, payload = told[-1]
    assert name == f"checkpoint.{verdict}"
    assert payload["checkpoint"] == checkpoint.stem
    assert payload["why"] == event.why

    changed = checkpoint.stat().st_mtime_ns, report.stat().st_mtime_ns
    second = run(dataset)
    assert not second["new"]
    assert second["checkpoint"] == str(checkpoint)
    assert (checkpoint.stat().st_mtime_ns, report.stat().st_mtime_ns) == changed
    # While it is being planned anew, what it holds now is not worth learning.
    before = dataset.description
    dataset.describe({**before, "next": {"config": before["config"]}})
    assert run(dataset)["checkpoint"] is None


@pytest.fixture
def trained_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retraining without what comes before and after: checks, reruns and trials."""
    from flows import retrain as flow
    from flows import train

    def settled(root: str, checkpoint: str, config: Any, learned: Learned) -> dict[str, Any]:
        there = Dataset.open(root)
        before, name = read_record(there).champion, Path(checkpoint).stem
        settle(there, name, before=before, promoted=False, why="no better", learned=learned)
        return {"champion": before, "promoted": False, "why": "no better"}

    monkeypatch.setattr(flow, "try_one", settled)
    monkeypatch.setattr(flow, "check", lambda **_: None)
    monkeypatch.setattr(flow, "evaluate", lambda **_: "report.html")
    monkeypatch.setattr(train, "tune_guide", lambda *_: None)


@pytest.mark.parametrize("better", ["onward", "scratch"])
def test_it_goes_on_from_the_champion_if_that_is_better_on_validation(
    prefect_server: None,
    trained_only: None,
    dataset: Dataset,
    monkeypatch: pytest.MonkeyPatch,
    better: str,
) -> None:
    from flows import retrain as flow
    from relevance.training import checkpoint_id

    [champion] = [row["checkpoint_id"] for row in dataset.read_rows("checkpoints")]
    crown(dataset, champion, "by hand")
    asked = replace(TrainConfig.smoke(), **HASTE)
    onward = replace(asked, continues=champion, steps=2)
    names = {way: checkpoint_id(dataset, config) for way, config in
             (("scratch", asked), ("onward", onward))}  # fmt: skip
    judged = flow._precision

    def figure(root: Path, checkpoint: str) -> float:
        assert 0 <= judged(root, checkpoint) <= 1
        return 0.9 if Path(checkpoint).stem == names[better] else 0.8

    monkeypatch.setattr(flow, "_precision", figure)
    found = run(dataset, continued=0.5, least_new=0.0)
    assert Path(found["checkpoint"]).stem == names[better]
    rows = {row["checkpoint_id"]: row for row in dataset.read_rows("checkpoints")}
    assert set(rows) == {champion, *names.values()}, "both were trained"
    assert json.loads(rows[names["onward"]]["config"])["continues"] == champion
    said = artifact("champion")
    figures = "0.900 after 2 steps on from" if better == "onward" else "0.900 after 4 from scratch"
    assert figures in said.replace(f"on from {champion}", "on from")
    [*_, event] = read_record(dataset).history
    assert (event.checkpoint_id, event.before) == (names[better], champion)
    assert event.learned.settings == asked.content_hash, "whichever way it was trained"
    again = run(dataset, continued=0.5)
    assert Path(again["checkpoint"]).stem == names[better], "nothing is new"


def test_a_champion_that_does_not_fit_is_one_line(prefect_server: None, dataset: Dataset) -> None:
    from prefect import flow

    from flows.retrain import choose

    [champion] = [row["checkpoint_id"] for row in dataset.read_rows("checkpoints")]
    other = replace(TrainConfig.smoke().with_body("geometry"), steps=2)

    @flow(persist_result=False)
    def choosing(config: Any, share: float) -> Any:
        return choose(dataset.path, config, champion, share)

    chosen = choosing(other, 0.5)
    assert chosen.more == {}
    assert chosen.why.startswith(f"Trained from scratch: continues: {champion} has body glimpse")
    assert "\n" not in chosen.why
    assert choosing(TrainConfig.smoke(), 0.0).why == "Trained from scratch."
    assert len(dataset.read_rows("checkpoints")) == 1, "nothing was trained to find out"


def test_a_broken_dataset_is_told_of_and_not_learned_from(
    prefect_server: None, told: list[Any], dataset: Dataset
) -> None:
    from flows.check import CheckFailed

    file = next((dataset.path / "labels").rglob("*.parquet"))
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(CheckFailed, match=r"breaches of contract; first labels/.*`relevance repai"):
        run(dataset, overrides=HASTE | {"seed": 1})
    name, payload = told[-1]
    assert name == "check.failed"
    assert payload["dataset"] == str(dataset.path)
    assert payload["breaches"] >= 1
    assert file.name in artifact("check-failed")
    assert file.name in artifact("check")
    assert len(dataset.read_rows("checkpoints")) == 1


def test_labels_that_shift_are_told_of(
    prefect_server: None, told: list[Any], dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flows.label import label
    from relevance import pipeline

    file = dataset.files("labels", predicate="behind", split="train")[0]
    file.unlink()
    asked: list[Any] = []

    def shifted(there: Dataset, new: Any, policy: Any = None) -> list[Any]:
        asked.append(list(new))
        numbers = {"scenes": (90, 90), "shares": (0.1, 0.2), "error": 0.01}
        return [pipeline.Balance(family="same-plane", predicate="behind", **numbers)]

    monkeypatch.setattr(pipeline, "balances", shifted)
    label(dataset=str(dataset.path), predicates=["behind"], max_workers=1)
    assert asked == [[("behind", "train", dataset.file_keys(file)["shard"])]]
    events = [name for name, _ in told]
    assert events[-2:] == ["labels.shifted", "shards.written"]
    assert "behind (same-plane): 20.0% of the queries" in told[-2][1]["said"]
    assert "(+10.0 points)" in artifact("labels-shifted")


def test_an_object_store_is_refused_before_any_training(
    prefect_server: None, monkeypatch: pytest.MonkeyPatch, dataset: Dataset
) -> None:
    from relevance import networks
    from relevance.store import DatasetError

    def refuse(there: Any) -> None:
        raise DatasetError(f"{there.path}: champions need a local folder")

    monkeypatch.setattr(networks, "refuse_remote", refuse)
    with pytest.raises(DatasetError, match="champions need a local folder"):
        run(dataset, force=True)
    assert len(dataset.read_rows("checkpoints")) == 1


def test_it_is_trained_anew_when_enough_is_new(dataset: Dataset) -> None:
    from flows.retrain import enough, tried_like

    def is_enough(
        labels: int, labelling: str = "8/x/found", settings: str = "s", least=0.1
    ) -> bool:
        learned = Learned(labels=labels, labelling=labelling, settings=settings)
        return enough(tried_like(read_record(dataset), learned), learned, least)

    assert is_enough(1000), "nobody was tried yet"
    crown(dataset, "a", "")
    assert is_enough(1000), "nobody counted"
    learned = Learned(labels=1000, labelling="8/x/found", settings="s")
    settle(dataset, "b", before="a", promoted=False, why="", learned=learned)
    assert not is_enough(1000, least=0.0), "nothing is new"
    assert not is_enough(1100)
    assert is_enough(1112)
    assert is_enough(1001, least=0.0)
    assert is_enough(1000, labelling="9/x/found")
    assert is_enough(1000, settings="others")
