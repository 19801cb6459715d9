"""Flow `check`: whether a dataset keeps its contracts; one that does not is told of, and fails."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flows.head import leave_table, retried, say, stage
from flows.parameters import DatasetPath, absolute
from flows.telling import CHECK_FAILED, trouble
from relevance.errors import RelevanceError

if TYPE_CHECKING:
    from relevance.pipeline.checking import Breach


class CheckFailed(RelevanceError):
    """A dataset that breaks its contracts."""


@retried(name="check-dataset")
def check_one(root: str, render: bool) -> list[Breach]:
    """Every breach of a contract."""
    from relevance.pipeline.checking import check

    return check(root, render=render)


@stage()
def check(dataset: DatasetPath = "data/demo", render: bool = True) -> None:
    """Hold a dataset against every contract, as `relevance check` does; fails if one is broken.

    Args:
        dataset: Folder of a dataset, or s3://bucket/prefix.
        render: Whether one scene of each shard is rendered again and its pixels compared.
    """
    root = absolute(dataset)
    breaches = check_one(str(root), render)
    if not breaches:
        say("check: %s keeps its contracts", root)
        return
    rows = [{"file": b.file, "row": b.row, "column": b.column, "what": b.message} for b in breaches]
    leave_table("check", rows, f"Breaches of contract in `{root}`")
    said = f"{len(breaches)} breaches of contract; first {breaches[0]}"
    more = f"`relevance repair {root}` makes anew what can be made exactly."
    trouble(root, CHECK_FAILED, said, f"{said}\n\n{more}", breaches=len(breaches))
    raise CheckFailed(f"{root}: {said}; {more}")
