"""Suites: small test sets that are drawn otherwise than what a network learned from.

Frozen: an entry never changes, so that figures can be compared; another setting is another entry.
`relevance suite NAME OUT` makes one; every command that takes a dataset takes it, with a
checkpoint that was trained elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from relevance.pipeline import Counts, DatasetConfig, load_config
from relevance.planner import PlannerConfig
from relevance.registry import Registry
from relevance.sampling import Randomisation, SceneConfig
from relevance.scene import FAMILIES, Camera, Robot
from relevance.store import Dataset, DatasetError

SEED = 14
"""Of every suite."""
LONG = PlannerConfig(max_actions=12)
"""For more boxes than plans of six actions can clear away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Suite:
    """A test set by name."""

    name: str
    about: str
    """What differs from the scenes that networks learn from."""
    scene: SceneConfig
    families: tuple[str, ...] = ("same-plane", "on")
    planner: PlannerConfig = field(default_factory=PlannerConfig)

    def config(self, scenes: int) -> DatasetConfig:
        """Its dataset, with that many scenes of each family; fewer are the first of more."""
        return DatasetConfig(
            seed=SEED,
            test=Counts.by_family({f: scenes * (f in self.families) for f in FAMILIES}),
            scenes_per_shard=25,
            scene=self.scene,
            planner=self.planner,
        )


SUITES: Registry[Suite] = Registry("suite")
"""Every suite by name."""

for _suite in (
    Suite(
        name="boxes-20",
        about="20 boxes on the table",
        scene=SceneConfig(min_objects=20, max_objects=20),
        families=("same-plane", "stacks"),
        planner=LONG,
    ),
    Suite(
        name="boxes-30",
        about="30 boxes on the table",
        scene=SceneConfig(min_objects=30, max_objects=30),
        families=("same-plane", "stacks"),
        planner=LONG,
    ),
    Suite(
        name="unseen-sizes",
        about="edges of 2.5 to 16 cm instead of 4 to 12: thinner, longer and taller boxes",
        scene=SceneConfig(min_edge=0.025, max_edge=0.16, max_height=0.16, stack_height=0.18),
    ),
    Suite(
        name="unseen-colours",
        about="pale and grey boxes, a third of which look like another one",
        scene=SceneConfig(
            saturation=(0.0, 0.4), brightness=(0.2, 0.85), color_distance=0.12, twins=0.35
        ),
    ),
    Suite(
        name="camera-shifted",
        about="the camera stands 7 cm, and looks 4 cm, beside where it did",
        scene=SceneConfig(camera=Camera(eye=(-0.71, 0.05, 0.68), target=(0.03, -0.02, 0.0))),
    ),
    Suite(
        name="lights-and-textures",
        about="another light and another table, mostly with a pattern, in every scene",
        scene=SceneConfig(randomisation=Randomisation(camera_shift=0.0, camera_fov=0.0)),
    ),
    Suite(
        name="occluded",
        about="boxes hide a third of each other, on average",
        scene=SceneConfig(
            min_objects=7, on_objects=(7, 10), crowding_on=1.0, visible=0.26, occlusion=0.33
        ),
    ),
    Suite(
        name="arm-camera",
        about="seen from over the table, by a wide lens, as from the arm's hand in its ready pose",
        scene=SceneConfig(camera=Camera(eye=(-0.18, 0.0, 0.55), target=(0.02, 0.0, 0.0), fov=69.0)),
    ),
    Suite(
        name="robot-elsewhere",
        about="the robot stands 20 cm to the left and 4 cm back, turned as ever",
        scene=SceneConfig(robot=Robot(base=(-0.52, 0.2, 0.0))),
    ),
):
    SUITES.register(_suite.name, _suite)


def suite_of(dataset: Dataset) -> str | None:
    """The name of the suite whose scenes a dataset has; None where they are of none."""
    try:
        drawn = load_config(dataset).scenes_hash
    except DatasetError:  # merged, or of an older layout
        return None
    names = (name for name, suite in SUITES.items() if suite.config(1).scenes_hash == drawn)
    return next(names, None)
