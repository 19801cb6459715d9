"""A checkpoint as the planner's scorer: it looks at a scene once and answers all its goals.

What was seen is kept by what the scene shows (boxes, table, camera, light), never by the
scene's id, which its author chooses.

Shape suffixes: G goals, N objects of the scene, H and W height and width in pixels.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from relevance.errors import RelevanceError, RelevanceWarning
from relevance.evaluation.calibration import Promise
from relevance.networks import (
    CHAMPION,
    GraphNetwork,
    Network,
    find_checkpoint,
    named,
    read_checkpoint,
    true_geometry,
)
from relevance.planner import GUIDES, PATIENCE, Guide, Scorer
from relevance.sampling import same_view, view_of
from relevance.scene import Goal, Predicate, Scene, lookalikes
from relevance.store import Dataset

_SAME_YAW = math.radians(1)


class EvaluationError(RelevanceError):
    """Settings or data that cannot be evaluated: says which, and what was expected."""


class NetworkScorer:
    """Scores from a checkpoint; encodes a scene once and answers all its goals from that.

    Scenes that were not shown to `observe` are rendered. Keeps the last `capacity` scenes. A
    scene whose picture would have another size than the model takes is refused, and one whose
    robot is turned as none was that it learned from; one whose camera stands elsewhere, or whose
    boxes look the same, gives a RelevanceWarning.
    """

    def __init__(
        self,
        model: Network,
        *,
        checkpoint_id: str = "",
        policy: str = "found",
        offsets: Mapping[str, float] = {},
        yaws: Sequence[float] = (0.0,),
        patience: int = PATIENCE,
        capacity: int = 64,
    ) -> None:
        self.model = model
        self.checkpoint_id = checkpoint_id
        self.policy = policy
        """The label policy that it learned."""
        self.offsets = dict(offsets)
        """By predicate, what is added to the network's logit (0 for others), so that beta = 0
        decides as validation chose."""
        self.yaws = tuple(yaws)
        """How the robots that it learned from were turned, rad."""
        self.patience = patience
        """Work after which a guide that waits should ask it, as validation chose."""
        self.capacity = capacity
        self.promise: Promise | None = None
        """A coverage, where it is asked for: its betas are then part of every score, so that
        beta = 0 keeps what was promised."""
        self.seconds = 0.0
        """CPU seconds of the last `scores`, a needed encoding included, rendering left out."""
        self.seconds_encoding = 0.0
        """Part of them that all goals of the scene share; 0 where it was encoded already."""
        self._seen: OrderedDict[Hashable, tuple[np.ndarray, np.ndarray]] = OrderedDict()
        self._encodings: OrderedDict[Hashable, Any] = OrderedDict()
        self._warned: set[Hashable] = set()

    def observe(self, scene: Scene, image: np.ndarray, views: np.ndarray) -> None:
        """Give a scene's image (H, W, 3) and its objects' views (N, 32, 32, 3), uint8 RGB."""
        self._check(scene)
        wanted = self.model.camera
        if image.shape[:2] != (wanted.height, wanted.width):
            raise EvaluationError(
                f"scene {scene.id}: image is {image.shape[1]}x{image.shape[0]}, "
                f"the model takes {wanted.width}x{wanted.height}"
            )
        if len(views) != len(scene.objects):
            raise EvaluationError(
                f"scene {scene.id}: {len(views)} views, expected one for each of its "
                f"{len(scene.objects)} objects"
            )
        key = shown(scene)
        self._keep(self._seen, key, (image, views))
        self._encodings.pop(key, None)

    def forget(self) -> None:
        """Drop every encoding, so that the next call of `scores` pays for its own."""
        self._encodings.clear()

    def offset(self, predicate: Predicate | str) -> float:
        """What a score has beyond the network's own logit."""
        promised = self.promise.beta(str(predicate)) if self.promise else 0.0
        return self.offsets.get(str(predicate), 0.0) + promised

    def scores(self, scene: Scene, goal: Goal) -> dict[str, float]:
        """Score of every object of the scene."""
        return dict(zip(scene.names, self.score_goals(scene, [goal])[0].tolist(), strict=True))

    def score_goals(self, scene: Scene, goals: Sequence[Goal]) -> np.ndarray:
        """Scores of every object for several goals, (G, N): the network's logits and the offsets.

        Raises EvaluationError where they are no numbers.
        """
        key = shown(scene)
        if key not in self._seen:
            from relevance.simulation import Renderer  # pybullet: only when there is no picture

            self._check(scene)  # before a picture is drawn that no model takes
            with Renderer() as renderer:
                rendering = renderer.render(scene)
            self.observe(scene, rendering.image, rendering.views)
        start = time.process_time()
        if key not in self._encodings:
            poses = true_geometry(scene) if self.model.told else None
            self._keep(self._encodings, key, self.model.look(*self._seen[key], poses))
        self.seconds_encoding = time.process_time() - start
        encoding = self._encodings[key]
        scores = np.empty((len(goals), len(scene.objects)))
        for predicate in dict.fromkeys(goal.predicate for goal in goals):
            which = [n for n, goal in enumerate(goals) if goal.predicate == predicate]
            pairs = [
                [scene.names.index(name) for name in (goals[n].subject, goals[n].reference)]
                for n in which
            ]
            logits = self.model.judge(encoding, predicate, np.array(pairs))
            scores[which] = logits.astype(float) + self.offset(predicate)
        self.seconds = time.process_time() - start
        if not np.isfinite(scores).all():
            raise EvaluationError(
                f"checkpoint {self.checkpoint_id or '(unnamed)'}: its scores of scene {scene.id} "
                "are not finite, expected numbers: its weights are broken"
            )
        return scores

    def _check(self, scene: Scene) -> None:
        """Refuse a robot turned otherwise and a picture of another size; warn of another camera
        and of lookalikes."""
        mine, its = self.model.camera, scene.camera
        turns = (math.remainder(scene.robot.yaw - yaw, math.tau) for yaw in self.yaws)
        if not any(abs(turn) < _SAME_YAW for turn in turns):
            learned = ", ".join(f"{yaw:g}" for yaw in self.yaws)
            raise EvaluationError(
                f"scene {scene.id}: its robot is turned by {scene.robot.yaw:g} rad, the model was "
                f"trained with robots turned by {learned}: left and right would mean other sides"
            )
        if (its.width, its.height) != (mine.width, mine.height):
            raise EvaluationError(
                f"scene {scene.id}: its camera takes {its.width}x{its.height} pixels, "
                f"the model was trained on {mine.width}x{mine.height}"
            )
        if not same_view(mine, its) and its not in self._warned:
            self._warned.add(its)
            warn(
                f"scene {scene.id}: its camera ({view_of(its)}) is not the one that the model was "
                f"trained with ({view_of(mine)}); its scores may mean nothing"
            )
        if shown(scene) not in self._seen and shown(scene) not in self._warned:
            for names in lookalikes(scene):
                self._warned.add(shown(scene))  # the picture is not kept yet when it is asked for
                warn(
                    f"scene {scene.id}: {', '.join(names)} look the same, so that the network "
                    "cannot tell them apart; give them other colours or sizes"
                )

    def _keep(self, cache: OrderedDict[Hashable, Any], key: Hashable, value: Any) -> None:
        cache[key] = value
        cache.move_to_end(key)
        while len(cache) > self.capacity:
            cache.popitem(last=False)


