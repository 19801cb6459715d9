"""Champions: who is promoted and why, two at once, a kill, the way back, and the one rule."""

import json
import multiprocessing
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import relevance
from relevance.cli import main
from relevance.evaluation import (
    EvaluationError,
    TrialConfig,
    champion,
    contend,
    fresh_tasks,
    load_scorer,
    read_predictions,
)
from relevance.metrics import Interval
from relevance.networks import champions, crown, find_checkpoint, read_record, roll_back, settle
from relevance.pipeline import fitting_preset
from relevance.report.page import build
from relevance.scene import PREDICATES
from relevance.store import Dataset, DatasetError

GOLDEN = Path(__file__).parent.parent / "data" / "golden"
RISES = Interval(value=0.02, low=0.01, high=0.03, n=9)
NOISE = Interval(value=-0.01, low=-0.03, high=0.01, n=9)
FALLS = Interval(value=-0.02, low=-0.03, high=-0.01, n=9)


@pytest.fixture(scope="module")
def ids():
    """The models of the package."""
    return {name: load_scorer(name).checkpoint_id for name in ("geometry", "glimpse")}


@pytest.fixture(scope="module")
def known(tmp_path_factory, ids):
    """A dataset that knows them."""
    root = tmp_path_factory.mktemp("known") / "d"
    shutil.copytree(GOLDEN, root)
    for name in ids:
        load_scorer(name, into=Dataset.open(root))
    return root


@pytest.fixture
def dataset(known, tmp_path):
    """That, to be changed."""
    shutil.copytree(known, tmp_path / "d")
    return Dataset.open(tmp_path / "d")


@pytest.fixture
def ruled(monkeypatch, ids):
    """Trials whose figures are given: work by the model's name, and the change."""

    def rule(work, change=RISES, meanwhile=lambda: None):
        def spent(scene, goal, planner, guide):
            meanwhile()
            name = guide and guide.scorer.checkpoint_id
            return work[next((n for n in ids if ids[n] == name), None)] + scene, True

        tasks = [(number, None) for number in range(8)]
        monkeypatch.setattr(champion, "_spent", spent)
        monkeypatch.setattr(champion, "fresh_tasks", lambda *_: tasks)
        monkeypatch.setattr(champion, "_change", lambda *a: a[3] and change)

    return rule


def test_the_first_has_to_beat_no_guide(dataset, ids, ruled):
    ruled({None: 1000, "glimpse": 1000})
    trial = contend(dataset.path, "glimpse")
    assert (trial.promoted, read_record(dataset).champion) == (False, None)
    assert "no less work beyond noise" in trial.why
    assert "no guide" in trial.why
    ruled({None: 1000, "glimpse": 500})
    assert contend(dataset.path, "glimpse").promoted
    assert read_record(dataset).champion == ids["glimpse"]
    assert [event.what for event in read_record(dataset).history] == ["refused", "promoted"]
    assert contend(dataset.path, "glimpse") is None, "it stands already"


@pytest.mark.parametrize(
    ("work", "change", "promoted", "why"),
    [
        (400, RISES, True, "better"),
        (400, NOISE, True, "better"),
        (400, FALLS, False, "true relevant falls"),
        (500, RISES, False, "no less work"),
        (600, FALLS, False, "true relevant falls, no less work"),
        (400, Interval(value=np.nan, low=np.nan, high=np.nan, n=0), False, "true relevant falls"),
    ],
)
def test_both_figures_decide_beyond_noise(dataset, ids, ruled, work, change, promoted, why):
    crown(dataset, ids["geometry"], "by hand")
    ruled({"geometry": 500, "glimpse": work}, change)
    trial = contend(dataset.path, ids["glimpse"])
    assert trial.promoted == promoted
    assert read_record(dataset).champion == ids["glimpse" if promoted else "geometry"]
    last = read_record(dataset).history[-1]
    assert (last.checkpoint_id, last.before) == (ids["glimpse"], ids["geometry"])
    assert last.why == trial.why
    assert trial.why.startswith(why)


