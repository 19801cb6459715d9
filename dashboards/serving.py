"""The dashboard's server."""

from __future__ import annotations

from pathlib import Path

from streamlit.web.cli import main


def serve(dataset: Path, *, address: str, port: int) -> None:
    """Serve the pages until the process is ended, in this process: what it has loaded stays."""
    options = {
        "server.port": port,
        "server.address": address,
        "server.headless": "true",
        "server.fileWatcherType": "none",  # it would look through all modules at each answer
        "browser.gatherUsageStats": "false",
    }
    flags = [f"--{name}={value}" for name, value in options.items()]
    app = Path(__file__).with_name("app.py")
    main(["run", str(app), *flags, "--", str(dataset)])
