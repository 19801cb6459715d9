"""Where datasets live: Parquet tables, WebDataset tars, and DuckDB over both.

The only importer of pyarrow, duckdb and webdataset.
"""

from relevance.store.compacting import altered, compact
from relevance.store.dataset import Dataset
from relevance.store.exporting import export
from relevance.store.files import LAYOUT, SPLITS, Files, Source, differences
from relevance.store.images import (
    MEMBERS,
    VIEW_SIZE,
    Pictures,
    Sample,
    decode,
    decoded,
    scene_text,
    undecoded,
)
from relevance.store.labellings import Labelling
from relevance.store.needs import needs
from relevance.store.parquet import empty_size
from relevance.store.paths import (
    DatasetError,
    absolute,
    copy_file,
    create_object,
    file_hash,
    is_remote,
    locate,
    replacing,
    sweep,
)
from relevance.store.queries import arrays, replanned, sql
from relevance.store.streaming import polled, shuffled
from relevance.store.synthetic import synthetic_labels
from relevance.store.tables import (
    SCHEMAS,
    TABLES,
    Column,
    TableSchema,
    table_schema,
    type_name,
)

__all__ = [
    "LAYOUT",
    "MEMBERS",
    "SCHEMAS",
    "SPLITS",
    "TABLES",
    "VIEW_SIZE",
    "Column",
    "Dataset",
    "DatasetError",
    "Files",
    "Labelling",
    "Pictures",
    "Sample",
    "Source",
    "TableSchema",
    "absolute",
    "altered",
    "arrays",
    "compact",
    "copy_file",
    "create_object",
    "decode",
    "decoded",
    "differences",
    "empty_size",
    "export",
    "file_hash",
    "is_remote",
    "locate",
    "needs",
    "polled",
    "replacing",
    "replanned",
    "scene_text",
    "shuffled",
    "sql",
    "sweep",
    "synthetic_labels",
    "table_schema",
    "type_name",
    "undecoded",
]
