"""Where files live: a folder of this machine, or an object store (`s3://bucket/prefix`).

A local file is written under a temporary name and renamed; an object is written by one PUT
(large ones by a multipart upload, which appears only when it is complete). So a file exists
whole or not at all, wherever it is. Credentials come from the environment, see the README.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from relevance.errors import RelevanceError

_STALE = 86_400.0  # s; a temporary file of another machine that old belongs to nobody
_URL = re.compile(r"([a-z][a-z0-9+]+):/+")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


class DatasetError(RelevanceError):
    """A dataset that is not what it should be: file, column, expected and found in one line."""


def checked_name(what: str, name: str) -> str:
    """A name that may become a folder or a file; raises DatasetError for any other."""
    if not _NAME.fullmatch(name):
        raise DatasetError(f"{what} {name!r}: expected letters, digits, dot, dash, underscore")
    return name


def keys_of(within: Path) -> dict[str, Any]:
    """What a file's way within its dataset says of its rows: `key=value` folders, shard number."""
    keys: dict[str, Any] = {}
    for part in within.parts[:-1]:
        key, sign, value = part.partition("=")
        if sign:
            keys[key] = value
    if found := re.fullmatch(r"shard-(\d+)", within.stem):
        keys["shard"] = int(found[1])
    return keys


def locate(path: str | Path) -> Path:
    """A path to work with: a local one, or for `PROTOCOL://...` one with the same methods."""
    text = str(path)
    found = _URL.match(text)
    if not found:
        return Path(text)
    # Here and not above: local datasets need no fsspec.
    from upath import UPath

    # A Path has folded the two slashes of the URL into one. Listings of others' writes must not
    # be remembered: which shards exist is what a run goes by.
    remote = UPath(f"{found[1]}://{text[found.end() :]}", use_listings_cache=False)
    return cast(Path, remote)


def is_remote(path: Path) -> bool:
    """Whether a located path is in an object store."""
    return not isinstance(path, Path)


def filesystem(path: Path) -> Any:
    """The fsspec file system of a remote path."""
    return cast(Any, path).fs


def listed(path: Path) -> Any:
    """The same of its own, which has listed the folder once and asks no more what is there."""
    its = filesystem(path)
    known = {**its.storage_options, "use_listings_cache": True, "skip_instance_cache": True}
    own = type(its)(*its.storage_args, **known)
    own.find(cast(Any, path).path)
    return own


def absolute(path: str | Path) -> Path:
    """The located path, made absolute when it is local."""
    there = locate(path)
    return there if is_remote(there) else there.expanduser().absolute()


def quoted(path: Path | str) -> str:
    """A path as SQL text; its own brackets, stars and question marks are names, not patterns."""
    escaped = re.sub(r"[\[*?]", r"[\g<0>]", str(path))
    return "'" + escaped.replace("'", "''") + "'"


def file_hash(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A local temporary name that becomes `path` when the block ends well.

    Raises DatasetError where nothing can be written: no permission, no room, no folder.
    """
    if is_remote(path):
        with tempfile.TemporaryDirectory(prefix="relevance-") as folder:
            temporary = Path(folder) / path.name
            yield temporary
            filesystem(path).pipe_file(cast(Any, path).path, temporary.read_bytes())
        return
    owner = f"{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"
    temporary = path.parent / f".{path.name}.{owner}.tmp"
    try:
        with writing(path, path.parent, temporary):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())  # the name must not outlive the bytes in a power cut
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path, *touched: Path) -> Iterator[None]:
    """Turn an OSError about the `touched` files, or a full disk, into one line about `path`."""
    try:
        yield
    except OSError as error:
        about = str(error.filename or "")
        mine = any(str(item) == about or item.is_relative_to(about or "?") for item in touched)
        if not mine and error.errno not in _DISK:
            raise
        reason = error.strerror or str(error)
        raise DatasetError(f"{path}: cannot be written ({reason})") from None


def create_object(path: Path, content: bytes) -> bool:
    """Write an object of a store unless there is one; whether it was written.

    One PUT on the condition that nothing is there (`If-None-Match: *`), which S3, MinIO and
    others keep; a store that does not know it overwrites, and two writers must not start at once.
    """
    try:
        filesystem(path).pipe_file(cast(Any, path).path, content, mode="create")
    except OSError:
        if path.exists():
            return False
        raise
    return True


def copy_file(source: Path, target: Path) -> None:
    """Copy a file within a dataset; the target exists whole or not at all."""
    if is_remote(source):
        filesystem(source).copy(cast(Any, source).path, cast(Any, target).path)
        return
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def sweep(root: Path) -> None:
    """Remove temporary files whose writers are dead: killed here, or a day old elsewhere."""
    if is_remote(root):
        return
    host = re.escape(socket.gethostname())
    for file in root.rglob(".*.tmp"):
        with suppress(FileNotFoundError):
            owner = re.search(rf"\.{host}-(\d+)-[0-9a-f]+\.tmp$", file.name)
            if owner:
                dead = not Path(f"/proc/{owner[1]}").exists()
            else:
                dead = time.time() - file.stat().st_mtime > _STALE
            if dead:
                file.unlink()
