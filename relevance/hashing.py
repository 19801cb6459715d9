"""Content hashes: what names a scene, a plan, a config or a checkpoint."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from pydantic import TypeAdapter


def content_hash(value: Any) -> str:
    """16 hex digits that depend on the JSON form of `value` alone."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=_jsonable)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _jsonable(value: Any) -> Any:
    return TypeAdapter(type(value)).dump_python(value, mode="json")
