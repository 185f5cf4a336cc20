"""Results of a batch on disk, one line each: an interrupted batch resumes from what it has.

The first line names the settings; each further line is one item's result: JSON and its CRC-32, so that no damaged
result is taken for a sound one. Memory holds where each line is and not what it says, so a store may be larger than
memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import time
import zlib
from collections import UserDict
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from tactile_bayes.declarations import EXACT, from_plain, to_plain
from tactile_bayes.errors import BadDataError, UsageError

STORE_SCHEMA: Final = "tactile-bayes.batch/2"
_FLUSHED_EVERY_S: Final = 5.0  #: Lines reach the disk at least this often: what a loss of power may cost.


class BatchStore(UserDict[str, Any]):
    """Results by the names of their items, each read from the file when it is asked for; open it with `open_store`.

    `descriptor` is of the open, locked file, `data` where the items' lines begin; the latest line of a name counts. A
    result that is deleted is missing in this run, and its line stays in the file. A line half written when the program
    was killed is dropped.
    """

    def __init__(
        self,
        descriptor: int,
        path: Path,
        *,
        encode: Callable[[Any], Any],
        decode: Callable[[Any], Any],
        read_only: bool = False,
    ) -> None:
        super().__init__()
        self.path = path
        self._descriptor, self._encode, self._decode, self._read_only = descriptor, encode, decode, read_only
        self._end = 0
        self._flush_at = time.monotonic() + _FLUSHED_EVERY_S

    def __getitem__(self, name: str) -> Any:
        with open(self._descriptor, "rb", closefd=False) as file:  # what is written goes to the end all the same
            file.seek(self.data[name])
            return self._decode(_unsealed(file.readline()[:-1].decode())["value"])

    def add(self, name: str, value: object) -> Any:
        """Append one result and return it as it will be read back."""
        line = json.dumps({"key": name, "value": self._encode(value)}, ensure_ascii=False)
        began = self._end
        self._append(_sealed(line))
        self.data[name] = began
        return self._decode(json.loads(line)["value"])

    def load(self, header: Mapping[str, Any]) -> None:
        """Find the results of an earlier run, or write the header of a new store; for the errors see `open_store`."""
        with open(self._descriptor, "rb", closefd=False) as file:
            first = file.readline()
            if not self._begun(first, header):
                return
            self._end = len(first)
            for number, line in enumerate(file, start=2):
                if not line.endswith(b"\n"):
                    break
                try:
                    record = _unsealed(line[:-1].decode("utf-8", errors="replace"))
                    name, _ = str(record["key"]), record["value"]
                except (ValueError, KeyError, TypeError, RecursionError):
                    way_out = "remove that line: its item will be run again"
                    raise BadDataError(f"line {number} is damaged", way_out=way_out, path=str(self.path)) from None
                self.data[name] = self._end
                self._end += len(line)
        if not self._read_only:
            os.ftruncate(self._descriptor, self._end)

    def _begun(self, line: bytes, header: Mapping[str, Any]) -> bool:
        """Whether the file's first line is this header; a missing one, or the beginning of one, is written."""
        wanted = _sealed(json.dumps(header, sort_keys=True, ensure_ascii=False))
        if not line.endswith(b"\n") and wanted.encode().startswith(line):
            if self._read_only:
                return False
            os.ftruncate(self._descriptor, 0)
            self._append(wanted)
            return False
        whole = line[:-1].decode("utf-8", errors="replace") if line.endswith(b"\n") else ""
        _check_header(whole, header, path=self.path)
        return True

    def _append(self, line: str) -> None:
        data = line.encode() + b"\n"
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
            if time.monotonic() >= self._flush_at:
                os.fdatasync(self._descriptor)
                self._flush_at = time.monotonic() + _FLUSHED_EVERY_S
        except OSError as error:
            raise UsageError(
                f"{self.path} cannot be written ({error.strerror}); what it holds is kept: free space and run again"
            ) from None
        self._end += len(data)


@contextlib.contextmanager
def open_store(
    path: Path,
    *,
    settings: Mapping[str, Any],
    encode: Callable[[Any], Any] = lambda value: value,
    decode: Callable[[Any], Any] = lambda value: value,
    read_only: bool = False,
) -> Iterator[BatchStore]:
    """Open or create a store, readable by its owner only and locked against a second run.

    `settings` are all that the results depend on besides the items' keys (options, seed, digests of inputs), as plain
    data; a store of other settings, or one in use, is a `UsageError`, another file or a damaged line in its middle a
    `BadDataError`. JSON keeps floats exactly; tuples come back as lists. A store that is read only is left as it is: it
    may be another's, or on a disk that takes nothing.
    """
    access = os.O_RDONLY if read_only else os.O_RDWR | os.O_CREAT | os.O_APPEND
    try:
        descriptor = os.open(path, access | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UsageError(f"{path} cannot be opened ({error.strerror}); choose another place") from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise UsageError(f"{path} is no regular file; choose another name")
        _lock(descriptor, path, shared=read_only)
        store = BatchStore(descriptor, path, encode=encode, decode=decode, read_only=read_only)
        store.load({"schema": STORE_SCHEMA, "settings": json.loads(json.dumps(settings))})
        yield store
        if not read_only:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def unfinished(output: Path) -> Path:
    """Where the results of a batch are kept until its output is written."""
    return output.with_name(f"{output.name}.unfinished")


@contextlib.contextmanager
def open_unfinished(output: Path | None, kind: Any, *, settings: Mapping[str, Any]) -> Iterator[BatchStore | None]:
    """Open the store of results of a `kind`, a record or a list of them, beside the output; None without an output."""
    if output is None:
        yield None
        return
    encode, decode = partial(to_plain, digits=EXACT), partial(from_plain, kind)
    with open_store(unfinished(output), settings=settings, encode=encode, decode=decode) as store:
        yield store


def _lock(descriptor: int, path: Path, *, shared: bool) -> None:
    import fcntl

    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UsageError(f"{path} is in use by another run; wait for it or choose another name") from None


def _sealed(text: str) -> str:
    """Format a line of a store: the text and its checksum."""
    return f"{text} {zlib.crc32(text.encode()):08x}"


def _unsealed(line: str) -> Any:
    """Read the text of a store's line; `ValueError` where it is damaged."""
    text = line.rpartition(" ")[0]
    if _sealed(text) != line:
        raise ValueError("its checksum does not match")
    return json.loads(text)


def _check_header(line: str, wanted: Mapping[str, Any], *, path: Path) -> None:
    try:
        found, _ = json.JSONDecoder().raw_decode(line)  # that of another schema may have another checksum, or none
        schema, settings = found["schema"], dict(found["settings"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise BadDataError("not a store of batch results", way_out="choose another name", path=str(path)) from None
    if schema != wanted["schema"]:
        raise BadDataError(
            f"is a store of schema {schema}, this program writes {wanted['schema']}",
            way_out="finish it with the version that began it, or choose another name",
            path=str(path),
        )
    if _sealed(line.rpartition(" ")[0]) != line:
        raise BadDataError("line 1 is damaged", way_out="choose another name", path=str(path))
    new = dict(wanted["settings"])
    differ = sorted(name for name in settings.keys() | new.keys() if settings.get(name) != new.get(name))
    if differ:
        name = differ[0]
        raise UsageError(
            f"{path} holds results of other settings ({', '.join(differ)}: {name} was {settings.get(name)!r}, "
            f"is {new.get(name)!r}); choose another name, or remove it to begin again"
        )
