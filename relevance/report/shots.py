"""What a film or the viewer shows: a task of a dataset or of a scene file, and plans for it.

Stored plans have no motions; they are planned again, by the dataset's own settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from relevance.errors import RelevanceError
from relevance.labels import stored_scene
from relevance.pipeline import load_config
from relevance.planner import Guide, Motion, PlannerConfig, PlanResult, plan
from relevance.scene import Action, Goal, Scene, SceneError, read_scenes
from relevance.store import Dataset, DatasetError


class NoPlanError(RelevanceError):
    """There is nothing to show: says which goal has no plan, and why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A goal of a scene, to be planned."""

    scene: Scene
    goal: Goal
    config: PlannerConfig
    relevant: frozenset[str] | None = None
    """What its labels say is relevant; None without labels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A plan as it is shown."""

    task: Task
    name: str
    """Whose plan it is."""
    result: PlanResult
    motion: Motion

    @property
    def relevant(self) -> frozenset[str]:
        """The objects that are outlined: as labels say, else those that this plan moves."""
        labelled = self.task.relevant
        return frozenset(self.result.moved) if labelled is None else labelled


def words(action: Action) -> str:
    """An action as people say it."""
    return f"{action.name} {action.object}" + (f" on {action.support}" if action.support else "")


def stored_task(dataset: Dataset, scene_id: str | None = None, goal: str | None = None) -> Task:
    """A goal that a dataset asks of a scene; of those that are left open, one with a long plan.

    Raises DatasetError where the dataset has no such scene or no such goal of it.
    """
    asked = Goal.parse(goal) if goal is not None else None
    with dataset.connect(names=("plans", "scenes", "labels")) as connection:
        rows = connection.execute(
            """
            select scene_id, split, shard, plan_id, predicate || '(' || subject || ', '
                || reference || ')' as goal
            from plans where $1 is null or scene_id = $1
            order by holds desc, n_actions desc, md5(plan_id)
            """,
            [scene_id],
        ).fetchall()
        of_it = "" if scene_id is None else f" of scene {scene_id!r}"
        if not rows:
            known = connection.execute("select min(scene_id) from plans").fetchone()
            if known is None or known[0] is None:
                raise DatasetError(
                    f"{dataset.path}: no plans there, expected `relevance label` first"
                )
            raise DatasetError(
                f"{dataset.path}: no planned goal{of_it}, expected a scene id such as {known[0]}"
            )
        chosen = [row for row in rows if asked is None or row[-1] == str(asked)]
        if not chosen:
            some = ", ".join(row[-1] for row in rows[:3])
            raise DatasetError(f"{dataset.path}: no goal {asked}{of_it}, expected one like {some}")
        scene_id, split, shard, plan_id, text = chosen[0]
        labels = connection.execute(
            "select query, relevant from labels where plan_id = ?", [plan_id]
        ).fetchall()
    [row] = dataset.read_rows("scenes", split=split, shard=shard, scene_id=scene_id)
    scene = stored_scene(row)
    return Task(
        scene=scene,
        goal=scene.goal(text),
        config=load_config(dataset).planner,
        relevant=frozenset(name for name, relevant in labels if relevant) if labels else None,
    )


def written_task(file: Path, scene_id: str | None = None, goal: str | None = None) -> Task:
    """A goal of a scene of a scene file, the first of those that are left open.

    Raises SceneError for a file that holds no such scene, or a scene without goals.
    """
    scenes = read_scenes(file)
    chosen = [scene for scene in scenes if scene_id in (None, scene.id)]
    if not chosen:
        known = ", ".join(scene.id for scene in scenes[:5])
        raise SceneError(f"{file}: no scene {scene_id!r}, expected one of {known}")
    scene = chosen[0] if goal is not None else next((s for s in chosen if s.goals), chosen[0])
    if goal is None and not scene.goals:
        raise SceneError(f"{file}: scene {scene.id} has no goals, expected one by --goal")
    return Task(scene=scene, goal=scene.goal(goal or scene.goals[0]), config=PlannerConfig())


def shoot(task: Task, guides: Mapping[str, Guide | None]) -> tuple[list[Shot], list[str]]:
    """The plans that guides find for a task, by their names, and why others find none.

    Raises NoPlanError where none does.
    """
    shots, reasons = [], []
    for name, guide in guides.items():
        try:
            shots.append(_shot(task, name, guide))
        except RelevanceError as error:  # no plan, or a model that does not fit the scene
            reasons.append(str(error))
    if not shots:
        raise NoPlanError(reasons[0])
    return shots, reasons


def _shot(task: Task, name: str, guide: Guide | None) -> Shot:
    scene, goal = task.scene, task.goal
    result = plan(scene, goal, config=task.config, guide=guide, replay=False)
    if result.status != "solved":
        raise NoPlanError(
            f"scene {scene.id}: no plan to show for {goal} ({name}), {result.status}: "
            f"{result.reason}"
        )
    return Shot(task=task, name=name, result=result, motion=Motion(scene, result))
