"""Vision models that score how relevant each object is to a goal: bodies behind one interface.

`encode` looks at a scene once; `decode` scores every object for any number of goals from
that one encoding. Bodies: `vit` is the paper's (32x32 patches, one shared convolutional
embedding, all views at position zero) with image tokens that never see object tokens, which
is what makes the sharing exact; `glimpse` first finds each object by matching its canonical
view with the image, then looks at a window around it. Every predicate has its own head.

A body is a file of this package that registers itself; nothing else names it.

Images and views are RGB. Goals are about the axes of the robot where it stands by default:
a picture of a scene whose robot is turned shows nothing that a model was trained on.
"""

from importlib import import_module
from pkgutil import iter_modules

from relevance.models.config import PATCH, STRIDE, Encoding, ModelConfig, ModelError
from relevance.models.layers import Attention, Extractor
from relevance.models.poses import ANGLES, DECIMETRE, GEOMETRY, half_extents, mirrored
from relevance.models.registry import (
    BODIES,
    Body,
    BodyKind,
    RelevanceModel,
    config_values,
    model_config,
)

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "ANGLES",
    "BODIES",
    "DECIMETRE",
    "GEOMETRY",
    "PATCH",
    "STRIDE",
    "Attention",
    "Body",
    "BodyKind",
    "Encoding",
    "Extractor",
    "ModelConfig",
    "ModelError",
    "RelevanceModel",
    "config_values",
    "half_extents",
    "mirrored",
    "model_config",
]
