"""Files in object stores by their addresses, through fsspec; who may read and write is the environment's matter.

Nothing here is imported, and no network is used, unless somebody names such an address. Credentials come from where the
store's own tools look for them (for `s3://` the AWS variables and files) and are in no message, file or log.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final

from tactile_bayes.errors import BadDataError, UsageError

SCHEMES: Final = ("s3", "gs", "abfs")
"""Kinds of stores; `s3` is tried in the tests, each of the others needs its own package beside fsspec."""
_ADDRESS: Final = re.compile(rf"({'|'.join(SCHEMES)})://[^/\s@:]+(/[^\x00-\x1f\x7f]*)?")
_READ_BYTES: Final = 2**20


def is_address(name: object) -> bool:
    """True when a name is the address of a file or folder in an object store, as ``s3://bucket/scan.mcap``."""
    return isinstance(name, str) and name.startswith(tuple(f"{scheme}://" for scheme in SCHEMES))


def check_address(address: str) -> str:
    """Address without a slash at its end; it must have a bucket and no user or password."""
    if not _ADDRESS.fullmatch(address):
        raise UsageError(
            "the address of the object store is not as s3://bucket/folder; no user, port or password in it"
        )
    return address.rstrip("/")


def version_of(address: str) -> str:
    """Size, time and tag that the store gives of a file's content without reading it."""
    try:
        known = _store(address).info(address)
    except Exception as error:
        raise _unreadable(address, error) from None
    named = {key.lower(): known[key] for key in known}
    tag = named.get("etag") or named.get("md5hash") or named.get("content_md5")
    return f"{known.get('size')} {tag} {named.get('lastmodified') or named.get('updated')}"


def sha256_of(address: str) -> str:
    """Hex digest of a file's bytes, read as a stream; see `version_of` for the errors."""
    digest = hashlib.sha256()
    try:
        with _store(address).open(address, "rb") as file:
            while data := file.read(_READ_BYTES):
                digest.update(data)
    except Exception as error:
        raise _unreadable(address, error) from None
    return digest.hexdigest()


@contextlib.contextmanager
def fetched(address: str) -> Iterator[Path]:
    """Copy of a file of a store on this computer, for as long as the block lasts; see `version_of` for the errors."""
    with tempfile.TemporaryDirectory(prefix="tactile-bayes-") as folder:
        path = Path(folder) / PurePosixPath(address).name
        try:
            _store(address).get_file(address, str(path))
        except Exception as error:
            raise _unreadable(address, error) from None
        yield path


def put(path: Path, address: str) -> None:
    """Copy a local file into a store; it appears there whole or not at all."""
    try:
        _store(address).put_file(str(path), address)
    except Exception as error:
        raise UsageError(f"{address} cannot be written ({_why(error)}); check address and credentials") from None


def files_below(address: str, *endings: str) -> Iterator[str]:
    """Addresses of all files below a folder that end in one of some ways, sorted; see `version_of` for the errors."""
    scheme = address.split("://", 1)[0]
    try:
        names = sorted(_store(address).find(address))
    except Exception as error:
        raise _unreadable(address, error) from None
    for name in names:
        if name.lower().endswith(endings):
            yield f"{scheme}://{name.split('://')[-1]}"


def _store(address: str) -> Any:
    """File system that an address belongs to."""
    scheme = address.split("://", 1)[0]
    try:
        import fsspec

        # a listing that another process changed must not answer for it
        return fsspec.filesystem(scheme, use_listings_cache=False)
    except ImportError:
        raise UsageError(
            f"{scheme}:// needs a package that is not installed; for s3:// pip install 'tactile-bayes[cloud]', for "
            "others the package that fsspec names"
        ) from None


def _unreadable(address: str, error: Exception) -> Exception:
    """A file's own fault where there is none or nobody may read it; otherwise the store's, which spares the exam."""
    if isinstance(error, UsageError):
        return error
    if isinstance(error, (FileNotFoundError, PermissionError, IsADirectoryError)):
        return BadDataError(f"cannot be read ({_why(error)})", way_out="check address and credentials", path=address)
    return UsageError(f"{address} cannot be read ({_why(error)}); check network and credentials, then run again")


def _why(error: Exception) -> str:
    """First line of an error of a store's library, without what may be a signed address."""
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, PermissionError):
        return "access denied"
    text = " ".join(str(error).split())
    return re.sub(r"\?\S+", "?...", text)[:200] or type(error).__name__