def shown(scene: Scene) -> Hashable:
    """All that a scene's picture depends on; its id and goals are not part of it."""
    return scene.objects, scene.table, scene.camera, scene.light, scene.robot


def warn(message: str) -> None:
    """A RelevanceWarning, shown once for each message."""
    warnings.warn(message, RelevanceWarning, stacklevel=2)


def open_checkpoint(checkpoint: str | Path) -> tuple[NetworkScorer, dict[str, Any]]:
    """A checkpoint's scorer, and what is known of it (id, config, metrics, hashes)."""
    path = named(checkpoint)
    found = read_checkpoint(path)
    meta = found.meta
    model: Network
    if found.graphs:
        model = GraphNetwork(found, path)
    else:
        from relevance.training import load_checkpoint  # torch: only where nothing else runs it

        model, meta = load_checkpoint(path)
        warn(f"{path}: body {model.body_name} has no graph for ONNX Runtime, it runs in torch")
    scorer = NetworkScorer(
        model,
        checkpoint_id=meta["checkpoint_id"],
        policy=policy_of(meta["config"]),
        offsets=meta.get("offsets", {}),
        yaws=meta.get("yaws", (0.0,)),
        patience=meta.get("patience", PATIENCE),
    )
    return scorer, meta


def load_scorer(
    checkpoint: str | Path, *, into: Dataset | None = None, coverage: float | None = None
) -> NetworkScorer:
    """Read a checkpoint; CheckpointError names the file and the found and expected version.

    `into` is a dataset that gets the checkpoint's row, where it has none yet; `coverage` is what
    is promised of what scores over 0, see `Promise`.
    """
    scorer, meta = open_checkpoint(checkpoint)
    if into is not None:
        enter(into, checkpoint, meta)
    if coverage is not None:
        scorer.promise = Promise.of(meta, coverage)
    return scorer


