"""`relevance predict`: pictures from elsewhere, and what is said of bad ones."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from relevance.cli import main
from relevance.evaluation import load_scorer
from relevance.evaluation.pictures import judge, look_at
from relevance.models import BODIES, RelevanceModel
from relevance.scene import PREDICATES, Goal
from relevance.training import TrainConfig, save_checkpoint

GOAL = "on-the-left(red, blue)"
CROPS = {"red": (40, 80, 32, 32), "blue": (200, 90, 32, 32), "green": (100, 20, 32, 32)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Files:
    folder: Path
    image: Path
    views: Path
    checkpoint: Path


def checkpoint(folder: Path, body: str) -> Path:
    """A model that learned nothing."""
    config = TrainConfig.smoke().with_body(body)
    torch.manual_seed(0)
    meta = {"checkpoint_id": f"{body}-untrained", "config": config.to_dict()}
    path = folder / f"{body}.pt"
    save_checkpoint(path, RelevanceModel(config.model), meta)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A picture of noise, and views that are parts of it."""
    folder = tmp_path_factory.mktemp("pictures")
    picture = np.random.default_rng(1).integers(0, 256, (192, 320, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "table.png"), picture)
    views = folder / "views"
    views.mkdir()
    for (name, (x, y, w, h)), suffix in zip(CROPS.items(), ("png", "bmp", "webp"), strict=True):
        lossless = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else []
        cv2.imwrite(str(views / f"{name}.{suffix}"), picture[y : y + h, x : x + w], lossless)
    return Files(
        folder=folder,
        image=folder / "table.png",
        views=views,
        checkpoint=checkpoint(folder, "glimpse"),
    )


