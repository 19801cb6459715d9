"""What flows tell the outside: Prefect events about a dataset, and an artifact for each trouble.

The resource of every event is `relevance.dataset.PATH`; its payload names the dataset, so that a
trigger can hand it to a deployment (prefect.yaml). Events: `shards.written` (`relevance.table` of
the resource is scenes or labels), `checkpoint.promoted` and `checkpoint.refused`, and the troubles
`shard.failed`, `labels.shifted` and `check.failed`, which also leave an artifact of their name with
a dash.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from prefect import get_run_logger
from prefect.artifacts import create_markdown_artifact
from prefect.events import emit_event

WRITTEN = "shards.written"
"""New shards are there."""
SHARD_FAILED = "shard.failed"
"""A shard could not be made, after all its tries."""
LABELS_SHIFTED = "labels.shifted"
"""The share of relevant objects changed by more than 3 points, beyond noise."""
CHECK_FAILED = "check.failed"
"""A dataset breaks its contracts."""
PROMOTED, REFUSED = "checkpoint.promoted", "checkpoint.refused"
"""What became of a checkpoint that was tried."""


def tell(dataset: Path, event: str, *, resource: dict[str, str] | None = None, **told: Any) -> None:
    """Emit an event about a dataset."""
    emit_event(
        event,
        resource={
            "prefect.resource.id": f"relevance.dataset.{dataset}",
            "prefect.resource.name": dataset.name,
            **(resource or {}),
        },
        payload={"dataset": str(dataset), **told},
    )


def announce(dataset: Path, table: str, written: Iterable[str]) -> None:
    """Emit `shards.written` with the number of new shards; nothing when there are none."""
    if count := len([*written]):
        tell(dataset, WRITTEN, resource={"relevance.table": table}, table=table, shards=count)


def trouble(dataset: Path, event: str, said: str, markdown: str = "", **told: Any) -> None:
    """Emit an event about something that went wrong, warn in the log, and leave an artifact.

    said: one line; markdown: what else there is to read.
    """
    get_run_logger().warning("%s: %s", event, said)
    create_markdown_artifact(
        f"# {event}\n\n`{dataset}`\n\n{markdown or said}\n",
        key=event.replace(".", "-"),
        description=f"{event}: {said}"[:200],
    )
    tell(dataset, event, said=said, **told)
