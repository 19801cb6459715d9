"""Work that is missing, whoever asks for it; and what must never go wrong without a word."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from conftest import CONFIG, GROWN, complete, contents, done, grown_dataset, make

from relevance import labels
from relevance.errors import RelevanceError
from relevance.pipeline import (
    Counts,
    beyond_repair,
    checking,
    finish,
    generate_shard,
    generated,
    labelling,
    labels_work,
    load_config,
    missing,
    prepare,
    preparing,
    scenes,
    scenes_work,
    settings,
)
from relevance.pipeline.checking import check
from relevance.planner import PlannerConfig
from relevance.sampling import SceneConfig
from relevance.scene import FAMILIES
from relevance.simulation import Replay
from relevance.store import Dataset, DatasetError, sql, table_schema

ON = "predicate=on/split=train/shard-000001.parquet"
OTHER = replace(GROWN, planner=PlannerConfig(max_actions=2))


@pytest.fixture
def made(tmp_path: Path) -> Path:
    return Path(shutil.copytree(grown_dataset(), tmp_path / "dataset"))


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: -file.stat().st_size // 2])


# asking ----------------------------------------------------------------------------------------


def test_each_family_has_its_count() -> None:
    assert [family.replace("-", "_") for family in FAMILIES] == list(Counts.__dataclass_fields__)
    every = dict.fromkeys(FAMILIES, 3)
    assert Counts.total([Counts.by_family(every)] * 2) == Counts(
        **{name: 6 for name in Counts.__dataclass_fields__}
    )
    assert Counts.total([Counts(on=1), Counts(on=2, same_plane=1)]) == Counts(on=3, same_plane=1)


def test_scenes_then_labels(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    work = scenes_work(root, CONFIG)
    assert [job.name for job in work.jobs][:2] == ["train-000000", "train-000001"]
    assert sum(job.size for job in work.jobs) == 8
    for job in work.jobs[:-1]:  # the last one fails, say
        job.run()
    work.finish()
    half = labels_work(root, predicates=["on", "behind"])
    assert half.waiting == 1
    assert {job.predicate for job in half.jobs} == {"on", "behind"}
    assert half.jobs[0].name.partition("-")[2].startswith("train-0000")
    done(half)
    done(scenes_work(root, CONFIG))
    done(labels_work(root))
    expected = contents(make(tmp_path / "by hand"))
    del expected["dataset.json"]
    assert {n: c for n, c in contents(root).items() if n != "dataset.json"} == expected
    again = labels_work(root)
    assert (again.jobs, again.waiting) == ((), 0)
    assert again.done == len({*Dataset.open(root).files("labels")})


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        ({"predicates": ["on", "under"]}, "unknown predicate 'under', expected one of on-the-left"),
        ({"policy": "guess"}, "unknown policy 'guess', expected one of found"),
        ({"overrides": {"planner.depth": 3}}, "planner.depth: unknown setting"),
        ({"goals_per_scene": 0}, "goals_per_scene"),
        ({"overrides": {"seed": 9}}, "config.seed: the dataset was made with 5, found 9"),
    ],
)
def test_what_cannot_be_asked(made: Path, ask: dict[str, Any], message: str) -> None:
    before = contents(made)
    with pytest.raises(RelevanceError, match=message):
        labels_work(made, **ask)
    assert contents(made) == before


def test_settings_that_admit_no_scene_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes, "ATTEMPTS", 3)
    tight = replace(CONFIG, scene=SceneConfig(min_objects=10, reach=(0.30, 0.34), tries=2))
    with pytest.raises(DatasetError, match="no draw in 3 was accepted"):
        scenes_work(tmp_path / "x", tight)
    assert not (tmp_path / "x").exists()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DatasetError, match="file"):
        prepare(tmp_path / "file", CONFIG)
    assert (tmp_path / "file").read_text() == "mine"


# identities ------------------------------------------------------------------------------------


def test_identities_name_what_differs_and_the_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = (GROWN.scenes_hash, GROWN.plans_hash)
    more = replace(
        GROWN,
        train=Counts.by_family(dict.fromkeys(FAMILIES, 9)),
        scenes_per_shard=7,
        policy="necessary",
    )
    assert (more.scenes_hash, more.plans_hash) == plain
    assert replace(GROWN, seed=6).scenes_hash != plain[0]
    # a seed of its own for the goals, equal to the other, is the same goal set
    assert replace(GROWN, goals_seed=GROWN.seed).plans_hash == plain[1]
    assert OTHER.plans_hash != plain[1]
    for name, changed in (("RENDERER", (0,)), ("SAMPLER", (0, 1)), ("LABELS", (1,))):
        with monkeypatch.context() as patch:
            patch.setattr(settings, f"{name}_VERSION", "next")
            now = (GROWN.scenes_hash, GROWN.plans_hash)
        assert [i for i in (0, 1) if now[i] != plain[i]] == list(changed), name


def test_scenes_of_another_sampler_are_labelled_but_not_added(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settings, "RENDERER_VERSION", "next")
    assert labels_work(made).jobs == ()
    assert scenes_work(made, GROWN).jobs == ()
    before = contents(made)
    with pytest.raises(DatasetError, match=r"versions\.renderer: .* made with '1', found 'next'"):
        scenes_work(made, replace(GROWN, train=Counts(same_plane=2, on=9)))
    assert contents(made) == before


# two writers -----------------------------------------------------------------------------------


def _prepare(arguments: tuple[Path, int]) -> bool:
    root, seed = arguments
    try:
        prepare(root, replace(CONFIG, seed=seed))
    except DatasetError:
        return False
    return True


def test_one_of_two_writers_makes_the_dataset(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=2, mp_context=spawn) as pool:
        list(pool.map(_prepare, [(tmp_path / "a", 0), (tmp_path / "b", 0)]))  # both are up
        for number in range(20):
            root = tmp_path / str(number)
            made = list(pool.map(_prepare, [(root, 1), (root, 2)]))
            assert sorted(made) == [False, True]
            assert load_config(Dataset.open(root)).seed == made.index(True) + 1
            assert [file.name for file in root.iterdir()] == ["dataset.json"]


def test_a_shard_of_other_settings_is_not_put_in_place(tmp_path: Path) -> None:
    spec = prepare(tmp_path, CONFIG)[0]
    with pytest.raises(DatasetError, match=r"hashes\.scenes: .* made with other settings"):
        generate_shard(tmp_path, replace(CONFIG, seed=4), spec)
    assert [f.name for f in tmp_path.rglob("*") if f.is_file()] == ["dataset.json"]
    # and one that is there all the same does not count
    other = tmp_path / "other"
    prepare(other, replace(CONFIG, seed=4))
    generate_shard(other, replace(CONFIG, seed=4), spec)
    for kind in ("scenes", "images"):
        shutil.copytree(other / kind, tmp_path / kind, dirs_exist_ok=True)
    assert not generated(Dataset.open(tmp_path), spec)


# planned anew ----------------------------------------------------------------------------------


def test_half_new_plans_are_not_read(made: Path) -> None:
    before = contents(made)
    query = "select config_hash, count(*) from labels group by all"
    own = sql(made, query)
    work = labels_work(made, overrides={"planner.max_actions": 2})
    for job in work.jobs[: len(work.jobs) // 2]:
        job.run()
    work.finish()  # as if the others had failed
    assert sql(made, query) == own
    assert {n: c for n, c in contents(made).items() if n in before and n != "dataset.json"} == {
        n: c for n, c in before.items() if n != "dataset.json"
    }
    assert Dataset.open(made).labelling == GROWN.labelling
    assert check(made, render=False) == []
    rest = labels_work(made)  # goes on without being told again
    assert {job.name for job in rest.jobs} == {j.name for j in work.jobs[len(work.jobs) // 2 :]}
    done(rest)
    assert Dataset.open(made).labelling == OTHER.labelling
    assert sql(made, query)[1][0][0] == OTHER.plans_hash
    assert len(sql(made, query)[1]) == 1
    assert check(made, render=False) == []


def test_a_change_over_that_is_killed_goes_on(made: Path, tmp_path: Path) -> None:
    for job in labels_work(made, overrides={"planner.max_actions": 2}).jobs:
        job.run()
    whole = Path(shutil.copytree(made, tmp_path / "whole"))
    finish(whole)
    program = (
        "import os, signal, sys\n"
        "from relevance.pipeline import finish, preparing\n"
        "copy, left = preparing.copy_file, [int(sys.argv[2])]\n"
        "def deadly(*files):\n"
        "    left[0] -= 1\n"
        "    if left[0] < 0:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    copy(*files)\n"
        "preparing.copy_file = deadly\n"
        "finish(sys.argv[1])\n"
    )
    for copies in (0, 7, 20):
        root = Path(shutil.copytree(made, tmp_path / f"killed-{copies}"))
        command = [sys.executable, "-c", program, str(root), str(copies)]
        assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
        with pytest.raises(DatasetError, match="was cut short; `relevance label` does it to its"):
            Dataset.open(root)
        assert labels_work(root).jobs == ()
        assert contents(root) == contents(whole)
        assert check(root, render=False) == []


# repair ----------------------------------------------------------------------------------------


def test_a_truncated_file_and_a_second_policy(made: Path) -> None:
    complete(made, policy="any-minimal")
    before = contents(made)
    [of] = Dataset.open(made).labellings()
    beside = Dataset.open(made).files("labels", of=of)[0].relative_to(made)
    for name in (f"plans/{ON}", str(beside)):
        cut(made / name)
    named = [breach.file for breach in check(made, render=False)]
    assert sorted(named) == sorted((f"plans/{ON}", str(beside)))
    assert beyond_repair(made, named) == {}
    for work in missing(made, named):
        done(work)
    assert contents(made) == before
    assert check(made, render=False) == []


def test_nothing_is_lost_that_cannot_be_made_again(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = (f"plans/{ON}", f"scenes/{ON[13:]}")
    for name in broken:
        cut(made / name)
    monkeypatch.setattr(settings, "SAMPLER_VERSION", "next")
    for module in (settings, labels, preparing):
        monkeypatch.setattr(module, "PLANNER_VERSION", "next")
    before = contents(made)
    named = [breach.file for breach in check(made, render=False)]
    left = beyond_repair(made, named)
    assert left.keys() == {*named} == {*broken}
    assert "drawn or rendered by another version" in left[broken[1]]
    assert "planned by another version" in left[broken[0]]
    with pytest.raises(DatasetError, match=r"versions\.sampler"):
        list(missing(made, named))
    assert contents(made) == before


# refused replays -------------------------------------------------------------------------------


def test_many_refused_replays_are_not_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = Replay(ok=False, max_penetration=0.02, reason="the hand misses")
    monkeypatch.setattr(labelling, "replay", lambda *_: refusal)
    config = replace(CONFIG, replay_share=1.0, train=Counts(on=2), goals_per_scene=3)
    config = replace(config, validation=Counts(), test=Counts())
    done(scenes_work(tmp_path, config))
    work = labels_work(tmp_path)
    with pytest.raises(RelevanceError, match=r"the replay refuses \d+ of \d+ plans, .* most 1%"):
        done(work)
    rows = Dataset.open(tmp_path).read_rows("plans", status="refused")
    assert rows
    assert {(row["reason"], row["holds"]) for row in rows} == {("the hand misses", False)}
    assert Dataset.open(tmp_path).read_rows("labels") == []
    [breach] = check(tmp_path, render=False)
    assert (breach.file, breach.column) == ("plans", "replay_ok")


# older schemas ---------------------------------------------------------------------------------


def test_only_strict_minds_older_schemas(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check(made, render=False, strict=True) == []

    def younger(table: str) -> Any:
        schema = table_schema(table)
        return replace(schema, version=schema.version + (table == "scenes"))

    monkeypatch.setattr(checking, "table_schema", younger)
    assert check(made, render=False) == []
    found = check(made, render=False, strict=True)
    assert {breach.file for breach in found} == {
        str(file.relative_to(made)) for file in Dataset.open(made).files("scenes")
    }
    assert "expected version" in found[0].message
