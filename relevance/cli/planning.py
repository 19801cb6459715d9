"""The subcommand `plan`."""

# No `from __future__ import annotations`: tyro reads the annotations of local functions.
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from relevance.cli.arguments import (
    Command,
    OptionalPath,
    Preset,
    Repeated,
    at_least,
    check_file,
    one_of,
    settings_of,
)
from relevance.cli.terminal import UsageError, bar, to_json

Name = Annotated[str, tyro.conf.arg(metavar="NAME")]
OptionalShare = Annotated[float | None, tyro.conf.arg(metavar="SHARE")]


def _plan(_: Preset) -> Callable[..., int]:
    from relevance.planner import GUIDES, PLANNERS, PlannerConfig
    from relevance.scene import SceneError, read_scenes

    default = PlannerConfig()

    def plan(
        scenes: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENES")],
        goal: Annotated[Repeated, tyro.conf.arg(metavar="GOAL")] = (),
        json: tyro.conf.FlagCreatePairsOff[bool] = False,
        planner: Name = "ours",
        search: Literal["tree", "informed"] = default.search,
        guide: Name = "none",
        checkpoint: OptionalPath = None,
        beta: float = 0.0,
        coverage: OptionalShare = None,
        limit: int = default.node_limit,
        max_actions: int = default.max_actions,
        seconds: float = 30.0,
        trajectory: OptionalPath = None,
    ) -> int:
        """Plan the goals of your own scenes; every plan is replayed in the simulator.

        A plan that the replay does not confirm is refused: exit code 1 then. A goal that no plan
        reaches is an answer.

        Args:
            scenes: JSON file, or JSON lines with one scene a line; - is standard input.
            goal: A further goal for every scene, e.g. 'on-the-left(red, blue)'; may be given again.
            json: One JSON line a goal instead of text.
            planner: ours, or rai: rai's own LGP solver (pip install 'relevance[rai]').
            search: The paper's breadth-first tree, or our informed search.
            guide: How the scores of the checkpoint enter the search: none, prune,
                prune-then-full, expand, order, shortest or lazy.
            checkpoint: The model that scores the objects, which a guide needs: a file, or the name
                of one that comes with the package (glimpse, crowd, geometry).
            beta: An object is kept when its score exceeds -beta.
            coverage: Instead of a beta, with what probability at least all relevant objects are
                kept, e.g. 0.95; for a checkpoint that `relevance calibrate` has seen.
            limit: Most nodes that the search may open for a goal.
            max_actions: Most picks and places in a plan.
            seconds: CPU seconds that rai has for a goal (--search, --limit and --max-actions
                are settings of our planner).
            trajectory: File (.npz) for the plan as arrays: times, joints, gripper, attached (see
                relevance.trajectory). With several goals they are numbered in order: plan.npz
                becomes plan-1.npz, plan-2.npz. A goal without a plan leaves no file.
        """
        one_of("--planner", planner, PLANNERS)
        one_of("--guide", guide, GUIDES)
        at_least("--limit", limit, 1)
        at_least("--max-actions", max_actions, 2)
        at_least("--seconds", seconds, 0.001)
        at_least("--beta", beta, -math.inf)
        check_file("--trajectory", trajectory, ".npz")
        if coverage is not None and checkpoint is None:
            raise UsageError("--coverage needs a --guide and a --checkpoint")
        if GUIDES[guide].guided != (checkpoint is not None):
            raise UsageError("--guide and --checkpoint go together: a guide needs a model")
        chosen = PLANNERS[planner]
        chosen.require()
        config = settings_of(
            chosen.Config,
            search=search,
            node_limit=limit,
            max_actions=max_actions,
            seconds=seconds,
        )
        tasks = [
            (scene, scene.goal(text))
            for scene in read_scenes(scenes)
            for text in (*scene.goals, *goal)
        ]
        if not tasks:
            raise SceneError(f"{scenes}: no goals, expected some in the file or by --goal")
        files = _numbered(trajectory, len(tasks))
        guidance: Any = None
        if checkpoint:
            from relevance.evaluation import load_guide

            guidance = load_guide(checkpoint, mode=guide, beta=beta, coverage=coverage)
        chosen.warm_up()
        refused = 0
        with bar("goals", quiet=not json and sys.stdout.isatty()) as progress:
            for done, (scene, wanted) in enumerate(tasks, 1):
                if guidance is not None:
                    # The picture is the camera's work: taken before the clock runs.
                    guidance.scorer.scores(scene, wanted)
                    guidance.scorer.forget()
                result = chosen.plan(scene, wanted, config=config, guide=guidance, replay=True)
                refused += result.status == "refused"
                line = plan_line(scene.id, result)
                file = files[done - 1]
                if file is not None:
                    line["trajectory"] = str(file) if _write(file, result) else None
                print(to_json(line) if json else plan_text(line), flush=True)
                progress(done, len(tasks))
        return 1 if refused else 0

    return plan


