"""What the flows are asked with: their parameters, and their names on the command line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from flows.parameters import configured
from flows.plugin import deployments, full_name, wrap_read_deployment
from relevance.configs import override


def test_overrides_reach_nested_settings() -> None:
    from relevance.pipeline import DatasetConfig

    config = configured(DatasetConfig, "smoke", {"seed": 7, "train.on": 3, "train.same_plane": 5})
    assert (config.seed, config.train.on, config.train.same_plane) == (7, 3, 5)
    assert config.validation == DatasetConfig.smoke().validation
    assert override(config, {}) == config
    assert override(config, {"train": {"on": 4}}).train.same_plane == 5


@pytest.mark.parametrize(
    ("preset", "overrides", "culprit"),
    [
        ("smoke", {"sede": 1}, "sede: unknown setting"),
        ("smoke", {"train.of": 1}, "train.of: unknown setting, expected one of on, same_plane"),
        ("smoke", {"seed": "many"}, "seed: Input should be a valid integer"),
        ("smoke", {"seed.low": 1}, "seed has no settings of its own"),
        ("smoke", {"seed": -1}, "seed"),
        ("huge", {}, "preset 'huge'"),
        ("__init__", {}, "preset '__init__'"),
    ],
)
def test_bad_parameters_are_named(preset: str, overrides: dict[str, Any], culprit: str) -> None:
    from relevance.pipeline import DatasetConfig

    with pytest.raises(ValueError, match=re.escape(culprit)):
        configured(DatasetConfig, preset, overrides)


def test_flows_refuse_bad_parameters_before_any_work(tmp_path: Path) -> None:
    from prefect.exceptions import ParameterTypeError

    from flows.generate import generate

    (tmp_path / "file").write_text("")
    for wrong in (
        {"preset": "huge"},
        {"max_workers": 0},
        {"overrides": 3},
        {"dataset": str(tmp_path / "file")},
        {"dataset": " "},
    ):
        parameters = {"dataset": str(tmp_path / "new"), "preset": "smoke"} | wrong
        with pytest.raises(ParameterTypeError, match=next(iter(wrong))):
            generate.validate_parameters(parameters)
    assert not (tmp_path / "new").exists()


def test_short_names_are_only_ours() -> None:
    known = {"generate", "label", "train", "evaluate", "reproduce", "retrain"}
    assert set(deployments()) >= known
    assert [full_name(name) for name in deployments()] == [f"{n}/{n}" for n in deployments()]
    assert full_name("generate/other") == "generate/other"
    assert full_name("somebody") == "somebody"


def test_a_client_is_wrapped_once() -> None:
    class Client:
        def read_deployment_by_name(self, name: str) -> str:
            return name

    wrap_read_deployment(Client)
    once = Client.read_deployment_by_name
    wrap_read_deployment(Client)
    assert Client.read_deployment_by_name is once
    assert Client().read_deployment_by_name("train") == "train/train"
