"""A scan file during its recording: readable at any moment, whatever happens to the program.

Beside what every scan file holds there is ``/log``, foxglove.Log: one message for each thing that went wrong, with the
device time of the frame or pose it belongs to; and, when the recording ended in order, a metadata record
``recording`` with the account.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Final

from foxglove_schemas_protobuf.Log_pb2 import Log

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import ScanWriter
from tactile_bayes.scans import ElementCalibration, HeadGeometry

LOG_TOPIC: Final = "/log"
ACCOUNT: Final = "recording"
# So often what was handed to the system is seen onto the disk: power may fail.
SYNC_S: Final = 0.5


def create_exclusive(path: Path, *, force: bool) -> IO[bytes]:
    """Create a new file for its owner only; under its final name, because it must survive a kill.

    It is locked until it is closed: another recording, or `repair`, leaves it alone.
    """
    refuse_existing(path, force=force)
    flags = os.O_WRONLY | os.O_CREAT | (0 if force else os.O_EXCL)
    try:
        stream = os.fdopen(os.open(path, flags, 0o600), "wb")
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); choose another place") from None
    try:
        _lock(stream, path)
    except UsageError:
        stream.close()
        raise
    stream.truncate(0)
    return stream


def refuse_recording(path: Path) -> None:
    """Raise `UsageError` when a file is being recorded right now."""
    try:
        stream = path.open("rb")
    except OSError:
        return  # whoever reads it says what is wrong with it
    with stream:
        _lock(stream, path)


def _lock(stream: IO[bytes], path: Path) -> None:
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UsageError(f"{path} is being recorded; wait for its end, or choose another name") from None
    except OSError:
        return  # some network file systems have no locks


class _Syncer:
    """Thread that syncs a file to the disk repeatedly, so that the writer does not wait for the disk.

    A thread, because the system lets go of the interpreter while it waits; readers are processes of their own and know
    nothing of it.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._dirty, self._ended = threading.Event(), threading.Event()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """Request a sync; raises the last sync's error."""
        if self._error is not None:
            raise self._error
        self._dirty.set()

    def stop(self) -> None:
        """Wait for the running sync."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(SYNC_S):
            if not self._dirty.is_set():
                continue
            self._dirty.clear()
            try:
                getattr(os, "fdatasync", os.fsync)(self._descriptor)  # not every system has the first
            except OSError as error:
                self._error = error
                return


class RecordingWriter(ScanWriter):
    """A `ScanWriter` that can flush at once, and stores notes about problems; the session was checked before the file
    was made.
    """

    def __init__(
        self,
        stream: IO[bytes],
        *,
        head: HeadGeometry,
        element_calibration: ElementCalibration,
        session: Mapping[str, str],
        provenance: Provenance,
    ) -> None:
        super().__init__(
            stream, head=head, element_calibration=element_calibration, session=session, provenance=provenance
        )
        self._stream = stream
        self._syncer: _Syncer | None = None
        self._log_channel: int = self._writer.register_channel(
            topic=LOG_TOPIC, message_encoding="protobuf", schema_id=self._schema(Log)
        )
        self.flush()

    def add_note(self, text: str, *, device: str, device_ns: int, host_ns: int, serious: bool = False) -> None:
        """Add a line about the data at this time."""
        message = Log(level=Log.WARNING if serious else Log.INFO, message=text, name=device)
        self._send_message(self._log_channel, message, device_ns=device_ns, host_ns=host_ns)

    def flush(self) -> None:
        """Close the chunk and hand it to the system, from where it survives this process.

        Within `SYNC_S` it is on the disk too, and survives the computer. An OSError may be that of the disk before this
        call.
        """
        self._writer.flush()
        if self._syncer is None:
            self._syncer = _Syncer(self._stream.fileno())
        self._syncer.ask()

    def close(self, account: Mapping[str, Any]) -> None:
        """Write the account, the index and the footer, and sync them to the disk."""
        self.stop_syncing()
        self._writer.flush()
        self._writer.add_metadata(ACCOUNT, {name: str(value) for name, value in account.items()})
        self.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def stop_syncing(self) -> None:
        """Release the file in any case; call it before closing the stream."""
        if self._syncer is not None:
            self._syncer.stop()
            self._syncer = None


def full_disk(path: Path, error: OSError) -> BadDataError:
    """Error for a recording that could not be continued because the disk is full."""
    way_out = "what was recorded before is kept; free space, then `tactile-bayes repair` it"
    return BadDataError(f"cannot be written any further ({error.strerror})", way_out=way_out, path=str(path))
