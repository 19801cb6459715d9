"""What a checkpoint is worth: its accuracy, and the planner rerun with and without it.

How the comparison stays honest:

- Paired: each task is planned unguided and with every guide, one right after the other, the
  order rotated from task to task, so that a warm cache or a busy machine favours nobody.
- All of it counts: guided time includes the network and every fallback. The scene is encoded
  anew in each guided run, as though its goal came alone; `seconds_inference` says how much of
  the time that was. The picture itself is the camera's work and is not timed.
- CPU time (`time.process_time`, all threads), so that a shared machine does not blur it.
- Misses stay in: a task that `prune` fails and the unguided planner solves is a row.

beta (DESIGN section 2): an object is kept iff score > -beta; goal objects are always kept.
"""

from __future__ import annotations

import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from relevance.errors import RelevanceError
from relevance.hashing import content_hash
from relevance.planner import (
    GUIDES,
    PLANNER_VERSION,
    Guide,
    PlannerConfig,
    PlanResult,
    Scorer,
    plan,
)
from relevance.scene import PREDICATES, Goal, Scene
from relevance.store import SPLITS, Dataset

if TYPE_CHECKING:  # models imports torch, which the planner and the report do without
    from relevance.models import RelevanceModel

Progress = Callable[[int, int], None]


class EvaluationError(RelevanceError):
    """Settings or data that cannot be evaluated: says which, and what was expected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """What to rerun, and how often."""

    guides: tuple[str, ...] = ("prune", "prune-then-full")
    beta: float = 0.0
    """The working point: an object is kept iff score > -beta."""
    betas: tuple[float, ...] = (-2.0, 2.0, 4.0)
    """Further values at which `sweep_guide` is rerun, on the first `sweep_tasks` tasks."""
    sweep_guide: str = "prune"
    tasks: int = 40
    """Tasks per predicate, drawn by the hash of their id; 0 takes all."""
    sweep_tasks: int = 20
    """Tasks per predicate that also rerun the further betas."""
    repeats: int = 1
    """Timed runs of each task and guide; the median counts."""
    split: str = "test"
    searches: tuple[Literal["tree", "informed"], ...] = ("tree",)
    """`tree` is the paper's uninformed baseline; `informed` our own stronger one."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Limits of the search; its own `search` is overridden by each of the ones above."""

    def __post_init__(self) -> None:
        for guide in (*self.guides, self.sweep_guide):
            if guide not in GUIDES or guide == "none":
                allowed = ", ".join(name for name in GUIDES if name != "none")
                raise EvaluationError(f"guides: unknown guide {guide!r}, expected one of {allowed}")
        if len(set(self.guides)) != len(self.guides) or not self.guides:
            raise EvaluationError(f"guides: {self.guides}, expected distinct names, at least one")
        if self.split not in SPLITS:
            raise EvaluationError(f"split: {self.split!r}, expected one of {', '.join(SPLITS)}")
        for name, least in (("tasks", 0), ("sweep_tasks", 0), ("repeats", 1)):
            if getattr(self, name) < least:
                raise EvaluationError(f"{name}: {getattr(self, name)}, expected at least {least}")
        if not all(np.isfinite((self.beta, *self.betas))):
            raise EvaluationError(f"betas: {(self.beta, *self.betas)}, expected finite numbers")
        for search in self.searches:
            replace(self.planner, search=search)  # the planner refuses an unknown one

    @classmethod
    def smoke(cls) -> EvaluationConfig:
        """Seconds: enough to see every column filled."""
        return cls(tasks=2, sweep_tasks=1, betas=(2.0,))

    @classmethod
    def demo(cls) -> EvaluationConfig:
        """A minute or two."""
        return cls(tasks=24, sweep_tasks=10)

    @classmethod
    def laptop(cls) -> EvaluationConfig:
        """An hour."""
        return cls(tasks=200, sweep_tasks=60, repeats=3, betas=(-4.0, -2.0, -1.0, 1.0, 2.0, 4.0))

    @classmethod
    def paper(cls) -> EvaluationConfig:
        """Every test task."""
        return cls(tasks=0, sweep_tasks=500, repeats=3, betas=(-4.0, -2.0, -1.0, 1.0, 2.0, 4.0))