def predicted(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> list[dict]:
    assert main(["predict", *map(str, arguments), "--format", "json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_scores_are_the_models(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    told = ("--goal", GOAL, "--checkpoint", files.checkpoint)
    rows = predicted(capsys, files.image, "--views", files.views, *told)
    scorer = load_scorer(files.checkpoint)
    picture = cv2.cvtColor(cv2.imread(str(files.image)), cv2.COLOR_BGR2RGB)
    names = [row["object"] for row in rows]
    assert names == sorted(CROPS)
    views = np.stack([picture[y : y + h, x : x + w] for x, y, w, h in map(CROPS.get, names)])
    pair = np.array([[names.index("red"), names.index("blue")]])
    seen = scorer.model.look(picture, views, None)
    expected = scorer.model.judge(seen, PREDICATES["on-the-left"], pair)[0].tolist()
    assert [row["score"] for row in rows] == pytest.approx(expected, abs=1e-4)
    for row in rows:
        assert row["probability"] == pytest.approx(1 / (1 + np.exp(-row["score"])), abs=1e-3)
        assert row["relevant"] == (row["score"] > 0)
    assert {row["object"]: row["role"] for row in rows} == {
        "red": "subject",
        "blue": "reference",
        "green": "query",
    }


def test_views_cut_from_the_picture(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """What is cut out at 32x32 pixels is the view itself; other sizes are scaled."""
    crops = [f"--crop={name}={','.join(map(str, crop))}" for name, crop in CROPS.items()]
    told = ("--goal", GOAL, "--checkpoint", files.checkpoint)
    cut = {row["object"]: row for row in predicted(capsys, files.image, *crops, *told)}
    read = predicted(capsys, files.image, "--views", files.views, *told)
    assert [cut[row["object"]] for row in read] == read
    named = [*crops, "--crop=a=b=1,2,32,32", "--crop=\u00e9=5,6,32,32"]
    names = {row["object"] for row in predicted(capsys, files.image, *named, *told)}
    assert names == {*CROPS, "a=b", "\u00e9"}
    assert (
        main(["predict", str(files.image), *named, "--crop=e\u0301=1,2,3,4", "--goal", GOAL]) == 2
    )
    assert "expected each name once" in capsys.readouterr().err
    seen = look_at(files.image, crops={"red": (0, 0, 90, 50), "blue": (5, 5, 7, 9)})
    assert {view.shape for view in seen.views.values()} == {(32, 32, 3)}


def test_beta_keeps_more_and_pictures_are_drawn(
    files: Files, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "answer.webp"
    rows = predicted(
        capsys, files.image, "--views", files.views, "--goal", GOAL, "--goal", "on(green, red)",
        "--checkpoint", files.checkpoint, "--beta", "1000", "--out", out,
    )  # fmt: skip
    assert len(rows) == 6
    assert all(row["relevant"] for row in rows)
    drawn = cv2.imread(str(out))
    assert drawn is not None
    assert drawn.shape[1] == 960
    assert drawn.shape[0] > 2 * 576  # a panel for each goal
    assert [file.name for file in tmp_path.iterdir()] == ["answer.webp"]


def test_every_body_that_looks_can_be_asked(files: Files, tmp_path: Path) -> None:
    seen = look_at(files.image, views=files.views)
    for body in BODIES:
        scorer = load_scorer(checkpoint(tmp_path, body))
        if not scorer.model.told:
            judged = judge(scorer, seen, [Goal.parse("on(red, blue)")])
            assert [one.name for one in judged] == sorted(CROPS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": "missing.png"}, "missing.png: No such file or directory, expected a picture"),
        ({"image": "text.png"}, "text.png: not a picture that can be read, expected PNG, WebP or"),
        ({"image": "empty.png"}, "empty.png: not a picture that can be read"),
        ({"image": "small.png"}, "picture is 64x48, glimpse-untrained expects 320x192"),
        ({"views": "nowhere"}, "nowhere: no such folder, expected one with a view NAME.png"),
        ({"views": "large"}, "red.png: is 64x48, expected 32x32"),
        ({"views": "twice"}, "red.png: a second view of red, expected one"),
        ({"views": "single"}, "1 views of objects, expected at least two"),
        ({"goal": "on(red, grey)"}, "goal on(red, grey): no view of grey, expected one of blue"),
        ({"goal": "under(red, blue)"}, "unknown predicate 'under', expected one of on-the-left"),
        ({"goal": "red"}, "goal 'red': expected predicate(subject, reference)"),
        ({"checkpoint": "geometry.pt"}, "geometry-untrained: is told where objects are, expected"),
        ({"checkpoint": "text.png"}, "text.png: not a checkpoint"),
        ({"crop": "red=300,0,40,40"}, "crop red=300,0,40,40: expected left, top, width and height"),
        ({"crop": "red=1,2,3"}, "--crop 'red=1,2,3': expected NAME=X,Y,W,H, in pixels"),
        ({"crop": f"red={'9' * 5000},2,3,4"}, "99…: expected NAME=X,Y,W,H, in pixels"),
        ({"crop": " red=1,2,3,4"}, "--crop ' red=1,2,3,4': name: expected no blanks at its ends"),
        ({"crop": "a,b=1,2,3,4"}, "--crop 'a,b=1,2,3,4': name: expected none of"),
        ({"crop": "red=1,2,0,3"}, "crop red=1,2,0,3: expected left, top, width and height"),
        ({"out": "answer.xyz"}, "answer.xyz: cannot write .xyz, expected .png, .webp or .jpg"),
        ({"beta": "nan"}, "--beta nan: expected a finite number"),
    ],
)
def test_bad_input_is_one_line(
    files: Files, capsys: pytest.CaptureFixture[str], change: dict[str, str], message: str
) -> None:
    folder = files.folder
    if not (folder / "text.png").exists():
        (folder / "text.png").write_text("no picture")
        (folder / "empty.png").touch()
        small, view = np.zeros((48, 64, 3), np.uint8), np.zeros((32, 32, 3), np.uint8)
        cv2.imwrite(str(folder / "small.png"), small)
        for name, found in (("large", small), ("twice", view), ("single", view)):
            (folder / name).mkdir()
            cv2.imwrite(str(folder / name / "red.png"), found)
        cv2.imwrite(str(folder / "twice" / "red.bmp"), view)
        checkpoint(folder, "geometry")
    given = {"image": files.image, "views": files.views, "goal": GOAL} | change
    given |= {"checkpoint": folder / str(given.get("checkpoint", files.checkpoint))}
    arguments = [str(folder / given.pop("image")), "--views", str(folder / given.pop("views"))]
    if "out" in given:
        given["out"] = folder / str(given["out"])
    arguments += [word for key, value in given.items() for word in (f"--{key}", str(value))]
    assert main(["predict", *arguments]) == 2
    told = capsys.readouterr()
    assert told.out == "" or "out" in change
    [line] = told.err.splitlines()
    assert message in line
