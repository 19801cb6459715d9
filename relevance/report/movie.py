"""Films of plans, as GIF or MP4, drawn without a window or a browser."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from relevance.errors import RelevanceError
from relevance.planner import Moment
from relevance.report.shots import Shot, words
from relevance.report.style import FAINT, INK, MUTED, RELEVANT
from relevance.simulation import Film, film_camera
from relevance.store import replacing

SIZE = (400, 300)
"""Width and height of the picture over the caption, pixels."""
RATE = 10
"""Frames a second."""
SPEED = 2.0
"""How much faster than the arm it runs."""
_CAPTION = 40
_COLORS = 128
_REST = 1.5  # s that the last frame stays
_CODEC = "vp09"  # what browsers play of what every OpenCV writes


def film(
    paths: Sequence[Path],
    shot: Shot,
    *,
    size: tuple[int, int] = SIZE,
    rate: int = RATE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the same film to files that end in .gif or .mp4, each whole or not at all.

    Raises RelevanceError for a file that ends otherwise.
    """
    for path in paths:
        if path.suffix.lower() not in WRITERS:
            raise RelevanceError(f"{path}: expected a name that ends in {' or '.join(WRITERS)}")
    total, drawn = count_frames(shot, rate=rate), []
    for picture in frames(shot, size=size, rate=rate):
        drawn.append(picture)
        progress(len(drawn), total)
    for path in paths:
        kind = path.suffix.lower()
        with tempfile.TemporaryDirectory(prefix="relevance-film-") as folder:
            made = Path(folder) / f"film{kind}"  # writers go by the ending
            WRITERS[kind](made, drawn, rate)
            with replacing(path) as temporary:
                temporary.write_bytes(made.read_bytes())


def count_frames(shot: Shot, *, rate: int = RATE) -> int:
    """How many pictures a film has."""
    return math.ceil(shot.motion.seconds / SPEED * rate) + 1


def frames(shot: Shot, *, size: tuple[int, int] = SIZE, rate: int = RATE) -> Iterator[np.ndarray]:
    """The pictures of a film, (H, W, 3) uint8 RGB: a plan from its first moment to its last."""
    times = np.linspace(0.0, shot.motion.seconds, count_frames(shot, rate=rate))
    scene = shot.task.scene
    with Film(scene, film_camera(scene, *size)) as camera:
        for seconds in times:
            now = shot.motion.at(float(seconds))
            picture, shown = camera.frame(now.joints, now.gripper, now.poses)
            for name in shot.relevant:
                _outline(picture, shown[name])
            yield np.vstack([picture, _caption(shot, now, float(seconds), size[0])])


def _outline(picture: np.ndarray, mask: np.ndarray) -> None:
    """Draw around what is shown of a box."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    color = tuple(bytes.fromhex(RELEVANT.removeprefix("#")))
    cv2.polylines(picture, found, True, (255, 255, 255), 2, cv2.LINE_AA)
    cv2.polylines(picture, found, True, color, 1, cv2.LINE_AA)


def _caption(shot: Shot, now: Moment, seconds: float, width: int) -> np.ndarray:
    """The goal, the step that is under way and how far the plan is, as pixels."""
    image = Image.new("RGB", (width, _CAPTION), "white")
    draw = ImageDraw.Draw(image)
    small, large = ImageFont.load_default(size=11), ImageFont.load_default(size=13)
    whole = shot.motion.seconds
    draw.rectangle((0, 0, width, 2), fill=FAINT)
    draw.rectangle((0, 0, width * (seconds / whole if whole else 1.0), 2), fill=RELEVANT)
    actions = shot.motion.actions
    if now.step < len(actions):
        step = f"{now.step + 1}/{len(actions)}  {words(actions[now.step])}"
    else:
        step = "done"
    draw.text((8, 6), str(shot.task.goal), font=small, fill=MUTED)
    draw.text((8, 20), step, font=large, fill=INK)
    return np.asarray(image)


def _write_gif(path: Path, pictures: list[np.ndarray], rate: int) -> None:
    """One palette for all and no dithering: what stands still costs nothing then."""
    palette = _palette(np.stack(pictures[:: max(len(pictures) // 8, 1)]))
    first, *rest = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    )
    lasting = [1000 // rate] * len(rest) + [int(1000 * _REST)]
    first.save(path, save_all=True, append_images=rest, duration=lasting, loop=0)


def _palette(pictures: np.ndarray) -> Image.Image:
    """Colours for pictures (..., 3): small things count too, by the root of their pixels."""
    pixels = pictures.reshape(-1, 3)
    alike = (pixels >> 3) @ np.array([1024, 32, 1])
    count = np.bincount(alike)
    there = np.flatnonzero(count)
    means = [np.bincount(alike, pixels[:, k])[there] / count[there] for k in range(3)]
    colors = np.rint(np.stack(means, axis=1)).astype(np.uint8)
    weighed = np.repeat(colors, np.ceil(np.sqrt(count[there])).astype(int), axis=0)
    return Image.fromarray(weighed[None]).quantize(_COLORS)


def _write_mp4(path: Path, pictures: list[np.ndarray], rate: int) -> None:
    """VP9, which needs even sides."""
    height, width = (side - side % 2 for side in pictures[0].shape[:2])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*_CODEC), rate, (width, height))
    if not writer.isOpened():
        raise RelevanceError(f"this OpenCV cannot write MP4 ({_CODEC}); expected that of PyPI")
    for picture in [*pictures, *pictures[-1:] * round(_REST * rate)]:
        writer.write(cv2.cvtColor(picture[:height, :width], cv2.COLOR_RGB2BGR))
    writer.release()


WRITERS: dict[str, Callable[[Path, list[np.ndarray], int], None]] = {
    ".gif": _write_gif,
    ".mp4": _write_mp4,
}
"""Kinds of films, by the ending of their files."""