# --- the network as a planner's scorer ---------------------------------------------------


class NetworkScorer:
    """Scores from a checkpoint; encodes a scene once and answers all its goals from that.

    Scenes that were not shown to `observe` are rendered. Keeps the last `capacity` scenes.
    """

    def __init__(
        self, model: RelevanceModel, *, checkpoint_id: str = "", capacity: int = 64
    ) -> None:
        self.model = model
        self.checkpoint_id = checkpoint_id
        self.capacity = capacity
        self.seconds = 0.0
        """CPU seconds of the last `scores`, a needed encoding included, rendering left out."""
        self._seen: OrderedDict[str, tuple[np.ndarray, np.ndarray]] = OrderedDict()
        self._encodings: OrderedDict[str, Any] = OrderedDict()

    def observe(self, scene: Scene, image: np.ndarray, views: np.ndarray) -> None:
        """Give a scene's image (H, W, 3) and its objects' views (N, 32, 32, 3), uint8 RGB."""
        if len(views) != len(scene.objects):
            raise EvaluationError(
                f"scene {scene.id}: {len(views)} views, expected one for each of its "
                f"{len(scene.objects)} objects"
            )
        self._keep(self._seen, scene.id, (image, views))
        self._encodings.pop(scene.id, None)

    def forget(self) -> None:
        """Drop every encoding, so that the next call of `scores` pays for its own."""
        self._encodings.clear()

    def scores(self, scene: Scene, goal: Goal) -> dict[str, float]:
        """Logit of every object of the scene."""
        return dict(zip(scene.names, self.score_goals(scene, [goal])[0].tolist(), strict=True))

    def score_goals(self, scene: Scene, goals: Sequence[Goal]) -> np.ndarray:
        """Logits of every object for several goals, (G, N)."""
        if scene.id not in self._seen:
            from relevance.simulation import Renderer  # pybullet: only when there is no picture

            with Renderer() as renderer:
                rendering = renderer.render(scene)
            self.observe(scene, rendering.image, rendering.views)
        import torch

        start = time.process_time()
        with torch.inference_mode():
            if scene.id not in self._encodings:
                image, views = (torch.from_numpy(pixels) for pixels in self._seen[scene.id])
                encoding = self.model.encode(
                    image.permute(2, 0, 1)[None], views.permute(0, 3, 1, 2)[None]
                )
                self._keep(self._encodings, scene.id, encoding)
            encoding = self._encodings[scene.id]
            scores = np.empty((len(goals), len(scene.objects)))
            for predicate in dict.fromkeys(goal.predicate for goal in goals):
                which = [n for n, goal in enumerate(goals) if goal.predicate == predicate]
                pairs = [
                    [scene.names.index(name) for name in (goals[n].subject, goals[n].reference)]
                    for n in which
                ]
                scores[which] = self.model.decode(encoding, predicate, torch.tensor([pairs]))[0]
        self.seconds = time.process_time() - start
        return scores

    def _keep(self, cache: OrderedDict[str, Any], key: str, value: Any) -> None:
        cache[key] = value
        cache.move_to_end(key)
        while len(cache) > self.capacity:
            cache.popitem(last=False)


def load_scorer(checkpoint: str | Path) -> NetworkScorer:
    """Read a checkpoint; CheckpointError names the file and the found and expected version."""
    from relevance.training import load_checkpoint

    model, meta = load_checkpoint(checkpoint)
    return NetworkScorer(model, checkpoint_id=meta["checkpoint_id"])


def load_guide(
    checkpoint: str | Path, *, mode: str = "prune-then-full", beta: float = 0.0
) -> Guide:
    """A guide for `plan` from a checkpoint file."""
    return Guide(scorer=load_scorer(checkpoint), mode=mode, beta=beta)


# --- rows ---------------------------------------------------------------------------------


