"""Plans what it is asked on stdin, one JSON object a line, and answers likewise; see `versus`.

A program of its own: it runs with the package of *another* checkout, which may be older, so it
uses nothing but what every version has: `plan`, `warm_up`, `PlannerConfig`, `scene_from_json`.
"""

from __future__ import annotations

import inspect
import json
import os
import sys
import time
from typing import Any


def main() -> None:
    """Say where the package is from, then answer until stdin ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer

    import relevance
    from relevance.planner import PlannerConfig, plan, warm_up
    from relevance.scene import scene_from_json

    def answer(**found: object) -> None:
        answers.write(json.dumps(found) + "\n")
        answers.flush()

    # Older ones never replayed; nobody's time holds a replay.
    bare: dict[str, Any] = (
        {"replay": False} if "replay" in inspect.signature(plan).parameters else {}
    )
    warm_up()
    answer(package=os.path.realpath(relevance.__file__))
    for line in sys.stdin:
        asked = json.loads(line)
        scene, config = scene_from_json(asked["scene"]), PlannerConfig(**asked["config"])
        began = time.process_time()
        result = plan(scene, asked["goal"], config=config, **bare)
        cpu = time.process_time() - began
        answer(cpu=cpu, status=result.status, reason=result.reason, moved=list(result.moved))


if __name__ == "__main__":
    # Python put this file's folder in front of the path, where `tasks` and others would be found.
    sys.path.pop(0)
    main()
