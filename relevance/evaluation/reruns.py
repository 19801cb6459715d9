"""The planner rerun with and without a checkpoint's guidance, paired, into rows.

How each task is timed is told in `pairing`. Misses stay in: a task that `prune` fails and the
unguided planner solves is a row. Beside the checkpoint other priors guide the same runs, true
labels above all: what they save is what there is to win.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from relevance.configs import config, identity_hash
from relevance.evaluation.pairing import Asked, side_by_side
from relevance.evaluation.predictions import Progress
from relevance.evaluation.priors import PRIORS, TRUE, prior_scorer
from relevance.evaluation.scorer import NetworkScorer, load_scorer
from relevance.evaluation.suites import suite_of
from relevance.hashing import content_hash
from relevance.pipeline import DatasetConfig, load_config
from relevance.planner import GUIDES, PLANNER_VERSION, PlannerConfig, Scorer
from relevance.scene import PREDICATES, Goal, Scene
from relevance.store import Dataset

EVALUATION_VERSION = "5"
"""Raised when rows of equal settings would come out otherwise."""
OWN = "checkpoint"
"""What rows call the prior that is the checkpoint itself."""


@config
class EvaluationConfig:
    """What to rerun, and how often."""

    guides: Annotated[tuple[str, ...], Field(min_length=1)] = (
        "prune", "prune-then-full", "order", "lazy",
    )  # fmt: skip
    """Names of guides; the first is also rerun at `betas`."""
    priors: tuple[str, ...] = (TRUE,)
    """Who else gives scores to every guide: true, all, none, random, distance, swept, or another
    checkpoint (a file, or one that comes with the package)."""
    beta: float = 0.0
    """The working point: an object is kept iff score > -beta."""
    betas: tuple[float, ...] = (-2.0, 2.0, 4.0)
    """Further values at which the first guide is rerun, on the first `sweep_tasks` tasks."""
    tasks: Annotated[int, Field(ge=0)] = 40
    """Tasks per predicate, drawn by the hash of their id; 0 takes all."""
    sweep_tasks: Annotated[int, Field(ge=0)] = 20
    """Tasks per predicate that also rerun the further betas."""
    repeats: Annotated[int, Field(ge=1)] = 1
    """Timed runs of each task and guide; the median counts."""
    split: Literal["train", "validation", "test"] = "test"
    searches: Annotated[tuple[Literal["tree", "informed"], ...], Field(min_length=1)] = ("tree",)
    """`tree` is the paper's uninformed baseline; `informed` our own stronger one."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Limits of the search, the dataset's own where these are the defaults; its `search` is
    overridden by each of the ones above."""

    @model_validator(mode="after")
    def _guides(self) -> EvaluationConfig:
        allowed = [name for name, mode in GUIDES.items() if mode.guided]
        for guide in self.guides:
            if guide not in allowed:
                raise ValueError(f"unknown guide {guide!r}, expected one of {', '.join(allowed)}")
        if OWN in self.priors:
            raise ValueError(f"priors {self.priors}: {OWN} is the one that is evaluated")
        for name in ("guides", "searches", "betas", "priors"):
            given = getattr(self, name)
            if len(set(given)) != len(given):
                raise ValueError(f"{name} {given}: expected distinct ones")
        return self

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One goal of one stored scene."""

    plan_id: str
    scene_id: str
    shard: int
    goal: Goal
    nth: int
    """Its place among the tasks of its predicate and family, from 1."""
    moved: tuple[str, ...] = ()
    """What the stored plan moves; nothing where there is none that holds."""


