"""Making a dataset: which shards there are, and how one of each kind is made.

A shard is one unit of work and depends on (config, spec) alone: equal bytes whatever worker
makes it, in whatever order. Its file appears whole, last, by a rename; so a finished shard is
one whose file is there, and a re-run skips it. Scenes and images are made once
(`generate_shard`); planning and labelling read the stored scenes and never render
(`label_shard`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from relevance.labels import (
    POLICIES,
    label_rows,
    plan_row,
    scene_row,
    stored_scene,
    timing_row,
)
from relevance.planner import PLANNER_VERSION, PlannerConfig, plan, warm_up
from relevance.sampling import SceneConfig, sample_goals, sample_scene
from relevance.scene import FAMILIES, Predicate, Scene, content_hash, scene_to_json
from relevance.simulation import Renderer, Rendering, rejects, replay
from relevance.store import (
    SPLITS,
    TABLES,
    Dataset,
    DatasetError,
    differences,
    table_schema,
)

LAYOUT = 1
"""Version of dataset.json."""
ATTEMPTS = 1000
"""Draws of one scene before the settings count as impossible."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Number of scenes of each family in one split."""

    same_plane: int = 0
    on: int = 0

    def __post_init__(self) -> None:
        for name in ("same_plane", "on"):
            if getattr(self, name) < 0:
                raise ValueError(f"Counts.{name} = {getattr(self, name)}: expected at least 0")

    def of(self, family: str) -> int:
        """Number of scenes of a family."""
        return self.on if family == "on" else self.same_plane


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetConfig:
    """What a dataset is made of; raises ValueError that names the field."""

    seed: int = 0
    """Seed of everything that is drawn."""
    train: Counts = field(default_factory=Counts)
    """Scenes to train on."""
    validation: Counts = field(default_factory=Counts)
    """Scenes to choose by."""
    test: Counts = field(default_factory=Counts)
    """Scenes that only evaluation sees."""
    scenes_per_shard: int = 100
    """Scenes in one unit of work."""
    goals_per_scene: int = 3
    """Goals drawn for each scene and predicate."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How scenes are drawn; `family` is set by the shard."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """How goals are planned."""
    replay_share: float = 0.02
    """Share of the plans that the simulator replays, outside the test split."""
    test_replay_share: float = 1.0
    """The same for the test split."""
    policy: str = "found"
    """How relevance is read from the plans."""

    def __post_init__(self) -> None:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                found = getattr(self, name)
                raise ValueError(f"DatasetConfig.{name} = {found!r}: expected {expected}")

        require("seed", self.seed >= 0, "at least 0")
        require("scenes_per_shard", self.scenes_per_shard >= 1, "at least 1")
        require("goals_per_scene", self.goals_per_scene >= 1, "at least 1")
        require("replay_share", 0 <= self.replay_share <= 1, "0 to 1")
        require("test_replay_share", 0 <= self.test_replay_share <= 1, "0 to 1")
        require("policy", self.policy in POLICIES, f"one of {', '.join(POLICIES)}")

    def counts(self, split: str) -> Counts:
        """Scenes asked for in a split."""
        return {"train": self.train, "validation": self.validation, "test": self.test}[split]

    @property
    def scenes_hash(self) -> str:
        """Changes with whatever changes a scene, not with how many there are."""
        return content_hash([self.seed, _family(self.scene, FAMILIES[0])])

    @property
    def plans_hash(self) -> str:
        """Changes with whatever changes a plan row."""
        shares = [self.replay_share, self.test_replay_share]
        return content_hash([self.seed, self.goals_per_scene, self.planner, shares])

    @classmethod
    def smoke(cls) -> DatasetConfig:
        """Seconds: for tests, and to see that everything runs."""
        return cls(
            train=Counts(same_plane=12, on=12),
            validation=Counts(same_plane=4, on=4),
            test=Counts(same_plane=4, on=4),
            scenes_per_shard=6,
            goals_per_scene=2,
        )

    @classmethod
    def demo(cls) -> DatasetConfig:
        """Minutes: enough for a small network to learn from."""
        return cls(
            train=Counts(same_plane=1300, on=1000),
            validation=Counts(same_plane=80, on=100),
            test=Counts(same_plane=60, on=80),
            scenes_per_shard=100,
            goals_per_scene=2,
        )

    @classmethod
    def laptop(cls) -> DatasetConfig:
        """Hours: enough to come close to the best accuracy."""
        return cls(
            train=Counts(same_plane=24_000, on=24_000),
            validation=Counts(same_plane=500, on=500),
            test=Counts(same_plane=500, on=500),
            scenes_per_shard=250,
            goals_per_scene=4,
        )

    @classmethod
    def paper(cls) -> DatasetConfig:
        """A night: about the paper's 9 million queries a predicate."""
        return cls(
            train=Counts(same_plane=400_000, on=400_000),
            validation=Counts(same_plane=2_000, on=2_000),
            test=Counts(same_plane=2_000, on=2_000),
            scenes_per_shard=1_000,
            goals_per_scene=5,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardSpec:
    """One unit of work: scenes `first` to `first + count - 1` of a split, all of one family."""

    split: str
    shard: int
    family: str
    first: int
    count: int

    @property
    def predicates(self) -> tuple[Predicate, ...]:
        """The predicates that its scenes are asked."""
        return tuple(p for p in Predicate if p.family == self.family)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardReport:
    """What became of one unit of work."""

    spec: ShardSpec
    predicate: str | None
    """None for scenes and images."""
    skipped: bool
    """It was finished before."""
    rows: int
    """Scenes, or goals."""
    holds: int = 0
    """Plans that hold (labelling only)."""
    seconds: float = 0.0


def work(config: DatasetConfig, finished: list[ShardSpec] | None = None) -> list[ShardSpec]:
    """Every shard of a config; `finished` ones stay as they are, more are appended to them."""
    specs = list(finished or ())
    for split in SPLITS:
        for family in FAMILIES:
            have = sum(s.count for s in specs if (s.split, s.family) == (split, family))
            missing = config.counts(split).of(family) - have
            while missing > 0:
                mine = [s for s in specs if s.split == split]
                count = min(missing, config.scenes_per_shard)
                specs.append(
                    ShardSpec(
                        split=split,
                        shard=len(mine),
                        family=family,
                        first=sum(s.count for s in mine),
                        count=count,
                    )
                )
                missing -= count
    return sorted(specs, key=lambda s: (SPLITS.index(s.split), s.shard))


def prepare(root: str | Path, config: DatasetConfig, *, replan: bool = False) -> list[ShardSpec]:
    """Make or extend a dataset's dataset.json; returns every shard of it.

    More scenes than before append shards and renumber none. Raises DatasetError when the
    dataset there was drawn with other settings, or planned with others unless `replan`: then
    `label_shard` makes its plans and labels anew (scenes and images stay).
    """
    root = Path(root)
    if not (root / "dataset.json").exists():
        specs = work(config)
        Dataset.create(root, describe(config, specs))
        return specs
    there = Dataset.open(root)
    specs = work(config, shards_of(there))
    for split in SPLITS:  # asking for fewer than there are keeps what there is
        grown = {
            name: sum(s.count for s in specs if (s.split, s.family) == (split, family))
            for name, family in (("same_plane", "same-plane"), ("on", "on"))
        }
        config = replace(config, **{split: Counts(**grown)})
    wanted = describe(config, specs)
    ignore = _GROWING + (_PLANNING if replan else ())
    # read and written again: a setting that is younger than the dataset has its default there
    before = {**there.description, "config": _CONFIG.dump_python(load_config(there), mode="json")}
    for key, found, expected in differences(before, wanted, ignore=ignore):
        planning = key.startswith(_PLANNING)
        hint = "plan it anew (replan)" if planning else "take another folder or the same settings"
        raise DatasetError(
            f"{root / 'dataset.json'}: {key}: the dataset was made with {found!r}, "
            f"found {expected!r}; {hint}"
        )
    if wanted != there.description:
        there.describe(wanted)
    return specs


_GROWING = (
    "config.train",
    "config.validation",
    "config.test",
    "config.scenes_per_shard",
    "counts",
    "shards",
)
_PLANNING = (
    "config.goals_per_scene",
    "config.planner",
    "config.policy",
    "config.replay_share",
    "config.test_replay_share",
    "hashes.plans",
    "planner_version",
)


def describe(config: DatasetConfig, specs: list[ShardSpec]) -> dict[str, Any]:
    """What dataset.json holds: settings, their hashes, versions, counts and the shards."""
    return {
        "layout": LAYOUT,
        "config": _CONFIG.dump_python(config, mode="json"),
        "hashes": {"scenes": config.scenes_hash, "plans": config.plans_hash},
        "planner_version": PLANNER_VERSION,
        "tables": {table: table_schema(table).version for table in TABLES},
        "counts": {
            split: {
                family: sum(s.count for s in specs if (s.split, s.family) == (split, family))
                for family in FAMILIES
            }
            for split in SPLITS
        },
        "shards": _SPECS.dump_python(specs, mode="json"),
    }


def load_config(dataset: Dataset) -> DatasetConfig:
    """The config that a dataset was made with; raises DatasetError that names the field."""
    return _from_description(dataset, "config", _CONFIG)


def shards_of(dataset: Dataset) -> list[ShardSpec]:
    """Every shard that dataset.json lists, finished or not."""
    return _from_description(dataset, "shards", _SPECS)


def generate_shard(
    root: str | Path,
    config: DatasetConfig,
    spec: ShardSpec,
    progress: Progress | None = None,
) -> ShardReport:
    """Draw and render the scenes of one shard; writes its tar, then its row file.

    Skips a finished shard. Raises DatasetError when the settings admit no scene.
    """
    dataset = Dataset.open(root)
    started = time.perf_counter()
    where: dict[str, Any] = {"split": spec.split, "shard": spec.shard}
    if dataset.has("scenes", **where) and dataset.images_path(**where).is_file():
        return ShardReport(spec=spec, predicate=None, skipped=True, rows=spec.count)
    rows: list[dict[str, Any]] = []
    config_hash = config.scenes_hash

    def pictures(renderer: Renderer) -> Iterator[tuple[str, Rendering, str]]:
        for index in range(spec.first, spec.first + spec.count):
            scene, rendering, attempt = draw(config, spec, index, renderer)
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

    with Renderer() as renderer:
        made = dataset.write_images(samples=pictures(renderer), **where)
    dataset.write_rows("scenes", rows, made_by=made, **where)
    seconds = time.perf_counter() - started
    return ShardReport(spec=spec, predicate=None, skipped=False, rows=len(rows), seconds=seconds)


def draw(
    config: DatasetConfig, spec: ShardSpec, index: int, renderer: Renderer
) -> tuple[Scene, Rendering, int]:
    """Scene `index` of a shard with its rendering, and how many draws were rejected before it."""
    settings = _family(config.scene, spec.family)
    reason = "no room"
    for attempt in range(ATTEMPTS):
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


def label_shard(
    root: str | Path,
    config: DatasetConfig,
    spec: ShardSpec,
    predicate: Predicate | str,
    progress: Progress | None = None,
) -> ShardReport:
    """Plan the goals of one shard's stored scenes; writes timings, plans, then labels.

    Skips what was made with this config, planner version and policy; makes anything else
    anew. Raises DatasetError when the scenes are not there, ValueError for a predicate of
    another family.
    """
    predicate = Predicate(predicate)
    if predicate not in spec.predicates:
        raise ValueError(f"{predicate.value}: expected a predicate of family {spec.family}")
    dataset = Dataset.open(root)
    started = time.perf_counter()
    scenes = {"split": spec.split, "shard": spec.shard}
    where: dict[str, Any] = {**scenes, "predicate": predicate.value}
    plans_by = {"config": config.plans_hash, "planner": PLANNER_VERSION}
    labels_by = {**plans_by, "policy": config.policy}
    plans: list[dict[str, Any]] = []
    planned = _made_by(dataset, "plans", plans_by, where)
    skipped = planned and _made_by(dataset, "labels", labels_by, where)
    if planned:
        plans = dataset.read_rows("plans", **where)
    if not skipped:
        if not dataset.has("scenes", **scenes):
            file = dataset.shard_path("scenes", **scenes)
            raise DatasetError(f"{file}: does not exist, expected its scenes to be made first")
        rows = dataset.read_rows("scenes", **scenes)
        if not planned:
            plans, timings = _plans(config, predicate, rows, progress)
            # Plans after timings and labels last: a finished plan file is never planned again.
            dataset.write_rows("timings", timings, made_by=plans_by, **where)
            dataset.write_rows("plans", plans, made_by=plans_by, **where)
        by_id = {row["scene_id"]: row for row in rows}
        labels = [
            label
            for row in plans
            for label in label_rows(by_id[row["scene_id"]], row, config.policy)
        ]
        dataset.write_rows("labels", labels, made_by=labels_by, **where)
    return ShardReport(
        spec=spec,
        predicate=predicate.value,
        skipped=skipped,
        rows=len(plans),
        holds=sum(row["holds"] for row in plans),
        seconds=time.perf_counter() - started,
    )


def _plans(
    config: DatasetConfig,
    predicate: Predicate,
    rows: list[dict[str, Any]],
    progress: Progress | None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    plans: list[dict[str, Any]] = []
    timings: list[dict[str, Any]] = []
    config_hash = config.plans_hash
    warm_up()
    for done, row in enumerate(rows, 1):
        scene = stored_scene(row)
        share = config.test_replay_share if row["split"] == "test" else config.replay_share
        for goal in sample_goals(scene, predicate, config.goals_per_scene, seed=config.seed):
            result = plan(scene, goal, config=config.planner)
            verdict, seconds = None, None
            if result.status == "solved" and _chosen(scene.id, str(goal), share):
                started = time.perf_counter()
                verdict = replay(scene, goal, result.phases)
                seconds = time.perf_counter() - started
            plans.append(
                plan_row(
                    scene,
                    row["split"],
                    row["shard"],
                    result,
                    verdict,
                    config_hash=config_hash,
                )
            )
            timings.append(timing_row(plans[-1], result, seconds_replay=seconds))
        if progress:
            progress(done, len(rows))
    return plans, timings


def _chosen(scene_id: str, goal: str, share: float) -> bool:
    """Whether a plan is among the replayed share: drawn by its task, so that order is nothing."""
    return int(content_hash(["replay", scene_id, goal])[:8], 16) < share * 2**32


def _made_by(dataset: Dataset, table: str, expected: dict[str, str], where: dict[str, Any]) -> bool:
    if not dataset.has(table, **where):
        return False
    found = dataset.metadata(dataset.shard_path(table, **where))
    return all(found.get(key) == value for key, value in expected.items())


def _family(settings: SceneConfig, family: str) -> SceneConfig:
    return replace(settings, family=family)


def _from_description(dataset: Dataset, key: str, adapter: TypeAdapter[Any]) -> Any:
    file = dataset.path / "dataset.json"
    if key not in dataset.description:
        raise DatasetError(f"{file}: {key}: expected there, found no such key")
    try:
        return adapter.validate_python(dataset.description[key])
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field_name = ".".join(str(part) for part in (key, *first["loc"]))
        raise DatasetError(f"{file}: {field_name}: {first['msg']}") from None


_CONFIG = TypeAdapter(DatasetConfig)
_SPECS = TypeAdapter(list[ShardSpec])
