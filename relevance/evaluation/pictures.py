"""Answers about pictures from elsewhere: an image, a view of each object, a goal.

Shape suffixes: N objects, G goals, H and W height and width of the image, 3 RGB.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relevance.errors import RelevanceError
from relevance.evaluation.scorer import NetworkScorer
from relevance.networks import DECIMETRE
from relevance.scene import Goal, project
from relevance.scene.words import normal
from relevance.store import VIEW_SIZE, locate, replacing

_SCALE = 3
"""How much larger a picture is drawn."""
_RELEVANT, _IRRELEVANT, _INK = (215, 48, 39), (130, 130, 130), (30, 30, 30)
Crop = tuple[int, int, int, int]
"""Left, top, width and height, pixels."""


class PictureError(RelevanceError):
    """A picture, view or question that cannot be used: says which, found and expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """What a model says of one object for one goal."""

    goal: Goal
    name: str
    role: str
    """subject, reference or query."""
    score: float
    probability: float
    relevant: bool
    """Whether it is kept at the beta that was asked for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """A picture, views of its objects, and where they are in it as far as that is known."""

    image: np.ndarray
    """(H, W, 3) uint8."""
    views: Mapping[str, np.ndarray]
    """By name, (32, 32, 3) uint8."""
    crops: Mapping[str, Crop] = field(default_factory=dict)
    """Those that were cut from the picture."""

    def __post_init__(self) -> None:
        shapes = {"image": (self.image, (*self.image.shape[:2], 3))}
        shapes |= {f"view {n}": (v, (VIEW_SIZE, VIEW_SIZE, 3)) for n, v in self.views.items()}
        for name, (pixels, expected) in shapes.items():
            if pixels.shape != expected or pixels.dtype != np.uint8:
                raise PictureError(
                    f"{name}: {pixels.shape} {pixels.dtype}, expected {expected} uint8"
                )
        if len(self.views) < 2:
            raise PictureError(f"{len(self.views)} views of objects, expected at least two")


def look_at(image: Path, *, views: Path | None = None, crops: Mapping[str, Crop] = {}) -> Seen:
    """Read a picture; its objects' views from a folder of files NAME.png, or cut from the picture.

    PNG, WebP, JPEG and whatever else OpenCV reads. Raises PictureError.
    """
    picture = _read(image)
    found = _read_views(views) if views is not None else {}
    height, width = picture.shape[:2]
    crops = {normal(name): crop for name, crop in crops.items()}
    for name, (x, y, w, h) in crops.items():
        if min(x, y) < 0 or min(w, h) < 1 or x + w > width or y + h > height:
            raise PictureError(
                f"crop {name}={x},{y},{w},{h}: expected left, top, width and height within the "
                f"{width}x{height} pixels of {image}"
            )
        part = picture[y : y + h, x : x + w]
        smaller = min(w, h) >= VIEW_SIZE
        how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        found[name] = cv2.resize(part, (VIEW_SIZE, VIEW_SIZE), interpolation=how)
    return Seen(image=picture, views=found, crops=crops)


def judge(
    scorer: NetworkScorer, seen: Seen, goals: Sequence[Goal], *, beta: float = 0.0
) -> list[Judged]:
    """What the model says of every object for every goal; an object is kept iff score > -beta.

    Raises PictureError where the model does not take the picture, or a goal names what has no view.
    """
    names = list(seen.views)
    _refuse(scorer, seen, goals)
    scores_GN = _scores(scorer, seen, goals)
    found = []
    for goal, row in zip(goals, scores_GN.tolist(), strict=True):
        roles = {goal.subject: "subject", goal.reference: "reference"}
        found += [
            Judged(
                goal=goal,
                name=name,
                role=roles.get(name, "query"),
                score=score,
                probability=1 / (1 + math.exp(-max(-500.0, min(500.0, score)))),
                relevant=score > -beta,
            )
            for name, score in zip(names, row, strict=True)
        ]
    return found


def draw(path: Path, scorer: NetworkScorer, seen: Seen, judged: Sequence[Judged]) -> None:
    """Write the picture with the answers drawn in, one above the other for several goals.

    Objects are marked where they were cut out, else where the model believes them to be; below
    the picture stands every view with its score.
    """
    where = dict(_believed(scorer, seen))
    panels = [
        _panel(seen, where, [one for one in judged if one.goal == goal])
        for goal in dict.fromkeys(one.goal for one in judged)
    ]
    suffix = path.suffix.lower() or ".png"
    drawn = cv2.cvtColor(np.concatenate(panels), cv2.COLOR_RGB2BGR)
    try:
        done, content = cv2.imencode(suffix, drawn)
    except cv2.error:
        done, content = False, np.empty(0, np.uint8)
    if not done:
        raise PictureError(f"{path}: cannot write {suffix}, expected .png, .webp or .jpg")
    with replacing(locate(path)) as temporary:
        temporary.write_bytes(content.tobytes())


def _read(path: Path) -> np.ndarray:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise PictureError(f"{path}: {error.strerror}, expected a picture") from None
    found = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if found is None:
        raise PictureError(f"{path}: not a picture that can be read, expected PNG, WebP or JPEG")
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB)


def _read_views(folder: Path) -> dict[str, np.ndarray]:
    if not folder.is_dir():
        raise PictureError(f"{folder}: no such folder, expected one with a view NAME.png an object")
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name[0] != ".")
    found: dict[str, np.ndarray] = {}
    for file in files:
        view = _read(file)
        if view.shape[:2] != (VIEW_SIZE, VIEW_SIZE):
            raise PictureError(
                f"{file}: is {view.shape[1]}x{view.shape[0]}, expected {VIEW_SIZE}x{VIEW_SIZE}"
            )
        name = normal(file.stem)  # as goals have it
        if name in found:
            raise PictureError(f"{file}: a second view of {name}, expected one")
        found[name] = view
    return found


def _refuse(scorer: NetworkScorer, seen: Seen, goals: Sequence[Goal]) -> None:
    model, camera = scorer.model, scorer.model.camera
    name = scorer.checkpoint_id or model.body_name
    if model.told:
        raise PictureError(f"{name}: is told where objects are, expected a model that looks")
    height, width = seen.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise PictureError(
            f"picture is {width}x{height}, {name} expects {camera.width}x{camera.height}"
        )
    for goal in goals:
        for role in (goal.subject, goal.reference):
            if role not in seen.views:
                known = ", ".join(seen.views)
                raise PictureError(f"goal {goal}: no view of {role}, expected one of {known}")


def _look(scorer: NetworkScorer, seen: Seen) -> Any:
    return scorer.model.look(seen.image, np.stack(list(seen.views.values())), None)


def _scores(scorer: NetworkScorer, seen: Seen, goals: Sequence[Goal]) -> np.ndarray:
    """Scores (G, N), the checkpoint's offsets added."""
    names, model = list(seen.views), scorer.model
    scores, looked = np.empty((len(goals), len(names))), _look(scorer, seen)
    for row, goal in zip(scores, goals, strict=True):
        pair = np.array([[names.index(goal.subject), names.index(goal.reference)]])
        row[:] = model.judge(looked, goal.predicate, pair)[0] + scorer.offset(goal.predicate)
    if not np.isfinite(scores).all():
        raise PictureError(f"{scorer.checkpoint_id}: its scores are not finite, expected numbers")
    return scores


