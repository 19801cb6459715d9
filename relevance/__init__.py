"""Datasets, models and guides that tell a task-and-motion planner which objects matter.

    import relevance
    scene = relevance.read_scenes("scenes.jsonl")[0]
    guide = relevance.load_guide("checkpoint.pt", mode="prune-then-full")
    result = relevance.plan(scene, "on-the-left(red, blue)", guide=guide)

Names are imported when first used, so that `import relevance` stays light.
"""

import hashlib
import os
import re
import tempfile
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from relevance.errors import RelevanceError, RelevanceWarning
    from relevance.evaluation import Seen, load_guide, look_at, scores
    from relevance.planner import Guide, PlannerConfig, PlanResult, plan, trajectory
    from relevance.scene import Goal, Scene, SceneError, read_scenes
    from relevance.simulation import World, read_bullet, write_bullet
    from relevance.store import Dataset

# torch's threads spin while they wait unless told so before torch loads; on a shared machine
# that made a training step four to nine times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _caches() -> Path:
    """The folder of caches: the user's own, or one of this user's among the temporary files.

    Where a home cannot be written (a service, a container) what is compiled is still kept, as long
    as the machine runs, and by whoever looks at XDG_CACHE_HOME.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    own = Path(tempfile.gettempdir()) / f"relevance-cache-{os.getuid()}"
    for folder in (Path(home), own):
        with suppress(OSError):
            (folder / "relevance").mkdir(mode=0o700, parents=True, exist_ok=True)
            # Among the temporary files somebody else may have been first.
            if os.access(folder / "relevance", os.W_OK) and (
                folder != own or folder.stat().st_uid == os.getuid()
            ):
                os.environ["XDG_CACHE_HOME"] = str(folder)
                if folder == own:  # else matplotlib complains of the home in two lines of its own
                    os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))
                return folder
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="relevance-cache-")
    return Path(os.environ["XDG_CACHE_HOME"])


def _kernel_cache(package: Path) -> Path:
    """Where compiled kernels are kept: one folder for each content of all their sources.

    Left alone, numba looks for changes in a kernel's own file, not in those of the kernels that
    it calls or of the numbers that it was compiled with, and would go on with the old ones.
    """
    sources = {file: file.read_bytes() for file in sorted(package.rglob("*.py"))}
    kernels = b"".join(text for text in sources.values() if b"@njit" in text)
    names = set(re.findall(rb"^from (relevance\.[\w.]+) import", kernels, re.MULTILINE))
    for file, text in sources.items():
        name = ".".join(("relevance", *file.relative_to(package).with_suffix("").parts))
        if name.encode() in names and b"@njit" not in text:
            kernels += text
    digest = hashlib.sha256(kernels).hexdigest()
    return _caches() / "relevance" / f"kernels-{digest[:16]}"


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
    "RelevanceError": "relevance.errors",
    "RelevanceWarning": "relevance.errors",
    "Scene": "relevance.scene",
    "SceneError": "relevance.scene",
    "Seen": "relevance.evaluation",
    "World": "relevance.simulation",
    "load_guide": "relevance.evaluation",
    "look_at": "relevance.evaluation",
    "plan": "relevance.planner",
    "read_bullet": "relevance.simulation",
    "read_scenes": "relevance.scene",
    "scores": "relevance.evaluation",
    "trajectory": "relevance.planner",
    "write_bullet": "relevance.simulation",
}

__all__ = [
    "Dataset",
    "Goal",
    "Guide",
    "PlanResult",
    "PlannerConfig",
    "RelevanceError",
    "RelevanceWarning",
    "Scene",
    "SceneError",
    "Seen",
    "World",
    "load_guide",
    "look_at",
    "plan",
    "read_bullet",
    "read_scenes",
    "scores",
    "trajectory",
    "write_bullet",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'relevance' has no attribute {name!r}")
