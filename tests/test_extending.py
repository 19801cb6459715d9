"""A variant of every kind, registered from outside, goes through the whole pipeline by its name.

The pipeline of every test here is the smoke preset's, stage after stage: once with a tenth of its
scenes, and once (slow) as it is.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from conftest import done
from torch import nn

from relevance.cli import main
from relevance.configs import config
from relevance.evaluation import read_predictions, speed_table
from relevance.labels import POLICIES, Verdict
from relevance.models import BODIES, Answer, Body, BodyKind, Encoding, ModelConfig
from relevance.pipeline import Counts, DatasetConfig, labels_work, scenes_work
from relevance.pipeline.checking import check
from relevance.planner import GUIDES, PLANNERS, PlannerConfig
from relevance.planner.guides import Mode
from relevance.planner.result import Counts as Work
from relevance.planner.result import PlanResult, Seconds
from relevance.report.card import card
from relevance.report.tables import statistics
from relevance.sampling import SceneConfig
from relevance.scene import PREDICATES, Predicate, Rectangle, scene_to_json
from relevance.store import Dataset
from relevance.training import find_checkpoint, load_checkpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagonal(Predicate):
    """On the table, behind the reference and to one side of it."""

    side: int
    """1: left, -1: right."""

    def region(self, subject, reference, robot) -> Rectangle:
        c, s = math.cos(robot.yaw), math.sin(robot.yaw)
        x, y = 0.13, 0.13 * self.side
        return Rectangle(
            x=reference.position[0] + c * x - s * y,
            y=reference.position[1] + s * x + c * y,
            angle=robot.yaw,
            half=(0.04, 0.04),
        )


@config
class MeanConfig(ModelConfig):
    body: Literal["mean"] = "mean"
    width: int = 4

    @classmethod
    def smoke(cls):
        return cls(width=2)


class MeanBody(Body):
    """Sees the mean colour of each view."""

    def __init__(self, config: MeanConfig, predicates: Sequence[str]) -> None:
        super().__init__()
        self.embed = nn.Linear(3, config.width)
        self.heads = nn.ModuleDict({name: nn.Linear(config.width, 1) for name in predicates})

    def encode(self, image, views, present):
        return Encoding(tokens=self.embed(views.mean(dim=(-2, -1))), present=present)

    def decode(self, encoding, predicate, goals, asked):
        scores = self.heads[predicate.name](encoding.tokens)[..., 0]
        return Answer(scores=scores[:, None].expand(-1, goals.shape[1], -1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Twice(Mode):
    """Everything, then everything again."""

    def rounds(self, everything, kept, scores) -> Iterator[frozenset[str]]:
        yield everything
        yield everything


class Never:
    """A planner that gives up at once."""

    name = "never"
    Config = PlannerConfig

    def require(self) -> None: ...

    def warm_up(self) -> None: ...

    def plan(self, scene, goal, *, config=None, guide=None, movable=None, replay=True):
        goal = scene.goal(goal) if isinstance(goal, str) else goal
        return PlanResult(
            goal=goal,
            status="infeasible",
            reason="never tried",
            final={},
            counts=Work(),
            seconds=Seconds(total=1e-3),  # times are drawn on a logarithmic axis
        )


class Alphabetical:
    """Relevant is what comes first in the alphabet, and the subject."""

    plans = False

    def verdicts(self, scene: Mapping[str, Any], plan: Mapping[str, Any], config: PlannerConfig):
        names = [box["name"] for box in scene["objects"]]
        others = sorted(set(names) - {plan["subject"], plan["reference"]})
        wanted = {plan["subject"], *others[:1]}
        return {n: Verdict(relevant=n in wanted, because="its name") for n in names}


VARIANTS = (
    # of the scenes of `on`, and yet another predicate: nobody may take the one for the other
    (PREDICATES, Diagonal(name="behind-left", family="on", mirror="behind-right", side=1)),
    (PREDICATES, Diagonal(name="behind-right", family="on", mirror="behind-left", side=-1)),
    (GUIDES, Twice(name="twice", color="#123456")),
    (PLANNERS, Never()),
)
NAMED = (
    (BODIES, "mean", BodyKind(config=MeanConfig, make=MeanBody, version="1")),
    (POLICIES, "alphabetical", Alphabetical()),
)
SMOKE = DatasetConfig.smoke()
FEW = replace(
    SMOKE,
    train=Counts(on=2, same_plane=1),
    validation=Counts(on=1),
    test=Counts(on=2),
    scene=SceneConfig(max_objects=4),
)


@pytest.fixture(scope="module", autouse=True)
def _registered() -> Iterator[None]:
    every = [*((registry, item.name, item) for registry, item in VARIANTS), *NAMED]
    before = [(registry, list(registry)) for registry, _, _ in every]
    for registry, name, item in every:
        registry.register(name, item)
    yield
    for registry, name, _ in every:
        registry.unregister(name)
    assert all(list(registry) == names for registry, names in before)


@pytest.fixture(
    scope="module",
    params=[pytest.param(FEW, id="few"), pytest.param(SMOKE, id="smoke", marks=pytest.mark.slow)],
)
def made(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """A dataset that went through every stage with the dummies, and its checkpoint."""
    root = tmp_path_factory.mktemp("extending") / "dataset"
    done(scenes_work(root, replace(request.param, policy="alphabetical")))
    done(labels_work(root))
    smoke = (str(root), "--preset", "smoke")
    assert main(["train", *smoke, "--model.body", "mean", "--policy", "alphabetical"]) == 0
    assert main(["evaluate", *smoke, "--guides", "twice"]) == 0
    assert main(["report", str(root)]) == 0
    return root, find_checkpoint(root)


def test_labels_are_those_of_the_policy(made: tuple[Path, Path]) -> None:
    dataset = Dataset.open(made[0])
    rows = dataset.read_rows("labels")
    assert {row["predicate"] for row in rows} == {*PREDICATES}
    assert {(row["policy"], row["because"]) for row in rows} == {("alphabetical", "its name")}
    assert any(row["relevant"] and not row["is_goal_object"] for row in rows)
    assert check(made[0]) == []


def test_a_plan_of_the_predicate_makes_it_true(made: tuple[Path, Path]) -> None:
    dataset = Dataset.open(made[0])
    sides = ("behind-left", "behind-right")
    plans = [p for p in dataset.read_rows("plans") if p["predicate"] in sides]
    assert any(plan["holds"] for plan in plans)
    assert any(plan["replay_ok"] for plan in plans)
    assert not any(plan["status"] == "refused" for plan in plans)


def test_the_body_is_learned_and_loaded_by_name(made: tuple[Path, Path]) -> None:
    model, meta = load_checkpoint(made[1])
    assert isinstance(model.body, MeanBody)
    assert model.body.embed.out_features == MeanConfig.smoke().width
    assert set(model.predicates) == {*PREDICATES}
    assert all(torch.isfinite(weight).all() for weight in model.parameters())
    assert "behind-left" in meta["metrics"]


def test_predictions_and_reruns_are_of_the_variants(made: tuple[Path, Path]) -> None:
    dataset = Dataset.open(made[0])
    name = load_checkpoint(made[1])[1]["checkpoint_id"]
    assert len(read_predictions(dataset, name).of("behind-left"))
    rows = dataset.read_rows("evaluations")
    assert {row["guide"] for row in rows} == {"twice"}
    assert {row["predicate"] for row in rows} >= {"behind-left", "behind-right", "on"}
    assert all(row["solved_guided"] == row["solved_unguided"] for row in rows)
    assert {row["guide"] for row in speed_table(dataset, name)} == {"twice"}


def test_the_report_shows_them(made: tuple[Path, Path]) -> None:
    page = (made[0] / "report.html").read_text()
    for name in ("behind-left", "alphabetical", "twice", GUIDES["twice"].color, "mean"):
        assert name in page, name


def test_tables_count_a_predicate_with_the_family_of_its_scenes(made: tuple[Path, Path]) -> None:
    found = statistics(made[0])
    plans = Dataset.open(made[0]).read_rows("plans")
    table = found["paper_label_distribution"]
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    goals = Counter((plan["predicate"], plan["split"]) for plan in plans)
    for (name, split), count in list(goals.items()):
        if PREDICATES[name].family == "same-plane":  # pooled, and without the dummies
            goals["all", split] += count
    assert {
        (r["predicate"], r["split"]): r["goals"] for r in rows if r["n_actions"] == "all"
    } == goals
    sizes = found["by_size"]
    assert {row[sizes.columns.index("family")] for row in sizes.rows} == {"on", "same-plane"}
    assert "behind-left" in card(found, Dataset.open(made[0]))


def test_planners_and_guides_go_by_name(
    made: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = next(iter(Dataset.open(made[0]).samples("test"))).scene
    goal = f"behind-left({scene.names[0]}, {scene.names[1]})"
    assert PLANNERS["never"].plan(scene, goal).reason == "never tried"
    file = tmp_path / "scene.json"
    file.write_text(scene_to_json(scene))
    assert main(["plan", str(file), "--goal", goal, "--planner", "never"]) == 0
    assert "never tried" in capsys.readouterr().out
    assert main(["plan", str(file), "--goal", goal, "--guide", "twice"]) == 2
    assert "go together" in capsys.readouterr().err


def test_a_planner_takes_turns_with_ours_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = ["bench", "planner", "--tasks", "2", "--seed", "3", "--out", str(tmp_path)]
    assert main([*bench, "--against", "never"]) == 0
    with (tmp_path / "against-never.csv").open() as file:
        rows = [*csv.DictReader(file)]
    assert {(row["peer"], row["status_peer"]) for row in rows} == {("never", "infeasible")}
    assert {row["reason_peer"] for row in rows} == {"never tried"}
    assert main([*bench, "--against", "nobody"]) == 2
    assert "unknown planner 'nobody', expected one of ours, rai, never" in capsys.readouterr().err
