"""Imports point one way, never in a circle, and each foreign library enters through one door."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

from structure import (
    ABOVE,
    ORDER,
    ROOT,
    circle,
    drawing,
    files_imported,
    imports,
    module_of,
    rewrite,
    room_of,
    sources,
)

DOORS = {
    "pybullet": ("simulation",),
    "casadi": ("planner",),
    "numba": ("scene", "holding", "networks", "sampling", "simulation", "planner"),
    "pyarrow": ("store",),
    "duckdb": ("store",),
    "webdataset": ("store",),
    "upath": ("store",),
    "fsspec": ("store",),
    "monai": ("models",),
    "torch": ("models", "training"),
    "onnx": ("models",),
    "onnxruntime": ("networks",),
    "matplotlib": ("report", "benchmarks"),
    "robotic": ("planner",),
    "jinja2": ("report",),
    "viser": ("report",),
    "yourdfpy": ("report",),
    "prefect": ("flows",),
    "prefect_dask": ("flows",),
    "streamlit": ("dashboards",),
    "tyro": ("cli",),
    "rich": ("cli",),
}


def breaches(root: Path) -> list[str]:
    """Every import that points the wrong way or through the wrong door, as file:line: what."""
    found = []
    for file in sources(root):
        where = file.relative_to(root)
        room = room_of(module_of(file, root))
        if where.parts[0] == "relevance" and room == "relevance" and file.name != "__init__.py":
            found.append(f"{where}: no place in ORDER")
        for line, target in imports(file, root):
            to = room_of(target)
            if to in DOORS and room not in DOORS[to]:
                found.append(f"{where}:{line}: {to} enters through {', '.join(DOORS[to])} only")
            elif room in ABOVE or to == room:
                continue
            elif where.parts[0] == "relevance" and to in ("flows", "dashboards"):
                found.append(f"{where}:{line}: {room} imports {to}")
            elif room in ORDER and to in ORDER and ORDER.index(to) > ORDER.index(room):
                found.append(f"{where}:{line}: {room} imports {to}, which comes later")
    return list(dict.fromkeys(found))


def test_imports_point_one_way_and_libraries_have_one_door() -> None:
    assert breaches(ROOT) == []


def test_no_two_files_import_each_other() -> None:
    assert circle(files_imported(ROOT)) == []


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
    write(tmp_path, files)
    assert [breach.split(" enters")[0] for breach in breaches(tmp_path)] == [
        "relevance/cli/__init__.py:2: torch",
        "relevance/helpers.py: no place in ORDER",
        "relevance/labels.py:1: labels imports pipeline, which comes later",
        "relevance/labels.py:2: duckdb",
        "relevance/models.py:2: pybullet",
        "relevance/report/__init__.py:1: report imports flows",
        "relevance/scene.py:2: scene imports store, which comes later",
        "relevance/store/tables.py:1: store imports pipeline, which comes later",
        "dashboards/app.py:2: matplotlib",
    ]


def test_circles_are_seen_within_a_room_and_inside_functions(tmp_path: Path) -> None:
    files = {
        "relevance/store/__init__.py": "from relevance.store.a import f\n",
        "relevance/store/a.py": "from relevance.store import b\nf = b.g\n",
        "relevance/store/b.py": "from relevance.store.c import h\ng = h\n",
        "relevance/store/c.py": "h = 1\n",
    }
    write(tmp_path, files)
    assert circle(files_imported(tmp_path)) == []
    late = "def h():\n    from relevance.store.a import f\n    return f\n"
    write(tmp_path, {"relevance/store/c.py": late})
    found = circle(files_imported(tmp_path))
    assert found[0] == found[-1]
    assert {*found} == {f"relevance.store.{name}" for name in "abc"}


def test_what_people_get_wrong_is_a_relevance_error() -> None:
    """A plain ValueError is a fault of ours, but for validators: pydantic turns it into one."""
    plain = [
        str(file.relative_to(ROOT))
        for file in sources(ROOT)
        if "raise ValueError" in file.read_text()
        and "pydantic" not in {room_of(name) for _, name in imports(file, ROOT)}
    ]
    assert plain == []


def test_drawing_and_map_are_of_this_house() -> None:
    """`make drawing` writes them anew."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert rewrite(text) == text
    assert drawing() in text


def test_importing_the_package_is_light() -> None:
    script = "import sys, relevance; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout.split()
    assert "relevance" in loaded
    assert not set(DOORS) & set(loaded)


def test_tensor_shapes_are_explained() -> None:
    """In the rooms of tensors every letter of a shape is in the legend of its file."""
    lacking = {
        str(file.relative_to(ROOT)): letters
        for file in sources(ROOT)
        if room_of(module_of(file, ROOT)) in DOORS["torch"]
        if (letters := unexplained(file.read_text()))
    }
    assert lacking == {}


def unexplained(text: str) -> set[str]:
    """Letters of `x_BND` and of shapes like (B, N, 3) that `Shape suffixes:` does not name."""
    tree = ast.parse(text)
    named = {letter for name in re.findall(r"\b[a-z]\w*_([A-Z0-9]+)\b", text) for letter in name}
    said = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    for shape in re.findall(r"\((?:\w+|\.\.\.)(?:, ?[\w .]*)+\)", "\n".join(map(str, said))):
        named |= {*re.findall(r"\b[A-Z]\b", shape)}
    legend = (ast.get_docstring(tree) or "").partition("Shape suffixes:")[2].partition("\n\n")[0]
    return {letter for letter in named if letter.isalpha()} - {*re.findall(r"\b[A-Z]\b", legend)}


def test_a_shape_without_legend_is_seen() -> None:
    legend = '''"""Layers.\n\nShape suffixes: B scenes, N objects.\n\nD is said too late."""\n'''
    assert unexplained("x_BN = 1\ny = MAX_EDGE\n") == {"B", "N"}
    assert unexplained(f"{legend}x_BN3 = 1\n") == set()
    assert unexplained(f"{legend}x_BND = 1\n") == {"D"}
    assert unexplained(f'{legend}def f():\n    """Scores (B, T, 3)."""\n') == {"T"}


def test_modules_stay_short() -> None:
    long = {
        str(file.relative_to(ROOT)): count
        for file in sources(ROOT)
        if (count := len(file.read_text().splitlines())) > 600
    }
    assert long == {}


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
