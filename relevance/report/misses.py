"""The page's section about errors: what was left out though relevant, why, and what ties allow.

A query that was left out has one cause, the first that fits: a *tie*, if a plan as short leaves it
where it is; a *close call*, if its plan is ambiguous otherwise (a bound was undecided, or 0.2 mm
would have turned a decision); *occluded*, if less than half of it shows; else *wrong*.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from relevance.report.gallery import Rows, in_words, outlined, test_samples
from relevance.report.style import GROUPS, percent
from relevance.store import Dataset

HIDDEN = 0.5
"""Less than that of an occluded box shows."""
CAUSES = {
    "wrong": "wrong: it shows, and no plan as short does without it",
    "occluded": f"occluded: less than {100 * HIDDEN:g}% of it shows",
    "close call": "close call: a bound was undecided, or 0.2 mm would have turned a decision",
    "tie": "tie: a plan as short leaves it where it is",
}

_ASKED = f"""
create or replace temp table asked as
select
    j.family, j.scene_id, j.query, j.relevant, j.score, j.visible_fraction,
    p.plan_id, p.shard, p.predicate, p.subject, p.reference, p.actions, p.final, p.ambiguous,
    list_distinct(list_transform(coalesce(p.alternatives, [p.moved]), lambda names: list_sort(
        list_filter(names, lambda name: name not in (p.subject, p.reference))))) as sets,
    len(list_filter(sets, lambda names: list_contains(names, j.query))) / len(sets) as share,
    case
        when share < 1 then 'tie'
        when p.ambiguous then 'close call'
        when j.visible_fraction < {HIDDEN} then 'occluded'
        else 'wrong'
    end as cause
from judged as j join plans as p using (split, scene_id, predicate, subject, reference)
where j.checkpoint_id = $1 and j.split = 'test' and j.policy = $2 and not j.is_goal_object
"""
"""A row a test query, with the sets of other objects that plans of that length move."""


def misses_section(
    dataset: Dataset, rows: Rows, chosen: str | None, policy: str | None, *, each: int = 3
) -> dict[str, Any]:
    """Relevant test queries that a checkpoint leaves out at beta = 0, by cause, the `each` surest
    of each cause as pictures; and the most that ties let a network be right about."""
    found: dict[str, Any] = {"causes": [], "others": None, "ties": [], "worst": []}
    if chosen is None:
        return found
    rows(_ASKED, chosen, policy)
    causes = rows(
        """
        select family, cause, count(*) as asked, count_if(score <= 0) as left_out,
            count(distinct plan_id) filter (score <= 0) as goals
        from asked where relevant group by family, cause
        """
    )
    order = {name: place for place, name in enumerate(CAUSES)}
    causes.sort(key=lambda row: (GROUPS.index(row["family"]), order[row["cause"]]))
    lost = {group: sum(r["left_out"] for r in causes if r["family"] == group) for group in GROUPS}
    found["causes"] = [
        row | {"of_all": row["left_out"] / lost[row["family"]] if lost[row["family"]] else None}
        for row in causes
    ]
    [found["others"]] = rows(
        """
        with goals as (
            select any_value(sets) as sets, coalesce(list(query) filter (score > 0), []) as kept
            from asked group by plan_id having count_if(relevant and score <= 0) > 0)
        select count(*) as goals, count_if(len(list_filter(sets, lambda names:
            list_has_all(kept, names))) > 0) as unharmed
        from goals
        """
    )
    found["ties"] = _ties(rows) if policy == "found" else []
    found["worst"] = _worst(dataset, rows, each)
    return found


def _ties(rows: Rows) -> list[dict[str, Any]]:
    """By family, what a network could reach that foresees all but which of several plans as short
    the planner takes; of labels that say what the found plan moves."""
    found = rows(
        """
        with goals as (
            select family, plan_id, 1 / len(any_value(sets)) as chance,
                bool_and((score > 0) = relevant) as all_right
            from asked group by family, plan_id),
        counted as (
            select family, count(*) as goals, count_if(chance < 1) as tied,
                avg(chance) as goals_ceiling, avg(all_right::int) as goals_right
            from goals group by family)
        select family, c.goals, c.tied, c.goals_ceiling, c.goals_right, count(*) as queries,
            count_if(share > 0 and share < 1) as open, 1 - avg(least(share, 1 - share)) as ceiling,
            avg(((score > 0) = relevant)::int) as total
        from asked join counted as c using (family) group by all
        """
    )
    return sorted(found, key=lambda row: GROUPS.index(row["family"]))


def _worst(dataset: Dataset, rows: Rows, each: int) -> list[dict[str, Any]]:
    """By cause, the goals in which a relevant query has the least scores, drawn: one of each family
    before a second of any."""
    tasks = rows(
        """
        with goals as (
            select plan_id, map(list(query order by query), list(score order by query)) as scores,
                list(query order by query) filter (relevant) as relevant
            from asked group by plan_id),
        missed as (
            from asked where relevant and score <= 0
            qualify row_number() over (partition by plan_id order by score, query) = 1),
        ranked as (
            select *, row_number() over (partition by cause, family order by score, plan_id) as nth
            from missed)
        select ranked.*, goals.scores, goals.relevant as all_relevant
        from ranked join goals using (plan_id)
        qualify row_number() over (partition by cause order by nth, score, plan_id) <= $1
        order by score, plan_id
        """,
        each,
    )
    samples = test_samples(dataset, tasks)
    return [
        {
            "cause": about,
            "goals": [
                _drawn(samples[task["scene_id"]], task) for task in tasks if task["cause"] == cause
            ],
        }
        for cause, about in CAUSES.items()
        if any(task["cause"] == cause for task in tasks)
    ]


def _drawn(sample: Any, task: Mapping[str, Any]) -> dict[str, Any]:
    moved = {place["name"] for place in task["final"]}
    return {
        "goal": f"{task['predicate']}({task['subject']}, {task['reference']})",
        "scene": f"{task['scene_id']}, family {task['family']}",
        "plan": in_words(task["actions"]),
        "why": _why(task),
        "picture": outlined(
            sample,
            relevant={*task["all_relevant"], *moved & {task["subject"], task["reference"]}},
            subject=task["subject"],
            reference=task["reference"],
            scores=task["scores"],
            final=task["final"],
        ),
    }


def _why(task: Mapping[str, Any]) -> str:
    score = f"{task['score']:+.1f}".replace("-", "\N{MINUS SIGN}")
    said = f"{task['query']} was left out, score {score}"
    if task["cause"] == "tie":
        others = [set(names) for names in task["sets"] if task["query"] not in names]
        moved = sorted(others[0])
        return f"{said}; as short: move {', '.join(moved) or 'nothing else'} instead"
    if task["cause"] == "occluded":
        return f"{said}; {percent(task['visible_fraction'], 0)} of it shows"
    return said