def plan_line(scene_id: str, result: Any) -> dict[str, Any]:
    """A result as `plan --json` prints it."""
    counts = {name: getattr(result.counts, name) for name in ("nodes", "pose", "keyframe", "path")}
    verdict = result.replay
    return {
        "id": scene_id,
        "goal": str(result.goal),
        "status": result.status,
        "reason": result.reason,
        "blocking": list(result.blocking),
        "actions": [action.to_list() for action in result.actions],
        "moved": list(result.moved),
        "final": {
            name: {"position": list(pose.position), "yaw": pose.yaw}
            for name, pose in result.final.items()
        },
        "cost": result.cost,
        "ambiguous": result.ambiguous,
        "seconds": result.seconds.total,
        "counts": counts,
        "looked": result.looked,
        "replay": verdict
        and {
            "ok": verdict.ok,
            "reason": verdict.reason,
            "max_penetration": verdict.max_penetration,
        },
    }


def _numbered(file: Path | None, count: int) -> list[Path | None]:
    """A file for each plan."""
    if file is None or count == 1:
        return [file] * count
    return [file.with_stem(f"{file.stem}-{number}") for number in range(1, count + 1)]


def _write(file: Path, result: Any) -> bool:
    """Write a plan's arrays, whole or not at all; a file of an older plan goes in any case."""
    from relevance.planner import write_trajectory

    if result.status != "solved":
        file.unlink(missing_ok=True)
        return False
    write_trajectory(file, result)
    return True


def plan_text(line: Mapping[str, Any]) -> str:
    """A line of `plan --json` for people: the verdict, then one line a step."""
    head = f"{line['id']}  {line['goal']}: "
    notes = ["ambiguous"] if line["ambiguous"] else []
    if line["status"] == "solved" and not line["actions"]:
        return head + ", ".join(["holds already", *notes])
    if line["status"] == "solved":
        replayed = ["replayed"] if line["replay"] else []
        head += ", ".join([f"solved in {line['seconds']:.3f} s", *replayed, *notes])
    else:
        count = line["counts"]["nodes"]
        nodes = f"{count} node{'' if count == 1 else 's'} opened"
        head += ", ".join([f"{line['status']} ({line['reason']})", nodes, *notes])
    steps = [f"  {i}. {' '.join(action)}" for i, action in enumerate(line["actions"], 1)]
    return "\n".join([head, *steps])


COMMANDS = {
    "plan": Command(
        make=_plan,
        about="plan the goals of your own scenes",
        examples=(
            "relevance plan scenes.jsonl --json",
            "relevance plan scene.json --goal 'on(red, blue)' --search tree",
            "relevance plan scenes.jsonl --guide prune-then-full --checkpoint model.pt",
            "relevance plan scenes.jsonl --guide prune --checkpoint model.pt --coverage 0.95",
            "relevance plan scenes.jsonl --planner rai --seconds 10",
            "relevance plan scenes.jsonl --trajectory plan.npz",
            "relevance plan - < scenes.jsonl",
        ),
    ),
}
