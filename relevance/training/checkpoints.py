"""Which checkpoints a dataset has."""

from __future__ import annotations

from pathlib import Path

from relevance.store import Dataset, DatasetError


def newest_checkpoint(root: str | Path) -> Path:
    """The file of the dataset's checkpoint that was made last; DatasetError when there is none."""
    dataset = Dataset.open(root)
    rows = dataset.read_rows("checkpoints")
    if not rows:
        raise DatasetError(f"{dataset.path}: no checkpoints there, expected `train` first")
    return dataset.path / max(rows, key=lambda row: (row["created"], row["checkpoint_id"]))["path"]
