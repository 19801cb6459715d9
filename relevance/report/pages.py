"""How pages are made: Jinja templates beside this file, with one way to write each figure."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from relevance.metrics import Interval
from relevance.report.style import DASH, TIMES, number, percent, seconds
from relevance.store import replacing


def write_page(template: str, out: Path, **given: Any) -> Path:
    """Render a template into a file, whole or not at all; its path."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "percent": percent,
        "seconds": seconds,
        "times": times,
        "spread": spread,
        "number": number,
        "code": code,
    }
    page = environment.get_template(template).render(given)
    with replacing(out) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return out


def code(text: str) -> Markup:
    """Text in which what stands in backticks is code."""
    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def times(interval: Interval) -> Markup:
    """A ratio with its interval."""
    if not math.isfinite(interval.value):
        return Markup(DASH)
    low, high = f"{interval.low:.2f}", f"{interval.high:.2f}"
    return Markup("{}{} <small>{} to {}</small>").format(f"{interval.value:.2f}", TIMES, low, high)


def spread(interval: Interval) -> Markup:
    """A time with its interval."""
    if not math.isfinite(interval.value):
        return Markup(DASH)
    value, low, high = map(seconds, (interval.value, interval.low, interval.high))
    if low.split()[-1:] == high.split()[-1:]:
        low = low.split()[0]
    return Markup("{} <small>{} to {}</small>").format(value, low, high)
