"""Studies, run: each network is trained and judged on the test scenes once, some at a time.

What is finished stays: checkpoints and predictions in the dataset, where whoever evaluates finds
them, and a row of figures in the study's folder. Killed and called again, a study goes on.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from relevance.errors import RelevanceError
from relevance.store import Dataset, DatasetError, replacing
from relevance.training.budget import one_core, steps_within
from relevance.training.catalogue import Catalogue
from relevance.training.checkpoints import id_of, load_checkpoint
from relevance.training.reading import Reader
from relevance.training.settings import TrainConfig
from relevance.training.studies import STUDIES, Run
from relevance.training.trainer import Judged, judged, metrics_of, on_threads, train
from relevance.workers import Outcomes, Unit, gather, pool

VALIDATIONS = 10
"""Points of a learning curve."""
SAVED = 20.0
"""Seconds of a core between saved states."""

Progress = Callable[[int, int], None]
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A study on a dataset, and where its rows are kept."""

    root: Path
    study: str
    folder: Path
    minutes: float
    """Of a core, for a run that takes the study's whole time."""
    only: tuple[str, ...] = ()
    """Runs with one of these words in their name; all without any."""
    device: str = "cpu"
    goals: int = 0
    """Of each scene and predicate, the most goals that networks are judged by; all with 0."""

    @classmethod
    def of(
        cls,
        root: str | Path,
        study: str,
        *,
        minutes: float | None = None,
        goals: int | None = None,
        **more: Any,
    ) -> Plan:
        """The study of that name, with its own time and goals unless others are given."""
        own = STUDIES[study]
        minutes = own.minutes if minutes is None else minutes
        goals = own.goals if goals is None else goals
        return cls(root=Path(root), study=study, minutes=minutes, goals=goals, **more)

    @property
    def runs(self) -> list[Run]:
        """Those that were chosen; raises RelevanceError where there are none."""
        every = list(STUDIES[self.study].runs())
        chosen = [r for r in every if not self.only or any(word in r.name for word in self.only)]
        if not chosen:
            raise RelevanceError(
                f"study {self.study}: no run has {' or '.join(self.only)} in its name, expected "
                f"some of: {'; '.join(run.name for run in every)}"
            )
        return chosen

    def seconds(self, run: Run) -> float:
        """Time of a core that a run has."""
        return 60 * self.minutes * run.share

    def row_file(self, name: str) -> Path:
        """Where the row of a checkpoint is."""
        return self.folder / "rows" / f"{name}.json"

    @property
    def table(self) -> Path:
        """The rows of the study, one a line."""
        return self.folder / f"{self.study}.jsonl"


def run_study(
    plan: Plan,
    *,
    processes: int = 1,
    pooled: Callable[[str, int], Outcomes[Unit]] | None = None,
    told: Callable[[str], None] = print,
) -> list[Row]:
    """Train and judge what is missing, `processes` runs at a time; the rows of all, in order.

    They are in FOLDER/STUDY.jsonl, too, as far as they are done. `pooled` makes another pool than
    plain processes, of what is done and how many steps it has. One run that fails stops no
    other; it raises in the end.
    """
    pools = pooled or (lambda what, total: pool(processes))
    dataset = Dataset.open(plan.root)
    if not dataset.files("labels", split="test"):
        raise DatasetError(f"{dataset.path}: no labels of split test, which a study is judged by")
    plan.folder.mkdir(parents=True, exist_ok=True)
    named = _names(dataset)
    steps = _steps(plan, named, pools, told)
    networks = {run.name: _settled(plan, run, steps[_alike(plan, named, run)]) for run in plan.runs}
    names = {name: named(config) for name, config in networks.items()}
    jobs = {
        name: Training(plan=plan, config=config)
        for name, config in networks.items()
        if not plan.row_file(names[name]).exists()
        or not dataset.files("predictions", name=names[name])
    }
    written = _write(plan, names)

    def made(count: int) -> None:
        done = _write(plan, names)
        told(f"{plan.study}: {len(done)} of {len(names)} runs, {count} of them now")

    if jobs:
        outcomes = pools("steps", sum(job.size for job in jobs.values()))
        gather(plan.study, jobs, outcomes, made=made, warn=told, unit="run")
        written = _write(plan, names)
    return written


def _names(dataset: Dataset) -> Callable[[TrainConfig], str]:
    """Ids of checkpoints; the data is hashed once."""
    data = cache(lambda policy: dataset.content_hash(policy=policy, split="train"))
    return lambda config: id_of(config, data(config.policy))


def _write(plan: Plan, names: Mapping[str, str]) -> list[Row]:
    """Write the table of what is finished."""
    rows = []
    for run in plan.runs:
        file = plan.row_file(names[run.name])
        if file.exists():
            head = {"study": plan.study, "run": run.name}
            head |= {name: getattr(run, name) for name in ("label", "recipe", "curve", "ship")}
            head |= {"minutes": plan.seconds(run) / 60}
            rows.append({**head, **json.loads(file.read_text())})
    with replacing(plan.table) as temporary:
        temporary.write_text("".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))
    return rows


