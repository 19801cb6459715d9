"""Models that come with the package: by name, half as large, each with a page about it.

`ship` makes them; `load_checkpoint` and whatever rests on it takes their names for files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from relevance.configs import dotted
from relevance.models import BODIES
from relevance.store import replacing
from relevance.training.checkpoints import load_checkpoint, save_checkpoint
from relevance.training.decision import group_that_decides
from relevance.training.settings import TrainConfig
from relevance.training.trainer import train

_EXECUTION = {f.name for f in fields(TrainConfig) if not f.metadata.get("identity", True)}
"""Settings that say how a model is trained, not which."""


def ship(
    root: str | Path,
    config: TrainConfig,
    out: str | Path,
    *,
    name: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Train on a dataset, or take what was trained, and write OUT/NAME.pt and OUT/NAME.md.

    Weights are in half precision; the page says what the model learned from, how right it is and
    the command that makes it. `name` is the body's when not given.
    """
    name = name or config.model.body
    model, meta = load_checkpoint(train(root, config, progress=progress), "cpu")
    # A calibration is of the very weights that it was made with, not of halved ones.
    kept = {key: value for key, value in meta.items() if key not in ("history", "calibration")}
    path = Path(out) / f"{name}.pt"
    path.parent.mkdir(parents=True, exist_ok=True)
    for weight in model.parameters():  # what is computed of the camera stays as exact as it is
        weight.data = weight.data.half()
    save_checkpoint(path, model, kept)
    with replacing(path.with_suffix(".md")) as temporary:
        temporary.write_text(_card(name, Path(root), config, meta), encoding="utf-8")
    return path


def _card(name: str, root: Path, config: TrainConfig, meta: Mapping[str, Any]) -> str:
    """The page about a model."""
    body = BODIES[config.model.body]
    chosen = {group_that_decides(name, meta["metrics"]): it for name, it in meta["offsets"].items()}
    rows = [
        f"| {group} | {found['goals']:,} | {q['relevant'] + q['irrelevant']:,} | "
        + " | ".join(_percent(q[key]) for key in ("true_relevant", "true_irrelevant", "total"))
        + f" | {_percent(q['base_rate'])} | {_number(q['auc'])} | "
        f"{_number(chosen.get(group))} | {_percent(q.get('tuned', {}).get('total'))} |"
        for group, found in meta["metrics"].items()
        for q in [found["queries"]]
    ]
    sees = body.advantage or "sees the picture and the views of subject, reference and query"
    return f"""# {name}

A `{config.model.body}` of {meta["parameters"]:,} parameters: it {sees}.
`relevance.load_guide("{name}")`, `relevance plan ... --checkpoint {name}`.

- checkpoint `{meta["checkpoint_id"]}`, weights halved
- trained in {meta["train_seconds"] / 60:.1f} minutes on {meta["device"]}, {config.steps:,} \
steps, on data `{meta["dataset_hash"]}`, labels of policy `{config.policy}`
- made by `{command(config, root, name)}`
{_patience(meta)}
Queries of the validation split (subject and reference left out), the network's own scores at
beta = 0; the offset is what is added to them, so that beta = 0 is the decision that validation
chose; tuned is the total there. (A predicate that only scenes of another family ask of has its
offset in that family's row.)

| | goals | queries | true relevant | true irrelevant | total | base rate | AUC | offset | tuned |
|---|---|---|---|---|---|---|---|---|---|
{chr(10).join(rows)}
"""


def _patience(meta: Mapping[str, Any]) -> str:
    """When it looks as a guide that waits, where that was chosen."""
    if "patience" not in meta:
        return ""
    return f"- as `lazy` it looks after work of {meta['patience']:,} (`relevance tune`)\n"


def command(config: TrainConfig, root: Path, name: str) -> str:
    """The command line that ships this model: the preset, and what differs from it."""
    make = getattr(TrainConfig, config.preset, TrainConfig)
    before = dotted(asdict(make().with_body(config.model.body)))
    changed = {
        key: value
        for key, value in dotted(asdict(config)).items()
        if value != before.get(key) and key not in (*_EXECUTION, "model.body")
    }
    preset = [f"--preset {config.preset}"] if make is not TrainConfig else []
    words = [f"relevance ship {root}", *preset, f"--model.body {config.model.body}"]
    words += [_flag(key, value) for key, value in changed.items()]
    return " ".join(words if name == config.model.body else [*words, f"--name {name}"])


def _flag(key: str, value: Any) -> str:
    """A setting as the command line takes it."""
    *parents, last = key.replace("_", "-").split(".")
    where = ".".join(parents) + "." if parents else ""
    if isinstance(value, bool):
        return f"--{where}{'' if value else 'no-'}{last}"
    values = value if isinstance(value, tuple) else (value,)
    return " ".join([f"--{where}{last}", *map(str, values)])


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
