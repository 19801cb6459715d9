"""The subcommands: each maker returns a typed function, from which tyro derives the flags.

A maker imports only what its own flags need; the function imports the rest when it runs.
"""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import dataclasses
import functools
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from relevance.cli import datasets
from relevance.cli.arguments import CORES, DatasetArg, OptionalPath, Preset, Workers
from relevance.cli.bench import bench_planner
from relevance.cli.processes import make_shards
from relevance.cli.terminal import Format, UsageError, bar, bars, console, say, show, to_json

OptionalName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="N")]


def _generate(preset: Preset) -> Callable[..., int]:
    from relevance.pipeline import DatasetConfig, finish, generate_shard, generated, prepare
    from relevance.store import Dataset

    start: DatasetConfig = getattr(DatasetConfig, preset)()

    def generate(
        dataset: DatasetArg,
        preset: Preset = preset,
        workers: Workers = CORES,
        config: Annotated[DatasetConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Make random scenes and render them; finished shards are skipped.

        Args:
            dataset: Folder of the dataset; made when it is not there.
            preset: Where the other settings start from.
            workers: Processes that work at a time.
        """
        specs = prepare(dataset, config, scenes_only=True)
        there = Dataset.open(dataset)
        missing = [spec for spec in specs if not generated(there, spec)]
        jobs = [(generate_shard, (dataset, config, spec)) for spec in missing]
        make_shards(dataset, jobs, [spec.count for spec in missing], workers)
        finish(dataset)
        say(f"{dataset}: {len(missing)} shards made, {len(specs) - len(missing)} were there")
        return 0

    return generate


def _label(_: Preset) -> Callable[..., int]:
    from relevance.labels import POLICIES
    from relevance.pipeline import finish, label_shard, labelled, load_config, prepare
    from relevance.scene import PREDICATES
    from relevance.store import Dataset, sql

    def label(
        dataset: DatasetArg,
        predicates: tuple[str, ...] = tuple(PREDICATES),
        policy: OptionalName = None,
        replan: bool = False,
        goals_per_scene: OptionalCount = None,
        goals_seed: OptionalCount = None,
        workers: Workers = CORES,
    ) -> int:
        """Plan the goals of a dataset's scenes and label what each plan moves.

        Finished shards are skipped. Other labels never replace those that are there: another
        policy's lie beside them, and after --replan the old plans and labels do.

        Args:
            dataset: Folder of the dataset.
            predicates: Which predicates to plan.
            policy: found, necessary or any-minimal; the dataset's own when not given.
            replan: Plan anew with the planner of today, if that is another one.
            goals_per_scene: Plan another number of goals a scene (and replan).
            goals_seed: Plan another draw of goals (and replan).
            workers: Processes that work at a time.
        """
        if policy is not None and policy not in POLICIES:
            raise UsageError(f"--policy {policy}: expected one of {', '.join(POLICIES)}")
        for name in predicates:
            PREDICATES[name]  # refuses an unknown one
        there = Dataset.open(dataset)
        config = load_config(there)
        goals = {"goals_per_scene": goals_per_scene, "goals_seed": goals_seed}
        goals = {name: value for name, value in goals.items() if value is not None}
        config = dataclasses.replace(config, **goals)
        pairs = [
            (spec, predicate)
            for spec in prepare(dataset, config, replan=replan or bool(goals))
            for predicate in spec.predicates
            if predicate.name in predicates
        ]
        missing = [pair for pair in pairs if not labelled(there, config, *pair, policy)]
        stage = functools.partial(label_shard, policy=policy)
        jobs = [(stage, (dataset, config, spec, predicate)) for spec, predicate in missing]
        make_shards(dataset, jobs, [spec.count for spec, _ in missing], workers)
        finish(dataset)
        _, [(tasks, holds)] = sql(dataset, "select count(*), count_if(holds) from plans")
        say(f"{dataset}: {len(missing)} shards made, {len(pairs) - len(missing)} were there")
        say(f"{dataset}: {tasks} goals, {holds} have a plan that holds")
        return 0

    return label


def _train(preset: Preset, body: str | None = None) -> Callable[..., int]:
    from relevance.training import TrainConfig

    start: TrainConfig = getattr(TrainConfig, preset)()
    if body is not None:
        start = start.with_body(body)

    # --preset is a setting of TrainConfig itself.
    def train(
        dataset: DatasetArg,
        out: OptionalPath = None,
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Train a relevance model; prints the path of its checkpoint.

        Args:
            dataset: Folder of a labelled dataset.
            out: Another folder for the checkpoint than DATASET/checkpoints.
        """
        from relevance.training import train

        with bar("steps") as progress:
            path = train(dataset, config, out=out, progress=progress)
        print(path)
        return 0

    return train


def _evaluate(preset: Preset) -> Callable[..., int]:
    from relevance.evaluation import EvaluationConfig

    start: EvaluationConfig = getattr(EvaluationConfig, preset)()

    def evaluate(
        dataset: DatasetArg,
        checkpoint: OptionalPath = None,
        preset: Preset = preset,
        config: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = start,
    ) -> int:
        """Rerun the planner on test scenes, unguided and guided by a checkpoint.

        Args:
            dataset: Folder of a labelled dataset.
            checkpoint: The model, a file or an id; the dataset's newest when not given.
            preset: Where the other settings start from.
        """
        from relevance import evaluation
        from relevance.training import find_checkpoint

        path = find_checkpoint(dataset, checkpoint)
        with bar("shards scored") as progress:
            scored = evaluation.predict(dataset, path, split=config.split, progress=progress)
        with bar("tasks") as progress:
            rows = evaluation.evaluate(dataset, path, config, progress=progress)
        say(f"{dataset}: {scored} predictions, {rows} comparisons of {path.stem}")
        return 0

    return evaluate


def _report(_: Preset) -> Callable[..., int]:
    def report(dataset: DatasetArg, out: OptionalPath = None) -> int:
        """Write the report, one HTML file that opens offline; prints its path.

        Args:
            dataset: Folder of the dataset.
            out: Where to; DATASET/report.html when not given.
        """
        from relevance.report import page

        with console.status("report"):
            path = page.build(dataset, out)
        print(path)
        return 0

    return report


def _plan(_: Preset) -> Callable[..., int]:
    from relevance.planner import PlannerConfig
    from relevance.planner.search import Mode
    from relevance.scene import SceneError, read_scenes

    default = PlannerConfig()

    def plan(
        scenes: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENES")],
        goal: Annotated[tuple[str, ...], tyro.conf.arg(metavar="GOAL")] = (),
        json: tyro.conf.FlagCreatePairsOff[bool] = False,
        planner: Literal["ours", "rai"] = "ours",
        search: Literal["tree", "informed"] = "informed",
        guide: Mode = "none",
        checkpoint: OptionalPath = None,
        beta: float = 0.0,
        limit: int = default.node_limit,
        max_actions: int = default.max_actions,
        seconds: float = 30.0,
    ) -> int:
        """Plan the goals of your own scenes; every plan is replayed in the simulator.

        Args:
            scenes: JSON file, or JSON lines with one scene a line.
            goal: Further goals for every scene, e.g. 'on-the-left(red, blue)'.
            json: One JSON line a goal instead of text.
            planner: Our planner, or rai's own LGP solver (pip install 'relevance[rai]').
            search: The paper's breadth-first tree, or our informed search.
            guide: How the scores of the checkpoint enter the search.
            checkpoint: The model that scores the objects; a guide needs one.
            beta: An object is kept when its score exceeds -beta.
            limit: Most nodes that the search may open for a goal.
            max_actions: Most picks and places in a plan.
            seconds: CPU seconds that rai has for a goal (--search, --limit and --max-actions
                are settings of our planner).
        """
        from relevance.simulation import replay

        if limit < 1:
            raise UsageError(f"--limit {limit}: expected at least 1")
        if (guide == "none") != (checkpoint is None):
            raise UsageError("--guide and --checkpoint go together: a guide needs a model")
        config = dataclasses.replace(
            default, search=search, node_limit=limit, max_actions=max_actions
        )
        tasks = [
            (scene, scene.goal(text))
            for scene in read_scenes(scenes)
            for text in (*scene.goals, *goal)
        ]
        if not tasks:
            raise SceneError(f"{scenes}: no goals, expected some in the file or by --goal")
        if planner == "rai":
            from relevance.planner.rai.planner import RaiConfig, plan_rai

            solve = functools.partial(plan_rai, config=RaiConfig(seconds=seconds))
        else:
            from relevance.planner import plan

            solve = functools.partial(plan, config=config)

        guidance = None
        if checkpoint:
            from relevance.evaluation import load_guide

            guidance = load_guide(checkpoint, mode=guide, beta=beta)
        with bar("goals", quiet=not json and sys.stdout.isatty()) as progress:
            for done, (scene, wanted) in enumerate(tasks, 1):
                result = solve(scene, wanted, guide=guidance)
                solved = result.status == "solved"
                verdict = replay(scene, wanted, result.phases) if solved else None
                line = _plan_line(scene.id, result, verdict)
                print(to_json(line) if json else _plan_text(line), flush=True)
                progress(done, len(tasks))
        return 0

    return plan


def _check(_: Preset) -> Callable[..., int]:
    def check(dataset: DatasetArg, render: bool = True) -> int:
        """Check every contract of a dataset; exit code 1 and a line for each breach.

        Args:
            dataset: Folder of the dataset.
            render: Also render one scene of each shard again and compare the pixels.
        """
        from relevance.pipeline.checking import check

        with bar("files") as progress:
            breaches = check(dataset, render=render, progress=progress)
        for breach in breaches:
            print(breach)
        say(
            f"{dataset}: {len(breaches)} breaches" if breaches else f"{dataset}: all contracts hold"
        )
        return 1 if breaches else 0

    return check


def _sql(_: Preset) -> Callable[..., int]:
    def sql(
        dataset: DatasetArg,
        query: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="QUERY")],
        format: Format = "table",
        policy: OptionalName = None,
    ) -> int:
        """Ask DuckDB about a dataset; there is a view for each table.

        Args:
            dataset: Folder of the dataset.
            query: SQL over scenes, objects, plans, labels, predictions, evaluations, checkpoints.
            format: How to print the rows.
            policy: The label policy that `labels` shows; the dataset's own when not given.
        """
        from relevance.store import sql

        show(*sql(dataset, query, policy=policy), format)
        return 0

    return sql


