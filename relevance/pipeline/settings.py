"""What a dataset is made of: its settings, its presets, its shards.

A shard is one unit of work and depends on (config, spec) alone: equal bytes whatever worker
makes it, in whatever order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, field_validator

from relevance.configs import ConfigError, config, first_error, identity_hash
from relevance.labels import LABELS_VERSION, POLICIES
from relevance.planner import PLANNER_VERSION, PlannerConfig
from relevance.sampling import SAMPLER_VERSION, GoalConfig, Randomisation, SceneConfig
from relevance.scene import FAMILIES, Predicate, asked_of
from relevance.simulation import RENDERER_VERSION
from relevance.store import SPLITS, Dataset, DatasetError, Labelling

Natural = Annotated[int, Field(ge=0, lt=2**63)]
Positive = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]


@config
class Counts:
    """Number of scenes of each family in one split: one field a family of `scene.FAMILIES`."""

    same_plane: Natural = 0
    on: Natural = 0
    stacks: Natural = 0

    def of(self, family: str) -> int:
        """Number of scenes of a family."""
        return getattr(self, _field(family))

    @classmethod
    def by_family(cls, counts: Mapping[str, int]) -> Counts:
        """Counts from the families' names."""
        return cls(**{_field(family): count for family, count in counts.items()})

    @classmethod
    def total(cls, parts: Iterable[Counts]) -> Counts:
        """The sum of several."""
        several = list(parts)
        return cls.by_family({f: sum(counts.of(f) for counts in several) for f in FAMILIES})


def _field(family: str) -> str:
    return family.replace("-", "_")


@config
class DatasetConfig:
    """What a dataset is made of; raises ConfigError that names the field."""

    seed: Natural = 0
    """Seed of everything that is drawn."""
    train: Counts = field(default_factory=Counts)
    """Scenes to train on."""
    validation: Counts = field(default_factory=Counts)
    """Scenes to choose by."""
    test: Counts = field(default_factory=Counts)
    """Scenes that only evaluation sees."""
    own_scenes: bool = False
    """Whether each predicate has scenes of its own, that many each, as in the paper; else all
    predicates of a family are asked of the same scenes."""
    scenes_per_shard: Positive = 100
    """Scenes in one unit of work."""
    goals_per_scene: Positive = 3
    """Goals drawn for each scene and predicate."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How scenes are drawn; `family` is set by the shard."""
    goals: GoalConfig = field(default_factory=GoalConfig)
    """Which pairs of objects goals are asked of."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """How goals are planned."""
    replay_share: Share = 0.02
    """Share of the plans that the simulator replays, outside the test split."""
    test_replay_share: Share = 1.0
    """The same for the test split."""
    goals_seed: Natural | None = None
    """Seed of the goals alone, for another goal set over the same scenes; None: `seed`."""
    policy: str = "found"
    """How relevance is read from the plans."""
    mined: str | None = None
    """Hash of what `relevance mine` found, of which the scenes are near copies and which they are
    asked (`mined.json`); None: all is drawn at random."""

    @field_validator("policy")
    @classmethod
    def _known(cls, policy: str) -> str:
        if policy not in POLICIES:
            raise ValueError(f"one of {', '.join(POLICIES)}")
        return policy

    def counts(self, split: str) -> Counts:
        """Scenes asked for in a split."""
        return {"train": self.train, "validation": self.validation, "test": self.test}[split]

    @property
    def drawn_as(self) -> DatasetConfig:
        """The settings that change a scene, all others at their defaults."""
        return DatasetConfig(
            seed=self.seed,
            own_scenes=self.own_scenes,
            mined=self.mined,
            scene=settings_of_family(self.scene, FAMILIES[0]),
        )

    @property
    def planned_as(self) -> DatasetConfig:
        """The settings that change a plan row, all others at their defaults."""
        return DatasetConfig(
            goals_seed=self.drawn_by,
            goals_per_scene=self.goals_per_scene,
            goals=self.goals,
            planner=self.planner,
            replay_share=self.replay_share,
            test_replay_share=self.test_replay_share,
            mined=self.mined,
        )

    @property
    def scenes_hash(self) -> str:
        """Changes with whatever changes a scene, not with how many there are."""
        return identity_hash(self.drawn_as, sampler=SAMPLER_VERSION, renderer=RENDERER_VERSION)

    @property
    def plans_hash(self) -> str:
        """Changes with whatever changes a plan row, but for the planner, which is named beside."""
        return identity_hash(self.planned_as, sampler=SAMPLER_VERSION, labels=LABELS_VERSION)

    @property
    def content_hash(self) -> str:
        """Changes with every setting and every version."""
        return identity_hash(self, **versions(), planner=PLANNER_VERSION)

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
            train=Counts(same_plane=1000, on=1600),
            validation=Counts(same_plane=60, on=160),
            test=Counts(same_plane=40, on=120),
            scenes_per_shard=100,
            goals_per_scene=6,
        )

    @classmethod
    def laptop(cls) -> DatasetConfig:
        """Under an hour on two cores: enough to come close to the best accuracy."""
        return cls(
            train=Counts(same_plane=10_000, on=16_000, stacks=8_000),
            validation=Counts(same_plane=1_000, on=1_000, stacks=800),
            test=Counts(same_plane=1_000, on=1_600, stacks=800),
            scenes_per_shard=250,
            goals_per_scene=6,
        )

    @classmethod
    def crowd(cls) -> DatasetConfig:
        """Under half an hour on two cores: up to 30 boxes, plans of up to 12 actions."""
        return cls(
            train=Counts(same_plane=2_200, stacks=2_200),
            validation=Counts(same_plane=150, stacks=150),
            test=Counts(same_plane=250, stacks=250),
            scenes_per_shard=50,
            goals_per_scene=3,
            scene=SceneConfig(min_objects=3, max_objects=30),
            planner=PlannerConfig(max_actions=12),
            test_replay_share=0.2,
        )

    @classmethod
    def randomised(cls) -> DatasetConfig:
        """Some half an hour on one core: lights, tables, cameras and colours differ by scene."""
        return cls(
            train=Counts(same_plane=3_000, on=5_000, stacks=1_500),
            validation=Counts(same_plane=300, on=400, stacks=200),
            test=Counts(same_plane=300, on=500, stacks=200),
            scenes_per_shard=100,
            goals_per_scene=6,
            scene=SceneConfig(randomisation=Randomisation()),
        )

    @classmethod
    def paper(cls) -> DatasetConfig:
        """A day and more: the paper's scale, each predicate with scenes of its own."""
        return cls(
            train=Counts(same_plane=80_000, on=160_000),
            validation=Counts(same_plane=800, on=1_600),
            test=Counts(same_plane=800, on=1_600),
            own_scenes=True,
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
    predicate: str | None = None
    """The predicate that the scenes are for; None: all that are asked of the family."""

    @property
    def predicates(self) -> tuple[Predicate, ...]:
        """The predicates that its scenes are asked."""
        return tuple(p for p in asked_of(self.family) if self.predicate in (None, p.name))


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


def versions() -> dict[str, str]:
    """Versions of the stages of today, but for the planner's."""
    return {"sampler": SAMPLER_VERSION, "renderer": RENDERER_VERSION, "labels": LABELS_VERSION}


def settings_of_family(settings: SceneConfig, family: str) -> SceneConfig:
    """Scene settings for a family."""
    return replace(settings, family=family)


def scenes_of(specs: Iterable[ShardSpec], split: str, *, each: bool = False) -> Counts:
    """How many scenes the shards of a split have, or of `each` predicate with its own."""
    scenes = {family: Counter[str | None]() for family in FAMILIES}
    for spec in specs:
        if spec.split == split:
            scenes[spec.family][spec.predicate] += spec.count
    count = max if each else sum
    return Counts.by_family({f: count(found.values() or [0]) for f, found in scenes.items()})


def shard_specs(config: DatasetConfig, finished: list[ShardSpec] | None = None) -> list[ShardSpec]:
    """Every shard of a config; `finished` ones stay as they are, more are appended to them."""
    specs = list(finished or ())
    for split in SPLITS:
        for family, predicate in _asked(config):
            wanted = (split, family, predicate)
            have = sum(s.count for s in specs if (s.split, s.family, s.predicate) == wanted)
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
                        predicate=predicate,
                    )
                )
                missing -= count
    return sorted(specs, key=lambda s: (SPLITS.index(s.split), s.shard))


