"""Made-up label rows in any number, to measure queries on; never to learn from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import duckdb

from relevance.scene import PREDICATES
from relevance.store.dataset import Dataset
from relevance.store.parquet import to_parquet
from relevance.store.paths import replacing
from relevance.store.tables import table_schema

OBJECTS = 7
"""Label rows a plan."""

Progress = Callable[[int, int], None]


def synthetic_labels(
    root: str | Path, rows: int, *, shards: int, progress: Progress | None = None
) -> Dataset:
    """Make a dataset of label files alone, that many rows in that many shards a predicate.

    Two objects of each plan are its goal objects and a seventh of the queries is relevant.
    Raises DatasetError when there is another dataset.
    """
    dataset = Dataset.create(root, {"synthetic": {"rows": rows, "shards": shards}})
    schema = table_schema("labels")
    plans = rows // (len(PREDICATES) * shards * OBJECTS)
    done = 0
    with duckdb.connect() as connection:
        connection.execute("SET enable_progress_bar = false")
        for predicate in PREDICATES:
            for shard in range(shards):
                where = {"split": "train", "shard": shard, "predicate": predicate}
                first = shard * plans
                body = connection.sql(
                    f"""
                    SELECT
                        printf('%016x', hash(p, '{predicate}')) AS plan_id,
                        printf('%016x', hash(p // 6)) AS scene_id,
                        'train' AS split, {shard}::INTEGER AS shard, '{predicate}' AS predicate,
                        'object0' AS subject, 'object1' AS reference, 'object' || q AS query,
                        q = 0 OR (q > 1 AND hash(p, q) % 7 = 0) AS relevant,
                        q < 2 AS is_goal_object, hash(p) % 20 = 0 AS ambiguous, 'found' AS policy,
                        NULL AS because, (hash(q, p) % 1000) / 1000 AS visible_fraction,
                        '0' AS planner_version, 'synthetic' AS config_hash
                    FROM range({first}, {first + plans}) AS plans(p), range({OBJECTS}) AS objects(q)
                    ORDER BY p, q
                    """
                ).to_arrow_table()
                file = dataset.shard_path("labels", **where)
                content = to_parquet(schema, body.cast(schema.arrow), {"policy": "found"}, file)
                with replacing(file) as temporary:
                    temporary.write_bytes(content)
                done += 1
                if progress:
                    progress(done, shards * len(PREDICATES))
    return dataset