def predict(
    root: str | Path,
    checkpoint: str | Path,
    *,
    split: str = "test",
    shards: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> int:
    """Score every labelled object of a split's shards into `predictions`; returns the row count."""
    dataset = Dataset.open(root)
    scorer = load_scorer(checkpoint)
    checkpoint_id = scorer.checkpoint_id
    shards, count = dataset.shards(split) if shards is None else shards, 0
    for number, shard in enumerate(shards, 1):
        labels: dict[str, dict[Goal, dict[str, dict[str, Any]]]] = defaultdict(dict)
        for row in dataset.read_rows("labels", split=split, shard=shard):
            labels[row["scene_id"]].setdefault(_goal(row), {})[row["query"]] = row
        rows: list[dict[str, Any]] = []
        for sample in dataset.samples(split, [shard]) if labels else ():
            goals = labels.get(sample.scene.id, {})
            if not goals:
                continue
            scorer.observe(sample.scene, sample.image, sample.views)
            scores = scorer.score_goals(sample.scene, list(goals))
            for queries, values in zip(goals.values(), scores.tolist(), strict=True):
                scored = dict(zip(sample.scene.names, values, strict=True))
                rows += [
                    {name: label[name] for name in _PREDICTED}
                    | {"checkpoint_id": checkpoint_id, "score": scored[query]}
                    for query, label in queries.items()
                ]
        dataset.write_rows("predictions", rows, name=checkpoint_id, split=split, shard=shard)
        count += len(rows)
        if progress:
            progress(number, len(shards))
    return count


_PREDICTED = (
    "scene_id",
    "split",
    "predicate",
    "subject",
    "reference",
    "query",
    "is_goal_object",
    "relevant",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One goal of one stored scene."""

    plan_id: str
    scene_id: str
    shard: int
    goal: Goal
    nth: int
    """Its place among the predicate's tasks, from 1."""


def choose_tasks(dataset: Dataset, *, split: str, per_predicate: int) -> list[Task]:
    """Planned goals of a split, unselected: the first by the hash of their id; 0 takes all.

    Tasks that have no plan stay in: a user meets them too.
    """
    with dataset.connect() as connection:
        rows = connection.execute(
            """
            select plan_id, scene_id, shard, predicate, subject, reference, nth from (
                select *, row_number() over (partition by predicate order by md5(plan_id)) as nth
                from plans where split = ?)
            where ? = 0 or nth <= ?
            order by predicate, nth
            """,
            [split, per_predicate, per_predicate],
        ).fetchall()
    return [
        Task(
            plan_id=plan_id,
            scene_id=scene_id,
            shard=shard,
            goal=Goal(predicate=PREDICATES[predicate], subject=subject, reference=reference),
            nth=nth,
        )
        for plan_id, scene_id, shard, predicate, subject, reference, nth in rows
    ]


def evaluate(
    root: str | Path,
    checkpoint: str | Path,
    config: EvaluationConfig | None = None,
    *,
    shards: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> int:
    """Rerun the planner on tasks of a split's shards into `evaluations`; returns the row count.

    A shard whose file was made with the same settings, planner and tasks is left as it is;
    another file of this checkpoint and shard is replaced.
    """
    config = config or EvaluationConfig.demo()
    dataset = Dataset.open(root)
    scorer = load_scorer(checkpoint)
    shards = dataset.shards(config.split) if shards is None else shards
    tasks: dict[int, list[Task]] = {shard: [] for shard in shards}
    for task in choose_tasks(dataset, split=config.split, per_predicate=config.tasks):
        if task.shard in tasks:
            tasks[task.shard].append(task)
    total, done, count = sum(map(len, tasks.values())), 0, 0
    for shard, chosen in tasks.items():
        where = {"name": scorer.checkpoint_id, "split": config.split, "shard": shard}
        made_by = content_hash([config, PLANNER_VERSION, [task.plan_id for task in chosen]])
        file = dataset.shard_path("evaluations", **where)
        if file.is_file() and dataset.metadata(file).get("made_by") == made_by:
            done, count = done + len(chosen), count + dataset.read_file(file).num_rows
            continue
        rows: list[dict[str, Any]] = []
        for found in _reruns(dataset, shard, chosen, scorer, config):
            rows += found
            done += 1
            if progress:
                progress(done, total)
        dataset.write_rows("evaluations", rows, made_by={"made_by": made_by}, **where)
        count += len(rows)
    return count


def _reruns(
    dataset: Dataset,
    shard: int,
    tasks: Sequence[Task],
    scorer: NetworkScorer,
    config: EvaluationConfig,
) -> Iterator[list[dict[str, Any]]]:
    """The rows of each task."""
    made = {
        "checkpoint_id": scorer.checkpoint_id,
        "split": config.split,
        "config_hash": content_hash(config),
    }
    warm = False
    for sample in dataset.samples(config.split, [shard]) if tasks else ():
        for task in tasks:
            if task.scene_id != sample.scene.id:
                continue
            scorer.observe(sample.scene, sample.image, sample.views)
            if not warm:  # first calls load compiled code; nobody's time should hold that
                compare(sample.scene, task.goal, scorer, config)
                warm = True
            swept = task.nth <= config.sweep_tasks
            rows = compare(sample.scene, task.goal, scorer, config, swept=swept, turn=task.nth)
            yield [row | made for row in rows]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """One timed call of the planner."""

    result: PlanResult
    seconds: float
    inference: float

    @property
    def solved(self) -> bool:
        return self.result.status == "solved" and self.result.check_ok

    @property
    def length(self) -> int | None:
        return len(self.result.actions) if self.solved else None

    @property
    def nlps(self) -> int:
        return self.result.counts.keyframe + self.result.counts.path


def compare(
    scene: Scene,
    goal: Goal,
    scorer: Scorer,
    config: EvaluationConfig,
    *,
    swept: bool = False,
    turn: int = 0,
) -> list[dict[str, Any]]:
    """Plan one task unguided and with each guide; one row a search, guide and beta.

    `turn` rotates who goes first; further betas are rerun, with the first search, if `swept`.
    Rows lack checkpoint_id, split and config_hash.
    """
    scores, rows = scorer.scores(scene, goal), []
    for search in config.searches:
        guides: list[tuple[str, float]] = [(guide, config.beta) for guide in config.guides]
        if swept and search == config.searches[0]:
            sweep: str = config.sweep_guide
            guides.extend((sweep, beta) for beta in (config.beta, *config.betas))
        runs: list[tuple[str, float] | None] = [None, *dict.fromkeys(guides)]
        planner = replace(config.planner, search=search)
        timed: dict[tuple[str, float] | None, list[_Run]] = defaultdict(list)
        for repeat in range(config.repeats):
            for position in range(len(runs)):
                which = runs[(position + turn + repeat) % len(runs)]
                guide = which and Guide(scorer=scorer, mode=which[0], beta=which[1])
                timed[which].append(_timed(scene, goal, planner, guide))
        unguided = timed.pop(None)
        for which in runs[1:]:
            assert which is not None
            (guide, beta), guided = which, timed[which]
            kept = {name for name, score in scores.items() if score > -beta}
            rows.append(
                {
                    "guide": guide,
                    "search": search,
                    "beta": beta,
                    "scene_id": scene.id,
                    "predicate": goal.predicate.name,
                    "subject": goal.subject,
                    "reference": goal.reference,
                    "n_objects": len(scene.objects),
                    "solved_unguided": unguided[0].solved,
                    "solved_guided": guided[0].solved,
                    "seconds_unguided": float(np.median([run.seconds for run in unguided])),
                    "seconds_guided": float(np.median([run.seconds for run in guided])),
                    "seconds_inference": float(np.median([run.inference for run in guided])),
                    "nodes_unguided": unguided[0].result.counts.nodes,
                    "nodes_guided": guided[0].result.counts.nodes,
                    "nlps_unguided": unguided[0].nlps,
                    "nlps_guided": guided[0].nlps,
                    "n_actions_unguided": unguided[0].length,
                    "n_actions_guided": guided[0].length,
                    "n_kept": len(kept | {goal.subject, goal.reference}),
                    "planner_version": PLANNER_VERSION,
                }
            )
    return rows


def _timed(scene: Scene, goal: Goal, planner: PlannerConfig, guide: Guide | None) -> _Run:
    scorer = guide.scorer if guide else None
    if isinstance(scorer, NetworkScorer):
        scorer.forget()
    start = time.process_time()
    result = plan(scene, goal, config=planner, guide=guide, replay=False)
    seconds = time.process_time() - start
    inference = scorer.seconds if isinstance(scorer, NetworkScorer) else 0.0
    return _Run(result=result, seconds=seconds, inference=inference)


def _goal(row: dict[str, Any]) -> Goal:
    return Goal(
        predicate=PREDICATES[row["predicate"]], subject=row["subject"], reference=row["reference"]
    )
