"""Guides where they matter: guided against unguided against the oracle, by the number of boxes.

Rows are written as they are made, a scene of every size in turn: a run that is killed goes on where
it was, and what there is at any time says something about every size. How a task is timed is told
in `evaluation.pairing`.

- u: unguided, to the stop that the guide has; g: guided, the look and every fallback included, a
  miss costs the unguided run besides; o: the same guide with true labels, without a look.
- True labels are what the plan moves that the informed search finds, all plans of its length
  compared.
- Tasks at the node limit count as they ran.

With another planner (`Settings.by`) all of it is that planner's: a task that it does not solve
unguided is not asked further, the plans on both sides are judged by the replay, and there is one
prior more: what its own unguided plan moves, which knows what true labels, those of our planner's
plans, say of another planner's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from relevance.benchmarks.runs import Progress
from relevance.benchmarks.searches import MAX_EDGE, MOST_ACTIONS, SIZES
from relevance.benchmarks.tasks import BenchmarkError, Task, draw
from relevance.evaluation import (
    PRIORS,
    TRUE,
    Asked,
    NetworkScorer,
    Pair,
    Timed,
    beside_another,
    prior_name,
    prior_scorer,
    side_by_side,
)
from relevance.planner import (
    GUIDES,
    PLANNER_VERSION,
    PLANNERS,
    PlannerConfig,
    PlanResult,
    Scorer,
    plan,
    warm_up,
)
from relevance.sampling import sample_goals
from relevance.scene import Goal, Scene
from relevance.simulation import Renderer, replay

ROWS, SETTINGS = "guides.jsonl", "settings.json"
"""Files of a run: its rows as they were made, and what makes them."""
NODE_LIMIT = 200_000
LIMITS = PlannerConfig(max_actions=MOST_ACTIONS, node_limit=NODE_LIMIT)
_STREAM = "bench guides"
OURS = "ours"
"""Name of our planner."""
OWN_PLAN = "own plan"
"""Name of the prior that knows what another planner's unguided plan moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What is measured; runs of equal settings go on with each other's rows."""

    seed: int
    goals: int = 5
    """Most goals of a scene."""
    searches: tuple[str, ...] = ("tree", "informed")
    priors: tuple[str, ...] = ("glimpse",)
    """Who gives the scores; true labels are always rerun, too."""
    guides: tuple[str, ...] = ("order", "lazy")
    repeats: int = 1
    """Timed runs of each task and guide; the median counts."""
    planner: PlannerConfig = LIMITS
    """Limits; its search is overridden by each of the ones above."""
    by: str = OURS
    """Whose planner is guided, a name in PLANNERS; searches are ours alone."""
    peer: Any = None
    """Settings of another planner."""

    def __post_init__(self) -> None:
        for name in self.guides:
            if not GUIDES[name].guided:
                raise BenchmarkError(f"guides: {name} asks for no scores, expected one that does")
            if self.by != OURS and GUIDES[name].walk != "levels":
                raise BenchmarkError(
                    f"guides: {name} orders our search, expected one that says what {self.by} may "
                    "move"
                )
        for name in ("priors", "guides", "searches"):
            given = [prior_name(each) for each in getattr(self, name)]
            if not given or len(set(given)) < len(given):
                raise BenchmarkError(f"{name} {', '.join(given)}: expected distinct ones, some")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rerun:
    """One task, unguided and guided; CPU seconds."""

    size: int
    """Boxes."""
    task: int
    """Its place among the tasks of its size, from 0."""
    scene_id: str
    goal: str
    search: str
    prior: str
    guide: str
    stop: str
    patience: int
    status_unguided: str
    status_guided: str
    seconds_unguided: float
    seconds_guided: float
    seconds_inference: float
    """Part of seconds_guided that the look took."""
    seconds_encoding: float
    """Part of the look that all goals of the scene share."""
    looked: bool
    work_unguided: int
    """As `Counts.work` has it: what the times would be on a machine without other load."""
    work_guided: int
    """The look is no part of it."""
    nodes_unguided: int
    nodes_guided: int
    nlps_unguided: int
    nlps_guided: int
    sequences_unguided: int
    sequences: int
    """Action sequences whose keyframes were sought with the guide."""
    n_actions_unguided: int | None
    n_actions_guided: int | None
    solved_unguided: bool
    solved_guided: bool
    truth: bool
    """Whether a plan was known to the oracle."""
    replays_unguided: bool | None = None
    """Whether the replay confirms the plan; None for ours, which checks them itself."""
    replays_guided: bool | None = None


_COLUMNS = tuple(field.name for field in fields(Rerun))


def rerun_guides(
    settings: Settings,
    folder: Path,
    *,
    tasks: int,
    sizes: Sequence[int] = SIZES,
    scenes: Callable[[Sequence[Task]], None] = lambda tasks: None,
    progress: Progress = lambda done, total: None,
) -> Iterator[list[Rerun]]:
    """Rerun `tasks` tasks of each size; all rows so far after every turn through the sizes.

    Goes on with what `folder` has; raises BenchmarkError where that is of other settings. `scenes`
    is told the tasks of every new scene.
    """
    scorers = {name: prior_scorer(name) for name in settings.priors}
    _claim(folder, settings, scorers)
    rows = read_reruns(folder)
    lacking = {size: Tasks(size, tasks, settings) for size in sizes}
    counts = {size: len({row.task for row in rows if row.size == size}) for size in sizes}
    done, total = sum(min(count, tasks) for count in counts.values()), tasks * len(sizes)
    progress(done, total)
    if done < total:
        warm_up()
    with Renderer() as renderer, (folder / ROWS).open("a", encoding="utf-8") as file:
        while any(some.left for some in lacking.values()):
            for some in lacking.values():
                drawn = some.scene()
                known = {row.task for row in rows if row.size == some.size}
                missing = [task for task in drawn if task.index not in known]
                if not missing:
                    continue
                scenes(missing)
                _show(missing[0].scene, scorers, renderer)
                for task in missing:
                    found = list(_rerun(task, some.size, scorers, settings))
                    # whole tasks, a line each: what a kill cuts off is made again
                    file.write(json.dumps([[getattr(r, c) for c in _COLUMNS] for r in found]))
                    file.write("\n")
                    file.flush()
                    rows += found
                    done += 1
                    progress(done, total)
            yield rows


class Tasks:
    """The tasks of one size, a scene at a time."""

    def __init__(self, size: int, count: int, settings: Settings) -> None:
        self.size, self.left = size, count
        """How many are still to come."""
        self._settings, self._drawn, self._scenes = settings, 0, 0

    def scene(self) -> list[Task]:
        """The tasks of the next scene."""
        if not self.left:
            return []
        seed, size = self._settings.seed, self.size
        [first] = draw(
            1, seed, boxes=(size, size), max_edge=MAX_EDGE, stream=_STREAM, first=self._scenes
        )
        most = min(self._settings.goals, self.left)
        goals = sample_goals(first.scene, first.goal.predicate, most, seed=seed)
        found = [replace(first, index=self._drawn + n, goal=g) for n, g in enumerate(goals)]
        self._scenes, self._drawn, self.left = (
            self._scenes + 1, self._drawn + len(found), self.left - len(found),
        )  # fmt: skip
        return found


def _show(scene: Scene, scorers: Mapping[str, Scorer], renderer: Renderer) -> None:
    """Give networks the scene's picture: the camera's work, which nobody's time holds."""
    networks = [each for each in scorers.values() if isinstance(each, NetworkScorer)]
    if networks:
        picture = renderer.render(scene)
        for network in networks:
            network.observe(scene, picture.image, picture.views)


