"""A page of ours in the system's Chromium, which may ask this machine alone.

Playwright drives it over a pipe. What the page writes to its console as an error, and whatever it
asks of another machine, is kept and barred; `Visit.clean` says that there was none of either.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Page, Route, sync_playwright
from served import ended, wait_for

ROOT = Path(__file__).parent.parent
SCREENSHOTS = ROOT / "build" / "screenshots"
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or "/usr/bin/chromium"
HERE = ("127.0.0.1", "localhost")
QUIET = ("--disable-background-networking", "--disable-component-update", "--no-first-run")
"""What Chromium itself does not ask of anybody."""


@dataclass(slots=True)
class Visit:
    """A page, and what went wrong on it."""

    page: Page
    errors: list[str] = field(default_factory=list)
    """What was written to the console as an error, or thrown."""
    outside: list[str] = field(default_factory=list)
    """Addresses of other machines that were asked for (and not reached)."""

    def clean(self) -> None:
        """Nothing went wrong so far."""
        assert self.errors == []
        assert self.outside == []

    def keep(self, name: str, *, full: bool = True) -> bytes:
        """A screenshot, kept as build/screenshots/NAME.png; the whole page unless not `full`."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        return self.page.screenshot(path=SCREENSHOTS / f"{name}.png", full_page=full)


@contextmanager
def visit(width: int = 1440, height: int = 900) -> Iterator[Visit]:
    """An empty page of that size."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM,
            args=[*QUIET, *(["--no-sandbox"] if os.geteuid() == 0 else [])],
        )
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            found = Visit(page)
            page.on("console", lambda said: _note(found, said))
            page.on("pageerror", lambda error: found.errors.append(str(error)))
            page.on("websocket", lambda opened: _outside(found, opened.url))
            page.route("**/*", lambda route: _pass(found, route))
            yield found
        finally:
            browser.close()


def _note(found: Visit, said: Any) -> None:
    if said.type == "error":
        found.errors.append(said.text[:300])


def _outside(found: Visit, url: str) -> bool:
    place = urlsplit(url)
    if place.scheme in ("data", "blob", "about") or place.hostname in HERE:
        return False
    found.outside.append(url)
    return True


def _pass(found: Visit, route: Route) -> None:
    if _outside(found, route.request.url):
        route.abort()
    else:
        route.continue_()


@contextmanager
def running(command: Sequence[str | Path], log: Path, **more: str) -> Iterator[str]:
    """A program of ours that serves a page, `{port}` in its words being a free one; its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [str(word).replace("{port}", str(port)) for word in command]
    env = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | more
    with log.open("wb") as stream:
        process = subprocess.Popen(
            words, cwd=ROOT, env=env, start_new_session=True, stdout=stream, stderr=stream
        )

    def answers() -> bool:
        assert process.poll() is None, log.read_text()
        with socket.socket() as asking:
            return asking.connect_ex(("127.0.0.1", port)) == 0

    with ended(process):
        wait_for(answers, 120, f"somebody listens at {port}")
        yield f"http://127.0.0.1:{port}"


def relevance(*words: str | Path) -> list[str | Path]:
    """A command of ours."""
    return [sys.executable, "-c", "from relevance.cli import main; main()", *words]
