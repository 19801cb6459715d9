"""Images: what a sample of an image tar holds, encoded and decoded.

Everything is lossless: a stored scene renders again to equal pixels, and a test says so.

Shape suffixes: H and W height and width of the image, N objects of the scene, V their
views side by side (N * 32 pixels), 3 RGB.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from relevance.scene import Scene, scene_from_json
from relevance.store.paths import DatasetError

VIEW_SIZE = 32
"""Edge of a canonical view, pixels."""
MEMBERS = ("mask.png", "scene.json", "scene.webp", "views.webp")
"""What every sample of an image tar holds, in this order."""


class Pictures(Protocol):
    """What `write_images` stores of a scene (a `Rendering` is one)."""

    @property
    def image(self) -> np.ndarray: ...
    @property
    def mask(self) -> np.ndarray: ...
    @property
    def views(self) -> np.ndarray: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """One scene with its images, as stored."""

    key: str
    """The scene's id."""
    scene: Scene
    image: np.ndarray
    """(H, W, 3) uint8, RGB."""
    views: np.ndarray
    """(N, 32, 32, 3) uint8, RGB, in the order of the scene's objects."""
    mask: np.ndarray
    """(H, W) uint8: 0 background and table, 1 + i object i."""


def write_tar(path: Path, samples: Iterable[tuple[str, Pictures, str]]) -> None:
    """Write the image tar of (key, pictures, scene JSON); equal samples, equal bytes."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for key, pictures, scene_json in samples:
            for member, content in encode(pictures, scene_json).items():
                # a TarInfo's defaults are time 0, owner 0: equal bytes everywhere
                info = tarfile.TarInfo(f"{key}.{member}")
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))


def encode(pictures: Pictures, scene_json: str) -> dict[str, bytes]:
    """The members of one sample by name, in order."""
    wide_HV3 = np.concatenate(list(pictures.views), axis=1)
    # WebP quality over 100 means lossless
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
    # PNG's filters help photographs; flat regions without are smaller, and faster to read
    unfiltered = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    return {
        "mask.png": _encoded(".png", pictures.mask, unfiltered),
        "scene.json": scene_json.encode(),
        "scene.webp": _encoded(".webp", cv2.cvtColor(pictures.image, cv2.COLOR_RGB2BGR), lossless),
        "views.webp": _encoded(".webp", cv2.cvtColor(wide_HV3, cv2.COLOR_RGB2BGR), lossless),
    }


def _encoded(extension: str, image: np.ndarray, options: list[int]) -> bytes:
    done, content = cv2.imencode(extension, image, options)
    assert done, f"{extension} of shape {image.shape} could not be encoded"
    return content.tobytes()


def undecoded(content: bytes, url: str) -> Iterator[dict[str, Any]]:
    """The samples of an image tar, members by name, grouped as webdataset groups them.

    `tarfile`, on which webdataset's reader rests, takes ten times as long (LOG, fourth round) for
    headers as plain as those that `write_images` wrote: ustar, names shorter than 100 bytes, no
    links. Raises DatasetError for anything else.
    """
    item: dict[str, Any] = {}
    at = 0
    while at < len(content) and content[at]:  # an empty header ends the tar
        name = content[at : at + 100].rstrip(b"\0").decode("ascii", "replace")
        key, dot, member = name.partition(".")
        try:
            size = int(content[at + 124 : at + 135], 8)
        except ValueError:
            size = -1
        if not dot or size < 0 or content[at + 257 : at + 262] != b"ustar":
            raise DatasetError(f"{url}: byte {at}: expected the ustar header of KEY.MEMBER")
        start = at + 512
        end = start + size
        if end > len(content):
            raise DatasetError(f"{url}: {name}: expected {size} bytes, the tar ends before")
        if key != item.get("__key__"):
            if item:
                yield item
            item = {"__key__": key, "__url__": url}
        item[member] = content[start:end]
        at = end + -end % 512
    if item:
        yield item


def decode(item: Mapping[str, Any]) -> Sample:
    """A sample from its members, as webdataset groups them; DatasetError names a bad one."""
    text, where = scene_text(item)
    scene = scene_from_json(text, where=where)
    image, views, mask = decoded(item, len(scene.objects))
    return Sample(key=item["__key__"], scene=scene, image=image, views=views, mask=mask)


def scene_text(item: Mapping[str, Any]) -> tuple[bytes, str]:
    """The scene of a sample as it is stored, and where that is."""
    return _member(item, "scene.json"), f"{item['__url__']}: {item['__key__']}.scene.json"


def decoded(item: Mapping[str, Any], objects: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, views and mask of a sample of so many objects, as in `Sample`."""
    where = f"{item['__url__']}: {item['__key__']}"

    def image(member: str, flag: int) -> np.ndarray:
        content = cv2.imdecode(np.frombuffer(_member(item, member), np.uint8), flag)
        if content is None:
            raise DatasetError(f"{where}.{member}: expected an image, found undecodable bytes")
        return content

    wide_HV3 = cv2.cvtColor(image("views.webp", cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    expected = (VIEW_SIZE, VIEW_SIZE * objects, 3)
    if wide_HV3.shape != expected:
        raise DatasetError(f"{where}.views.webp: expected shape {expected}, found {wide_HV3.shape}")
    return (
        cv2.cvtColor(image("scene.webp", cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB),
        np.stack(np.split(wide_HV3, objects, axis=1)),
        image("mask.png", cv2.IMREAD_GRAYSCALE),
    )


def _member(item: Mapping[str, Any], member: str) -> bytes:
    if member not in item:
        where = f"{item['__url__']}: {item['__key__']}"
        raise DatasetError(f"{where}: expected member {member}, found none")
    return item[member]
