"""Which checkpoint of a dataset is meant: its champion where there is one, else its newest.

The champion, those before it and what became of every contender are one file beside
dataset.json. It is read, judged and replaced under a lock and by one rename, so that of two
writers the second sees the first, and a kill leaves one whole champion.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from relevance.configs import first_error
from relevance.networks.files import named, read_checkpoint, shipped
from relevance.store import Dataset, DatasetError, is_remote, locate, replacing

CHAMPION = "champion"
"""The name by which the champion of a dataset is asked for."""
_FILE = "champion.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Learned:
    """What a contender learned from, as far as it says when the next one is due."""

    labels: int = 0
    """Training labels that there were when it began; 0 where nobody counted."""
    labelling: str = ""
    """How they were made."""
    settings: str = ""
    """Hash of the settings of training that were asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """What became of a checkpoint."""

    checkpoint_id: str
    what: Literal["promoted", "refused", "rolled back"]
    why: str
    before: str | None
    """The champion that stood then; None for none."""
    at: str
    """When, UTC, ISO 8601."""
    learned: Learned = Learned()


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """The champions of a dataset."""

    line: tuple[str, ...] = ()
    """Those that stood, one after the other; the last one is the champion."""
    history: tuple[Event, ...] = ()
    """Every event, the oldest first."""

    @property
    def champion(self) -> str | None:
        """Id of the checkpoint that stands."""
        return self.line[-1] if self.line else None

    def tried(self, checkpoint_id: str) -> bool:
        """Whether a checkpoint was promoted or refused before."""
        return any(event.checkpoint_id == checkpoint_id for event in self.history)


_RECORD = TypeAdapter(Record)


def read_record(dataset: Dataset) -> Record:
    """The champions of a dataset, none where nobody contended; DatasetError for a broken file."""
    file = dataset.path / _FILE
    try:
        return _RECORD.validate_json(file.read_bytes())
    except FileNotFoundError:
        return Record()
    except ValidationError as error:
        raise DatasetError(
            f"{file}: no record of champions{first_error(error)}; "
            "`relevance champion --promote` begins a new one once it is gone"
        ) from None
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from None


def settle(
    dataset: Dataset,
    checkpoint_id: str,
    *,
    before: str | None,
    promoted: bool,
    why: str,
    learned: Learned | None = None,
) -> bool:
    """Enter what became of a contender; False, and nothing entered, where another champion than
    `before` stands by now."""

    def change(record: Record) -> Record | None:
        if record.champion != before:
            return None
        line = (*record.line, checkpoint_id) if promoted else record.line
        what = "promoted" if promoted else "refused"
        record = replace(record, line=line)
        return _entered(record, checkpoint_id, what, why, before, learned)

    return _change(dataset, change)


def crown(dataset: Dataset, checkpoint_id: str, why: str) -> None:
    """Make a checkpoint the champion, whatever stands; nothing to do where it is."""

    def change(record: Record) -> Record | None:
        if record.champion == checkpoint_id:
            return None
        line = (*record.line, checkpoint_id)
        before = record.champion
        return _entered(replace(record, line=line), checkpoint_id, "promoted", why, before)

    _change(dataset, change)


def roll_back(dataset: Dataset, why: str) -> str:
    """Put the champion before the present one in its place; its id.

    Raises DatasetError where there is none.
    """
    found: list[str] = []

    def change(record: Record) -> Record | None:
        if len(record.line) < 2:
            raise DatasetError(
                f"{dataset.path}: no champion before {record.champion}, nothing to roll back to"
                if record.line
                else f"{dataset.path}: no champion yet, nothing to roll back"
            )
        *line, last = record.line
        found.append(line[-1])
        return _entered(replace(record, line=tuple(line)), last, "rolled back", why, last)

    _change(dataset, change)
    return found[0]


def _entered(
    record: Record,
    checkpoint_id: str,
    what: Any,
    why: str,
    before: str | None,
    learned: Learned | None = None,
) -> Record:
    event = Event(
        checkpoint_id=checkpoint_id,
        what=what,
        why=why,
        before=before,
        at=datetime.now(UTC).isoformat(timespec="seconds"),
        learned=learned or Learned(),
    )
    return replace(record, history=(*record.history, event))


def _change(dataset: Dataset, change: Callable[[Record], Record | None]) -> bool:
    """Replace the record by what is made of it, unless that is None; whether it was."""
    refuse_remote(dataset)
    with _alone(dataset):
        record = change(read_record(dataset))
        if record is None:
            return False
        with replacing(dataset.path / _FILE) as temporary:
            text = json.dumps(_RECORD.dump_python(record, mode="json"), indent=2)
            temporary.write_text(text + "\n", encoding="utf-8")
        return True


def refuse_remote(dataset: Dataset) -> None:
    """Raise DatasetError where no champion can be made."""
    if is_remote(dataset.path):
        raise DatasetError(
            f"{dataset.path}: champions need a local folder, an object store has no locks"
        )


@contextmanager
def _alone(dataset: Dataset) -> Iterator[None]:
    """One writer at a time: a lock on the folder itself, which ends with its process."""
    folder = os.open(dataset.path, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


# --- which checkpoint -----------------------------------------------------------------------


def age(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """By what rows of `checkpoints` are ordered: when training ended, then the id."""
    return row["created"], row["checkpoint_id"]


def meant(dataset: Dataset) -> str | None:
    """Id of the checkpoint that is meant where none is named: the champion, else the newest."""
    rows = dataset.read_rows("checkpoints")
    newest = max(rows, key=age)["checkpoint_id"] if rows else None
    return read_record(dataset).champion or newest


def find_checkpoint(root: str | Path, text: str | Path | None = None) -> Path:
    """The file that is meant by an id of the dataset or of a model of the package, a path,
    `champion`, or nothing: see `meant`.

    Raises DatasetError with the ids that there are.
    """
    dataset = Dataset.open(root)
    rows = {row["checkpoint_id"]: row for row in dataset.read_rows("checkpoints")}
    known = ", ".join([*rows, *shipped()]) or "none: nothing was trained yet"
    if text is None:
        name = meant(dataset)
    elif str(text) == CHAMPION:
        name = read_record(dataset).champion
    else:
        name = str(text)
    if name is None and text is None:
        raise DatasetError(f"{dataset.path}: no checkpoints there, expected `train` first")
    if name is None:
        raise DatasetError(f"{dataset.path}: no champion yet, expected one of {known}")
    if name in rows:
        file = locate(rows[name]["path"])
        return file if is_remote(file) or file.is_absolute() else dataset.path / file
    path = named(name)
    if path.is_file():
        return path
    for path in shipped().values():
        if read_checkpoint(path).meta["checkpoint_id"] == name:
            return path
    raise DatasetError(
        f"{dataset.path}: unknown checkpoint {name!r}, expected a file or one of {known}"
    )
