"""The plan viewer in a real browser: the slider moves the arm, and no stranger is asked.

`make test-browser` runs it; it needs Chromium. Screenshots are kept in build/screenshots.
"""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from planning import OPEN

from relevance.scene import scene_to_json

pytest.importorskip("viser", reason="pip install 'relevance[view]'")
browsing = pytest.importorskip("browsing", reason="pip install 'relevance[browser]'")
pytestmark = pytest.mark.browser

PANEL = 360
"""Where the controls are, pixels from the right edge."""


@pytest.fixture(scope="module")
def visited(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewed")
    file = folder / "scene.json"
    file.write_text(scene_to_json(OPEN))
    command = browsing.relevance(
        "view", file, "--goal", "on-the-right(red, blue)", "--guide", "none", "--port", "{port}"
    )
    with browsing.running(command, folder / "view.log") as url, browsing.visit() as visit:
        visit.page.set_default_timeout(120_000)
        visit.page.goto(url)
        visit.page.get_by_text("pick red").wait_for()
        yield visit


def shown(visit, name: str) -> np.ndarray:
    """The scene without the controls, once it has been drawn and stands still."""
    before = None
    for _ in range(30):
        visit.page.wait_for_timeout(1000)
        picture = Image.open(io.BytesIO(visit.keep(name, full=False))).convert("RGB")
        now = np.asarray(picture, int)[:, :-PANEL]
        if before is not None and now.std() > 5 and np.abs(now - before).max() < 40:
            return now
        before = now
    raise AssertionError(f"{name}: the page does not come to rest")


def test_the_slider_moves_the_arm_and_marks_the_step(visited) -> None:
    home = shown(visited, "view-start")
    assert visited.page.locator("strong", has_text="pick red").count() == 1
    slider = visited.page.get_by_role("slider")
    slider.focus()
    slider.press("End")
    visited.page.locator("strong", has_text="pick red").wait_for(state="detached")
    end = shown(visited, "view-end")
    assert (np.abs(end - home).max(axis=-1) > 60).mean() > 0.01, "pixels of the arm"
    slider.press("Home")
    back = shown(visited, "view-back")
    assert (np.abs(back - home).max(axis=-1) > 60).mean() < 0.002
    visited.clean()


def test_play_goes_on_by_itself_until_paused(visited) -> None:
    visited.page.get_by_role("button", name="play").click()
    visited.page.locator("strong", has_text="place red").wait_for()
    visited.page.get_by_role("button", name="pause").click()
    visited.page.get_by_role("button", name="play").wait_for()
    visited.clean()