def _stats(_: Preset) -> Callable[..., int]:
    def stats(
        dataset: DatasetArg,
        format: Literal["table", "json"] = "table",
        card: Path | None = None,
    ) -> int:
        """Count a dataset: label balance, plan lengths, failures by reason, visibility, time.

        Args:
            dataset: Folder of the dataset.
            format: How to print the tables.
            card: Folder to write a dataset card to instead: a page of Markdown and its pictures.
        """
        from relevance.report.card import write_card
        from relevance.report.tables import statistics

        if card is not None:
            print(write_card(dataset, card))
            return 0
        found = statistics(dataset)
        if format == "json":
            print(to_json(dataclasses.asdict(found)))
        else:
            for table in found.tables:
                show(table.columns, table.rows, "table", title=table.title)
        return 0

    return stats


def _demo(preset: Preset) -> Callable[..., int]:
    def demo(
        dataset: Path = Path("data/demo"),
        preset: Preset = preset,
        workers: Workers = CORES,
    ) -> int:
        """Run the whole pipeline through the Prefect flows, from scenes to the report.

        Stopped half-way, the same command goes on; run again, it repeats nothing.

        Args:
            dataset: Folder of the dataset.
            preset: Size of everything.
            workers: Processes that work at a time.
        """
        from flows import demo, shards

        with bars() as drawn:
            rows: dict[str, Any] = {}

            def hear(stage: str, done: int, total: int) -> None:
                if stage not in rows:
                    rows[stage] = drawn.add_task(stage, total=total)
                drawn.update(rows[stage], completed=done)

            shards.listener.set(hear)
            result = demo.run(str(dataset), preset=preset, max_workers=workers)
        minutes = ", ".join(f"{name} {took / 60:.1f}" for name, took in result.seconds.items())
        say(f"minutes: {minutes}")
        print(f"dataset     {result.dataset}")
        print(f"checkpoint  {result.checkpoint}")
        print(f"report      {result.report}")
        return 0

    return demo


