"""The patience of a lazy guide: chosen by work on validation tasks, kept with the checkpoint."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
from evaluated import EVALUATION, evaluated, labelled

from relevance.cli import main
from relevance.evaluation import (
    EvaluationConfig,
    EvaluationError,
    Patience,
    TuningConfig,
    checkpoint_id,
    choose_tasks,
    evaluate,
    load_guide,
    load_scorer,
    tune,
)
from relevance.evaluation.tuning import PRICE, chosen
from relevance.networks import read_checkpoint
from relevance.planner import PATIENCE, Guide, plan
from relevance.store import Dataset
from relevance.training import load_checkpoint

CONFIG = TuningConfig(tasks=2, patiences=(0, 1_500, 10**8))


@pytest.fixture
def copy(tmp_path):
    """The evaluated dataset and its checkpoint, to change."""
    root, checkpoint = evaluated()
    shutil.copytree(root, tmp_path / "dataset")
    return tmp_path / "dataset", tmp_path / "dataset" / checkpoint.relative_to(root)


def test_patience_is_kept_in_the_checkpoint_and_found_by_guides(copy):
    root, checkpoint = copy
    before = read_checkpoint(checkpoint)
    assert load_guide(checkpoint, mode="lazy").patience == PATIENCE
    name = checkpoint_id(checkpoint)
    tuned = tune(root, checkpoint, CONFIG)
    assert tuned.patience in CONFIG.patiences
    assert load_guide(checkpoint, mode="lazy").patience == tuned.patience
    assert load_scorer(checkpoint).patience == tuned.patience
    after = read_checkpoint(checkpoint)
    assert after.meta == before.meta | {"patience": tuned.patience}
    assert after.graphs == before.graphs
    assert checkpoint_id(checkpoint) == name
    assert load_checkpoint(checkpoint)[1]["patience"] == tuned.patience
    # the same again, bytes too: work is counted, not timed
    content = checkpoint.read_bytes()
    assert tune(root, checkpoint, CONFIG) == tuned
    assert checkpoint.read_bytes() == content


def test_what_a_patience_costs_is_the_work_of_its_plans_and_the_price_of_their_looks(copy):
    root, checkpoint = copy
    scorer = load_scorer(checkpoint)
    config = replace(CONFIG, searches=("tree",))
    expected = dict.fromkeys(config.patiences, 0)
    looks, unguided = dict.fromkeys(config.patiences, 0), 0
    samples = {s.scene.id: s for s in Dataset.open(root).samples("validation")}
    for task in choose_tasks(Dataset.open(root), split="validation", per_predicate=2):
        sample = samples[task.scene_id]
        scorer.observe(sample.scene, sample.image, sample.views)
        planner = replace(config.planner, search="tree", stop="first")
        unguided += plan(sample.scene, task.goal, config=planner, replay=False).counts.work
        for patience in config.patiences:
            guide = Guide(scorer=scorer, mode="lazy", patience=patience)
            found = plan(sample.scene, task.goal, config=planner, guide=guide, replay=False)
            once, each = PRICE[False]
            price = (once + each * len(sample.scene.objects)) * found.looked
            expected[patience] += found.counts.work + price
            looks[patience] += found.looked
    tuned = tune(root, checkpoint, config)
    assert {one.patience: one.work for one in tuned.tried} == expected
    assert {one.patience: one.looks for one in tuned.tried} == looks
    assert tuned.unguided == unguided
    assert looks[0] == tuned.runs > looks[10**8] == 0


def test_dear_looks_are_put_off_and_cheap_ones_are_not(copy):
    root, checkpoint = copy
    dear = tune(root, checkpoint, replace(CONFIG, price=10**9))
    assert dear.patience > 0
    assert min(dear.tried, key=lambda one: one.work).looks == 0


def test_the_smallest_of_nearly_equal_ones_is_chosen():
    def of(*works):
        return tuple(Patience(patience=i, work=work, looks=0) for i, work in enumerate(works))

    assert chosen(of(2000, 1009, 1000, 1004)) == 1
    assert chosen(of(2000, 1011, 1000, 1004)) == 2
    assert chosen(of(10, 10)) == 0


def test_another_patience_makes_the_reruns_anew(copy):
    root, checkpoint = copy
    fewer = replace(EVALUATION, tasks=1, sweep_tasks=0, guides=("lazy",), priors=())
    seen = []
    evaluate(root, checkpoint, fewer)
    evaluate(root, checkpoint, fewer, progress=lambda *at: seen.append(at))
    assert not seen
    tune(root, checkpoint, replace(CONFIG, patiences=(7,)))
    evaluate(root, checkpoint, fewer, progress=lambda *at: seen.append(at))
    assert len(seen) == 5
    assert EvaluationConfig(guides=("lazy",)).guides == ("lazy",)


def test_no_tasks_are_refused_and_the_checkpoint_stays(copy, tmp_path):
    _, checkpoint = copy
    content = checkpoint.read_bytes()
    empty = tmp_path / "empty"
    shutil.copytree(labelled(), empty)
    shutil.rmtree(empty / "plans")
    with pytest.raises(EvaluationError, match="no validation tasks, expected planned goals"):
        tune(empty, checkpoint, CONFIG)
    assert checkpoint.read_bytes() == content


def test_the_command_says_what_it_chose(copy, capsys):
    root, checkpoint = copy
    words = ["tune", str(root), "--tasks", "1", "--patiences", "0", "4000"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "4000" in out
    patience = load_guide(checkpoint).patience
    assert f"a lazy guide looks after work of {patience}" in " ".join(err.split())
