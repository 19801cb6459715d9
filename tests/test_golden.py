"""The committed dataset: its contracts hold, and today's code still makes its plans."""

from pathlib import Path

from relevance.pipeline.checking import check
from relevance.planner import plan
from relevance.store import Dataset

GOLDEN = Path(__file__).parent.parent / "data" / "golden"


def test_golden_dataset_keeps_every_contract():
    """Among them: stored scenes render to the stored pixels."""
    assert check(GOLDEN) == []


def test_golden_dataset_is_small():
    assert sum(file.stat().st_size for file in GOLDEN.rglob("*") if file.is_file()) < 2_000_000


def test_golden_goals_are_planned_as_before():
    dataset = Dataset.open(GOLDEN)
    scenes = {sample.key: sample.scene for sample in dataset.samples("train")}
    rows = [row for row in dataset.read_rows("plans") if row["split"] == "train"]
    assert len(rows) >= 20
    changed = []
    for row in rows:
        text = f"{row['predicate']}({row['subject']}, {row['reference']})"
        result = plan(scenes[row["scene_id"]], text)
        if (result.status, list(result.moved)) != (row["status"], row["moved"]):
            changed.append((text, row["moved"], result.moved, row["ambiguous"]))
    assert [item for item in changed if not item[-1]] == []
