"""The dashboard in a real browser: every page with data, its filters and sliders, and no stranger.

`make test-browser` runs these; they need Chromium. Screenshots are kept in build/screenshots.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluated import DATA, TRAINING, evaluated

from relevance.evaluation import predict
from relevance.pipeline import describe
from relevance.store import Dataset
from relevance.training import train

browsing = pytest.importorskip("browsing", reason="pip install 'relevance[browser]'")
pytestmark = pytest.mark.browser

IDLE = """() => {
    const app = document.querySelector('[data-testid="stApp"]')
    return app && app.dataset.testScriptState === 'notRunning'
        && !document.querySelector('[data-testid="stSkeleton"]')
}"""
BROKEN = "images => images.filter(image => image.complete && !image.naturalWidth).length"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """One with two checkpoints."""
    root = tmp_path_factory.mktemp("browsed") / "demo"
    shutil.copytree(evaluated()[0], root)
    predict(root, train(root, replace(TRAINING, seed=1)))
    return root


@pytest.fixture(scope="module")
def visited(dataset, tmp_path_factory) -> Iterator[browsing.Visit]:
    """The dashboard, opened once."""
    log = tmp_path_factory.mktemp("log") / "dashboard.log"
    command = browsing.relevance("dashboard", dataset, "--port", "{port}")
    nobody = {"PREFECT_API_URL": "http://127.0.0.1:9/api"}
    with browsing.running(command, log, **nobody) as url, browsing.visit() as visit:
        visit.page.set_default_timeout(300_000)
        visit.page.goto(url)
        yield visit


def settle(visit: browsing.Visit) -> None:
    """Wait until the page has done all that it was told."""
    for _ in range(2):
        visit.page.wait_for_timeout(400)
        visit.page.wait_for_function(IDLE)


def turn_to(visit: browsing.Visit, title: str) -> None:
    visit.page.get_by_role("link", name=title, exact=True).click()
    settle(visit)


def looked_at(visit: browsing.Visit, name: str) -> None:
    """Nothing is wrong on the page; keep it as it looks, to its end."""
    page = visit.page
    main = page.get_by_test_id("stMainBlockContainer")
    height = round((main.bounding_box() or {"height": 900})["height"])
    page.set_viewport_size({"width": 1440, "height": max(900, height + 40)})
    settle(visit)
    visit.keep(name)
    page.set_viewport_size({"width": 1440, "height": 900})
    assert page.get_by_test_id("stException").count() == 0
    assert page.locator("img").evaluate_all(BROKEN) == 0
    visit.clean()


def widget(visit: browsing.Visit, kind: str, label: str) -> Any:
    """The field of a widget that has that label."""
    found = visit.page.get_by_test_id(f"st{kind}").filter(has_text=label).first
    return found.locator("input").first


def choose(visit: browsing.Visit, kind: str, label: str, option: str) -> None:
    widget(visit, kind, label).click()
    visit.page.get_by_role("option", name=option, exact=True).click()
    if kind == "MultiSelect":
        visit.page.keyboard.press("Escape")  # its list stays open
    settle(visit)


def figure(visit: browsing.Visit, label: str) -> str:
    """A headline figure."""
    found = visit.page.get_by_test_id("stMetric").filter(has_text=label).first
    return found.get_by_test_id("stMetricValue").inner_text()


def test_data(visited) -> None:
    turn_to(visited, "Data")
    everything = int(figure(visited, "Scenes"))
    assert visited.page.locator("img").count() >= 5  # plots
    looked_at(visited, "data")
    groups = visited.page.get_by_test_id("stButtonGroup")
    groups.first.get_by_text("train", exact=True).click()
    settle(visited)
    assert 0 < int(figure(visited, "Scenes")) < everything
    looked_at(visited, "data-without-train")


def test_scenes(visited) -> None:
    turn_to(visited, "Scenes")
    page = visited.page
    page.get_by_text("Only where something is in the way").click()
    settle(visited)
    large = page.locator("img").first.bounding_box()
    assert large
    assert large["width"] > 500
    assert page.get_by_text(re.compile("score [+-]")).count() > 1
    looked_at(visited, "scenes")
    first = page.locator("h3").first.inner_text()
    page.get_by_role("button", name="Next", exact=True).click()
    settle(visited)
    assert widget(visited, "NumberInput", "Goal, of").input_value() == "2"
    assert page.locator("h3").first.inner_text() != first
    choose(visited, "MultiSelect", "Predicates", "behind")
    assert page.locator("h3").first.inner_text().startswith("behind(")
    looked_at(visited, "scenes-behind")


def test_models(visited) -> None:
    rerun = evaluated()[1].stem
    turn_to(visited, "Models")
    alone = visited.page.locator("img").count()
    looked_at(visited, "models")
    choose(visited, "Selectbox", "Compare with", rerun)
    assert visited.page.locator("img").count() > alone
    looked_at(visited, "models-two")


def test_planning(visited) -> None:
    turn_to(visited, "Planning")
    page = visited.page
    choose(visited, "Selectbox", "Checkpoint", evaluated()[1].stem)
    before = page.locator("img").first.get_attribute("src")
    looked_at(visited, "planning")
    page.get_by_role("slider").press("PageUp")
    settle(visited)
    assert page.locator("img").first.get_attribute("src") != before
    page.get_by_test_id("stRadio").get_by_text("coverage", exact=True).click()
    settle(visited)
    page.get_by_role("slider").press("ArrowRight")
    settle(visited)
    said = page.get_by_text("keeps all relevant objects in").inner_text()
    wanted = int(said.rpartition(" in ")[2].partition("%")[0])
    assert wanted > 90  # as it was at first
    assert float(figure(visited, "Goals kept whole").rstrip("%")) >= wanted
    looked_at(visited, "planning-coverage")


def test_runs(visited, dataset) -> None:
    turn_to(visited, "Runs")
    newest = max(Dataset.open(dataset).read_rows("checkpoints"), key=lambda row: row["created"])
    assert visited.page.get_by_text(newest["checkpoint_id"]).count()
    assert visited.page.get_by_text("No Prefect server answers").count()
    looked_at(visited, "runs")


def test_an_empty_dataset_and_none(visited, tmp_path) -> None:
    Dataset.create(tmp_path / "empty", describe(DATA, []))
    for name, said in (("empty", "This dataset is empty"), ("none", "No dataset here")):
        field = widget(visited, "TextInput", "Dataset folder")
        field.fill(str(tmp_path / name))
        field.press("Enter")
        settle(visited)
        assert visited.page.get_by_role("heading", name=said).count() == 1
        looked_at(visited, name)