def _believed(scorer: NetworkScorer, seen: Seen) -> list[tuple[str, Crop]]:
    """Where objects are: what was cut out, else a spot where the model believes the centre."""
    camera = scorer.model.camera
    geometry = scorer.model.believed(_look(scorer, seen))
    found = []
    for place, name in enumerate(seen.views):
        if name in seen.crops:
            found.append((name, seen.crops[name]))
        elif geometry is not None:
            position = geometry[place, :3].astype(float) * DECIMETRE
            (u, v), depth = project(camera, position)
            if depth > 0 and 0 <= u < camera.width and 0 <= v < camera.height:
                found.append((name, (round(float(u)) - 5, round(float(v)) - 5, 10, 10)))
    return found


def _panel(seen: Seen, where: Mapping[str, Crop], judged: Sequence[Judged]) -> np.ndarray:
    """One goal's picture: marks, and below it the goal and every view with name and score."""
    height, width = seen.image.shape[:2]
    picture = cv2.resize(seen.image, (width * _SCALE, height * _SCALE))
    for one in judged:
        if one.name not in where:
            continue
        x, y, w, h = (_SCALE * value for value in where[one.name])
        color = _RELEVANT if one.relevant else _IRRELEVANT
        cv2.rectangle(picture, (x, y), (x + w, y + h), (255, 255, 255), 5)
        cv2.rectangle(picture, (x, y), (x + w, y + h), color, 2)
        _write(picture, one.name, (x, max(y - 6, 12)), _INK, halo=True)
    cell, row = 190, 2 * VIEW_SIZE + 16
    columns = max(1, picture.shape[1] // cell)
    strip = np.full((34 + row * -(-len(judged) // columns), picture.shape[1], 3), 255, np.uint8)
    _write(strip, str(judged[0].goal), (10, 23), _INK)
    for number, one in enumerate(judged):
        x, y = cell * (number % columns) + 10, 34 + row * (number // columns)
        edge = 2 * VIEW_SIZE
        strip[y : y + edge, x : x + edge] = cv2.resize(seen.views[one.name], (edge, edge))
        color = _RELEVANT if one.relevant else _IRRELEVANT
        cv2.rectangle(strip, (x, y), (x + edge, y + edge), color, 2)
        lines = (one.name, one.role, f"{one.score:+.2f}  p {one.probability:.2f}")
        for line, text in enumerate(lines):
            _write(strip, text, (x + edge + 6, y + 16 + 20 * line), color if line == 2 else _INK)
    return np.concatenate([picture, strip])


def _write(
    picture: np.ndarray,
    text: str,
    at: tuple[int, int],
    color: tuple[int, int, int],
    halo: bool = False,
) -> None:
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    if halo:
        cv2.putText(picture, text, at, font, size, (255, 255, 255), 4, cv2.LINE_AA)
    cv2.putText(picture, text, at, font, size, color, 1, cv2.LINE_AA)
