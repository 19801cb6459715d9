"""Prefect's API, as far as the page of runs reads it: plain HTTP, so that nothing is imported.

(Prefect's own client takes 3.7 s of CPU to import, more than a page may take to its first figure.)
The server is the one that PREFECT_API_URL names, else one of this machine at its usual port.
"""

from __future__ import annotations

import json
import os
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from relevance.errors import RelevanceError

USUAL = "http://127.0.0.1:4200/api"
FLOWS = ("generate", "label", "check", "train", "evaluate", "reproduce", "retrain")
"""Those of this project; a server may have others."""
_SECONDS = 5.0


class NoAnswer(RelevanceError):
    """No server answers at the address, or what answers is none of Prefect's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowRun:
    """One run of a flow."""

    name: str
    flow: str
    state: str
    """Completed, Failed, Crashed, Running, ..."""
    said: str
    """What its state adds, such as an error."""
    started: datetime | None
    seconds: float
    dataset: str
    link: str
    """Its page on the server."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Artifact:
    """What a run left to look at."""

    key: str
    kind: str
    description: str
    data: str
    updated: datetime | None


def server() -> str:
    """The address of the API."""
    return os.environ.get("PREFECT_API_URL") or USUAL


def flow_runs(url: str, *, limit: int = 100) -> list[FlowRun]:
    """The latest runs of this project's flows, the newest first; NoAnswer without a server."""
    flows = _post(url, "/flows/filter", {"flows": {"name": {"any_": list(FLOWS)}}})
    names = {flow["id"]: flow["name"] for flow in flows}
    asked = {"sort": "EXPECTED_START_TIME_DESC", "limit": limit}
    asked |= {"flows": {"id": {"any_": list(names)}}}
    asked |= {"flow_runs": {"state": {"type": {"not_any_": ["SCHEDULED"]}}}}
    runs = _post(url, "/flow_runs/filter", asked) if names else []
    return [_run(url, run, names[run["flow_id"]]) for run in runs]


def artifacts(url: str, *, limit: int = 20) -> list[Artifact]:
    """The latest tables, pages and links that runs left, the newest first."""
    asked = {"sort": "UPDATED_DESC", "limit": limit}
    asked |= {"artifacts": {"key": {"exists_": True}, "type": {"not_any_": ["progress"]}}}
    return [
        Artifact(
            key=found["key"],
            kind=found["type"],
            description=found["description"] or "",
            data=found["data"] if isinstance(found["data"], str) else json.dumps(found["data"]),
            updated=_time(found["updated"]),
        )
        for found in _post(url, "/artifacts/latest/filter", asked)
    ]


def _run(url: str, run: Mapping[str, Any], flow: str) -> FlowRun:
    state = run["state"] or {}
    return FlowRun(
        name=run["name"],
        flow=flow,
        state=run["state_name"] or "Pending",
        said=state.get("message") or "",
        started=_time(run["start_time"]),
        seconds=run["total_run_time"] or 0.0,
        dataset=str(run["parameters"].get("dataset", "")),
        link=f"{url.removesuffix('/api')}/runs/flow-run/{run['id']}",
    )


def _time(text: str | None) -> datetime | None:
    return datetime.fromisoformat(text) if text else None


def _post(url: str, path: str, body: Mapping[str, Any]) -> Any:
    request = urllib.request.Request(
        url.rstrip("/") + path,
        data=json.dumps(body).encode(),
        headers={"Content-Type": "application/json"},
    )
    try:
        with urllib.request.urlopen(request, timeout=_SECONDS) as answer:
            return json.load(answer)
    except (OSError, ValueError) as error:  # refused, too slow, another program, no address
        reason = getattr(error, "reason", error)
        raise NoAnswer(f"{url}: no Prefect server answers ({reason})") from None