def enter(dataset: Dataset, checkpoint: str | Path, meta: dict[str, Any]) -> None:
    """Give a dataset the row of a checkpoint, where it has none yet."""
    from relevance.training import write_row

    write_row(dataset, named(checkpoint), meta)


def policy_of(config: dict[str, Any] | None) -> str:
    """The label policy that the training settings of a checkpoint name."""
    return (config or {}).get("policy", "found")


def checkpoint_id(checkpoint: str | Path) -> str:
    """The name that a checkpoint has inside; its file may be called anything."""
    return open_checkpoint(checkpoint)[0].checkpoint_id


def load_guide(
    checkpoint: str | Path,
    *,
    mode: str = "prune-then-full",
    beta: float = 0.0,
    coverage: float | None = None,
    dataset: str | Path | None = None,
) -> Guide:
    """A guide for `plan` from a checkpoint file, a model's name, or a checkpoint of a dataset.

    Of a `dataset` it may be an id or "champion". coverage: instead of a beta, with what probability
    at least all relevant objects are kept (see `calibration`); for a calibrated checkpoint, and a
    mode that goes by what is kept. Its patience is what `tune` chose for it, if it did. Raises
    EvaluationError unless beta is finite, and where it is not said whose champion is meant.
    """
    if not math.isfinite(beta):
        raise EvaluationError(f"beta: {beta}, expected a finite number")
    if dataset is not None:
        checkpoint = find_checkpoint(dataset, checkpoint)
    elif str(checkpoint) == CHAMPION and not named(checkpoint).exists():
        raise EvaluationError('load_guide("champion"): expected dataset=, whose champion it is')
    if coverage is not None:
        keeping = [n for n, kind in GUIDES.items() if kind.guided and kind.walk == "levels"]
        if mode in GUIDES and mode not in keeping:
            raise EvaluationError(
                f"coverage: guide {mode} leaves nothing out, expected one of {', '.join(keeping)}"
            )
        if beta:
            raise EvaluationError(f"coverage {coverage:g} and beta {beta:g}: expected one of them")
    return guide_by(load_scorer(checkpoint, coverage=coverage), mode, beta)


def guide_by(scorer: Scorer, mode: str, beta: float = 0.0) -> Guide:
    """A guide that asks a scorer, with the scorer's own patience where it has one."""
    patience = getattr(scorer, "patience", PATIENCE)
    return Guide(scorer=scorer, mode=mode, beta=beta, patience=patience)
