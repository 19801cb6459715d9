"""The page: whole and self-contained at every stage of a dataset, its figures those of the rows."""

from __future__ import annotations

import re
import shutil
import tempfile
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from evaluated import DATA, evaluated, labelled

from relevance import evaluation as figures
from relevance.pipeline import describe
from relevance.planner import GUIDES
from relevance.report import gallery
from relevance.report.gallery import outlined
from relevance.report.page import build
from relevance.report.paper import paper
from relevance.report.style import KEPT, LOST, RELEVANT, TIMES, guide_style, percent, seconds
from relevance.store import Dataset, DatasetError
from relevance.training import load_checkpoint

VOID = {"meta", "link", "br", "img", "hr", "path", "use", "rect"}


class Page(HTMLParser):
    """Tags that do not nest, ids, links and whatever would be fetched."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs) -> None:
        given = dict(attrs)
        if "id" in given:
            self.ids.append(given["id"])
        for name in ("href", "xlink:href", "src"):
            target = given.get(name)
            if target and target.startswith("#"):
                self.links.append(target[1:])
            elif target and not target.startswith("data:"):
                self.fetched.append(target)
        self.links += re.findall(r"url\(#([^)]+)\)", " ".join(v or "" for v in given.values()))

    def handle_endtag(self, tag) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def whole(text: str) -> Page:
    """The parsed page, once it is seen to be well-formed and to fetch nothing."""
    page = Page(text)
    assert page.open == []
    assert page.fetched == []
    assert "@import" not in text
    assert len(page.ids) == len(set(page.ids))
    assert set(page.links) <= set(page.ids)
    assert not re.search(r"\bnan\b|None|inf\b", page.text)
    return page


@cache
def page_of_everything() -> str:
    with tempfile.TemporaryDirectory() as folder:
        return build(evaluated()[0], Path(folder) / "page.html").read_text()


def test_an_empty_dataset_says_what_is_missing(tmp_path) -> None:
    Dataset.create(tmp_path / "empty", describe(DATA, []))
    page = whole(build(tmp_path / "empty").read_text())
    for command in ("generate", "label", "train", "evaluate"):
        assert f"relevance {command}" in page.text


def test_a_dataset_without_a_checkpoint_shows_its_labels(tmp_path) -> None:
    out = build(labelled(), tmp_path / "page.html")
    assert out == tmp_path / "page.html"
    page = whole(out.read_text())
    assert "No checkpoint yet" in page.text
    assert "Label distribution" in page.text
    with Dataset.open(labelled()).connect() as connection:
        goals, solved = connection.execute(
            "select count(*), avg((status = 'solved')::int) from plans"
        ).fetchall()[0]
    assert f"{100 * solved:.1f}% of goals solved {goals} goals" in page.text


def test_the_whole_page_says_what_the_rows_say() -> None:
    root, checkpoint = evaluated()
    page = whole(page_of_everything())
    dataset = Dataset.open(root)
    everything = figures.read_predictions(dataset, checkpoint.stem)
    table = figures.accuracy_table(everything.queries())
    found = {(row["family"], row["judge"]): row for row in table}
    for family, theirs in (("same-plane", "94%"), ("on", "87%")):
        row, rule = found[family, figures.NETWORK], found[family, figures.RULE]
        card = f"{100 * row['total']:.1f}% accuracy, {family}"
        rules = (
            f"always irrelevant: {100 * row['base_rate']:.1f}%; rule: {100 * rule['total']:.1f}%"
        )
        assert f"{card} {rules}; {row['tasks']} tasks; paper: {theirs}" in page.text
    for title in (question.title for question in figures.BREAKDOWNS.values()):
        assert title in page.text
    for shown in (*table, *figures.accuracy_table(everything)):
        assert f"{shown['judge']} {percent(shown['true_relevant'])}" in page.text
    for name, offset in load_checkpoint(checkpoint)[1]["offsets"].items():
        assert f"{offset:+.2f} ({name})" in page.text
    rows = figures.settings(figures.read_evaluations(dataset, checkpoint.stem))
    whole_guide = figures.summarise(rows["tree", "prune-then-full", 0.0])
    assert f"{whole_guide.speedup.value:.2f}{TIMES} speed-up by prune-then-full" in page.text
    assert f"over {whole_guide.n_solvable} tasks" in page.text
    for svg in ("labels", "lengths", "times", "accuracy", "beta", "scores", "training"):
        assert f"{svg}-figure_1" in page.ids
    for svg in ("tree-runtimes", "tree-objects", "tree-pairs", "tree-sweep"):
        assert f"{svg}-figure_1" in page.ids
    # the sweep keeps the goal objects alone at one end and everything at the other
    assert "-50" in page.text
    assert "+50 100%" in page.text


def test_misses_link_to_their_scenes_and_no_weights_are_needed(tmp_path) -> None:
    root, checkpoint = evaluated()
    dataset = Dataset.open(root)
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    changed = Dataset.open(copy)
    for shard in dataset.shards("test"):
        where = {"name": checkpoint.stem, "split": "test", "shard": shard}
        stored = dataset.read_file(dataset.shard_path("evaluations", **where)).to_pylist()
        for row in stored:
            if row["guide"] == "prune" and row["beta"] == 0:
                row |= {"solved_guided": False, "n_actions_guided": None}
        changed.write_rows("evaluations", stored, **where)
    (copy / checkpoint.relative_to(root)).unlink()
    text = build(copy).read_text()
    page = whole(text)
    assert "training-figure_1" not in page.ids
    assert "accuracy-figure_1" in page.ids
    missed = [
        gallery.anchor(row)
        for row in figures.read_evaluations(changed, checkpoint.stem)
        if row["guide"] == "prune" and row["beta"] == 0 and row["solved_unguided"]
    ]
    linked = [name for name in page.links if name.startswith("task-")]
    assert linked
    assert set(linked) <= set(missed)
    assert text.count("Missed by prune.") == len(set(linked) & set(page.ids))
    assert f"{len(missed)} missed, counted" in page.text


def test_equal_rows_give_an_equal_page(tmp_path) -> None:
    root, _ = evaluated()
    one, two = page_of_everything(), build(root, tmp_path / "page.html").read_text()

    def timeless(text: str) -> str:
        return re.sub(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", "", text)

    assert timeless(one) == timeless(two)


def test_unknown_folders_and_checkpoints_are_named(tmp_path) -> None:
    with pytest.raises(DatasetError, match=r"no dataset\.json"):
        build(tmp_path)
    root, checkpoint = evaluated()
    with pytest.raises(
        DatasetError, match=f"unknown checkpoint 'x', expected one of {checkpoint.stem}"
    ):
        build(root, tmp_path / "page.html", checkpoint_id="x")
    assert not (tmp_path / "page.html").exists()


def test_outlines_say_relevant_kept_and_lost() -> None:
    sample = next(iter(Dataset.open(labelled()).samples("test")))
    subject, reference, query = sample.scene.names[:3]
    given = {"subject": subject, "reference": reference}
    plain = outlined(sample, relevant={subject, query}, **given)
    assert plain.count(f'stroke="{RELEVANT}"') == 2
    assert KEPT not in plain
    assert LOST not in plain
    scores = dict.fromkeys(sample.scene.names, -1.0)
    lost = outlined(sample, relevant={subject, query}, scores=scores, **given)
    assert (lost.count(f'stroke="{RELEVANT}"'), lost.count(f'stroke="{LOST}"')) == (1, 1)
    kept = outlined(sample, relevant={subject}, scores=scores | {query: 1.0}, **given)
    assert (kept.count(f'stroke="{KEPT}"'), kept.count(f'stroke="{LOST}"')) == (1, 0)
    loose = outlined(sample, relevant={subject, query}, scores=scores, beta=2.0, **given)
    assert LOST not in loose


def test_an_outline_follows_its_mask() -> None:
    sample = next(iter(Dataset.open(labelled()).samples("test")))
    query = sample.scene.names[2]
    svg = outlined(
        sample, relevant={query}, subject=sample.scene.names[0], reference=sample.scene.names[1]
    )
    points = re.search(r'<path d="M([^"]*?)Z', svg)
    assert points
    xy = np.array([[float(v) for v in pair.split(",")] for pair in points[1].split()])
    ys, xs = np.nonzero(sample.mask == 3)
    np.testing.assert_allclose(xy.min(axis=0), [xs.min() + 0.5, ys.min() + 0.5], atol=1)
    np.testing.assert_allclose(xy.max(axis=0), [xs.max() + 0.5, ys.max() + 0.5], atol=1)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.0031, "3.1 ms"), (0.0567, "57 ms"), (1.24, "1.2 s"), (43.0, "43 s")],
)
def test_seconds_read_well(value, text) -> None:
    assert seconds(value) == text


def changed(tmp_path: Path, table: str, **values) -> Dataset:
    """A copy of the evaluated dataset, columns of a table's test rows set to other values."""
    root, checkpoint = evaluated()
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    dataset = Dataset.open(copy)
    for shard in dataset.shards("test"):
        where = {"name": checkpoint.stem, "split": "test", "shard": shard}
        rows = dataset.read_file(dataset.shard_path(table, **where)).to_pylist()
        dataset.write_rows(table, [row | values for row in rows], **where)
    return dataset