def _dashboard(_: Preset) -> Callable[..., int]:
    def dashboard(
        dataset: DatasetArg = Path("data/demo"), port: int = 8501, address: str = "127.0.0.1"
    ) -> int:
        """Open the dashboard in a browser.

        Args:
            dataset: Folder of the dataset.
            port: Where it listens.
            address: For whom it listens; this machine only, unless changed.
        """
        import dashboards
        from relevance.store import Dataset

        Dataset.open(dataset)
        app = Path(next(iter(dashboards.__path__))) / "app.py"
        options = {
            "server.port": port,
            "server.address": address,
            "server.headless": "true",
            "browser.gatherUsageStats": "false",
        }
        flags = [f"--{name}={value}" for name, value in options.items()]
        command = [sys.executable, "-m", "streamlit", "run", str(app), *flags, "--", str(dataset)]
        sys.stdout.flush()
        os.execv(sys.executable, command)  # who ends this command ends the page

    return dashboard


def _plan_line(scene_id: str, result: Any, verdict: Any) -> dict[str, Any]:
    counts = {name: getattr(result.counts, name) for name in ("nodes", "pose", "keyframe", "path")}
    return {
        "id": scene_id,
        "goal": str(result.goal),
        "status": result.status,
        "reason": result.reason,
        "actions": [action.to_list() for action in result.actions],
        "moved": list(result.moved),
        "final": {
            name: {"position": list(pose.position), "yaw": pose.yaw}
            for name, pose in result.final.items()
        },
        "cost": result.cost,
        "seconds": result.seconds.total,
        "counts": counts,
        "replay": verdict and {"ok": verdict.ok, "max_penetration": verdict.max_penetration},
    }


