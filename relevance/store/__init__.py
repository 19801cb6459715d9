"""Where datasets live: Parquet tables, WebDataset tars, and DuckDB over both.

The only importer of pyarrow, duckdb and webdataset.
"""

from relevance.store.dataset import SPLITS, Dataset, differences, file_hash, replacing, sql
from relevance.store.images import MEMBERS, VIEW_SIZE, Pictures, Sample
from relevance.store.tables import (
    SCHEMAS,
    TABLES,
    Column,
    DatasetError,
    TableSchema,
    table_schema,
    type_name,
)

__all__ = [
    "MEMBERS",
    "SCHEMAS",
    "SPLITS",
    "TABLES",
    "VIEW_SIZE",
    "Column",
    "Dataset",
    "DatasetError",
    "Pictures",
    "Sample",
    "TableSchema",
    "differences",
    "file_hash",
    "replacing",
    "sql",
    "table_schema",
    "type_name",
]
