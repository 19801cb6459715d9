"""What a query reads: tables and views, by name, as DuckDB's own parser has them.

So a broken file stops only those who ask for its table, and nobody reads footers for nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from typing import Any

import duckdb

from relevance.store.tables import SCHEMAS, TABLES, table_schema

_FILES = ("views.sql", "changes.sql", "card.sql", "judged.sql")
_HEAD = re.compile(r"CREATE OR REPLACE VIEW (\w+) AS\s")


def needs(query: str) -> frozenset[str]:
    """All tables and views that a query reads, through other views too; everything if in doubt."""
    names = _names(query)
    return everything() if names is None else _through(names)


def everything() -> frozenset[str]:
    """Every table, with those of other labellings (`beside_`), and every view."""
    return _tables() | set(views())


@cache
def views() -> dict[str, str]:
    """The statements of `schemas/*.sql` that make views, by name, in their order."""
    found = {}
    for file in _FILES:
        for statement in duckdb.extract_statements((SCHEMAS / file).read_text(encoding="utf-8")):
            head = _HEAD.search(statement.query)
            assert head, f"{file}: expected views alone"
            found[head[1]] = statement.query[head.start() :]
    return found


@cache
def _tables() -> frozenset[str]:
    beside = {f"beside_{table}" for table in TABLES if table_schema(table).beside}
    return frozenset(TABLES) | beside


def _through(names: frozenset[str]) -> frozenset[str]:
    deeper = frozenset().union(*(_of_view(name) for name in names if name in views()))
    return names if deeper <= names else _through(names | deeper)


@cache
def _of_view(name: str) -> frozenset[str]:
    names = _names(_HEAD.sub("", views()[name], count=1))
    assert names is not None, f"{name}: expected a view over tables and views"
    return names


def _names(query: str) -> frozenset[str] | None:
    """The tables and views that a query names; None when that cannot be said."""
    found = duckdb.execute("SELECT json_serialize_sql(?)", [query]).fetchone()
    tree = json.loads(found[0]) if found else {"error": True}
    if tree["error"]:
        return None  # what is no plain SELECT: PIVOT, SHOW
    names, known = set(), _tables() | set(views())
    own = {entry["key"].lower() for node in _nodes(tree) for entry in _ctes(node)}
    for node in _nodes(tree):
        match node.get("type"):
            case "BASE_TABLE":
                names.add(node["table_name"].lower())
            case "TABLE_FUNCTION" if not node["function"]["function_name"].startswith("read_"):
                return None  # such as query('...')
            case "SHOW_REF":
                return None
    return frozenset(names & known) if names <= known | own else None


def _ctes(node: dict[str, Any]) -> list[dict[str, Any]]:
    return (node.get("cte_map") or {}).get("map", [])


def _nodes(tree: Any) -> Iterator[dict[str, Any]]:
    if isinstance(tree, dict):
        yield tree
    for item in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from _nodes(item)
