"""The page's sections about what a dataset holds, and how its planner did."""

from __future__ import annotations

from typing import Any

from relevance.report import plots
from relevance.report.style import GROUPS, named
from relevance.store import SPLITS


def data_section(rows: Any) -> dict[str, Any]:
    """Scenes, label balance and plan lengths."""
    shares = rows(
        """
        select family, predicate, split, goals, solved, plans, queries, relevant, relevant_share
        from paper_label_distribution where n_actions = 'all'
        """
    )
    pooled = named(
        rows(
            """
            select family, predicate, sum(queries)::bigint as queries,
                sum(relevant) / nullif(sum(queries), 0) as relevant_share
            from paper_label_distribution
            where n_actions = 'all' and predicate <> 'all'
            group by family, predicate
            """
        )
    )
    lengths = rows(
        """
        select family, n_actions, sum(plans)::bigint as plans from plan_lengths group by all
        order by n_actions
        """
    )
    sizes = rows(
        """
        select family, split, count(*) as scenes, avg(n_objects) as mean, min(n_objects) as least,
            max(n_objects) as most
        from scenes group by all
        """
    )
    sizes.sort(key=lambda row: (GROUPS.index(row["family"]), SPLITS.index(row["split"])))
    visible = rows(
        "select avg(visible_fraction) as mean, min(visible_fraction) as least from objects"
    )
    return {
        "sizes": sizes,
        "shares": _in_order(shares),
        "visible": visible[0],
        "n_scenes": sum(row["scenes"] for row in sizes),
        "n_labels": sum(row["queries"] or 0 for row in pooled),
        "shares_plot": plots.svg("labels", plots.label_shares, rows=pooled) if pooled else "",
        "lengths_plot": plots.svg("lengths", plots.lengths, rows=lengths) if lengths else "",
    }


def _in_order(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return named(sorted(rows, key=lambda row: SPLITS.index(row["split"])))


def planner_section(rows: Any) -> dict[str, Any]:
    """Verdicts, times and failures."""
    verdicts = named(
        rows(
            """
            select family, predicate, sum(goals)::bigint as goals, sum(solved)::bigint as solved,
                sum(plans)::bigint as plans, sum(ambiguous)::bigint as ambiguous,
                sum(replayed)::bigint as replayed, sum(replay_ok)::bigint as replay_ok,
                max(max_penetration) as deepest, max(replay_max_penetration) as replay_deepest
            from plan_verdicts group by family, predicate
            """
        )
    )
    seconds = named(
        rows(
            """
            select family, predicate, count(*) as n, avg(seconds) as mean,
                median(seconds) as median, quantile_cont(seconds, 0.9) as p90,
                max(seconds) as longest, avg(seconds_pose) as pose,
                avg(seconds_keyframe) as keyframe, avg(seconds_path) as path
            from timings left join shard_families using (split, shard) group by family, predicate
            """
        )
    )
    counts = named(
        rows(
            """
            select family, predicate, avg(nodes) as nodes, avg(pose_checks) as pose,
                avg(keyframe_nlps) as keyframe, avg(path_nlps) as path
            from plans left join shard_families using (split, shard) group by family, predicate
            """
        )
    )
    counts_of = {row["group"]: row for row in counts}
    reasons = rows(
        """
        select status, reason, sum(goals)::bigint as goals
        from plan_failures group by all
        order by goals desc, status, reason
        """
    )
    families = rows(
        """
        select family, count(*) as n, quantile_cont(seconds, $1::double[]) as quantiles
        from timings join plans using (plan_id) join scenes using (scene_id)
        group by family order by family desc
        """,
        plots.QUANTILES.tolist(),
    )
    middle = rows("select count(*) as n, median(seconds) as median from timings")[0]
    versions = [
        row["planner_version"] for row in rows("select distinct planner_version from plans")
    ]
    for row in reasons:
        row["label"] = ": ".join(part for part in (row["status"], row["reason"]) if part)
    total = {
        key: sum(row[key] or 0 for row in verdicts)
        for key in ("goals", "solved", "plans", "ambiguous", "replayed", "replay_ok")
    }
    return {
        "verdicts": verdicts,
        "total": total,
        "seconds": [row | {"counts": counts_of.get(row["group"], {})} for row in seconds],
        "median": middle["median"],
        "n_timed": middle["n"],
        "versions": versions,
        "reasons": reasons,
        "reasons_plot": plots.svg(
            "reasons",
            plots.reasons,
            size=(4.8, 0.75 + 0.42 * min(len(reasons), 8)),
            rows=reasons[:8],
        )
        if reasons
        else "",
        "times_plot": plots.svg("times", plots.times, rows=families) if families else "",
    }
