"""First use: who compiles what, once, and that no plan's clock has loading in it."""

import subprocess
import sys
import threading

import pytest
from planning import OPEN

from relevance.planner import compiling, plan, search

FRESH = """
import sys
from numba.core.dispatcher import Dispatcher
from relevance.planner import compiling, keyframes, plan, warm_up
from relevance.planner.kernels import motions, planar
sys.path.insert(0, "tests")
from planning import tasks

def known():
    return {
        f"{kernel.py_func.__module__}.{kernel.py_func.__name__}": len(kernel.overloads)
        for name, module in list(sys.modules.items())
        if name.startswith(("relevance.planner", "relevance.holding", "relevance.scene"))
        for kernel in vars(module).values() if isinstance(kernel, Dispatcher)
    }

todo = tasks(24, 5)
compiling.other_half()
for kernel in (planar.find_pose, motions.retreat, keyframes.solve):
    assert kernel.overloads, kernel
assert not motions.motion.overloads
compiling.first_half()
assert motions.motion.overloads
warm_up()
before = known()
assert before["relevance.planner.kernels.motions.motion"] == 1
for scene, goal in todo:
    plan(scene, goal, replay=False)
assert known() == before, {k: v for k, v in known().items() if before[k] != v}
"""


def test_nothing_is_compiled_or_loaded_once_the_planner_is_warm():
    done = subprocess.run(
        [sys.executable, "-c", FRESH], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_kernels_are_there_before_the_clock_of_the_first_plan_starts(monkeypatch):
    happened = []
    monkeypatch.setattr(search, "warm_up", lambda: happened.append("loaded"))
    monkeypatch.setattr(search.time, "process_time", lambda: happened.append("clock") or 0.0)
    plan(OPEN, "on(red, blue)", replay=False)
    assert happened[:2] == ["loaded", "clock"]


@pytest.fixture
def unused(monkeypatch, tmp_path):
    """A machine without a cache; what is done to fill it."""
    done = []
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(compiling, "functions", lambda: None)
    monkeypatch.setattr(compiling, "_child", lambda: done.append("others"))
    monkeypatch.setattr(compiling, "first_half", lambda: done.append("motions"))
    monkeypatch.setattr(compiling.os, "sched_getaffinity", lambda _: {0, 1})
    return done


def test_kernels_are_compiled_once_and_one_line_says_so(unused, capsys):
    for _ in range(2):
        compiling.compile_once(lambda: unused.append("rest"))
    assert unused == ["others", "motions", "rest", "rest"]
    assert capsys.readouterr().err.splitlines() == [
        "compiling the planner's kernels, once on this machine: about 25 s"
    ]


def test_what_failed_is_tried_again(unused):
    def fail():
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        compiling.compile_once(fail)
    compiling.compile_once(lambda: None)
    assert unused == ["others", "motions"] * 2


def test_who_comes_meanwhile_waits_for_the_first(unused, monkeypatch):
    started, go_on = threading.Event(), threading.Event()

    def motions():
        unused.append("motions")
        started.set()
        assert go_on.wait(60)

    def rest():
        unused.append("rest")

    monkeypatch.setattr(compiling, "first_half", motions)
    threads = [threading.Thread(target=compiling.compile_once, args=(rest,)) for _ in range(2)]
    threads[0].start()
    assert started.wait(60)
    threads[1].start()
    threads[1].join(0.2)
    assert unused == ["others", "motions"]
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert unused == ["others", "motions", "rest", "rest"]


def test_a_folder_that_cannot_be_written_compiles_all_the_same(unused, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    compiling.compile_once(lambda: unused.append("rest"))
    assert unused[-1] == "rest"