def test_a_guide_that_nobody_knows_does_not_stop_the_report(tmp_path) -> None:
    dataset = changed(tmp_path, "evaluations", guide="oracle", beta=0.0)
    page = whole(build(dataset.path).read_text())
    assert "speed-up by oracle, tree search" in page.text


def test_guides_have_a_colour_each() -> None:
    names = ["unguided", *(name for name in GUIDES if name != "none")]
    assert len({guide_style(name).color for name in names}) == len(names)
    assert [name for name in names if not guide_style(name).complete] == ["prune"]
    assert guide_style("oracle") == guide_style("oracle")


def test_the_page_says_whose_labels_judge() -> None:
    page = whole(page_of_everything())
    assert "labels by policy found" in page.text
    assert "Judged by the labels of policy found , which this checkpoint learned." in page.text


def test_rows_of_another_planner_are_said(tmp_path) -> None:
    dataset = changed(tmp_path, "evaluations", planner_version="0")
    page = whole(build(dataset.path).read_text())
    planner = dataset.labelling.planner
    assert f"these reruns are of planner 0, the labels of planner {planner}" in page.text


def test_the_papers_figures_agree_with_themselves() -> None:
    found = paper()
    assert tuple(found.accuracy["on"]) == (0.81, 0.89, 0.87) == tuple(found.bodies["Transformer"])
    assert found.seconds == (3.06, 4.47)
    assert {name: round(q.share, 3) for name, q in found.test.items()} == {
        "on-the-left": 0.138,
        "on-the-right": 0.140,
        "in-front": 0.138,
        "behind": 0.139,
        "on": 0.289,
        "same-plane": 0.139,
    }
    for group, accuracy in found.accuracy.items():
        share = found.test[group].share
        total = share * accuracy.true_relevant + (1 - share) * accuracy.true_irrelevant
        assert total == pytest.approx(accuracy.total, abs=0.015), group
    for group, time in found.runtime.items():
        assert 1 - time.guided / time.unguided == pytest.approx(time.saved, abs=0.005), group
    same = [found.runtime[name].unguided for name in found.scenes if name != "on"]
    assert found.runtime["same-plane"].unguided == pytest.approx(sum(same) / 4, abs=0.005)
    assert {len(values) for values in found.curves.values()} == {11}
    for kept, lost in zip(
        found.curves["true_relevant"], found.curves["false_irrelevant"], strict=True
    ):
        assert kept + lost == pytest.approx(1, abs=0.011)


def test_no_other_file_has_figures_or_colours_of_its_own() -> None:
    root = Path(__file__).parent.parent
    files = [*(root / "relevance" / "report").glob("*.py"), *(root / "dashboards").rglob("*.py")]
    for file in files:
        text = file.read_text()
        if file.name != "style.py":
            assert not re.search(r"\"#[0-9a-f]{6}\"", text), file
        assert not re.search(r"0\.94|4\.47|4\.7\b|3\.06", text), file
