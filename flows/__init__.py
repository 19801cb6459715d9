"""Prefect flows over the stages: generate, label, check, train, evaluate, reproduce, retrain.

Prefect is glue here: a flow resolves its parameters, runs one task per shard and tells what
happened; the work itself is in `relevance` and runs without Prefect too. The shard files, not
Prefect's database, say what is finished. This package is the only importer of prefect.

Settings that Prefect must have before it is imported are set here, unless they were set already.
"""

import os

ENVIRONMENT = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    # Without a server a flow starts its own; on a busy machine that takes more than the usual 20 s.
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
    # Many tasks write to one SQLite file.
    "PREFECT_SERVER_DATABASE_TIMEOUT": "60",
}

for _name, _value in ENVIRONMENT.items():
    os.environ.setdefault(_name, _value)
