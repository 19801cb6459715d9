"""Vision models that score how relevant each object is to a goal: bodies behind one interface.

`encode` looks at a scene once; `decode` scores every object for any number of goals from
that one encoding. Bodies that look at a subject, a reference and a query together encode what
does not depend on the query, and do the rest anew for each. Every predicate has its own head.

- `vit`: the paper's transformer (32x32 patches, one shared convolutional embedding, all views
  at position zero). With `shared` attention image tokens never see object tokens, which is
  what makes one encoding serve all goals exactly; `trio` is the paper's own.
- `resnet`, `resnet3d`: the paper's two others.
- `glimpse`: finds each object by matching its view with the image, looks at a window around it,
  then closer at where its edges should be.
- `geometry`: no picture, the true poses.

A body is a file of this package that registers itself; nothing else names it.

Images and views are RGB. Goals are about the axes of the robot where it stands by default:
a picture of a scene whose robot is turned shows nothing that a model was trained on.
"""

from importlib import import_module
from pkgutil import iter_modules

from relevance.models.config import PATCH, STRIDE, Answer, Encoding, ModelConfig, ModelError, Sight
from relevance.models.graphs import export_graphs
from relevance.models.layers import Attention, Extractor
from relevance.models.poses import half_extents, mirrored
from relevance.models.registry import (
    BODIES,
    Body,
    BodyKind,
    RelevanceModel,
    model_config,
    unequal,
)
from relevance.networks import ANGLES, DECIMETRE, GEOMETRY, true_geometry

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "ANGLES",
    "BODIES",
    "DECIMETRE",
    "GEOMETRY",
    "PATCH",
    "STRIDE",
    "Answer",
    "Attention",
    "Body",
    "BodyKind",
    "Encoding",
    "Extractor",
    "ModelConfig",
    "ModelError",
    "RelevanceModel",
    "Sight",
    "export_graphs",
    "half_extents",
    "mirrored",
    "model_config",
    "true_geometry",
    "unequal",
]
