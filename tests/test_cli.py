"""The `relevance` command: results on stdout, one line and exit code 2 for bad input."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from relevance.cli import COMMANDS, main
from relevance.cli.terminal import show, to_json
from relevance.networks import named, read_checkpoint, write_checkpoint

ROOT = Path(__file__).parent.parent
RELEVANCE = Path(sys.executable).parent / "relevance"


def _box(name: str, x: float, y: float, color: tuple[float, float, float]) -> dict[str, object]:
    size = [0.06, 0.05, 0.08]
    return {"name": name, "size": size, "position": [x, y, 0.04], "yaw": 0.3, "color": color}


SCENE = {
    "id": "s1",
    "objects": [
        _box("red", 0.02, 0.11, (0.8, 0.1, 0.1)),
        _box("blue", 0.02, -0.11, (0.1, 0.1, 0.8)),
    ],
    "goals": ["on-the-left(blue, red)", "on(red, blue)"],
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset made by the command itself, on two processes."""
    root = tmp_path_factory.mktemp("cli") / "dataset"
    few = [
        f"--{split}.{family}=1"
        for split in ("train", "validation", "test")
        for family in ("same-plane", "on")
    ]
    assert main(["generate", str(root), "--preset", "smoke", *few, "--workers", "2"]) == 0
    assert main(["label", str(root), "--workers", "2"]) == 0
    return root


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([name, "--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    for example in COMMANDS[name].examples:
        assert example in out
    main(["--help"])
    out = capsys.readouterr().out
    assert f"  {name} " in out
    assert COMMANDS[name].about in out


def test_the_overview_is_quick_since_it_imports_nothing_heavy() -> None:
    script = "import sys; from relevance.cli import main; main(['--help']); print(*sys.modules)"
    out = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    ).stdout
    assert not {"torch", "pybullet", "casadi", "numba", "duckdb", "prefect"} & set(out.split())


def test_the_other_defaults_come_from_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    from relevance.pipeline import DatasetConfig

    for preset in ("smoke", "laptop"):
        with pytest.raises(SystemExit):
            main(["generate", "--preset", preset, "--help"])
        expected = getattr(DatasetConfig, preset)().scenes_per_shard
        help_text = " ".join(capsys.readouterr().out.replace("│", " ").split())
        flag = help_text.partition("--scenes-per-shard")[2].partition("--goals-per-scene")[0]
        assert f"(default: {expected})" in flag


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["sql", "none", "select 1"], "none: no dataset.json there, expected a dataset folder"),
        (["check", "none"], "none: no dataset.json there"),
        (["stats", "none"], "none: no dataset.json there"),
        (["report", "none"], "none: no dataset.json there"),
        (["label", "none"], "none: no dataset.json there"),
        (["train", "none"], "none: no dataset.json there"),
        (["evaluate", "none"], "none: no dataset.json there"),
        (["dashboard", "none"], "none: no dataset.json there"),
        (
            ["train", "none", "--steps", "0"],
            "TrainConfig.steps = 0: expected greater than or equal to 1",
        ),
        (["generate", "new", "--preset", "huge"], "--preset huge: expected one of smoke, demo"),
        (["generate", "new", "--preset", "smoke", "--workers", "0"], "--workers 0: expected"),
        (["generate", "new", "--nonsense"], "Unrecognized options: --nonsense; see relevance gen"),
        (["generate"], "DATASET Folder of the dataset"),
        (
            ["generate", "/dev/null/new", "--preset", "smoke"],
            "/dev/null/new: cannot be written (Not a directory)",
        ),
        (["label", "none", "--workers", "-2"], "--workers -2: expected 1 to 1024"),
        (["label", "none", "--goals-per-scene", "0"], "--goals-per-scene 0: expected at least 1"),
        (["label", "none", "--goals-seed", "-1"], "--goals-seed -1: expected at least 0"),
        (["repair", "none", "--workers", "0"], "--workers 0: expected"),
        (["demo", "--workers", "0"], "--workers 0: expected"),
        (["dashboard", "none", "--port", "99999"], "--port 99999: expected 1 to 65535"),
        (["plan", "none.jsonl", "--beta", "nan"], "--beta nan: expected a finite number"),
        (["plan", "none.jsonl", "--seconds", "-1"], "--seconds -1.0: expected at least 0.001"),
        (["plan", "none.jsonl", "--max-actions", "0"], "--max-actions 0: expected at least 2"),
        (["plan", "none.jsonl", "--guide", "gues"], "--guide gues: expected one of none, prune"),
        (["plan", "none.jsonl", "--planner", "his"], "--planner his: expected one of ours, rai"),
        (["bench", "dataset", "--kills", "0"], "--kills 0: expected at least 1"),
        (["generate", "new", "--replay-share", "2"], "DatasetConfig.replay_share = 2.0: expected"),
        (["generate", "new", "--seed", str(2**63)], "DatasetConfig.seed = 9223372036854775808: "),
        (["plan", "none.jsonl"], "none.jsonl: cannot be read"),
        (["plan", "none.jsonl", "--limit", "0"], "--limit 0: expected at least 1"),
        (["plan", "none.jsonl", "--trajectory", "a.npy"], "a.npy: expected a file that ends in"),
        (["plan", "none.jsonl", "--trajectory", "no/a.npz"], "no is no folder that can be"),
        (["plan", "none.jsonl", "--guide", "prune"], "--guide and --checkpoint go together"),
        (["paln"], "unknown command 'paln', expected one of estimate, generate, label"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith(f"relevance {arguments[0]}: ")
    assert expected in err
    assert not [*tmp_path.rglob("*")]


def _plan(
    tmp_path: Path, *arguments: str, scene: dict[str, object] = SCENE
) -> list[dict[str, object]]:
    (tmp_path / "scenes.jsonl").write_text(json.dumps(scene) + "\n")
    done = subprocess.run(
        [RELEVANCE, "plan", tmp_path / "scenes.jsonl", "--json", *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_plan_prints_one_json_line_a_goal(tmp_path: Path) -> None:
    more = ["behind(red, blue)", "in-front(red, blue)"]
    lines = _plan(tmp_path, *(word for goal in more for word in ("--goal", goal)))
    goals = [*SCENE["goals"], *more]
    assert [line["goal"] for line in lines] == goals
    for line in lines:
        assert set(line) == {
            *("id", "goal", "status", "reason", "actions", "moved", "final"),
            *("blocking", "cost", "ambiguous", "seconds", "counts", "looked", "replay"),
        }
        assert set(line["counts"]) == {"nodes", "pose", "keyframe", "path"}
        assert (line["id"], line["status"]) == ("s1", "solved")
        assert line["replay"]["ok"]
        assert line["replay"]["reason"] == ""
        assert 0 <= line["replay"]["max_penetration"] <= 1e-3
        assert line["seconds"] > 0
        assert set(line["final"]) == set(line["moved"])
    first = lines[0]
    assert first["actions"] == [["pick", "blue"], ["place", "blue", "table"]]
    assert first["moved"] == ["blue"]
    assert first["final"]["blue"]["position"][1] > 0.11  # left of red
    assert lines[1]["actions"][-1] == ["place", "red", "blue"]


def test_a_lazy_guide_looks_when_its_checkpoint_says(tmp_path: Path) -> None:
    plain = _plan(tmp_path)
    assert not any(line["looked"] for line in plain)
    shipped = read_checkpoint(named("geometry"))
    for patience, looked in ((0, True), (10**9, False)):
        file = tmp_path / f"{patience}.pt"
        write_checkpoint(file, replace(shipped, meta=shipped.meta | {"patience": patience}))
        lines = _plan(tmp_path, "--guide", "lazy", "--checkpoint", str(file))
        assert [line["looked"] for line in lines] == [looked] * len(plain)
        for mine, line in zip(plain, lines, strict=True):
            assert (line["status"], line["moved"]) == (mine["status"], mine["moved"])
            assert line["replay"]["ok"]


def test_an_infeasible_goal_is_a_result_with_a_reason(tmp_path: Path) -> None:
    far = SCENE | {"robot": {"base": [-3.0, 0.0, 0.0]}, "goals": ["on(red, blue)"]}
    [line] = _plan(tmp_path, scene=far)
    assert line["status"] == "infeasible"
    assert line["reason"]
    assert (line["actions"], line["cost"], line["replay"]) == ([], None, None)


def test_plan_names_file_and_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "scenes.jsonl"
    for change, culprit in (
        ({"goals": ["on(red, green)"]}, "unknown object 'green'"),
        ({"goals": ["above(red, blue)"]}, "unknown predicate 'above'"),
        ({"goals": []}, "no goals"),
        ({"surprise": 1}, "surprise"),
    ):
        file.write_text(json.dumps(SCENE | change))
        assert main(["plan", str(file), "--json"]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert str(file) in err
        assert culprit in err


def test_sql_prints_what_a_program_can_read(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    query = (
        "select split, count(*) as n, max(objects[1]) as first from scenes group by 1 order by 1"
    )
    assert main(["sql", str(dataset), query, "--format", "json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["split"], row["n"]) for row in rows] == [
        ("test", 2),
        ("train", 2),
        ("validation", 2),
    ]
    assert len(rows[0]["first"]["size"]) == 3
    assert main(["sql", str(dataset), query, "--format", "csv"]) == 0
    lines = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [line["n"] for line in lines] == ["2", "2", "2"]
    assert json.loads(lines[0]["first"]) == rows[0]["first"]
    assert main(["sql", str(dataset), query]) == 0
    assert "validation" in capsys.readouterr().out
    assert main(["sql", str(dataset), "select nonsense from scenes"]) == 2
    assert "nonsense" in capsys.readouterr().err
    views = "scenes objects plans labels predictions evaluations checkpoints"
    for view in views.split():
        assert main(["sql", str(dataset), f"select count(*) from {view}", "--format", "csv"]) == 0
        assert int(capsys.readouterr().out.splitlines()[1]) >= 0


def test_stats_and_check_speak_of_the_dataset(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stats", str(dataset)]) == 0
    assert "Label distribution" in capsys.readouterr().out
    assert main(["stats", str(dataset), "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == 6
    assert main(["check", str(dataset)]) == 0
    assert "all contracts hold" in capsys.readouterr().err


def test_check_finds_what_was_broken(dataset: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    tar = next(copy.glob("images/split=test/*.tar"))
    tar.write_bytes(tar.read_bytes()[:2000])
    done = subprocess.run([RELEVANCE, "check", copy], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert tar.name in done.stdout


def test_equal_column_names_are_kept_apart_and_decimals_are_numbers(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    query = "select 1 as a, 2 as a, 3 as a_1, 1.5 as half, sum(2.0) as two"
    assert main(["sql", str(dataset), query, "--format", "json"]) == 0
    [row] = json.loads(capsys.readouterr().out)
    assert row == {"a": 1, "a_2": 2, "a_1": 3, "half": 1.5, "two": 2}


def test_json_is_strict() -> None:
    assert to_json({"a": float("nan"), "b": [float("inf"), 1.5]}) == '{"a": null, "b": [null, 1.5]}'


def test_cells_are_text_not_markup(capsys: pytest.CaptureFixture[str]) -> None:
    show(["a[b]"], [["[red]x[/red]"], [None]], "table")
    out = capsys.readouterr().out
    assert "a[b]" in out
    assert "[red]x[/red]" in out
