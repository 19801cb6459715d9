"""What a dataset is made of: its settings, its presets, its shards, and dataset.json.

A shard is one unit of work and depends on (config, spec) alone: equal bytes whatever worker
makes it, in whatever order.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from relevance.hashing import content_hash
from relevance.labels import POLICIES
from relevance.planner import PLANNER_VERSION, PlannerConfig
from relevance.sampling import GoalConfig, SceneConfig
from relevance.scene import FAMILIES, PREDICATES, Predicate
from relevance.store import (
    SPLITS,
    TABLES,
    Dataset,
    DatasetError,
    Labelling,
    differences,
    locate,
    sweep,
    table_schema,
)

LAYOUT = 1
"""Version of dataset.json."""


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
    goals: GoalConfig = field(default_factory=GoalConfig)
    """Which pairs of objects goals are asked of."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """How goals are planned."""
    replay_share: float = 0.02
    """Share of the plans that the simulator replays, outside the test split."""
    test_replay_share: float = 1.0
    """The same for the test split."""
    goals_seed: int | None = None
    """Seed of the goals alone, for another goal set over the same scenes; None: `seed`."""
    policy: str = "found"
    """How relevance is read from the plans."""

    def __post_init__(self) -> None:
        def require(name: str, good: bool, expected: str) -> None:
            if not good:
                found = getattr(self, name)
                raise ValueError(f"DatasetConfig.{name} = {found!r}: expected {expected}")

        require("seed", self.seed >= 0, "at least 0")
        require("goals_seed", (self.goals_seed or 0) >= 0, "at least 0")
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
        return content_hash([self.seed, settings_of_family(self.scene, FAMILIES[0])])

    @property
    def plans_hash(self) -> str:
        """Changes with whatever changes a plan row."""
        shares = [self.replay_share, self.test_replay_share]
        return content_hash([self.drawn_by, self.goals_per_scene, self.goals, self.planner, shares])

    @property
    def content_hash(self) -> str:
        """Changes with every setting."""
        return content_hash(self)

    @property
    def drawn_by(self) -> int:
        """Seed of the goals."""
        return self.seed if self.goals_seed is None else self.goals_seed

    @property
    def labelling(self) -> Labelling:
        """How this config labels with the planner of today."""
        return Labelling(planner=PLANNER_VERSION, config=self.plans_hash, policy=self.policy)

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
            train=Counts(same_plane=1000, on=800),
            validation=Counts(same_plane=60, on=80),
            test=Counts(same_plane=40, on=60),
            scenes_per_shard=100,
            goals_per_scene=6,
        )

    @classmethod
    def laptop(cls) -> DatasetConfig:
        """Under an hour on two cores: enough to come close to the best accuracy."""
        return cls(
            train=Counts(same_plane=10_000, on=10_000),
            validation=Counts(same_plane=1_000, on=1_000),
            test=Counts(same_plane=1_000, on=1_000),
            scenes_per_shard=250,
            goals_per_scene=6,
        )

    @classmethod
    def paper(cls) -> DatasetConfig:
        """A night and more: the paper's scale, its same-plane predicates sharing their scenes."""
        return cls(
            train=Counts(same_plane=80_000, on=160_000),
            validation=Counts(same_plane=2_000, on=2_000),
            test=Counts(same_plane=2_000, on=2_000),
            scenes_per_shard=500,
            goals_per_scene=25,
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
        return tuple(p for p in PREDICATES.values() if p.family == self.family)


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


def shard_specs(config: DatasetConfig, finished: list[ShardSpec] | None = None) -> list[ShardSpec]:
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


def prepare(
    root: str | Path, config: DatasetConfig, *, replan: bool = False, scenes_only: bool = False
) -> list[ShardSpec]:
    """Make or extend a dataset's dataset.json; returns every shard of it.

    More scenes than before append shards and renumber none. Raises DatasetError when the
    dataset there was drawn with other settings, or planned with others unless `replan`: then
    `label_shard` makes its plans and labels anew (scenes and images stay, and so do the old
    plans and labels, beside the new ones). With `scenes_only` the planner of today may be
    another one than labelled the dataset.
    """
    root = locate(root)
    if not (root / "dataset.json").exists():
        specs = shard_specs(config)
        Dataset.create(root, describe(config, specs))
        return specs
    there = Dataset.open(root)
    refuse_merged(there)
    sweep(root)
    specs = shard_specs(config, shards_of(there))
    for split in SPLITS:  # asking for fewer than there are keeps what there is
        grown = {
            name: sum(s.count for s in specs if (s.split, s.family) == (split, family))
            for name, family in (("same_plane", "same-plane"), ("on", "on"))
        }
        config = replace(config, **{split: Counts(**grown)})
    wanted = describe(config, specs)
    if scenes_only:
        wanted["planner_version"] = there.description.get("planner_version", PLANNER_VERSION)
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
    if wanted != {key: value for key, value in there.description.items() if key != "finished"}:
        there.describe(wanted)  # and no longer finished
    return specs


_GROWING = (
    "finished",
    "config.train",
    "config.validation",
    "config.test",
    "config.scenes_per_shard",
    "counts",
    "shards",
)
_PLANNING = (
    "config.goals_per_scene",
    "config.goals_seed",
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


def append(root: str | Path, split: str, *, same_plane: int = 0, on: int = 0) -> list[ShardSpec]:
    """Add that many scenes to a split, as further shards with the next indices; all the shards.

    What is there is neither renumbered nor rewritten. Raises DatasetError for an unknown split.
    """
    if split not in SPLITS:
        raise DatasetError(f"split {split!r}: expected one of {', '.join(SPLITS)}")
    if same_plane < 0 or on < 0 or same_plane + on == 0:
        raise DatasetError(f"append {same_plane} and {on} scenes: expected at least 1 in all")
    config = load_config(Dataset.open(root))
    now = config.counts(split)
    more = Counts(same_plane=now.same_plane + same_plane, on=now.on + on)
    return prepare(root, replace(config, **{split: more}), scenes_only=True)


def refuse_merged(dataset: Dataset) -> None:
    """Raises DatasetError for a merged dataset, whose shards are made where they are."""
    if dataset.sources:
        names = ", ".join(str(source.dataset.path) for source in dataset.sources)
        raise DatasetError(f"{dataset.path}: is merged by reference; make shards in {names}")


def settings_of_family(settings: SceneConfig, family: str) -> SceneConfig:
    """Scene settings for a family."""
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
