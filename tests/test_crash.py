"""Real processes killed with SIGKILL while they make a dataset; the bytes do not change."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from relevance.benchmarks.crashes import disturb

FEW = {
    "train.same_plane": 0,
    "train.on": 8,
    "validation.same_plane": 0,
    "validation.on": 0,
    "test.same_plane": 0,
    "test.on": 4,
    "scenes_per_shard": 2,
    "goals_per_scene": 1,
}


@pytest.mark.slow  # a pipeline is killed and started anew three times
def test_three_kills_change_no_byte(tmp_path: Path) -> None:
    fewer = FEW | {"train.on": 4, "test.on": 2}
    trials = disturb(tmp_path, fewer, kills=3, seed=0, flows=False, workers=1, longest=2.0)
    assert len(trials) == 3
    assert [trial for trial in trials if trial.wrong or trial.left] == []
    assert max(trial.shards for trial in trials) > 0


@pytest.mark.slow
def test_twenty_kills_of_flows_workers_and_servers_change_no_byte(tmp_path: Path) -> None:
    more = FEW | {"train.on": 16, "train.same_plane": 8}
    trials = disturb(tmp_path, more, kills=24, seed=1, flows=True)
    kinds = Counter(trial.what for trial in trials)
    assert sum(count for what, count in kinds.items() if what.startswith("kill")) >= 18
    assert {"kill pipeline", "kill worker", "kill server", "full disk"} <= set(kinds)
    assert [trial for trial in trials if trial.wrong or trial.left] == []
    broken = [trial for trial in trials if not trial.what.startswith(("kill", "full"))]
    assert all(trial.recovered for trial in broken), "check names every broken file"
    full = [trial for trial in trials if trial.what == "full disk"]
    assert not any(trial.recovered for trial in full), "the disk was full"
