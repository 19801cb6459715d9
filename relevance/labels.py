"""From a planner's result to rows: plans (failures too), timings, and relevance labels.

Labels are read from plan rows, not from planner objects: another policy makes new labels from
stored plans, with no planning and no rendering.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from relevance.planner import PLANNER_VERSION, PlanResult
from relevance.scene import Scene, content_hash, scene_from_json, scene_to_json
from relevance.simulation import Rendering, Replay

POLICIES = ("found",)
"""`found`: relevant is what the plan that was found manipulates (the paper's Z_S)."""


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
    }


def stored_scene(row: Mapping[str, Any], *, where: str = "scenes") -> Scene:
    """The scene of a row; raises SceneError when it is impossible or is not what its id says."""
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
    """The row of a goal in `plans`; a plan that was not found keeps its reason."""
    solved = result.status == "solved"
    return {
        "plan_id": plan_id(scene.id, str(result.goal), config_hash=config_hash),
        "scene_id": scene.id,
        "split": split,
        "shard": shard,
        "predicate": result.goal.predicate.value,
        "subject": result.goal.subject,
        "reference": result.goal.reference,
        "status": result.status,
        "reason": result.reason,
        "actions": [action.to_list() for action in result.actions],
        "moved": list(result.moved),
        "final": [
            {"name": name, "position": list(pose.position), "yaw": pose.yaw, "on": pose.on}
            for name, pose in sorted(result.final.items())
        ],
        "n_actions": len(result.actions),
        "cost": _number(result.cost) if solved else None,
        "ambiguous": result.ambiguous,
        "nodes": result.counts.nodes,
        "pose_checks": result.counts.pose,
        "keyframe_nlps": result.counts.keyframe,
        "path_nlps": result.counts.path,
        "check_ok": solved and result.check_ok,
        "max_penetration": _number(result.max_penetration) if solved else None,
        "replay_ok": None if replay is None else replay.ok,
        "replay_max_penetration": None if replay is None else _number(replay.max_penetration),
        "replay_reason": None if replay is None else replay.reason,
        "holds": solved and result.check_ok and (replay is None or replay.ok),
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
    scene: Mapping[str, Any], plan: Mapping[str, Any], policy: str = "found"
) -> list[dict[str, Any]]:
    """One row an object of the scene, in its order; none when the plan does not hold.

    `scene` and `plan` are rows of `scenes` and `plans`. Raises ValueError for another policy.
    """
    if policy not in POLICIES:
        raise ValueError(f"policy {policy!r}: expected one of {', '.join(POLICIES)}")
    assert plan["scene_id"] == scene["scene_id"], "a plan is labelled with its own scene"
    if not plan["holds"]:
        return []
    goal_objects = (plan["subject"], plan["reference"])
    return [
        {
            **{key: plan[key] for key in _FROM_PLAN},
            "query": box["name"],
            "relevant": box["name"] in plan["moved"],
            "is_goal_object": box["name"] in goal_objects,
            "policy": policy,
            "visible_fraction": box["visible_fraction"],
        }
        for box in scene["objects"]
    ]


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