def _asked(config: DatasetConfig) -> list[tuple[str, str | None]]:
    """What scenes are drawn for: families, or each family's predicates with their own."""
    if not config.own_scenes:
        return [(family, None) for family in FAMILIES]
    return [(family, predicate.name) for family in FAMILIES for predicate in asked_of(family)]


def load_config(dataset: Dataset) -> DatasetConfig:
    """The config that a dataset was made with; raises DatasetError that names the field."""
    return read_config(dataset, "config", dataset.description)


def read_config(dataset: Dataset, key: str, said: Mapping[str, Any]) -> DatasetConfig:
    """A config that is kept in dataset.json, younger settings having their defaults."""
    return _from_description(dataset, key, said, _CONFIG)


def fitting_preset(train_scenes: int) -> Literal["smoke", "demo", "laptop", "paper"]:
    """The preset of training that fits so many scenes: the largest whose dataset has at most twice
    as many."""
    presets = (DatasetConfig.paper(), DatasetConfig.laptop(), DatasetConfig.demo())
    paper, laptop, demo = (
        sum(preset.train.of(family) for family in FAMILIES) <= 2 * train_scenes
        for preset in presets
    )
    return "paper" if paper else "laptop" if laptop else "demo" if demo else "smoke"


def shards_of(dataset: Dataset) -> list[ShardSpec]:
    """Every shard that dataset.json lists, finished or not."""
    return _from_description(dataset, "shards", dataset.description, _SPECS)


def dump_config(config: DatasetConfig) -> dict[str, Any]:
    """The JSON form of a config."""
    return _CONFIG.dump_python(config, mode="json")


def dump_specs(specs: Sequence[ShardSpec]) -> list[dict[str, Any]]:
    """The JSON form of shards."""
    return _SPECS.dump_python(list(specs), mode="json")


def refuse_merged(dataset: Dataset) -> None:
    """Raises DatasetError for a merged dataset, whose shards are made where they are."""
    if dataset.sources:
        names = ", ".join(str(source.dataset.path) for source in dataset.sources)
        raise DatasetError(f"{dataset.path}: is merged by reference; make shards in {names}")


def _from_description(
    dataset: Dataset, key: str, said: Mapping[str, Any], adapter: TypeAdapter[Any]
) -> Any:
    file = dataset.path / "dataset.json"
    if key not in said:
        raise DatasetError(f"{file}: {key}: expected there, found no such key")
    try:
        return adapter.validate_python(said[key])
    except ConfigError as error:
        raise DatasetError(f"{file}: {key}: {error}") from None
    except ValidationError as error:
        raise DatasetError(f"{file}: {key}{first_error(error)}") from None


_CONFIG = TypeAdapter(DatasetConfig)
_SPECS = TypeAdapter(list[ShardSpec])
