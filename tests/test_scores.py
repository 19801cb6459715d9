"""Scores for other people's loops, and the README's example of a planner that they guide."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from test_evaluation import BLOCKED, GOAL, Given
from test_predicting import CROPS, checkpoint

import relevance
from relevance.evaluation import EvaluationError, PictureError
from relevance.planner import Guide, GuideError
from relevance.scene import SceneError
from relevance.simulation import Renderer
from relevance.training import load_checkpoint

ROOT = Path(__file__).parent.parent
PICTURE = np.random.default_rng(1).integers(0, 256, (192, 320, 3), dtype=np.uint8)
VIEWS = {name: PICTURE[y : y + h, x : x + w] for name, (x, y, w, h) in CROPS.items()}


@pytest.fixture(scope="module")
def guide(tmp_path_factory: pytest.TempPathFactory) -> Guide:
    return relevance.load_guide(checkpoint(tmp_path_factory.mktemp("scores"), "glimpse"))


def test_of_a_scene_they_are_those_of_its_picture(guide: Guide) -> None:
    found = relevance.scores(BLOCKED, str(GOAL), guide=guide)
    assert tuple(found) == BLOCKED.names
    with Renderer() as renderer:
        taken = renderer.render(BLOCKED)
    views = dict(zip(BLOCKED.names, taken.views, strict=True))
    seen = relevance.Seen(image=taken.image, views=views)
    assert relevance.scores(seen, GOAL, guide=guide) == pytest.approx(found)
    shuffled = relevance.Seen(image=taken.image, views=dict(reversed(views.items())))
    assert relevance.scores(shuffled, GOAL, guide=guide) == pytest.approx(found, abs=1e-4)


def test_any_scorer_answers_for_a_scene() -> None:
    guide = Guide(scorer=Given(lid=3.0))
    assert relevance.scores(BLOCKED, GOAL, guide=guide) == Given(lid=3.0).scores(BLOCKED, GOAL)
    seen = relevance.Seen(image=PICTURE, views=VIEWS)
    with pytest.raises(EvaluationError, match="expected a network's guide, found Given"):
        relevance.scores(seen, "on(red, blue)", guide=guide)


def test_without_a_guide_the_shipped_model_is_asked() -> None:
    found = relevance.scores(BLOCKED, GOAL)
    assert found == pytest.approx(
        relevance.scores(BLOCKED, GOAL, guide=relevance.load_guide("glimpse"))
    )
    assert found["red"] > found["lid"] > found["far"]


def test_what_cannot_be_asked(guide: Guide, tmp_path: Path) -> None:
    seen = relevance.Seen(image=PICTURE, views=VIEWS)
    with pytest.raises(SceneError, match="unknown object 'grey'"):
        relevance.scores(BLOCKED, "on(red, grey)", guide=guide)
    with pytest.raises(PictureError, match="no view of grey, expected one of red, blue, green"):
        relevance.scores(seen, "on(red, grey)", guide=guide)
    with pytest.raises(PictureError, match=r"view red: \(64, 64, 3\) uint8, expected"):
        relevance.Seen(image=PICTURE, views=VIEWS | {"red": PICTURE[:64, :64]})
    with pytest.raises(PictureError, match=r"image: \(192, 320, 3\) float64, expected"):
        relevance.Seen(image=PICTURE / 255, views=VIEWS)
    with pytest.raises(PictureError, match="1 views of objects, expected at least two"):
        relevance.Seen(image=PICTURE, views={"red": VIEWS["red"]})
    with pytest.raises(GuideError, match="the score of 'far' is nan"):
        relevance.scores(BLOCKED, GOAL, guide=Guide(scorer=Given(far=float("nan"))))
    told = relevance.load_guide(checkpoint(tmp_path, "geometry"))
    with pytest.raises(PictureError, match="is told where objects are, expected a model that"):
        relevance.scores(seen, "on(red, blue)", guide=told)
    assert load_checkpoint(tmp_path / "geometry.pt")[0].told


def test_a_planner_of_ones_own_is_guided(capsys: pytest.CaptureFixture[str]) -> None:
    """The README's example: the same answer, in fewer tries."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    [block] = [text for text in blocks if "my_planner" in text]
    exec(compile(block, "README.md", "exec"), {"__name__": "readme"})
    unguided, guided = (eval(line[8:]) for line in capsys.readouterr().out.splitlines())
    assert unguided[0] == guided[0] == ("green",)
    assert guided[1] < unguided[1]
