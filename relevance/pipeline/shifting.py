"""Whether the balance of labels shifted: new shards beside those before, or new plans beside old.

The share of relevant objects among the queries (goal objects left out) is that of the sampler,
the planner and the label policy together; nothing that stays the same moves it. Scenes are what is
independent, so its standard error is that of a ratio of sums over scenes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from relevance.store import Dataset, Labelling

MOST = 0.03
"""A shift is larger than this: 3 points."""
SURE = 3.0
"""And larger than this many standard errors, lest every handful of scenes be one."""
FEWEST = 20
"""Scenes on either side: of fewer, the standard error says nothing (of one, none differs)."""

_SHARES = """
scenes as (
    select family, predicate, fresh, sum(relevant::int) as r, count(*) as q
    from counted left join shard_families using (split, shard)
    group by family, predicate, fresh, scene_id),
shares as (
    select family, predicate, fresh, count(*) as n, sum(r) / sum(q) as share,
        -- rounding may leave a sum of squares just below 0; of one scene there is no variance
        greatest(sum(r * r) - 2 * share * sum(r * q) + share * share * sum(q * q), 0) as squares,
        coalesce(sqrt(squares * n / nullif(n - 1, 0)), 0) / sum(q) as error
    from scenes group by family, predicate, fresh)
select new.family, new.predicate, old.n, new.n, old.share, new.share,
    sqrt(old.error * old.error + new.error * new.error)
from shares as new join shares as old using (family, predicate)
where new.fresh and not old.fresh order by all
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Balance:
    """The share of relevant objects before and now."""

    family: str
    predicate: str
    scenes: tuple[int, int]
    """How many it rests on, before and now."""
    shares: tuple[float, float]
    error: float
    """Standard error of their difference."""

    @property
    def change(self) -> float:
        """By how much the share rose."""
        return self.shares[1] - self.shares[0]

    @property
    def shifted(self) -> bool:
        """Whether that is more than 3 points, and more than noise."""
        enough = min(self.scenes) >= FEWEST
        return enough and abs(self.change) > max(MOST, SURE * self.error)

    def __str__(self) -> str:
        before, now = (f"{100 * share:.1f}%" for share in self.shares)
        where = "" if self.family == self.predicate else f" ({self.family})"
        return (
            f"{self.predicate}{where}: {now} of the queries in {self.scenes[1]} new scenes are "
            f"relevant, {before} in {self.scenes[0]} before ({100 * self.change:+.1f} points)"
        )


def balances(
    dataset: Dataset, new: Collection[tuple[str, str, int]], policy: str | None = None
) -> list[Balance]:
    """Label files, each (predicate, split, shard), beside all others of the policy; nothing of a
    predicate that is all new."""
    rows = [list(column) for column in zip(*new, strict=True)] or [[], [], []]
    query = f"""
        with fresh as (
            select unnest($1::varchar[]) as predicate, unnest($2::varchar[]) as split,
                unnest($3::integer[]) as shard),
        counted as (
            select l.*, f.predicate is not null as fresh
            from labels as l left join fresh as f using (predicate, split, shard)
            where not is_goal_object),
        {_SHARES}
    """
    return _asked(dataset, query, rows, policy)


def balances_between(dataset: Dataset, old: Labelling) -> list[Balance]:
    """The present labels beside those of another labelling, on scenes that have both."""
    query = f"""
        with before as (
            from beside_labels
            where (planner_version, config_hash, policy) = ($1, $2, $3) and not is_goal_object),
        shared as (
            select predicate, scene_id from before
            intersect select predicate, scene_id from labels),
        counted as (
            select split, shard, predicate, scene_id, relevant, true as fresh
            from labels semi join shared using (predicate, scene_id) where not is_goal_object
            union all
            select split, shard, predicate, scene_id, relevant, false
            from before semi join shared using (predicate, scene_id)),
        {_SHARES}
    """
    return _asked(dataset, query, [old.planner, old.config, old.policy], None)


def _asked(
    dataset: Dataset, query: str, values: Sequence[object], policy: str | None
) -> list[Balance]:
    names = ("labels", "beside_labels", "shard_families", "scenes")
    with dataset.connect(policy=policy, names=names) as connection:
        found = connection.execute(query, values).fetchall()
    return [
        Balance(
            family=family,
            predicate=predicate,
            scenes=(before, now),
            shares=(was, share),
            error=error,
        )
        for family, predicate, before, now, was, share, error in found
    ]
