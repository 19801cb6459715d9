"""What imports what: the reader behind `test_structure.py`, and the drawing in CONTRIBUTING.md.

python tests/structure.py    # prints the drawing (Mermaid), as `make drawing` does
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
TOPS = ("relevance", "flows", "dashboards")

ORDER = (
    "errors",
    "registry",
    "hashing",
    "configs",
    "counters",
    "workers",
    "robot",
    "scene",
    "holding",
    "store",
    "networks",
    "sampling",
    "simulation",
    "planner",
    "labels",
    "models",
    "metrics",
    "training",
    "pipeline",
    "evaluation",
    "report",
    "benchmarks",
    "cli",
)
"""The rooms; each may import those before it."""
ABOVE = ("relevance", "cli")
"""The package itself and the command line are above all rooms, flows included."""


def sources(root: Path) -> Iterator[Path]:
    """Every file of the product."""
    for top in TOPS:
        yield from sorted((root / top).rglob("*.py"))


def module_of(file: Path, root: Path) -> str:
    """`relevance/store/tables.py` -> relevance.store.tables; a package's is its folder's."""
    path = file.relative_to(root).with_suffix("")
    return ".".join(part for part in path.parts if part != "__init__")


def imports(file: Path, root: Path) -> Iterator[tuple[int, str]]:
    """(line, dotted module or name in it) of every import, those inside functions too."""
    module = module_of(file, root)
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_text(), str(file))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, *([base] if base else [])])
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}" if base else alias.name
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            yield node.lineno, str(node.args[0].value)


def room_of(module: str) -> str:
    """`relevance.planner.search` -> planner; `relevance` -> relevance; `flows.x` -> flows."""
    parts = module.split(".")
    if parts[0] == "relevance":
        return parts[1] if len(parts) > 1 and parts[1] in ORDER else "relevance"
    return parts[0]


def files_imported(root: Path) -> dict[str, set[str]]:
    """Each file (as a module) and the files that it imports.

    `from room import name` counts as the file `room/name.py` where there is one, else as the
    room's `__init__`; an `__init__` that gathers the names of its files imports them.
    """
    known = {module_of(file, root) for file in sources(root)}
    found: dict[str, set[str]] = {}
    for file in sources(root):
        mine = module_of(file, root)
        targets = set()
        for _, name in imports(file, root):
            while name and name not in known:
                name = name.rpartition(".")[0]
            if name and name != mine:
                targets.add(name)
        found[mine] = targets
    return found


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """A circle of imports between files, first and last the same; empty when there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []


def rooms_imported(root: Path) -> dict[str, set[str]]:
    """Each room and the rooms that it imports."""
    found: dict[str, set[str]] = {}
    for file in sources(root):
        room = room_of(module_of(file, root))
        targets = {room_of(name) for _, name in imports(file, root)}
        found.setdefault(room, set()).update(targets & {*ORDER, *TOPS} - {room})
    return found


def drawing(root: Path = ROOT) -> str:
    """The rooms from the ground up as a Mermaid graph; arrows that others imply are left out."""
    graph = rooms_imported(root)
    graph.pop("relevance", None)
    graph = {room: {t for t in targets if t in graph} for room, targets in graph.items()}

    def reach(room: str, seen: set[str]) -> set[str]:
        for target in graph[room]:
            if target not in seen:
                seen.add(target)
                reach(target, seen)
        return seen

    lines = ["graph BT"]
    place = {room: i for i, room in enumerate((*ORDER, "flows", "dashboards"))}
    for room in sorted(graph, key=place.__getitem__):
        implied = {far for target in graph[room] for far in reach(target, set())}
        needed = sorted(graph[room] - implied, key=place.__getitem__)
        lines += [f"    {target} --> {room}" for target in needed]
    return "\n".join(lines)


def house(root: Path = ROOT) -> str:
    """Every file of the product by room, from the ground up, with what its docstring says first."""
    place = {room: i for i, room in enumerate((*ORDER, "relevance", "flows", "dashboards"))}
    lines: list[str] = []
    for file in sorted(sources(root), key=lambda file: place[room_of(module_of(file, root))]):
        docstring = ast.get_docstring(ast.parse(file.read_text())) or ""
        lines.append(f"- `{file.relative_to(root)}`: {docstring.splitlines()[0]}")
    return "\n".join(lines)


def rewrite(text: str) -> str:
    """CONTRIBUTING.md with today's drawing and map between their marks."""
    for name, body in (("drawing", f"```mermaid\n{drawing()}\n```"), ("map", house())):
        start, end = f"<!-- {name} -->\n", f"<!-- end of the {name} -->"
        head, _, rest = text.partition(start)
        text = f"{head}{start}{body}\n{end}{rest.partition(end)[2]}"
    return text


if __name__ == "__main__":
    file = ROOT / "CONTRIBUTING.md"
    file.write_text(rewrite(file.read_text()))