def test_who_was_promoted_meanwhile_is_who_has_to_be_beaten(dataset, ids, ruled):
    # Both beat no guide; geometry gets there first while glimpse is being tried.
    def other_first():
        if read_record(dataset).champion is None:
            assert settle(dataset, ids["geometry"], before=None, promoted=True, why="")

    ruled({None: 1000, "geometry": 500, "glimpse": 500}, meanwhile=other_first)
    trial = contend(dataset.path, "glimpse")
    assert (trial.champion, trial.promoted) == (ids["geometry"], False)
    assert read_record(dataset).champion == ids["geometry"]


def test_of_many_processes_one_promotes(dataset):
    context = multiprocessing.get_context("fork")
    with context.Pool(4) as pool:
        won = pool.starmap(_settle, [(str(dataset.path), f"m-{number}") for number in range(12)])
    record = read_record(dataset)
    assert won.count(True) == 1
    assert record.line == (f"m-{won.index(True)}",)


def _settle(root, name):
    return settle(Dataset.open(root), name, before=None, promoted=True, why="")


def test_a_kill_while_it_is_written_leaves_the_old_champion_whole(dataset):
    crown(dataset, "old", "")

    def killed():
        replace = os.replace

        def die(source, target):
            if Path(target).name == "champion.json":
                os._exit(9)
            replace(source, target)

        os.replace = die
        crown(dataset, "new", "")

    child = multiprocessing.get_context("fork").Process(target=killed)
    child.start()
    child.join(60)
    assert child.exitcode == 9
    assert read_record(dataset).line == ("old",)
    crown(dataset, "next", "")  # nobody holds the lock any more
    assert read_record(dataset).line == ("old", "next")


def test_the_way_back_is_one_champion_at_a_time(dataset):
    with pytest.raises(DatasetError, match="no champion yet"):
        roll_back(dataset, "")
    for name in ("a", "b", "c"):
        crown(dataset, name, "")
    assert (roll_back(dataset, ""), roll_back(dataset, "")) == ("b", "a")
    with pytest.raises(DatasetError, match="no champion before a, nothing to roll back to"):
        roll_back(dataset, "")
    record = read_record(dataset)
    assert record.champion == "a"
    assert [event.what for event in record.history] == ["promoted"] * 3 + ["rolled back"] * 2


def test_a_broken_record_is_one_line_and_stays(dataset):
    file = dataset.path / "champion.json"
    for text in ("{", '{"line": 3}', "[]"):
        file.write_text(text)
        with pytest.raises(DatasetError, match=r"champion\.json: no record of champions"):
            crown(dataset, "a", "")
        assert file.read_text() == text


def test_the_champion_is_the_checkpoint_that_is_meant(dataset, ids):
    newest = find_checkpoint(dataset.path)
    with pytest.raises(DatasetError, match="no champion yet"):
        find_checkpoint(dataset.path, "champion")
    for name in ids.values():
        crown(dataset, name, "")
        assert load_scorer(find_checkpoint(dataset.path)).checkpoint_id == name
        assert find_checkpoint(dataset.path, "champion") == find_checkpoint(dataset.path)
        guide = relevance.load_guide("champion", dataset=dataset.path)
        assert guide.scorer.checkpoint_id == name
        assert name in build(dataset.path).read_text()
    assert newest in {find_checkpoint(dataset.path, name) for name in ids.values()}
    with pytest.raises(EvaluationError, match="whose champion it is"):
        relevance.load_guide("champion")


def test_fresh_tasks_are_the_datasets_own_but_for_their_boxes(dataset):
    names = ("on-the-left", "on")
    few, more = (fresh_tasks(dataset, TrialConfig(tasks=n, boxes=9), names) for n in (2, 4))
    assert few == more[:2] == fresh_tasks(dataset, TrialConfig(tasks=2, boxes=9), names)
    assert [goal.predicate.name for _, goal in more] == ["on-the-left", "on"] * 2
    assert {len(scene.objects) for scene, _ in more} == {9}
    assert {scene.id for scene, _ in more}.isdisjoint(
        row["scene_id"] for row in dataset.read_rows("scenes")
    )
    assert few != fresh_tasks(dataset, TrialConfig(tasks=2, boxes=8), names)