def _rerun(
    task: Task, size: int, scorers: Mapping[str, Scorer], settings: Settings
) -> Iterator[Rerun]:
    """The rows of a task."""
    if settings.by != OURS:
        yield from _rerun_peer(task, size, scorers, settings)
        return
    scene, goal = task.scene, task.goal
    true = _true(scene, goal, settings)
    priors = _priors(scene, goal, scorers, settings, true)
    asked = [
        Asked(prior=name, scorer=prior, mode=guide)
        for name, prior in priors.items()
        for guide in settings.guides
    ]
    for search in settings.searches:
        planner = replace(settings.planner, search=search)
        pairs = side_by_side(scene, goal, asked, planner, turn=task.index, repeats=settings.repeats)
        for pair in pairs:
            yield _row(task, size, search, pair, true)


def _true(scene: Scene, goal: Goal, settings: Settings) -> PlanResult:
    """The plan that true labels are of."""
    return plan(scene, goal, config=replace(settings.planner, search="informed"), replay=False)


def _priors(
    scene: Scene,
    goal: Goal,
    scorers: Mapping[str, Scorer],
    settings: Settings,
    true: PlanResult,
) -> dict[str, Scorer]:
    moved = true.moved if true.status == "solved" else ()
    priors = {
        name: prior_scorer(name, moved) if name in PRIORS else scorers[name]
        for name in dict.fromkeys((*settings.priors, TRUE))
    }
    for prior in priors.values():  # heads are loaded when they are first asked
        prior.scores(scene, goal)
    return priors