def choose_tasks(
    dataset: Dataset, *, split: str, per_predicate: int, predicates: Sequence[str] = ()
) -> list[Task]:
    """Planned goals of a split, unselected: the first by the hash of their id; 0 takes all.

    predicates: of these alone; none for all. Tasks that have no plan stay in: a user meets them
    too.
    """
    with dataset.connect() as connection:
        rows = connection.execute(
            """
            select plan_id, scene_id, shard, predicate, subject, reference, nth,
                if(holds, moved, []) as moved
            from (
                select *, row_number() over (
                    partition by family, predicate order by md5(plan_id)) as nth
                from plans left join shard_families using (split, shard) where split = $1)
            where ($2 = 0 or nth <= $2) and ($3 = [] or list_contains($3, predicate))
            order by predicate, family, nth
            """,
            [split, per_predicate, list(predicates)],
        ).fetchall()
    return [
        Task(
            plan_id=plan_id,
            scene_id=scene_id,
            shard=shard,
            goal=Goal(predicate=PREDICATES[predicate], subject=subject, reference=reference),
            nth=nth,
            moved=tuple(moved),
        )
        for plan_id, scene_id, shard, predicate, subject, reference, nth, moved in rows
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
    config = replace(config, planner=limits(dataset, config.planner))
    scorer = load_scorer(checkpoint, into=dataset)
    shards = dataset.shards(config.split) if shards is None else shards
    tasks: dict[int, list[Task]] = {shard: [] for shard in shards}
    heads = scorer.model.predicates
    for task in choose_tasks(
        dataset, split=config.split, per_predicate=config.tasks, predicates=heads
    ):
        if task.shard in tasks:
            tasks[task.shard].append(task)
    total, done, count = sum(map(len, tasks.values())), 0, 0
    for shard, chosen in tasks.items():
        where = {"name": scorer.checkpoint_id, "split": config.split, "shard": shard}
        asked = [hash_of(config), scorer.patience, [task.plan_id for task in chosen]]
        made_by = content_hash(asked)
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


def limits(dataset: Dataset, asked: PlannerConfig) -> PlannerConfig:
    """The limits that are asked for; those of the dataset's own plans where they are the defaults.

    So a dataset of plans of twelve actions is not asked for six of them.
    """
    return settings_of(dataset).planner if asked == PlannerConfig() else asked


def settings_of(dataset: Dataset) -> DatasetConfig:
    """What a dataset was made with; a merged one's first source."""
    first = dataset.sources[0].dataset.path if dataset.sources else None
    return load_config(Dataset.open(first) if first else dataset)


def hash_of(config: EvaluationConfig) -> str:
    """16 hex digits of the settings and of what carries them out."""
    return identity_hash(config, evaluation=EVALUATION_VERSION, planner=PLANNER_VERSION)


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
        "suite": suite_of(dataset),
        "config_hash": hash_of(config),
    }
    others = {name: prior_scorer(name) for name in config.priors}
    warm = False
    for sample in dataset.samples(config.split, [shard]) if tasks else ():
        for task in tasks:
            if task.scene_id != sample.scene.id:
                continue
            for each in (scorer, *others.values()):
                if isinstance(each, NetworkScorer):
                    each.observe(sample.scene, sample.image, sample.views)
            given = {"moved": task.moved, "others": others}
            if not warm:  # first calls load compiled code; nobody's time should hold that
                compare(sample.scene, task.goal, scorer, config, **given)
                warm = True
            given |= {"swept": task.nth <= config.sweep_tasks, "turn": task.nth}
            rows = compare(sample.scene, task.goal, scorer, config, **given)
            yield [row | made for row in rows]


def compare(
    scene: Scene,
    goal: Goal,
    scorer: Scorer,
    config: EvaluationConfig,
    *,
    moved: Collection[str] = (),
    others: Mapping[str, Scorer] = {},
    swept: bool = False,
    turn: int = 0,
) -> list[dict[str, Any]]:
    """Plan one task unguided and with each guide; one row a search, guide, beta and prior.

    `moved` is what a known plan moves, `others` are scorers of the config's priors that are there
    already; `turn` draws who goes when; further betas are rerun, with the first search, if
    `swept`. Rows lack checkpoint_id, split, suite and config_hash.
    """
    priors: dict[str, Scorer] = {OWN: scorer}
    for name in config.priors:
        known = others.get(name) if name not in PRIORS else None  # those may need what is moved
        priors[name] = known or prior_scorer(name, moved)
    scores = {name: prior.scores(scene, goal) for name, prior in priors.items()}
    rows = []
    for search in config.searches:
        settings = [(OWN, guide, config.beta) for guide in config.guides]
        if swept and search == config.searches[0]:
            settings += [(OWN, config.guides[0], beta) for beta in config.betas]
        settings += [
            (name, guide, config.beta) for name in config.priors for guide in config.guides
        ]
        asked = [
            Asked(prior=name, scorer=priors[name], mode=guide, beta=beta)
            for name, guide, beta in dict.fromkeys(settings)
        ]
        planner = replace(config.planner, search=search)
        for pair in side_by_side(scene, goal, asked, planner, turn=turn, repeats=config.repeats):
            beta = pair.asked.beta
            kept = {name for name, score in scores[pair.asked.prior].items() if score > -beta}
            kept |= {goal.subject, goal.reference}
            rows.append({"search": search, **pair.row(scene, goal, len(kept))})
    return rows