def test_the_change_is_that_of_the_predictions_scene_by_scene(dataset, ids):
    files = {name: find_checkpoint(dataset.path, ids[name]) for name in ids}
    found = champion._change(dataset, files["glimpse"], ids["glimpse"], ids["geometry"], 0.95)
    shares = {}
    for name in ids:
        rows = read_predictions(dataset, ids[name]).queries()
        assert len(rows)
        shares[name] = rows.accuracy().true_relevant
    assert found.value == pytest.approx(shares["glimpse"] - shares["geometry"])
    assert found.low <= found.value <= found.high
    assert champion._change(dataset, files["glimpse"], ids["glimpse"], None, 0.95) is None
    same = champion._change(dataset, files["glimpse"], ids["glimpse"], ids["glimpse"], 0.95)
    assert (same.low, same.high) == (0.0, 0.0)


def test_a_contender_answers_all_that_the_champion_does(dataset, ids, monkeypatch):
    crown(dataset, ids["geometry"], "")
    fewer = load_scorer("glimpse")
    fewer.model.predicates = ("on",)
    load = champion.load_scorer
    monkeypatch.setattr(
        champion,
        "load_scorer",
        lambda path, **given: fewer if "glimpse" in str(path) else load(path, **given),
    )
    trial = contend(dataset.path, "glimpse")
    assert not trial.promoted
    assert "no head for on-the-left" in trial.why
    assert set(trial.lacking) == set(PREDICATES) - {"on"}
    assert read_record(dataset).champion == ids["geometry"]


def test_a_real_trial_counts_bounds_and_no_clock(dataset):
    config = TrialConfig(tasks=3, boxes=5)
    one, other = contend(dataset.path, "geometry", config), None
    if not one.promoted:
        other = contend(dataset.path, "geometry", config)
        assert other == one
    assert one.work.value > 0
    assert one.change is None


@pytest.mark.parametrize(("guide", "stop"), [("order", "first"), ("shortest", "level")])
def test_no_guide_stops_as_the_guide_does(dataset, monkeypatch, guide, stop):
    stops = []

    def spent(scene, goal, planner, guide):
        stops.append((guide is None, planner.stop))
        return 100, True

    monkeypatch.setattr(champion, "_spent", spent)
    monkeypatch.setattr(champion, "fresh_tasks", lambda *_: [(0, None), (1, None)])
    contend(dataset.path, "glimpse", TrialConfig(tasks=2, guide=guide))
    assert stops == [(False, stop), (True, stop)] * 2


def test_the_command_promotes_rolls_back_and_shows(dataset, ids, capsys, ruled):
    root = str(dataset.path)
    ruled({None: 1000, "geometry": 500, "glimpse": 600})

    def run(*arguments):
        code = main(["champion", root, *arguments])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    assert "champion: none yet" in run()[2]
    assert run("--promote", ids["geometry"])[0] == 0
    code, _, said = run("--promote", ids["glimpse"])
    assert code == 1
    assert said.startswith("refused: no less work beyond noise")
    assert run("--promote", ids["glimpse"], "--force")[0] == 0
    assert ids["geometry"] in run("--rollback")[2]
    code, out, said = run("--format", "json")
    assert [row["what"] for row in json.loads(out)] == [
        "promoted", "refused", "promoted", "rolled back",
    ]  # fmt: skip
    assert said.endswith(f"champion: {ids['geometry']}\n")
    assert run("--rollback")[0] == 2
    assert run("--rollback", "--promote", "x")[0] == 2
    assert run("--force")[0] == 2
    assert run("--promote", "x")[0] == 2
    assert "one of" in run("--promote", ids["glimpse"], "--guide", "prune")[2]


def test_the_preset_fits_the_scenes():
    found = [fitting_preset(n) for n in (0, 24, 1299, 1300, 16_999, 17_000, 10**6)]
    assert found == ["smoke", "smoke", "smoke", "demo", "demo", "laptop", "paper"]


def test_an_object_store_is_refused_before_anything_is_written():
    class There:
        path = "s3://bucket/d"

    refused = pytest.raises(DatasetError, match="an object store has no locks")
    with refused:
        champions.refuse_remote(There())
