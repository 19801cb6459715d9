"""Prefect plugin: short deployment names, and a temporary server that ends with its flow.

Prefect loads it through the `prefect.plugins` entry point wherever plugins are enabled, as they
are in the project folder (`[tool.prefect.plugins]` in pyproject.toml). Then
`prefect deployment run generate` means `generate/generate`, the full form that works anywhere.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect.plugins import register_hook

if TYPE_CHECKING:
    from prefect.plugins import HookContext

PREFECT_PLUGIN_API_REQUIRES = ">=0.1,<1"


@functools.cache
def deployments() -> tuple[str, ...]:
    """The names in the project's prefect.yaml; none outside the project folder."""
    import yaml

    file = Path(__file__).parent.parent / "prefect.yaml"
    found = yaml.safe_load(file.read_text("utf-8"))["deployments"] if file.is_file() else []
    return tuple(deployment["name"] for deployment in found)


def full_name(name: str) -> str:
    """`generate` -> `generate/generate` for our flows; every other name stays as it is."""
    return f"{name}/{name}" if name in deployments() else name


def wrap_read_deployment(client: Any) -> None:
    """Make a client class accept the short names; wrapping twice changes nothing."""
    read = client.read_deployment_by_name
    if getattr(read, "takes_short_names", False):
        return

    # Both clients return whatever this returns: an answer, or an awaitable one.
    @functools.wraps(read)
    def wrapped(self: Any, name: str, *args: Any, **kwargs: Any) -> Any:
        return read(self, full_name(name), *args, **kwargs)

    vars(wrapped)["takes_short_names"] = True
    client.read_deployment_by_name = wrapped


def end_with_parent(poll_seconds: float = 1.0) -> None:
    """End this process soon after its parent has gone, however the parent went."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(poll_seconds)
        os._exit(1)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


@register_hook
def setup_environment(*, ctx: HookContext) -> None:
    """Prefect's start-up hook: runs once in every process that imports prefect."""
    from prefect.client.orchestration import PrefectClient, SyncPrefectClient

    wrap_read_deployment(PrefectClient)
    wrap_read_deployment(SyncPrefectClient)
    if os.environ.get("PREFECT__SERVER_EPHEMERAL") == "1":
        # The server that a flow starts for itself would outlive a flow that was killed.
        end_with_parent()
