"""Datasets, models and guides that tell a task-and-motion planner which objects matter.

    import relevance
    scene = relevance.read_scenes("scenes.jsonl")[0]
    guide = relevance.load_guide("checkpoint.pt", mode="prune-then-full")
    result = relevance.plan(scene, "on-the-left(red, blue)", guide=guide)

Names are imported when first used, so that `import relevance` stays light.
"""

import hashlib
import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from relevance.evaluation import load_guide
    from relevance.planner import Guide, PlannerConfig, PlanResult, plan
    from relevance.scene import Goal, Scene, SceneError, read_scenes
    from relevance.store import Dataset

# torch's threads spin while they wait unless told so before torch loads; on a shared machine
# that made a training step four to nine times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _kernel_cache(package: Path) -> Path:
    """Where compiled kernels are kept: one folder for each content of all their sources.

    Left alone, numba looks for changes in a kernel's own file, not in those of the kernels that
    it calls, and would go on with what was compiled of the old ones.
    """
    sources = (file.read_bytes() for file in sorted(package.rglob("*.py")))
    digest = hashlib.sha256(b"".join(text for text in sources if b"@njit" in text)).hexdigest()
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return cache / "relevance" / f"kernels-{digest[:16]}"


_cache = _kernel_cache(Path(__file__).parent)
# Inherited from a process that began before the sources changed, it is not what the user chose.
if Path(os.environ.get("NUMBA_CACHE_DIR", _cache)).parent == _cache.parent:
    os.environ["NUMBA_CACHE_DIR"] = str(_cache)

_HOMES = {
    "Dataset": "relevance.store",
    "Goal": "relevance.scene",
    "Guide": "relevance.planner",
    "PlanResult": "relevance.planner",
    "PlannerConfig": "relevance.planner",
    "Scene": "relevance.scene",
    "SceneError": "relevance.scene",
    "load_guide": "relevance.evaluation",
    "plan": "relevance.planner",
    "read_scenes": "relevance.scene",
}

__all__ = [
    "Dataset",
    "Goal",
    "Guide",
    "PlanResult",
    "PlannerConfig",
    "Scene",
    "SceneError",
    "load_guide",
    "plan",
    "read_scenes",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'relevance' has no attribute {name!r}")
