"""What every flow stands on: its options, the retries of its tasks, its artifacts and its log.

A flow is a function that `stage` decorates, in a file of its name, and an entry of prefect.yaml.
"""

from __future__ import annotations

import functools
import inspect
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import httpx
from prefect import Flow, Task, get_run_logger, task
from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_table_artifact,
)
from prefect.cache_policies import NO_CACHE
from prefect.exceptions import ParameterTypeError
from prefect.settings import get_current_settings
from prefect.task_runners import TaskRunner

from flows.parameters import ParameterError
from flows.shards import one_by_one
from relevance.errors import RelevanceError

P = ParamSpec("P")
R = TypeVar("R")


class NoServer(RelevanceError):
    """The Prefect server that was named does not answer, or none can be started."""


class Stage(Flow[P, R]):
    """A flow that says in one line when its server is not there."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run it; raises NoServer, or ParameterError for parameters that cannot be."""
        find_server()
        try:
            return super().__call__(*args, **kwargs)
        except ParameterTypeError as error:
            # a heading, then one line for each parameter
            wrong = [line.removeprefix(" - ") for line in str(error).splitlines()[1:]]
            raise ParameterError("; ".join(wrong).replace("Value error, ", "")) from None


def find_server() -> None:
    """Raises NoServer when PREFECT_API_URL names a server that does not answer.

    Without a name a flow starts a server of its own, and that needs a home.
    """
    settings = get_current_settings()
    url = settings.api.url
    if not url:
        _writable(settings.home)
        return
    try:
        httpx.get(f"{url}/health", timeout=30)
    except (httpx.TransportError, httpx.InvalidURL) as error:
        raise NoServer(
            f"PREFECT_API_URL {url}: no Prefect server answers ({error}); start one with "
            "`prefect server start`, or unset it"
        ) from None


def _writable(home: Path) -> None:
    try:
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=home):
            return
    except OSError as error:
        raise NoServer(
            f"PREFECT_HOME {home}: {error.strerror}, expected a folder that can be written"
        ) from None


def stage(runner: TaskRunner[Any] | None = None) -> Callable[[Callable[P, R]], Stage[P, R]]:
    """Make a function a flow of its name; its tasks run on that runner, one by one if none."""

    def decorate(function: Callable[P, R]) -> Stage[P, R]:
        name = function.__name__
        preset = "preset" in inspect.signature(function).parameters
        return Stage(
            function,
            name=name,
            flow_run_name=f"{name}-{{preset}}" if preset else None,
            task_runner=runner or one_by_one(),
            persist_result=False,
        )

    return decorate


def worth_retrying(task: Task[Any, Any], run: Any, state: Any) -> bool:
    """Whether another try could help: bad input (a ValueError) stays bad."""
    return not isinstance(state.result(raise_on_failure=False), ValueError)


retried = functools.partial(
    task,
    retries=2,
    retry_delay_seconds=[1, 10],
    retry_condition_fn=worth_retrying,
    persist_result=False,
    cache_policy=NO_CACHE,
)
"""Decorates a task: another try for what is not the input's fault."""


# --- what a run leaves to look at ----------------------------------------------------------


def say(text: str, *values: Any) -> None:
    """A line in the run's log."""
    get_run_logger().info(text, *values)


def leave_table(key: str, rows: Sequence[Mapping[str, Any]], description: str) -> None:
    """A table artifact."""
    create_table_artifact([dict(row) for row in rows], key=key, description=description)


def leave_page(key: str, markdown: str, description: str) -> None:
    """A Markdown artifact."""
    create_markdown_artifact(markdown, key=key, description=description)


def leave_link(key: str, file: Path, text: str) -> None:
    """A link to a file."""
    create_link_artifact(file.as_uri(), key=key, link_text=text, description=text)
