"""Imports point one way, and each foreign library enters through one door."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent

ORDER = (
    "errors",
    "registry",
    "hashing",
    "configs",
    "counters",
    "scene",
    "store",
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
"""The stages; each may import those before it."""
ANYTHING = ("relevance", "cli")
"""The package itself and the command line are above all stages, flows included."""

DOORS = {
    "pybullet": ("simulation",),
    "casadi": ("planner",),
    "numba": ("sampling", "simulation", "planner"),
    "pyarrow": ("store",),
    "duckdb": ("store",),
    "webdataset": ("store",),
    "upath": ("store",),
    "fsspec": ("store",),
    "monai": ("models",),
    "torch": ("models", "training", "evaluation"),
    "matplotlib": ("report", "benchmarks"),
    "robotic": ("planner",),
    "jinja2": ("report",),
    "prefect": ("flows",),
    "prefect_dask": ("flows",),
    "streamlit": ("dashboards",),
    "tyro": ("cli",),
    "rich": ("cli",),
}


def imports(file: Path, package: str) -> Iterator[tuple[int, str]]:
    """(line, dotted module) of every import in a file, those inside functions too."""
    for node in ast.walk(ast.parse(file.read_text(), str(file))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, *([base] if base else [])])
            # `from relevance import store` imports relevance.store.
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}" if base == "relevance" else base
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            yield node.lineno, str(node.args[0].value)


def stage_of(module: str) -> str:
    """`relevance.planner.search` -> planner; `relevance` -> relevance; `flows.x` -> flows."""
    parts = module.split(".")
    if parts[0] == "relevance":
        return parts[1] if len(parts) > 1 and parts[1] in ORDER else "relevance"
    return parts[0]


def breaches(root: Path) -> list[str]:
    """Every import that points the wrong way or through the wrong door, as file:line: what."""
    found = []
    for file in sorted(
        f for top in ("relevance", "flows", "dashboards") for f in (root / top).rglob("*.py")
    ):
        path = file.relative_to(root).with_suffix("")
        module = ".".join(part for part in path.parts if part != "__init__")
        package = module if file.name == "__init__.py" else module.rpartition(".")[0]
        stage = stage_of(module)
        where = file.relative_to(root)
        if path.parts[0] == "relevance" and stage == "relevance" and file.name != "__init__.py":
            found.append(f"{where}: no place in ORDER")
        for line, target in imports(file, package):
            to = stage_of(target)
            if to in DOORS and stage not in DOORS[to]:
                found.append(f"{where}:{line}: {to} enters through {', '.join(DOORS[to])} only")
            elif stage in ANYTHING or to == stage:
                continue
            elif path.parts[0] == "relevance" and to in ("flows", "dashboards"):
                found.append(f"{where}:{line}: {stage} imports {to}")
            elif stage in ORDER and to in ORDER and ORDER.index(to) > ORDER.index(stage):
                found.append(f"{where}:{line}: {stage} imports {to}, which comes later")
    return found


def test_imports_point_one_way_and_libraries_have_one_door() -> None:
    assert breaches(ROOT) == []


def test_the_rules_see_what_they_should(tmp_path: Path) -> None:
    files = {
        "relevance/__init__.py": "from relevance.report.page import build\n",
        "relevance/scene.py": "def f():\n    from relevance import store\n",
        "relevance/labels.py": "import relevance.pipeline as g\nimport duckdb\n",
        "relevance/store/tables.py": "from ..pipeline import work\nimport pyarrow.parquet\n",
        "relevance/models.py": "import importlib\nimportlib.import_module('pybullet')\n",
        "relevance/helpers.py": "",
        "relevance/report/__init__.py": "from flows.generate import generate\n",
        "relevance/cli/__init__.py": "from flows import demo\nimport torch\n",
        "flows/train.py": "from relevance.training import train\nfrom prefect import flow\n",
        "dashboards/app.py": "import streamlit\nimport matplotlib.pyplot\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert [breach.split(" enters")[0] for breach in breaches(tmp_path)] == [
        "dashboards/app.py:2: matplotlib",
        "relevance/cli/__init__.py:2: torch",
        "relevance/helpers.py: no place in ORDER",
        "relevance/labels.py:1: labels imports pipeline, which comes later",
        "relevance/labels.py:2: duckdb",
        "relevance/models.py:2: pybullet",
        "relevance/report/__init__.py:1: report imports flows",
        "relevance/scene.py:2: scene imports store, which comes later",
        "relevance/store/tables.py:1: store imports pipeline, which comes later",
    ]


def test_importing_the_package_is_light() -> None:
    script = "import sys, relevance; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout.split()
    assert "relevance" in loaded
    assert not set(DOORS) & set(loaded)


def test_modules_stay_short() -> None:
    long = {
        str(file.relative_to(ROOT)): count
        for top in ("relevance", "flows", "dashboards")
        for file in (ROOT / top).rglob("*.py")
        if (count := len(file.read_text().splitlines())) > 600
    }
    assert long == {}
