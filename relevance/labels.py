"""From a planner's result to rows: plans (failures too), timings, and relevance labels.

Labels are read from plan rows, not from planner objects: another policy makes new labels from
stored plans, with no rendering (and no planning, unless the policy asks for it).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from relevance.hashing import content_hash
from relevance.planner import PLANNER_VERSION, PlannerConfig, PlanResult, plan
from relevance.registry import Registry
from relevance.sampling import SAMPLER_VERSION
from relevance.scene import Scene, scene_from_json, scene_to_json
from relevance.simulation import RENDERER_VERSION, Rendering, Replay

LABELS_VERSION = "1"
"""Raised when equal plans give other rows here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Whether an object is relevant, and what says so."""

    relevant: bool
    because: str


class Policy(Protocol):
    """A way to read relevance off a plan that holds."""

    plans: bool
    """Whether it plans again, which takes time."""

    def verdicts(
        self, scene: Mapping[str, Any], plan: Mapping[str, Any], config: PlannerConfig
    ) -> Mapping[str, Verdict]:
        """A verdict on every object of a row of `scenes`, from a row of `plans` that holds."""
        ...


POLICIES: Registry[Policy] = Registry("policy")
"""Label policies by name."""


class _Found:
    """Relevant is what the plan that was found manipulates (the paper's Z_S)."""

    plans = False

    def verdicts(
        self, scene: Mapping[str, Any], plan: Mapping[str, Any], config: PlannerConfig
    ) -> Mapping[str, Verdict]:
        # the plan's own row says why
        return {n: Verdict(relevant=n in plan["moved"], because="") for n in _names(scene)}


class _Necessary:
    """Relevant is what no plan of the allowed length can do without (leave one out)."""

    plans = True

    def verdicts(
        self, scene: Mapping[str, Any], plan: Mapping[str, Any], config: PlannerConfig
    ) -> Mapping[str, Verdict]:
        return necessary(stored_scene(scene), plan, config)


class _AnyMinimal:
    """Relevant is what some plan of the least length manipulates."""

    plans = False

    def verdicts(
        self, scene: Mapping[str, Any], plan: Mapping[str, Any], config: PlannerConfig
    ) -> Mapping[str, Verdict]:
        return {name: _in_any(name, plan) for name in _names(scene)}


POLICIES.register("found", _Found())
POLICIES.register("necessary", _Necessary())
POLICIES.register("any-minimal", _AnyMinimal())


def necessary(scene: Scene, found: Mapping[str, Any], config: PlannerConfig) -> dict[str, Verdict]:
    """Leave one out: plan the goal of a plan row again without moving each object that it moved.

    Every other object is one that the found plan does without. An object counts as necessary
    too when the search for a plan without it ended at its node limit; the verdict says so.
    """
    goal = scene.goal(f"{found['predicate']}({found['subject']}, {found['reference']})")
    verdicts = {}
    for name in scene.names:
        if name not in found["moved"]:
            verdicts[name] = Verdict(relevant=False, because="the plan does without it")
            continue
        others = frozenset(scene.names) - {name}
        without = plan(scene, goal, config=config, movable=others, replay=False)
        if without.status == "solved" and without.check_ok:
            moves = ", ".join(without.moved)
            verdicts[name] = Verdict(relevant=False, because=f"a plan without it moves {moves}")
        elif without.status == "limit":
            verdicts[name] = Verdict(relevant=True, because=f"undecided: {without.reason}")
        else:
            verdicts[name] = Verdict(
                relevant=True, because=f"no plan of up to {config.max_actions} actions without it"
            )
    return verdicts


def scene_row(
    scene: Scene,
    rendering: Rendering,
    *,
    split: str,
    shard: int,
    family: str,
    seed: int,
    index: int,
    attempt: int,
    config_hash: str,
) -> dict[str, Any]:
    """The row of a scene in `scenes`; `stored_scene` gives an equal scene back."""
    body = json.loads(scene_to_json(scene))
    visible = zip(rendering.visible_pixels, rendering.visible_fraction, strict=True)
    objects = [
        {**box, "visible_pixels": int(pixels), "visible_fraction": float(fraction)}
        for box, (pixels, fraction) in zip(body["objects"], visible, strict=True)
    ]
    return {
        "scene_id": scene.id,
        "split": split,
        "shard": shard,
        "family": family,
        "seed": seed,
        "index": index,
        "attempt": attempt,
        "n_objects": len(objects),
        "objects": objects,
        "table_top": body["table"],
        "camera": body["camera"],
        "light": body["light"],
        "robot": body["robot"],
        "config_hash": config_hash,
        "sampler_version": SAMPLER_VERSION,
        "renderer_version": RENDERER_VERSION,
    }


def stored_scene(row: Mapping[str, Any], *, where: str = "scenes") -> Scene:
    """The scene of a row; raises SceneError when it is impossible."""
    boxes = [
        {key: value for key, value in box.items() if not key.startswith("visible_")}
        for box in row["objects"]
    ]
    body = {
        "objects": boxes,
        "table": row["table_top"],
        **{key: row[key] for key in ("camera", "light", "robot")},
    }
    return scene_from_json(json.dumps(body), where=where)


def plan_id(scene_id: str, goal: str, *, config_hash: str) -> str:
    """16 hex digits that name one goal planned by one planner version with one config."""
    return content_hash([scene_id, goal, config_hash, PLANNER_VERSION])


def plan_row(
    scene: Scene,
    split: str,
    shard: int,
    result: PlanResult,
    replay: Replay | None,
    *,
    config_hash: str,
) -> dict[str, Any]:
    """The row of a goal in `plans`; a plan that was not found keeps its reason.

    A plan that the replay refuses is kept with the replay's reason; it is not solved and gets no
    label.
    """
    found = result.status in ("solved", "refused")
    refused = found and replay is not None and not replay.ok
    status = "refused" if refused else result.status
    reason = replay.reason if replay is not None and refused else result.reason
    return {
        "plan_id": plan_id(scene.id, str(result.goal), config_hash=config_hash),
        "scene_id": scene.id,
        "split": split,
        "shard": shard,
        "predicate": result.goal.predicate.name,
        "subject": result.goal.subject,
        "reference": result.goal.reference,
        "status": status,
        "reason": reason,
        "blocking": list(result.blocking) or None,
        "actions": [action.to_list() for action in result.actions],
        "moved": list(result.moved),
        "alternatives": [list(names) for names in result.alternatives],
        "final": [
            {"name": name, "position": list(pose.position), "yaw": pose.yaw, "on": pose.on}
            for name, pose in sorted(result.final.items())
        ],
        "n_actions": len(result.actions),
        "cost": _number(result.cost) if found else None,
        "ambiguous": result.ambiguous,
        "nodes": result.counts.nodes,
        "pose_checks": result.counts.pose,
        "keyframe_nlps": result.counts.keyframe,
        "path_nlps": result.counts.path,
        "check_ok": found and result.check_ok,
        "max_penetration": _number(result.max_penetration) if found else None,
        "replay_ok": None if replay is None else replay.ok,
        "replay_max_penetration": None if replay is None else _number(replay.max_penetration),
        "replay_reason": None if replay is None else replay.reason,
        "holds": status == "solved" and result.check_ok,
        "planner_version": PLANNER_VERSION,
        "config_hash": config_hash,
    }


def timing_row(
    plan: Mapping[str, Any], result: PlanResult, *, seconds_replay: float | None
) -> dict[str, Any]:
    """The row of a goal in `timings`, s."""
    return {
        **{key: plan[key] for key in ("plan_id", "split", "shard", "predicate")},
        "seconds": result.seconds.total,
        "seconds_pose": result.seconds.pose,
        "seconds_keyframe": result.seconds.keyframe,
        "seconds_path": result.seconds.path,
        "seconds_guide": result.seconds.guide,
        "seconds_replay": seconds_replay,
    }


def label_rows(
    scene: Mapping[str, Any],
    plan: Mapping[str, Any],
    policy: str = "found",
    config: PlannerConfig | None = None,
) -> list[dict[str, Any]]:
    """One row an object of the scene, in its order; none when the plan does not hold.

    `scene` and `plan` are rows of `scenes` and `plans`; policies that plan do it with `config`.
    Raises RelevanceError for an unknown policy.
    """
    by = POLICIES[policy]
    assert plan["scene_id"] == scene["scene_id"], "a plan is labelled with its own scene"
    if not plan["holds"]:
        return []
    verdicts = by.verdicts(scene, plan, config or PlannerConfig())
    goal_objects = (plan["subject"], plan["reference"])
    return [
        {
            **{key: plan[key] for key in _FROM_PLAN},
            "query": box["name"],
            "relevant": verdicts[box["name"]].relevant,
            "is_goal_object": box["name"] in goal_objects,
            "policy": policy,
            "because": verdicts[box["name"]].because or None,
            "visible_fraction": box["visible_fraction"],
        }
        for box in scene["objects"]
    ]


def _names(scene: Mapping[str, Any]) -> list[str]:
    return [box["name"] for box in scene["objects"]]


def _in_any(name: str, plan: Mapping[str, Any]) -> Verdict:
    if name in plan["moved"]:
        return Verdict(relevant=True, because="the plan moves it")
    for moved in plan["alternatives"] or ():
        if name in moved:
            others = ", ".join(moved)
            return Verdict(relevant=True, because=f"a plan as short moves {others}")
    return Verdict(relevant=False, because="no plan as short moves it")


_FROM_PLAN = (
    "plan_id",
    "scene_id",
    "split",
    "shard",
    "predicate",
    "subject",
    "reference",
    "ambiguous",
    "planner_version",
    "config_hash",
)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
