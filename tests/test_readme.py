"""The blocks of README.md and data/README.md run, in order, in a project folder of their own.

Blocks are told by what is in them, so that the text may change. Each line of shell runs or has a
reason in NOT_RUN; each other block is Python that runs, a scene that is read, or a drawing.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from relevance.cli import main
from relevance.scene import read_scenes

ROOT = Path(__file__).parent.parent
PAGES = ("README.md", "data/README.md")

NOT_RUN = {
    r"^(make|pip|git clone|apt-get|python3? -m venv)\b|\.venv/": "installs, or runs for minutes",
    r"^(prefect|export PREFECT_)": "needs a server: tests/test_flows.py runs server and worker",
    r"s3://|tcp://|AWS_": "needs an object store or a cluster: tests/test_many.py has both",
    r"^relevance (demo|dashboard|view)\b": "serves, or takes minutes: they have tests of their own",
    r"\brai\b": "needs rai, which is an extra: tests/test_rai.py",
    r"^(duckdb|D) ": "the duckdb program is not installed with the project",
    r"^relevance bench\b": "measures for minutes: tests/test_benchmarks.py",
    r"^relevance diff\b": "needs a dataset that was planned anew: tests/test_families.py",
    r"laptop|paper|randomised": "makes much",
    r"data/(mined|with-mined)|--random\b": "needs a model with failures: tests/test_mining.py",
    r"^relevance study ": "trains for hours: tests/test_studies.py",
    r" FILE\b|--coverage": "takes a calibration on many scenes: tests/test_coverage.py",
}
"""Lines of shell that are left out, and why."""
SLOW = (
    r"^relevance (append|merge|repair|label|generate|export|train|evaluate|reproduce|check|suite|"
    r"coverage)\b"
)
"""Lines that take their time; only the slow test runs them."""
DRAWING = r"[│├└→]|->|^[A-Z]+/\s*$|\.parquet|\.tar"
"""A block without a language that shows something and asks for nothing."""


@dataclass(frozen=True, slots=True)
class Block:
    """A block of code of a page."""

    page: str
    line: int
    language: str
    """As the fence says, or guessed from the first line of an indented block."""
    text: str


def _language(text: str) -> str:
    first = text.lstrip().partition("\n")[0]
    if re.match(r"(relevance|prefect|duckdb|pip|make|D|git|export)\b", first):
        return "sh"
    if re.match(r"(from \w[\w.]* import|import \w)", first):
        return "python"
    return ""


def blocks(page: str) -> Iterator[Block]:
    """Fenced and indented blocks, in order."""
    lines = (ROOT / page).read_text("utf-8").splitlines()
    number = 0
    while number < len(lines):
        start, line = number, lines[number]
        number += 1
        if fence := re.match(r"```(\w*)", line):
            while not lines[number].startswith("```"):
                number += 1
            text = "\n".join(lines[start + 1 : number])
            number += 1
            yield Block(page, start + 1, fence[1] or _language(text), text)
        elif line.startswith("    ") and not lines[start - 1].strip():
            while number < len(lines) and (lines[number].startswith("    ") or not lines[number]):
                number += 1
            text = textwrap.dedent("\n".join(lines[start:number])).strip()
            yield Block(page, start + 1, _language(text), text)


def commands(text: str) -> list[str]:
    """Lines of shell without comments; continued lines, and quotes over lines, as one."""
    found: list[str] = []
    for line in text.splitlines():
        bare = re.sub(r"\s+#.*$", "", line).rstrip()
        if found and (found[-1].endswith("\\") or found[-1].count('"') % 2):
            found[-1] = found[-1].removesuffix("\\") + " " + bare.strip()
        elif bare and not bare.startswith("#"):
            found.append(bare)
    return found


def reason(command: str) -> str | None:
    """Why a line of shell is not run."""
    return next((why for rule, why in NOT_RUN.items() if re.search(rule, command)), None)


ALL = [block for page in PAGES for block in blocks(page)]


def test_every_block_is_known() -> None:
    assert len(ALL) > 10
    shell = [c for block in ALL if block.language in ("sh", "bash") for c in commands(block.text)]
    run = [command for command in shell if reason(command) is None]
    assert len(run) > 5
    for command in run:
        assert command.startswith("relevance "), f"{command}: add a rule to NOT_RUN, with a reason"
    for block in ALL:
        where = f"{block.page}:{block.line}"
        if block.language not in ("sh", "bash", "python", "json"):
            assert block.language in ("", "text"), f"{where}: language {block.language!r}"
            assert re.search(DRAWING, block.text, re.MULTILINE), (
                f"{where}: neither code nor drawing"
            )


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the pages have it: a tiny dataset as data/demo, a checkpoint, a scene."""
    root = tmp_path_factory.mktemp("project")
    few = [f"--{split}.on=2" for split in ("train", "validation", "test")]
    few += ["--train.same-plane=1", "--validation.same-plane=1", "--test.same-plane=0"]
    for name, seed in (("demo", 0), ("more", 1)):
        made = ["generate", str(root / "data" / name), "--preset=smoke", *few, f"--seed={seed}"]
        assert main([*made, "--goals-per-scene=1", "--workers=1"]) == 0
    data = root / "data" / "demo"
    assert main(["label", str(data), "--workers=1"]) == 0
    assert main(["train", str(data), "--preset=smoke", "--steps=2"]) == 0
    (root / "schemas").symlink_to(ROOT / "schemas")
    [scene] = [block for block in ALL if block.language == "json" and '"objects"' in block.text]
    (root / "scenes.jsonl").write_text(" ".join(scene.text.split("\n")), "utf-8")
    assert read_scenes(root / "scenes.jsonl")[0].goals
    return root


def _filled(text: str, project: Path) -> str:
    """The text with names of this project where the pages have placeholders."""
    [checkpoint] = (project / "data/demo/checkpoints").glob("*.pt")
    names = {
        r"<ID>": checkpoint.stem,
        r"\bDATASET\b": "data/demo",
        r"\bA B --into C\b": "data/demo data/more --into data/both",
        r"\bOUT\b": "out",
        r"\bFOLDER\b": "out/card",
    }
    for rule, name in names.items():
        text = re.sub(rule, name, text)
    return text


def _run(arguments: list[str], project: Path, where: str) -> None:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        arguments,
        cwd=project,
        env=os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, f"{where}: {arguments[-1]}\n{done.stdout}{done.stderr}"


def _shell(block: Block, project: Path, *, slow: bool) -> None:
    for command in commands(block.text):
        if reason(command) is None and (slow or not re.search(SLOW, command)):
            line, where = _filled(command, project), f"{block.page}:{block.line}"
            if slow or re.search(r"[|<>&;$*]", line):
                _run(["bash", "-c", line], project, where)
            else:  # a second or two less for each
                with contextlib.chdir(project):
                    assert main(shlex.split(line)[1:]) == 0, f"{where}: {line}"


def test_quick_lines_and_python_run(project: Path) -> None:
    for block in ALL:
        if block.language in ("sh", "bash"):
            _shell(block, project, slow=False)
        elif block.language == "python":
            text = _filled(block.text, project)
            _run([sys.executable, "-c", text], project, f"{block.page}:{block.line}")


@pytest.mark.slow
def test_all_lines_run_in_order(project: Path, tmp_path: Path) -> None:
    copy = tmp_path / "project"
    shutil.copytree(project, copy, symlinks=True)
    for block in ALL:
        if block.language in ("sh", "bash"):
            _shell(block, copy, slow=True)
