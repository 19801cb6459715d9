"""How a model is trained: one config, its presets, and what of it names a checkpoint."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, field, replace
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from relevance.configs import config, execution, identity_hash
from relevance.models import BODIES, ModelConfig, model_config
from relevance.scene import PREDICATES, Predicate

TRAINER_VERSION = "2"
"""Raised when equal settings on equal data come to mean other weights."""

Count = Annotated[int, Field(ge=1)]
Weight = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, lt=1)]
Inner = Annotated[float, Field(gt=0, lt=1)]


@config
class TrainConfig:
    """How a model is trained; raises ConfigError that names the field on impossible settings."""

    preset: str = execution("custom")
    """What the other settings start from; a word for people, in no identity."""
    model: Annotated[ModelConfig, BeforeValidator(model_config)] = field(
        default_factory=lambda: BODIES["glimpse"].config()
    )
    """The body and its settings."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Of the weights, the order of scenes and the augmentation."""
    steps: Count = 1000
    """Optimiser steps."""
    scenes_per_batch: Count = 16
    goals_per_scene: Count = 16
    """Most goals of a scene and predicate in one batch."""
    queries_per_batch: Annotated[int, Field(ge=0)] = 0
    """More than 0: a batch is that many queries of a predicate, drawn uniformly among all of
    them, as in the paper, instead of whole scenes with their goals."""
    predicates: tuple[str, ...] = ()
    """What one network learns; all that are labelled when empty. (The paper trains one for the
    four same-plane predicates and another for `on`.)"""
    families: tuple[str, ...] = ()
    """The families of scenes that are learned from; all when empty. (`on` is asked of two.)"""
    scene_share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Of each family, the share of the training scenes that is learned from, by whole shards."""
    scene_goals: Annotated[int, Field(ge=0)] = 0
    """Of each scene and predicate, the most goals that are learned from, always the same; all
    with 0."""
    told_share: Share = 0.0
    """Share of the steps, the first ones, in which a body that thinks of where objects are
    (`glimpse`) is told that and shown no picture: a step costs a third, and it learns to think
    before it learns to see. Nothing to other bodies."""
    start: str = ""
    """Id of a checkpoint of the dataset whose weights are taken over and stay as they are: only
    heads that it lacks are trained, those of `predicates`."""
    continues: str = ""
    """Id of a checkpoint of the dataset or of a model of the package, of the same body and heads,
    whose weights training goes on from."""
    polling: Literal["turns", "rounds", "one-by-one"] = "turns"
    """turns: one predicate's batch a step, in rotation; rounds: a batch of each in every step;
    one-by-one: each predicate for its share of the steps, the next begins when it is done."""
    goal_objects: bool = True
    """Whether subject and reference are asked about in the loss, too (not in the paper's)."""
    share_encodings: bool = True
    """Consecutive turns of one family's predicates take one step; else a step each, on the same
    scenes."""
    learning_rate: Positive = 8e-4
    weight_decay: Weight = 0.02
    betas: tuple[Share, Share] = (0.9, 0.98)
    schedule: Literal["cosine", "constant"] = "cosine"
    """What the learning rate does after the warm-up."""
    warmup: Share = 0.05
    """Share of the steps over which the learning rate rises."""
    clip: Weight = 1.0
    """Largest norm of the gradient; 0 leaves it as it is."""
    eta_same_plane: Inner = 0.86
    eta_on: Inner = 0.66
    """Weight of the relevant objects in the loss (the paper's)."""
    relevance_weight: Positive = 1.0
    mask_weight: Weight = 0.3
    """Weight of the losses on where each object is in the image, by the mask: what a body says of
    it, and where its attention goes (glimpse, and others by the fair recipe)."""
    geometry_weight: Weight = 1.0
    """Weight of the loss on position, size and footprint half-extents (of the same)."""
    mirror: bool = True
    """Show half of the batches in a mirror."""
    recolor: bool = True
    """Exchange colour channels, image and views alike."""
    policy: str = "found"
    """The label policy to learn."""
    ambiguous: bool = True
    """Whether goals with a second moved set of the same length are learned from."""
    soft_labels: bool = False
    """Where several sets tie, learn of each object the share of them that it is in, instead of
    the one that was found (policy `found`)."""
    bfloat16: Literal["auto", "on", "off"] = "auto"
    """Autocast; auto: only on an accelerator that has it. On processors, some of which have it and
    some of which emulate it slowly, the same settings then learn the same."""
    device: str = execution("auto")
    """Where: auto is the accelerator if there is one; else as torch names them, e.g. cuda:1."""
    threads: Annotated[int, Field(ge=0)] = execution(0)
    """CPU threads; 0 leaves torch's choice."""
    save_every: Count = execution(50)
    """Steps between saved states."""
    validation_goals: Annotated[int, Field(ge=0)] = 0
    """Of each validation scene and predicate, the most goals that the decision is chosen by; all
    with 0. (Bodies that look anew for each query take their time.)"""
    validations: Annotated[int, Field(ge=0)] = execution(0)
    """How often, evenly over the steps, some validation scenes are judged for the learning curve,
    by a goal of each predicate; none of it is in the run's times."""
    validation_scenes: Count = execution(100)
    """How many of each family that are."""
    workers: Annotated[int, Field(ge=0)] | None = execution(None)
    """Processes that read and decode ahead, for each that trains; none with 0; one beside a CPU,
    more beside an accelerator when not given."""

    @model_validator(mode="after")
    def _tied(self) -> Self:
        if self.soft_labels and self.policy != "found":
            raise ValueError(f"soft_labels are of policy found, expected it, got {self.policy}")
        if self.start and self.continues:
            raise ValueError(f"start {self.start} and continues {self.continues}: expected one")
        return self

    @classmethod
    def smoke(cls) -> Self:
        """Seconds: every part runs, nothing is learned."""
        model = BODIES["glimpse"].config.smoke()
        return cls(preset="smoke", model=model, steps=8, scenes_per_batch=4, save_every=4)

    @classmethod
    def demo(cls) -> Self:
        """About five minutes on two cores.

        More steps on smaller batches learned more in the same time; exchanging colour channels
        changed nothing in so short a run. One thread, since two wait for each other as soon as a
        core is busy.
        """
        return cls(
            preset="demo",
            steps=2500,
            scenes_per_batch=4,
            goals_per_scene=3,
            recolor=False,
            threads=1,
        )

    @classmethod
    def laptop(cls) -> Self:
        """About an hour of one core.

        Few goals of many scenes: what is seen is learned more slowly than what follows from it.
        """
        return cls(
            preset="laptop",
            steps=15_000,
            goals_per_scene=3,
            learning_rate=1.5e-3,
            told_share=0.1,
        )

    @classmethod
    def paper(cls) -> Self:
        """The paper's ViT by its bare recipe: Adam at 1e-5 on batches of 50 queries, nothing else.

        For its network for `on`, give `--predicates on --families on`; for its other bodies,
        `--model.body`.
        """
        return cls(
            preset="paper",
            model=BODIES["vit"].config.paper(),
            predicates=tuple(p.name for p in PREDICATES.values() if p.family == "same-plane"),
            steps=500_000,
            queries_per_batch=50,
            share_encodings=False,
            goal_objects=False,
            learning_rate=1e-5,
            betas=(0.9, 0.999),
            weight_decay=0.0,
            schedule="constant",
            warmup=0.0,
            clip=0.0,
            mask_weight=0.0,
            geometry_weight=0.0,
            mirror=False,
            recolor=False,
        )

    @classmethod
    def fair(cls) -> Self:
        """The help that ours has, for any of the paper's bodies: about ten minutes on two cores.

        Masks and poses teach where objects are, the views' attention falls on their objects, the
        ViT's embedding is three convolutions deep. `--model.body` chooses the body, with sizes
        that a CPU can train.
        """
        return replace(cls.demo(), preset="fair", model=BODIES["vit"].config.fair(), steps=4000)

    def with_body(self, body: str) -> Self:
        """The same with another body, of the sizes that it has for this preset."""
        if body == self.model.body:
            return self
        kind = BODIES[body].config
        sizes = {"smoke": kind.smoke, "fair": kind.fair, "paper": kind.paper}.get(self.preset, kind)
        return replace(self, model=replace(sizes(), camera=self.model.camera))

    def eta(self, predicate: Predicate) -> float:
        """The loss weight of relevant objects for this predicate."""
        return self.eta_on if predicate.stacked else self.eta_same_plane

    @property
    def content_hash(self) -> str:
        """16 hex digits of what decides the weights: settings, trainer, body."""
        body = self.model.body
        return identity_hash(self, trainer=TRAINER_VERSION, body=f"{body} {BODIES[body].version}")

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; `from_dict` gives an equal config back."""
        return json.loads(json.dumps(asdict(self)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_dict` wrote; raises RelevanceError on anything else."""
        # The model first: what is wrong with it is said of its own class.
        return cls(**{**values, "model": model_config(values.get("model", {}))})
