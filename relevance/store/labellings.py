"""Labellings: plans and labels of one planner version, goal set and label policy.

The current ones lie in the dataset's own folders; every other one lies beside them, where
`beside` of a table's schema says: `beside/planner=V/config=HASH/labels/policy=POLICY/...`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from relevance.store.paths import DatasetError, checked_name
from relevance.store.tables import TABLES, table_schema

FOLDER = "beside"
"""Where every labelling but the current one lies."""


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Labelling:
    """One way in which a dataset's goals were planned and labelled; each part names a folder."""

    planner: str
    """Version of the planner."""
    config: str
    """Hash of the plan settings, goal set included."""
    policy: str
    """How relevance was read from the plans."""

    def __post_init__(self) -> None:
        for what, name in self.made_by.items():
            checked_name(what, name)

    @property
    def made_by(self) -> dict[str, str]:
        """What the footer of a labels file says."""
        return {**self.planned_by, "policy": self.policy}

    @property
    def planned_by(self) -> dict[str, str]:
        """What the footer of a plans file says."""
        return {"config": self.config, "planner": self.planner}


def beside_tables() -> tuple[str, ...]:
    """The tables that a labelling makes."""
    return tuple(table for table in TABLES if table_schema(table).beside)


def template(table: str, of: Labelling | None) -> str:
    """The file of a table, with its keys open; `of` asks for it beside the current ones."""
    schema = table_schema(table)
    if of is None:
        return schema.path
    if not schema.beside:
        known = ", ".join(beside_tables())
        raise DatasetError(f"table {table}: expected one of {known} beside others")
    path = schema.beside
    for key, value in of.made_by.items():
        path = path.replace(f"{{{key}}}", value)
    return path


def is_named(table: str, of: Labelling | None, within: Path) -> bool:
    """Whether a file's way within a dataset is one that the table's template leads to."""
    return _ways(table, of).fullmatch(within.as_posix()) is not None


@cache
def _ways(table: str, of: Labelling | None) -> re.Pattern[str]:
    number, key = re.escape("{shard:06d}"), r"\\{\w+\\}"
    fixed = re.escape(template(table, of)).replace(number, r"\d{6,}")
    return re.compile(re.sub(key, "[^/.][^/]*", fixed))


def folder(table: str, of: Labelling | None) -> str:
    """The folder of all files of a table."""
    head = template(table, of).partition("{")[0]
    return head.rpartition("/")[0]


def identity(table: str, made_by: Mapping[str, str]) -> tuple[str | None, ...]:
    """Which labelling a file of a table belongs to, by its footer."""
    asked = ("planner", "config", "policy")
    return tuple(made_by.get(key) for key in asked if f"{{{key}}}" in table_schema(table).beside)


def from_keys(keys: Mapping[str, Any]) -> Labelling | None:
    """The labelling that a way beside names; None for a way that names none."""
    try:
        return Labelling(planner=keys["planner"], config=keys["config"], policy=keys["policy"])
    except (KeyError, DatasetError):
        return None


def from_description(said: Mapping[str, Any]) -> Labelling | None:
    """The labelling that dataset.json names as the current one; None when it names none."""
    try:
        return Labelling(
            planner=said["planner_version"],
            config=said["hashes"]["plans"],
            policy=said["config"]["policy"],
        )
    except (KeyError, TypeError):
        return None