def _rerun_peer(
    task: Task, size: int, scorers: Mapping[str, Scorer], settings: Settings
) -> Iterator[Rerun]:
    """The rows of a task by another planner; one, of no prior, where it finds no plan unguided."""
    scene, goal = task.scene, task.goal
    true = _true(scene, goal, settings)
    priors = _priors(scene, goal, scorers, settings, true)

    def asked(found: PlanResult) -> list[Asked]:
        every = {**priors, OWN_PLAN: prior_scorer(TRUE, found.moved)}
        return [
            Asked(prior=name, scorer=prior, mode=guide)
            for name, prior in every.items()
            for guide in settings.guides
        ]

    peer = PLANNERS[settings.by]
    unguided, pairs = beside_another(peer, scene, goal, asked, settings.peer, turn=task.index)
    if not pairs:
        alone = Asked(prior="none", scorer=priors[TRUE], mode="none")
        pairs = [Pair(asked=alone, stop="first", unguided=unguided, guided=unguided)]
    holds = _replays(scene, goal, unguided)
    for pair in pairs:
        row = _row(task, size, settings.by, pair, true)
        guided = holds if pair.guided is unguided else _replays(scene, goal, pair.guided)
        # what `Counts.work` weighs is our planner's
        yield replace(
            row, work_unguided=0, work_guided=0, replays_unguided=holds, replays_guided=guided
        )


def _replays(scene: Scene, goal: Goal, found: Timed) -> bool | None:
    return replay(scene, goal, found.result.phases).ok if found.solved else None


def _row(task: Task, size: int, search: str, pair: Pair, true: PlanResult) -> Rerun:
    made = pair.row(task.scene, task.goal) | {
        "size": size,
        "task": task.index,
        "goal": str(task.goal),
        "search": search,
        "patience": pair.asked.guide.patience,
        "status_unguided": pair.unguided.result.status,
        "status_guided": pair.guided.result.status,
        "work_unguided": pair.unguided.result.counts.work,
        "work_guided": pair.guided.result.counts.work,
        "truth": true.status == "solved",
    }
    return Rerun(**{name: made[name] for name in _COLUMNS if name in made})


# --- files ----------------------------------------------------------------------------------------


def _claim(folder: Path, settings: Settings, scorers: Mapping[str, Scorer]) -> None:
    """Say in the folder what it is of; raises BenchmarkError where it is of something else."""
    of = {
        name: [scorer.checkpoint_id, scorer.patience]
        for name, scorer in scorers.items()
        if isinstance(scorer, NetworkScorer)
    }
    now = {**asdict(settings), "checkpoints": of, "version": PLANNER_VERSION, "columns": _COLUMNS}
    now = json.loads(json.dumps(now))
    file = folder / SETTINGS
    if file.is_file() and (folder / ROWS).is_file():
        before = json.loads(file.read_text(encoding="utf-8"))
        for name in now:
            if before.get(name) != now[name]:
                raise BenchmarkError(
                    f"{folder}: holds reruns of {name} {before.get(name)}, asked was {now[name]}: "
                    "expected another folder, or those settings"
                )
    file.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")


def read_reruns(folder: Path) -> list[Rerun]:
    """The rows of a folder; a line that a kill cut off is dropped, from the file, too."""
    file = folder / ROWS
    if not file.is_file():
        return []
    text = file.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole, encoding="utf-8")
    return [
        Rerun(**dict(zip(_COLUMNS, row, strict=True)))
        for line in whole.splitlines()
        for row in json.loads(line)
    ]
