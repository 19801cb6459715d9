"""DuckDB over datasets: what it answers, what it refuses, and what must never change an answer."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import duckdb
import pytest
from stored import KEYS, LABELS, aged, fill, label_values, plan_values

from relevance.store import (
    SCHEMAS,
    TABLES,
    Dataset,
    DatasetError,
    Labelling,
    compact,
    export,
    sql,
    table_schema,
)
from relevance.store.parquet import content_mark
from relevance.store.plain import tables_sql

SAID = {"planner_version": "1", "hashes": {"plans": "c"}, "config": {"policy": "found"}}
NECESSARY = Labelling(planner="1", config="c", policy="necessary")


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset.create(tmp_path / "it's [1]*", SAID)


def labelled(dataset: Dataset, shard: int = 0) -> Dataset:
    """Scenes, plans and labels of a shard: one of four queries is relevant."""
    scenes = fill(dataset, shard)
    where, own = {**LABELS, "shard": shard}, {"planner": "1", "config": "c"}
    plans = [plan_values(s, shard=shard) for s in scenes]
    dataset.write_rows("plans", plans, made_by=own, **where)
    rows = [
        label_values(s, query, relevant, shard=shard)
        for i, s in enumerate(scenes)
        for query, relevant in (("red", True), ("blue", i == 0), ("green", False))
    ]
    dataset.write_rows("labels", rows, made_by={**own, "policy": "found"}, **where)
    return dataset


def necessary(dataset: Dataset, relevant: bool = False) -> Path:
    """Labels of another policy, beside."""
    rows = dataset.read_rows("labels", **LABELS)
    rows = [{**row, "policy": "necessary", "relevant": relevant} for row in rows]
    return dataset.write_rows("labels", rows, of=NECESSARY, made_by=NECESSARY.made_by, **LABELS)


def contents(root: Path) -> dict[str, bytes]:
    return {str(f.relative_to(root)): f.read_bytes() for f in root.rglob("*") if f.is_file()}


# queries ---------------------------------------------------------------------------------------


def test_empty_tables_have_their_columns(dataset: Dataset) -> None:
    with dataset.connect() as connection:
        for table in TABLES:
            found = connection.execute(f"DESCRIBE {table}").fetchall()
            expected = table_schema(table).columns
            assert [row[0] for row in found] == [column.name for column in expected]
            for row, column in zip(found, expected, strict=True):
                assert row[1].replace('"', "") == column.type.replace('"', "")
            assert connection.execute(f"FROM {table}").fetchall() == []


def test_views_over_real_files(dataset: Dataset) -> None:
    scenes = fill(dataset)
    rows = [
        label_values(s, query, relevant)
        for i, s in enumerate(scenes)
        for query, relevant in (("red", True), ("blue", i == 0), ("green", False))
    ]
    dataset.write_rows("labels", rows, **LABELS)
    columns, found = sql(dataset.path, "FROM label_balance")
    balance = dict(zip(columns, found[0], strict=True))
    assert len(found) == 1
    assert (balance["plans"], balance["queries"], balance["relevant"]) == (4, 4, 1)
    assert balance["relevant_share"] == 0.25
    columns, found = sql(
        dataset.path,
        "SELECT name, place, stands_on, position FROM objects WHERE scene_id = "
        f"'{scenes[1].id}' ORDER BY place",
    )
    assert found == [
        ("red", 0, None, (0.01, 0.1, 0.04)),
        ("blue", 1, "red", (0.01, 0.1, 0.105)),
        ("green", 2, None, (0.01, -0.1, 0.025)),
    ]
    with dataset.connect(origin=True) as connection:
        assert connection.execute("SELECT file, row FROM scenes ORDER BY row").fetchall() == [
            ("scenes/split=train/shard-000000.parquet", row) for row in range(4)
        ]


def test_plain_duckdb_gives_the_same(dataset: Dataset, tmp_path: Path) -> None:
    plain_name = tmp_path / "plain"
    shutil.copytree(dataset.path, plain_name)
    copy = Dataset.open(plain_name)
    scenes = fill(copy)
    rows = [label_values(s, query, query == "red") for s in scenes for query in s.names]
    copy.write_rows("labels", rows, **LABELS)
    with duckdb.connect() as plain:
        plain.execute(f"SET VARIABLE dataset = '{plain_name}'")
        made = set()
        for statement in duckdb.extract_statements((SCHEMAS / "tables.sql").read_text()):
            name = re.search(r"VIEW (\w+)", statement.query)
            assert name is not None
            made.add(name[1])
            if name[1] in TABLES and copy.files(name[1]):
                plain.execute(statement)
            else:
                with pytest.raises(duckdb.IOException, match="No files found"):
                    plain.execute(statement)
        assert made == {*TABLES, *(f"beside_{table}" for table in ("plans", "timings", "labels"))}
        views = (SCHEMAS / "views.sql").read_text()
        for name in (
            "objects",
            "shard_families",
            "label_balance",
            "visibility",
            "scene_sizes",
            "split_overlap",
        ):
            query = re.search(rf"CREATE OR REPLACE VIEW {name} .*?;\n", views, re.DOTALL)
            assert query is not None
            plain.execute(query[0])
            ours = sql(copy.path, f"FROM {name} ORDER BY ALL")[1]
            theirs = plain.execute(f"FROM {name} ORDER BY ALL").fetchall()
            # plain DuckDB reads a fixed-size list as a list
            assert json.dumps(theirs) == json.dumps(ours)
            assert ours or name == "split_overlap"
        short = plain.execute(
            f"SELECT count(*), min(predicate) FROM read_parquet('{plain_name}/labels/**/*.parquet',"
            " hive_partitioning = false)"
        ).fetchall()
        assert short == [(12, "behind")]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("SELECT nope FROM scenes", r'query: Binder Error: Referenced column "nope" not found'),
        ("SELEC", r"query: Parser Error"),
        ("FROM nowhere", r"query: Catalog Error"),
    ],
)
def test_bad_queries(dataset: Dataset, query: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        sql(dataset.path, query)
    assert "\n" not in str(caught.value)


def test_content_hash_is_of_one_policy_and_split(dataset: Dataset, tmp_path: Path) -> None:
    labelled(dataset)

    def hashes() -> tuple[str, str, str]:
        now = Dataset.open(dataset.path)
        own = now.content_hash(policy="found", split="train")
        return now.content_hash(), own, now.content_hash(split="test")

    before = hashes()
    necessary(dataset)
    dataset.write_rows("plans", [], **{**LABELS, "shard": 7})
    assert hashes() == before, "neither plans nor labels of another policy count"
    half = dataset.content_hash(policy="necessary")
    labelled(dataset, shard=1)
    grown = hashes()
    assert [now != then for now, then in zip(grown, before, strict=True)] == [True, True, False]
    necessary(dataset, relevant=True)
    assert dataset.content_hash(policy="necessary") not in (half, grown[0])
    moved = Path(shutil.copytree(dataset.path, tmp_path / "moved"))
    assert Dataset.open(moved).content_hash() == grown[0]
    with pytest.raises(DatasetError, match="policy 'x': expected one of found, necessary"):
        dataset.content_hash(policy="x")


def test_tables_sql_is_made_of_the_schemas() -> None:
    written = (SCHEMAS / "tables.sql").read_text()
    assert written == tables_sql(), "python -m relevance.store.plain > schemas/tables.sql"


# folders above ---------------------------------------------------------------------------------


@pytest.mark.parametrize("above", ["seed=3", "relevant=true", "split=old", "planner_version=9"])
def test_a_folder_above_changes_nothing(tmp_path: Path, above: str) -> None:
    here = labelled(Dataset.create(tmp_path / "plain", SAID))
    necessary(here)
    there = Path(shutil.copytree(here.path, tmp_path / above / "ds"))
    tables = ("scenes", "plans", "labels", "beside_labels")
    queries = [f"SELECT * FROM {name} ORDER BY ALL" for name in tables]
    queries += ["FROM label_balance", "FROM labellings"]
    expected = [sql(here.path, query) for query in queries]
    assert [sql(there, query) for query in queries] == expected
    compact(Dataset.open(there))
    assert [sql(there, query) for query in queries] == expected
    with duckdb.connect() as plain:
        plain.execute(f"SET VARIABLE dataset = '{there}'")
        for statement in duckdb.extract_statements((SCHEMAS / "tables.sql").read_text()):
            if re.search(rf"VIEW ({'|'.join(tables)}) ", statement.query):
                plain.execute(statement)
        for query, (columns, rows) in zip(queries[:4], expected, strict=False):
            named = ", ".join(f'"{column}"' for column in columns)
            found = plain.execute(query.replace("*", named)).fetchall()
            assert json.dumps(found) == json.dumps(rows)


@pytest.mark.parametrize("table", TABLES)
def test_every_key_of_a_path_is_a_column(table: str) -> None:
    """So that nothing has to be read from folder names."""
    schema = table_schema(table)
    keys = set(re.findall(r"(\w+)=", f"{schema.path} {schema.beside}")) - {"planner", "config"}
    assert keys <= set(schema.arrow.names)
    if schema.beside:
        assert ("policy" in keys) == ("policy" in schema.arrow.names)


# broken files ----------------------------------------------------------------------------------


def test_one_broken_file_stops_only_who_needs_it(dataset: Dataset) -> None:
    labelled(dataset)
    labelled(dataset, shard=1)
    necessary(dataset)
    broken = dataset.shard_path("plans", **LABELS)
    broken.write_bytes(broken.read_bytes()[:-100])
    said = re.escape(str(broken)) + ": expected a whole Parquet file.*relevance repair"
    with pytest.raises(DatasetError, match=said) as caught:
        sql(dataset.path, "FROM plans")
    assert "\n" not in str(caught.value)
    for query in (
        "FROM plan_failures",
        "FROM label_changes",
        "FROM scenes JOIN plans USING (split)",
    ):
        with pytest.raises(DatasetError, match=said):
            sql(dataset.path, query)
    for query, rows in {
        "SELECT count(*) FROM Scenes": 8,
        "WITH a AS (FROM labels) SELECT count(*) FROM a JOIN scenes USING (scene_id)": 24,
        "SELECT count(*) FROM objects SEMI JOIN labels USING (scene_id)": 24,
    }.items():
        assert sql(dataset.path, query)[1] == [(rows,)]
    with dataset.connect(origin=True, without=[broken]) as connection:
        assert connection.execute("SELECT count(*) FROM plans").fetchone() == (4,)
        assert connection.execute("SELECT count(*) FROM beside_labels").fetchone() == (12,)
    assert dataset.labellings() == [NECESSARY]
    assert dataset.policies() == ["found", "necessary"]
    assert len(dataset.files_beside()) == 1
    assert len(dataset.read_rows("labels")) == 24
    assert dataset.content_hash(policy="necessary")
    assert len(list(dataset.samples("train"))) == 8


# older and younger files -----------------------------------------------------------------------


def test_older_files_have_nulls_in_younger_columns(dataset: Dataset, tmp_path: Path) -> None:
    labelled(dataset)
    labelled(dataset, shard=1)
    scenes = dataset.read_rows("scenes", shard=0)
    balance = sql(dataset.path, "FROM label_balance")
    old = {
        "scenes": ("sampler_version", "renderer_version"),
        "plans": ("blocking", "alternatives"),
        "labels": ("because",),
    }
    for table, younger in old.items():
        where = KEYS if table == "scenes" else LABELS
        path = dataset.shard_path(table, **where)
        aged(path, without=younger)
        assert dataset.metadata(path)["version"] == "1"
        younger_file = dataset.shard_path(table, **{**where, "shard": 1})
        assert dataset.metadata(younger_file)["version"] == str(table_schema(table).version)
        body = dataset.read_file(path)
        assert body.schema == table_schema(table).arrow
        for name in younger:
            assert body[name].null_count == len(body)
            query = f'SELECT count("{name}") FROM {table} WHERE shard = 0'
            assert sql(dataset.path, query)[1] == [(0,)]
    expected = [{**row, "sampler_version": None, "renderer_version": None} for row in scenes]
    assert dataset.read_rows("scenes", shard=0) == expected
    assert sql(dataset.path, "SELECT count(*), count(sampler_version) FROM scenes")[1] == [(8, 4)]
    assert sql(dataset.path, "FROM label_balance") == balance
    compact(dataset)
    assert sql(dataset.path, "FROM label_balance") == balance
    out = export(dataset, tmp_path / "out")
    with duckdb.connect() as plain:
        query = f"SELECT count(*), count(sampler_version) FROM '{out}/scenes/*.parquet'"
        assert plain.execute(query).fetchone() == (8, 4)


@pytest.mark.parametrize("table", TABLES)
def test_younger_columns_are_nullable(table: str) -> None:
    schema = table_schema(table)
    ages = [1]
    for column in schema.columns:
        ages.append(column.since)
        assert column.since == 1 or column.nullable, column.name
        for field in column.fields:
            ages.append(field.get("since", 1))
            assert ages[-1] == 1 or field["nullable"], f"{column.name}.{field['name']}"
    assert min(ages) == 1
    assert max(ages) == schema.version, "each version brought a column"


# gathered --------------------------------------------------------------------------------------


def test_gathered_rows_are_those_of_the_shards(dataset: Dataset) -> None:
    labelled(dataset)
    labelled(dataset, shard=1)
    query, root = "SELECT * FROM labels ORDER BY ALL", dataset.path
    before = sql(root, query)

    def gathered() -> bool:
        with dataset.connect() as connection:
            found = connection.execute("SELECT sql FROM duckdb_views() WHERE view_name = 'labels'")
            return "compacted" in str(found.fetchall())

    assert not gathered()
    assert compact(dataset) == {"labels": 24}
    assert gathered()
    assert sql(root, query) == before
    files = sorted((root / "compacted").rglob("*.parquet"))
    # touched or copied, but equal
    os.utime(files[0], (1, 1))
    shard = dataset.files("labels")[0]
    shard.write_bytes(shard.read_bytes())
    assert gathered()
    whole = files[0].read_bytes()
    files[0].write_bytes(bytes(len(whole)))
    assert not gathered()
    files[0].unlink()
    assert not gathered()
    assert sql(root, query) == before
    files[0].write_bytes(whole)
    assert gathered()
    # other labels of equal size and time of change
    times = shard.stat()
    keys = {key: dataset.file_keys(shard)[key] for key in LABELS}
    rows = [{**row, "relevant": not row["relevant"]} for row in dataset.read_rows("labels", **keys)]
    footer = {k: v for k, v in dataset.metadata(shard).items() if k in NECESSARY.made_by}
    dataset.write_rows("labels", rows, made_by=footer, **keys)
    os.utime(shard, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert not gathered()
    assert sql(root, query) != before
    assert compact(dataset) == {"labels": 24}
    assert len([item for item in (root / "compacted").iterdir() if item.is_dir()]) == 1
    assert gathered()
    (root / "compacted/labels.json").write_text('{"half')
    assert not gathered()
    assert all(content_mark(f) == dataset.metadata(f)["sha256"] for f in dataset.files("labels"))


# merged ----------------------------------------------------------------------------------------


def test_a_merged_dataset_behind_a_link_reads_its_own_sources(tmp_path: Path) -> None:
    real, other = tmp_path / "real", tmp_path / "other"
    labelled(Dataset.create(real / "a", SAID))
    labelled(labelled(Dataset.create(other / "a", SAID)), shard=1)
    source = {"path": "../a", "first": {"train": 0}, "count": {"train": 1}}
    Dataset.create(real / "both", {"sources": [source]})
    (other / "both").symlink_to(real / "both")
    merged = Dataset.open(other / "both")
    assert merged.sources[0].dataset.path == (real / "a").resolve()
    [name] = [merged.name_of(file) for file in merged.files("scenes")]
    assert name == "../a/scenes/split=train/shard-000000.parquet"
    with merged.connect(origin=True) as connection:
        assert connection.execute("SELECT DISTINCT file FROM scenes").fetchall() == [(name,)]


# what is refused -------------------------------------------------------------------------------


def test_policies_that_there_are(dataset: Dataset) -> None:
    labelled(dataset)
    with pytest.raises(DatasetError, match=r"policy 'nosuch': expected one of found$"):
        sql(dataset.path, "FROM labels", policy="nosuch")
    necessary(dataset)
    asked = "SELECT DISTINCT policy FROM labels"
    for policy in ("found", "necessary"):
        assert sql(dataset.path, asked, policy=policy)[1] == [(policy,)]
    assert sql(dataset.path, asked)[1] == [("found",)]
    for odd in ("../up", "a/b", "", ".hidden", "a b", "a\n"):
        with pytest.raises(DatasetError, match=r"policy '.*': expected letters, digits"):
            Labelling(planner="1", config="c", policy=odd)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("", "query: expected one statement, found none"),
        (" ; ", "query: expected one statement, found none"),
        ("-- a comment", "query: expected one statement, found none"),
        ("SELECT 1; SELECT 2", "query: expected one statement, found 2"),
        ("COPY scenes TO '{root}/x.parquet'", "query: COPY: expected a statement that reads"),
        ("ATTACH '{root}/x.db'", "query: ATTACH: expected a statement that reads"),
        ("EXPLAIN ANALYZE COPY scenes TO '{root}/x'", "query: EXPLAIN: expected a statement that"),
        ("SET x = 1", "query: SET: expected a statement that reads"),
        ("EXPORT DATABASE '{root}/x'", "query: EXPORT: expected a statement that reads"),
        ("DELETE FROM scenes", "query: DELETE: expected a statement that reads"),
        ("FROM query($$COPY scenes TO '{root}/x'$$)", "query: "),
        ("SELECT scene FROM scenes", 'not found in FROM clause! Candidate bindings: .*"scene_id"'),
        ("FROM scene", 'scene does not exist! Did you mean "scenes'),
    ],
)
def test_queries_read_and_nothing_else(tmp_path: Path, query: str, message: str) -> None:
    dataset = Dataset.create(tmp_path / "plain", SAID)
    fill(dataset)
    before = contents(tmp_path)
    with pytest.raises(DatasetError, match=message) as caught:
        sql(dataset.path, query.format(root=dataset.path))
    assert "\n" not in str(caught.value)
    assert contents(tmp_path) == before


def test_what_queries_give(dataset: Dataset, tmp_path: Path) -> None:
    fill(dataset)
    query = "SELECT 1 AS a, 2 AS a, 3 AS a_1, 4 AS a, 1.5 AS d, [2.25] AS l, {'x': 0.5} AS s"
    columns, rows = sql(dataset.path, query)
    assert columns == ["a", "a_2", "a_1", "a_3", "d", "l", "s"]
    assert rows == [(1, 2, 3, 4, 1.5, [2.25], {"x": 0.5})]
    assert type(rows[0][4]) is float
    pivoted = sql(dataset.path, "PIVOT (SELECT split, 1 AS n FROM scenes) ON split USING sum(n)")
    assert pivoted == (["train"], [(4,)])
    (tmp_path / "mine.csv").write_text("x\n1\n")
    assert sql(dataset.path, f"FROM read_csv('{tmp_path}/mine.csv')") == (["x"], [(1,)])


def test_failures_are_grouped_without_the_names_of_objects(dataset: Dataset) -> None:
    reasons = {
        "b0, b1 would have to leave first": "something would have to leave first",
        "b0 would have to leave first; b0 cannot be taken while b1, b2 stand there": (
            "something cannot be taken while others stand there"
        ),
        "b3 cannot be grasped: too wide for the hand": (
            "something cannot be grasped: too wide for the hand"
        ),
        "b0 would have to leave first; max_actions: no plan of up to 6 actions": (
            "max_actions: no plan of up to 6 actions"
        ),
    }
    no = {"status": "infeasible", "holds": False, "check_ok": False}
    rows = [
        plan_values(scene, reason=reason, **no)
        for scene, reason in zip(fill(dataset), reasons, strict=False)
    ]
    dataset.write_rows("plans", rows, made_by={"planner": "1", "config": "c"}, **LABELS)
    found = sql(dataset.path, "SELECT reason FROM plan_failures")[1]
    assert sorted(reason for (reason,) in found) == sorted(reasons.values())


def test_refused_plans_are_failures_of_their_own(dataset: Dataset) -> None:
    scenes = fill(dataset)
    no = {"holds": False, "replay_ok": False, "replay_reason": "it slips"}
    rows = [
        plan_values(scenes[0], status="refused", **no),
        plan_values(scenes[1], **no),
        plan_values(scenes[2], status="infeasible", reason="no room", holds=False, check_ok=False),
        plan_values(scenes[3]),
    ]
    dataset.write_rows("plans", rows, made_by={"planner": "1", "config": "c"}, **LABELS)
    found = sql(dataset.path, "SELECT status, reason, goals FROM plan_failures")[1]
    assert sorted(found) == [("infeasible", "no room", 1), ("refused", "it slips", 2)]
