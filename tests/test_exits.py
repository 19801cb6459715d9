"""How the `relevance` command ends: exit codes, closed pipes, full disks, kills, faults."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from relevance.benchmarks.crashes import kill_all, members
from relevance.cli import FAULT, main
from relevance.cli.planning import plan_text

RELEVANCE = Path(sys.executable).parent / "relevance"
FEW = [
    f"--{split}.{family}=1"
    for split in ("train", "validation", "test")
    for family in ("same-plane", "on")
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset; read only."""
    root = tmp_path_factory.mktemp("exits") / "dataset"
    assert main(["generate", str(root), "--preset", "smoke", *FEW, "--workers", "1"]) == 0
    return root


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A file with one scene; its first goal is easy, its second holds already."""
    boxes = [
        {"name": name, "size": [0.06, 0.05, 0.08], "position": [0.02, y, 0.04], "color": color}
        for name, y, color in (("red", 0.11, [0.8, 0.1, 0.1]), ("blue", -0.11, [0.1, 0.1, 0.8]))
    ]
    boxes.append(boxes[0] | {"name": "top", "position": [0.02, -0.11, 0.12], "on": "blue"})
    file = tmp_path / "scenes.jsonl"
    goals = ["on-the-left(blue, red)", "on(top, blue)"]
    file.write_text(json.dumps({"id": "s1", "objects": boxes, "goals": goals}) + "\n")
    return file


def _shell(command: str, **env: str) -> subprocess.CompletedProcess[str]:
    """A line of shell in which $R is the command."""
    return subprocess.run(
        ["bash", "-c", command],
        env=os.environ | {"R": str(RELEVANCE)} | env,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


# --- who reads, and who does not ----------------------------------------------------------


@pytest.mark.parametrize(
    "locale",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    ],
)
def test_what_a_locale_cannot_write_is_escaped(scene: Path, locale: dict[str, str]) -> None:
    scene.write_text(scene.read_text().replace("top", "d\\u00e9j\\u00e0"))
    done = _shell(f'"$R" plan "{scene}"', **locale)
    assert done.returncode == 0, done.stderr
    assert r"on(d\xe9j\xe0, blue): holds already" in done.stdout


@pytest.mark.parametrize(
    "command",
    [
        '"$R" --help | true; exit ${PIPESTATUS[0]}',
        '"$R" check --help | true; exit ${PIPESTATUS[0]}',
        '"$R" --version >&-',
        '"$R" --help >&- 2>&-',
    ],
)
def test_a_closed_stdout_is_no_error(command: str) -> None:
    done = _shell(command)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_prints_much_ends_quietly_when_nobody_reads_on(dataset: Path) -> None:
    query = "select repeat('x', 1000) from range(10000)"
    done = _shell(f'"$R" sql {dataset} "{query}" --format csv | head -1; exit ${{PIPESTATUS[0]}}')
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1


def test_a_full_disk_is_one_line(dataset: Path, tmp_path: Path) -> None:
    done = _shell('"$R" --help > /dev/full')
    assert done.returncode == 2
    assert done.stderr == "relevance --help: No space left on device\n"
    few = " ".join(FEW)
    new = tmp_path / "new"
    done = _shell(f'ulimit -f 4; "$R" generate {new} --preset smoke {few} --workers 1')
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert "shards failed" in last
    assert "File too large" in last
    assert not [*new.rglob("*.tmp")]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("generate FILE --preset smoke", "FILE"),
        ("check FILE", "FILE"),
        ("report DATASET --out FILE/report.html", "FILE"),
        ("export DATASET FILE", "FILE"),
        ("stats DATASET --card FILE", "FILE"),
        ("plan DATASET", "DATASET"),
        ("plan FILE --guide prune --checkpoint FILE", "FILE"),
        ("merge DATASET --into FILE", "FILE"),
    ],
)
def test_a_file_where_a_folder_belongs_is_named(
    arguments: str,
    expected: str,
    dataset: Path,
    scene: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = {"FILE": str(scene), "DATASET": str(dataset)}

    def named(text: str) -> str:
        for name, path in names.items():
            text = text.replace(name, path)
        return text

    before = scene.read_bytes()
    assert main(named(arguments).split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert named(expected) in err
    assert scene.read_bytes() == before


@pytest.mark.slow  # what is compiled cannot come from the usual cache
def test_a_home_that_cannot_be_written_is_no_obstacle(scene: Path, tmp_path: Path) -> None:
    done = _shell(f'unset XDG_CACHE_HOME; "$R" plan {scene}', HOME="/dev/null")
    assert done.returncode == 0, done.stderr
    assert "solved" in done.stdout


def test_the_cache_moves_when_the_home_cannot_be_written(tmp_path: Path) -> None:
    program = "import os, relevance; print(os.environ['NUMBA_CACHE_DIR'])"
    done = _shell(
        f'unset XDG_CACHE_HOME NUMBA_CACHE_DIR; {sys.executable} -c "{program}"',
        HOME="/dev/null",
        TMPDIR=str(tmp_path),
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path))


def test_a_port_in_use_is_named(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["dashboard", str(dataset), "--port", str(port)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"--port {port}: Address already in use, expected a free port" in err


# --- faults, and warnings -------------------------------------------------------------------


def test_a_fault_of_ours_is_a_traceback_that_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import relevance.store

    def broken(path: Path, query: str, *, policy: str | None) -> None:
        json.loads("{")

    monkeypatch.setattr(relevance.store, "sql", broken)
    assert main(["sql", "none", "select 1"]) == FAULT
    err = capsys.readouterr().err
    assert "JSONDecodeError" in err
    assert "this is a fault of relevance, not of yours: please report it" in err.splitlines()[-1]
    assert FAULT not in (0, 1, 2, 120, 130)
    assert main(["--help"]) == 0
    assert f"{FAULT} a fault of relevance" in capsys.readouterr().out


@pytest.mark.parametrize(
    "mistake",
    ["raise ValueError('no user did this')", "int('no number')", "a, b = 'one'", "[].index(0)"],
)
def test_a_value_error_in_our_own_code_is_a_fault(
    mistake: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import relevance.store

    planted: dict[str, Any] = {"__name__": "relevance.store.queries"}
    exec(f"def broken(path, query, *, policy):\n    {mistake}", planted)
    monkeypatch.setattr(relevance.store, "sql", planted["broken"])
    assert main(["sql", "none", "select 1"]) == FAULT
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "ValueError" in err
    assert "this is a fault of relevance, not of yours" in err.splitlines()[-1]


def test_warnings_of_ours_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import warnings

    import relevance.store
    from relevance.errors import RelevanceWarning

    def warn(path: Path, query: str, *, policy: str | None) -> tuple[list[str], list[int]]:
        warnings.warn("a and b look\nthe same", RelevanceWarning, stacklevel=1)
        return [], []

    monkeypatch.setattr(relevance.store, "sql", warn)
    assert main(["sql", "none", "select 1"]) == 0
    assert capsys.readouterr().err == "relevance sql: warning: a and b look the same\n"


# --- plan -----------------------------------------------------------------------------------


def test_standard_input_is_a_file(scene: Path) -> None:
    done = _shell(f'"$R" plan - --json < {scene}')
    assert done.returncode == 0, done.stderr
    first, second = map(json.loads, done.stdout.splitlines())
    assert (first["status"], second["status"], second["actions"]) == ("solved", "solved", [])


def test_a_goal_that_holds_says_so(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", str(scene)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("s1  on-the-left(blue, red): solved in ")
    assert lines[-1] == "s1  on(top, blue): holds already"


def test_a_plan_that_the_replay_refuses_is_exit_code_1_with_the_reason(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from relevance import simulation
    from relevance.simulation import Replay

    verdict = Replay(ok=False, max_penetration=0.01, reason="the fingers miss blue")
    monkeypatch.setattr(simulation, "replay", lambda *_: verdict)
    assert main(["plan", str(scene), "--json"]) == 1
    line = json.loads(capsys.readouterr().out.splitlines()[0])
    assert line["status"] == "refused"
    assert line["replay"] == {
        "ok": False,
        "reason": "the fingers miss blue",
        "max_penetration": 0.01,
    }
    assert main(["plan", str(scene)]) == 1
    assert "refused (the replay does not confirm the plan: the fingers miss blue)" in (
        capsys.readouterr().out
    )


def test_what_makes_an_answer_doubtful_is_shown() -> None:
    line = {"id": "s", "goal": "on(a, b)", "reason": "", "seconds": 0.1, "counts": {"nodes": 3}}
    line |= {"actions": [["pick", "a"]], "replay": {"ok": True}, "ambiguous": True}
    assert plan_text(line | {"status": "solved"}).splitlines()[0].endswith("replayed, ambiguous")
    lost = line | {"status": "infeasible", "reason": "no room", "actions": []}
    assert plan_text(lost) == "s  on(a, b): infeasible (no room), 3 nodes opened, ambiguous"


# --- kills ------------------------------------------------------------------------------------


def _started(root: Path, workers: int) -> subprocess.Popen[bytes]:
    """`generate` of much, once its first shard is there."""
    process = subprocess.Popen(
        [RELEVANCE, "generate", root, "--preset=smoke", "--train.same-plane=200",
         f"--workers={workers}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        # a background job of a plain shell is born deaf to SIGINT, and so are its children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    end = time.monotonic() + 120
    while not [*root.glob("scenes/*/*.parquet")]:
        assert time.monotonic() < end, "no shard in two minutes"
        time.sleep(0.05)
    return process


def test_an_interrupted_run_is_tidy_and_goes_on(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    process = _started(root, workers=1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: everybody hears it
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in errors.decode()
    assert "Traceback" not in errors.decode()
    assert not [*root.rglob("*.tmp")]
    assert main(["sql", str(root), "select count(*) from scenes"]) == 0


def test_a_killed_command_leaves_no_worker_behind(tmp_path: Path) -> None:
    process = _started(tmp_path / "dataset", workers=2)
    try:
        process.kill()
        process.communicate(timeout=30)
        end = time.monotonic() + 60
        while members(process.pid):
            assert time.monotonic() < end, f"still there: {members(process.pid)}"
            time.sleep(0.2)
    finally:
        kill_all(process.pid)


def test_one_shard_that_fails_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "dataset"
    (root / "images" / "split=validation").parent.mkdir(parents=True)
    (root / "images" / "split=validation").write_text("in the way")
    assert main(["generate", str(root), "--preset", "smoke", *FEW, "--workers", "1"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "generate: 2 of 6 shards failed, 4 were made; first validation-000000: " in last
    assert len([*root.glob("scenes/*/*.parquet")]) == 4
    (root / "images" / "split=validation").unlink()
    assert main(["generate", str(root), "--preset", "smoke", *FEW, "--workers", "1"]) == 0
    assert "2 shards made, 4 were there" in capsys.readouterr().err
