"""Studies: declared sets of trainings that make a table together, each for some time of a core.

A study is settings alone; `run_study` trains them. The body or setting that a row of its table
is about is the run's `label`; runs that differ in their seed alone share it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from relevance.models import BODIES
from relevance.networks import read_checkpoint, shipped
from relevance.registry import Registry
from relevance.scene import PREDICATES
from relevance.training.settings import TrainConfig

PAPERS = ("vit", "resnet", "resnet3d")
"""The paper's bodies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One network: what it is and how long it learns."""

    label: str
    """What its row is about, the same for every seed."""
    recipe: str
    config: TrainConfig
    """Its steps mean nothing: those that fit into the time are taken."""
    share: float = 1.0
    """Of the study's time for a run."""
    curve: str = ""
    """The picture that its learning curve is in; in none when empty."""
    ship: str = ""
    """The name under which it comes with the package, if it does."""

    @property
    def name(self) -> str:
        """Its label, the scenes that it learns from where those are not all, its seed."""
        families = "".join(f", {family}" for family in self.config.families)
        return f"{self.label}{families}, seed {self.config.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A set of runs."""

    about: str
    """In a few words."""
    minutes: float
    """Time of a core that a run has, unless another is asked for."""
    runs: Callable[[], Iterator[Run]]
    goals: int = 0
    """Of each scene and predicate, the most goals that its networks are judged by; all with 0."""


# --- recipes ----------------------------------------------------------------------------------

Networks = tuple[TrainConfig, ...]
"""What is trained side by side and shares the time evenly: one network or one a family."""


def _fair(body: str) -> Networks:
    return (TrainConfig.fair().with_body(body),)


def _a_family_each(config: TrainConfig) -> Networks:
    """As the paper has it: a network for the same-plane predicates, another for `on`."""
    names: dict[str, list[str]] = {}
    for predicate in PREDICATES.values():
        names.setdefault(predicate.family, []).append(predicate.name)
    return tuple(
        replace(config, predicates=tuple(own), families=(family,)) for family, own in names.items()
    )


def _bare(body: str) -> Networks:
    """A network a family, bare but for sizes that a CPU can train."""
    return _a_family_each(replace(TrainConfig.paper(), model=BODIES[body].config.bare()))


def _long(body: str) -> Networks:
    return (TrainConfig.laptop().with_body(body),)


RECIPES: dict[str, Callable[[str], Networks]] = {
    "fair": _fair,
    "fair, alone": lambda body: _a_family_each(*_fair(body)),
    "bare": _bare,
    "long": _long,
}
"""By name, from a body to the settings of its networks: `fair`, the help that ours has; `bare`,
the paper's, at sizes that a CPU can train; `long`, ours for an hour."""


def _runs(body: str, recipe: str, seeds: int = 1) -> Iterator[Run]:
    """The networks of a recipe with seeds 0, 1, ..."""
    networks = RECIPES[recipe](body)
    for seed in range(seeds):
        for config in networks:
            yield Run(
                label=f"{body} {recipe}",
                recipe=recipe,
                config=replace(config, seed=seed),
                share=1 / len(networks),
                curve=recipe,
            )


# --- studies ----------------------------------------------------------------------------------


def _bodies() -> Iterator[Run]:
    """Table III and the remark about polling."""
    for body in BODIES:
        yield from _runs(body, "fair", seeds=2)
    for body in PAPERS:
        yield from _runs(body, "bare")
    for body in BODIES:  # of same-plane alone the paper says nothing
        yield from (r for r in _runs(body, "fair, alone", seeds=2) if r.config.families == ("on",))
    for run in _runs("vit", "fair"):
        for polling in ("turns", "rounds", "one-by-one"):
            config = replace(run.config, polling=polling, share_encodings=False)
            yield replace(run, label=f"vit {polling}", config=config, curve="polling")


def _data() -> Iterator[Run]:
    """Scenes, goals of each and time against each other, then three of them with pictures."""
    everything = ((1.0, 0, 1.0), (0.5, 0, 1.0), (0.25, 0, 1.0), (0.125, 0, 1.0))
    fewer = ((1.0, 1, 1.0), (1.0, 3, 1.0), (0.125, 1, 1.0), (0.125, 3, 1.0))
    shorter = ((1.0, 0, 0.5), (1.0, 0, 0.25), (0.125, 0, 0.5), (0.125, 0, 0.25))
    for share, goals, time in (*everything, *fewer, *shorter):
        yield _some_data("geometry", share, goals, time)
    for share in (1.0, 0.25, 0.125):
        yield _some_data("glimpse", share, 0, 1.0)


def _some_data(body: str, share: float, goals: int, time: float) -> Run:
    (config,) = _long(body)
    what = f"{share:g} of the scenes, {goals or 'all'} goals, {time:g} of the time"
    return Run(
        label=f"{body}, {what}",
        recipe="long",
        config=replace(config, scene_share=share, scene_goals=goals),
        share=time,
        curve="" if goals or time < 1 else body,
    )


def _best() -> Iterator[Run]:
    for body in ("glimpse", "geometry"):
        yield from _runs(body, "long", seeds=3)


def _ship() -> Iterator[Run]:
    for body in ("glimpse", "geometry"):
        yield from (replace(run, ship=body) for run in _runs(body, "long"))


def _crowd() -> Iterator[Run]:
    for body in ("glimpse", "geometry"):
        yield from _runs(body, "long")
        onward = read_checkpoint(shipped()[body]).meta["checkpoint_id"]
        for run in _runs(body, "long"):
            yield replace(
                run,
                label=f"{body} long, on from the package's",
                config=replace(run.config, continues=onward),
                ship="crowd" if body == "glimpse" else "",
            )


STUDIES = Registry[Study]("study")
STUDIES.register(
    "bodies",
    Study(
        about="five bodies, two recipes, `on` alone, polling",
        minutes=20,
        runs=_bodies,
        goals=1,  # some look anew for each query: 17 ms of a core
    ),
)
STUDIES.register(
    "data", Study(about="accuracy against scenes, goals of each and time", minutes=10, runs=_data)
)
STUDIES.register("best", Study(about="the best body and geometry", minutes=60, runs=_best))
STUDIES.register("ship", Study(about="what comes with the package", minutes=60, runs=_ship))
STUDIES.register("crowd", Study(about="what learns from many boxes", minutes=60, runs=_crowd))
