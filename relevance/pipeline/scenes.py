"""Scenes and images: how one shard of them is drawn and rendered, and which are finished.

A shard's file appears whole, last, by a rename; so a finished shard is one whose file is there
and was drawn with the dataset's settings, and a re-run skips it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from relevance.labels import scene_row
from relevance.pipeline.measuring import Progress, Stopwatch, compiled, took
from relevance.pipeline.mining import Mined, mined_of
from relevance.pipeline.settings import (
    DatasetConfig,
    ShardReport,
    ShardSpec,
    refuse_merged,
    settings_of_family,
    shard_specs,
)
from relevance.sampling import SceneConfig, sample_scene
from relevance.scene import Scene, scene_to_json
from relevance.simulation import Renderer, Rendering, rejects
from relevance.store import Dataset, DatasetError

ATTEMPTS = 1000
"""Draws of one scene before the settings count as impossible."""


def generated(dataset: Dataset, spec: ShardSpec) -> bool:
    """Whether the scenes and images of a shard are there, drawn with the dataset's settings."""
    where: dict[str, Any] = {"split": spec.split, "shard": spec.shard}
    file = dataset.shard_path("scenes", **where)
    if not file.is_file() or not dataset.images_path(**where).is_file():
        return False
    try:
        made_by = dataset.metadata(file)
    except DatasetError:
        return False  # cut short: made anew
    expected = dataset.description.get("hashes", {}).get("scenes")
    return made_by.get("config", expected) == expected


def generate_shard(
    root: str | Path,
    config: DatasetConfig,
    spec: ShardSpec,
    progress: Progress | None = None,
    *,
    anew: bool = False,
) -> ShardReport:
    """Draw and render the scenes of one shard; writes its tar, then its row file.

    Skips a finished shard unless it is to be made `anew`. Raises DatasetError when the settings
    admit no scene, or when the dataset has become one of other settings meanwhile.
    """
    dataset = Dataset.open(root)
    refuse_merged(dataset)
    if generated(dataset, spec) and not anew:
        return ShardReport(spec=spec, predicate=None, skipped=True, rows=spec.count)
    compiled(_draw_one)
    watch = Stopwatch()
    where: dict[str, Any] = {"split": spec.split, "shard": spec.shard}
    rows: list[dict[str, Any]] = []
    config_hash, mined = config.scenes_hash, mined_of(dataset, config)

    def pictures(renderer: Renderer) -> Iterator[tuple[str, Rendering, str]]:
        for index in range(spec.first, spec.first + spec.count):
            scene, rendering, attempt = draw(config, spec, index, renderer, mined)
            rows.append(
                scene_row(
                    scene,
                    rendering,
                    split=spec.split,
                    shard=spec.shard,
                    family=spec.family,
                    seed=config.seed,
                    index=index,
                    attempt=attempt,
                    config_hash=config_hash,
                )
            )
            yield scene.id, rendering, scene_to_json(scene)
            if progress:
                progress(len(rows), spec.count)

        _still(dataset, config_hash)  # before anything appears under its name

    with Renderer() as renderer:
        made = dataset.write_images(samples=pictures(renderer), **where)
    dataset.write_rows("scenes", rows, made_by={**made, "config": config_hash}, **where)
    taken = watch.read()
    took(dataset, "scenes", spec, len(rows), taken)
    return ShardReport(
        spec=spec, predicate=None, skipped=False, rows=len(rows), seconds=taken["seconds"]
    )


def draw(
    config: DatasetConfig,
    spec: ShardSpec,
    index: int,
    renderer: Renderer,
    mined: Mined | None = None,
) -> tuple[Scene, Rendering, int]:
    """Scene `index` of a shard with its rendering, and how many draws were rejected before it."""
    settings = settings_of_family(config.scene, spec.family)
    reason = "no room"
    for attempt in range(ATTEMPTS):
        if mined is not None:
            scene = mined.draw(config, spec.family, index, attempt)
        else:
            scene = sample_scene(
                settings, seed=config.seed, index=index, split=spec.split, attempt=attempt
            )
        if scene is None:
            continue
        rendering = renderer.render(scene)
        reason = rejects(rendering)
        if reason is None:
            return scene, rendering, attempt
    raise DatasetError(
        f"scene {index} of {spec.split}: no draw in {ATTEMPTS} was accepted (last: {reason}); "
        "expected scene settings that leave room for the boxes"
    )


def try_out(config: DatasetConfig) -> None:
    """Draw and render the first scene of each family; raises DatasetError when there is none."""
    if config.mined is not None:
        raise DatasetError(f"mined: expected none, found {config.mined}; `relevance mine` makes it")
    first = {spec.family: spec for spec in reversed(shard_specs(config))}
    if first:
        with Renderer() as renderer:
            for spec in first.values():
                draw(config, spec, spec.first, renderer)


def _still(dataset: Dataset, config_hash: str) -> None:
    """Raises DatasetError when dataset.json no longer says those settings."""
    now = Dataset.open(dataset.path).description.get("hashes", {}).get("scenes")
    if now != config_hash:
        raise DatasetError(
            f"{dataset.path / 'dataset.json'}: hashes.scenes: expected {config_hash}, found {now}; "
            "the dataset is made with other settings"
        )


def _draw_one() -> None:
    """Draw and render a scene, for what is compiled on the way."""
    drawn = (sample_scene(SceneConfig(), seed=0, index=index) for index in range(ATTEMPTS))
    with Renderer() as renderer:
        renderer.render(next(scene for scene in drawn if scene is not None))