# --- how many steps fit -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitting:
    """How many steps of some settings fit into some time."""

    root: Path
    config: TrainConfig
    seconds: float
    device: str
    size: int = 1

    def run(self, progress: Progress) -> int:
        """Measure it."""
        return steps_within(self.root, self.config, self.seconds, self.device)


def _steps(
    plan: Plan,
    named: Callable[[TrainConfig], str],
    pools: Callable[[str, int], Outcomes[Unit]],
    told: Callable[[str], None],
) -> dict[str, int]:
    """How many steps fit, as measured the first time and kept in FOLDER/steps.json."""
    file = plan.folder / "steps.json"
    known: dict[str, int] = json.loads(file.read_text()) if file.exists() else {}
    missing = {
        key: Fitting(
            root=plan.root, config=run.config, seconds=plan.seconds(run), device=plan.device
        )
        for run in plan.runs
        for key in [_alike(plan, named, run)]
        if key not in known
    }
    if missing:
        outcomes = pools("how many steps fit", len(missing))
        known |= gather(
            plan.study, missing, outcomes, made=lambda count: None, warn=told, unit="measurement"
        )
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n")
    return known


def _alike(plan: Plan, named: Callable[[TrainConfig], str], run: Run) -> str:
    """The same for settings of which a step costs the same."""
    alike = replace(
        run.config,
        steps=1,
        seed=0,
        continues="",
        scene_share=1.0,
    )
    return f"{named(alike)} in {plan.seconds(run):g} s, {plan.device}"


def _settled(plan: Plan, run: Run, steps: int) -> TrainConfig:
    """The settings that are trained."""
    config = replace(
        run.config,
        steps=steps,
        validation_goals=plan.goals,
        validations=VALIDATIONS,
        save_every=max(1, round(steps * SAVED / plan.seconds(run))),
    )
    return one_core(config, plan.device)


# --- one run ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """A network to train and to judge."""

    plan: Plan
    config: TrainConfig

    @property
    def size(self) -> int:
        """Its steps."""
        return self.config.steps

    def run(self, progress: Progress) -> None:
        """Train it or go on, judge it, write its row."""
        plan, dataset = self.plan, Dataset.open(self.plan.root)
        path = train(plan.root, self.config, progress=progress)
        model, meta = load_checkpoint(path, self.config.device)
        with on_threads(self.config.threads):
            test = metrics_of(_judge(dataset, model, meta, self.config, plan.goals))
        file = plan.row_file(meta["checkpoint_id"])
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            row = _row(dataset, self.config, meta) | {"device": plan.device, "test": test}
            temporary.write_text(json.dumps(row, allow_nan=False) + "\n")


def _row(dataset: Dataset, config: TrainConfig, meta: Mapping[str, Any]) -> Row:
    """What a run was, what it took and what it said on the way."""
    known = Catalogue.of(dataset, "train", config)
    model = config.model
    kept = (
        "checkpoint_id", "dataset_hash", "parameters", "bfloat16", "core_seconds",
        "train_seconds", "wait_seconds", "asked", "offsets", "validations",
    )  # fmt: skip
    return {
        "body": model.body,
        "reading": next(name for name, its in model.readings().items() if its == model),
        "seed": config.seed,
        "predicates": [predicate.name for predicate in known.predicates],
        "families": sorted({shard.family for shard in known.shards}),
        "polling": config.polling,
        "scenes": sum(shard.scenes for shard in known.shards),
        "scene_goals": config.scene_goals,
        "steps": config.steps,
        "scenes_shown": meta["scenes"],
        **{name: meta[name] for name in kept},
        "history": meta.get("history", []),  # the package's models come without
        "config": config.to_dict(),
        "validation": meta["metrics"],
    }


def _judge(
    dataset: Dataset,
    model: Any,
    meta: Mapping[str, Any],
    config: TrainConfig,
    goals: int,
) -> Iterator[Judged]:
    """What a model says of the test scenes, at the offsets that validation chose; it is also
    written into the dataset's predictions, a shard at a time."""
    catalogue = Catalogue.of(dataset, "test", config)
    for shard in catalogue.shards:
        own = replace(catalogue, shards=(shard,), goals=goals)
        reader = Reader(catalogue=own, config=config, pictures=not model.told)
        rows: list[Row] = []
        for one in judged(model, reader.whole(), meta["offsets"]):
            rows += _predictions(one, meta)
            yield one
        dataset.write_rows(
            "predictions", rows, name=meta["checkpoint_id"], split="test", shard=shard.number
        )


def _predictions(one: Judged, meta: Mapping[str, Any]) -> Sequence[Row]:
    """Rows of `predictions`."""
    offset = meta["offsets"].get(one.predicate.name, 0.0)
    rows = []
    for b, g, n in zip(*one.labelled.nonzero(), strict=True):
        objects = one.batch.objects[b]
        subject, reference = (objects[place] for place in one.goals[b, g])
        rows.append(
            {
                "checkpoint_id": meta["checkpoint_id"],
                "scene_id": one.batch.names[b],
                "split": "test",
                "predicate": one.predicate.name,
                "subject": subject,
                "reference": reference,
                "query": objects[n],
                "is_goal_object": not one.query[b, g, n],
                "relevant": bool(one.relevant[b, g, n]),
                "score": float(one.score[b, g, n]),
                "offset": offset,
            }
        )
    return rows