def _plan_text(line: Mapping[str, Any]) -> str:
    head = f"{line['id']}  {line['goal']}: {line['status']}"
    if line["status"] != "solved":
        return f"{head} ({line['reason']}), {line['counts']['nodes']} nodes"
    verdict = "replayed" if line["replay"]["ok"] else "the replay disagrees"
    steps = [f"  {i}. {' '.join(action)}" for i, action in enumerate(line["actions"], 1)]
    return "\n".join([f"{head} in {line['seconds']:.3f} s, {verdict}", *steps])


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A subcommand: what makes its function, what it does in a few words, examples."""

    make: Callable[..., Callable[..., int]]
    about: str
    examples: tuple[str, ...]
    preset: Preset = "demo"
    decides: tuple[str, ...] = ()
    """Flags whose values `make` takes after the preset: other flags depend on them."""


COMMANDS = {
    "generate": Command(
        make=_generate,
        about="random scenes, rendered",
        examples=(
            "relevance generate data/tables --preset laptop --seed 7",
            "relevance generate data/few --preset smoke --train.on 0 --workers 1",
        ),
    ),
    "label": Command(
        make=_label,
        about="plans and labels for a dataset's scenes",
        examples=(
            "relevance label data/tables",
            "relevance label data/tables --predicates on",
            "relevance label data/tables --policy necessary",
        ),
    ),
    "train": Command(
        make=_train,
        about="a relevance model",
        examples=(
            "relevance train data/tables --preset laptop",
            "relevance train data/tables --steps 3000 --model.body vit --model.width 64",
        ),
        decides=("--model.body",),
    ),
    "evaluate": Command(
        make=_evaluate,
        about="rerun the planner with a model's guidance",
        examples=("relevance evaluate data/tables --tasks 100 --guides prune prune-then-full",),
    ),
    "report": Command(
        make=_report,
        about="tables and figures as one HTML file",
        examples=("relevance report data/tables",),
    ),
    "plan": Command(
        make=_plan,
        about="plan the goals of your own scenes",
        examples=(
            "relevance plan scenes.jsonl --json",
            "relevance plan scene.json --goal 'on(red, blue)' --search tree",
            "relevance plan scenes.jsonl --guide prune-then-full --checkpoint model.pt",
            "relevance plan scenes.jsonl --planner rai --seconds 10",
        ),
    ),
    "check": Command(
        make=_check,
        about="every contract of a dataset",
        examples=("relevance check data/tables", "relevance check data/tables --no-render"),
    ),
    "sql": Command(
        make=_sql,
        about="ask DuckDB about a dataset",
        examples=(
            'relevance sql data/tables "select relevant, count(*) from labels group by 1"',
            'relevance sql data/tables "from plans" --format csv > plans.csv',
            'relevance sql data/tables "select why, count(*) from label_changes group by all"',
        ),
    ),
    **{name: Command(make=make, **more) for name, (make, more) in datasets.COMMANDS.items()},
    "stats": Command(
        make=_stats,
        about="label balance, plan lengths, visibility",
        examples=("relevance stats data/tables", "relevance stats data/tables --card out/card"),
    ),
    "demo": Command(
        make=_demo,
        about="the whole pipeline, from scenes to the report",
        examples=("relevance demo", "relevance demo --preset smoke --dataset data/smoke"),
    ),
    "dashboard": Command(
        make=_dashboard,
        about="look around in a browser",
        examples=("relevance dashboard data/demo",),
    ),
    "bench planner": Command(
        make=bench_planner,
        about="the planner's speed, truth, stability and completeness",
        examples=(
            "relevance bench planner --tasks 1000",
            "relevance bench planner --tasks 200 --seed 7 --parts speed truth",
            "relevance bench planner --tasks 60 --against rai",
        ),
    ),
}
