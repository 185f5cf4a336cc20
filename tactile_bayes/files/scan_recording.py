"""A scan file while it is being recorded: readable at any moment, whatever happens to the program.

Beside what every scan file holds there is ``/log``, foxglove.Log: one message for each thing that went wrong, with the
device time of the frame or pose it belongs to; and, when the recording ended in order, a metadata record
``recording`` with the account.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Final

from foxglove_schemas_protobuf.Log_pb2 import Log
from mcap_protobuf.schema import build_file_descriptor_set

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import ScanWriter
from tactile_bayes.scan import ElementCalibration, HeadGeometry

LOG_TOPIC: Final = "/log"
ACCOUNT: Final = "recording"


def create_exclusive(path: Path, *, force: bool) -> IO[bytes]:
    """Open a new file for its owner only; not a temporary one, because it must be there after a kill.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false, or cannot be made.
    """
    refuse_existing(path, force=force)
    flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if force else os.O_EXCL)
    try:
        return os.fdopen(os.open(path, flags, 0o600), "wb")
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); choose another place") from None


class RecordingWriter(ScanWriter):
    """A `ScanWriter` that writes at once what it has when told, and notes what went wrong.

    Parameters
    ----------
    stream
        A new file.
    head, element_calibration, session, provenance
        As for `ScanWriter`; the session was checked, before the file was made.
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
        schema = build_file_descriptor_set(Log).SerializeToString(deterministic=True)
        number = self._writer.register_schema(name=Log.DESCRIPTOR.full_name, encoding="protobuf", data=schema)
        self._log_channel: int = self._writer.register_channel(
            topic=LOG_TOPIC, message_encoding="protobuf", schema_id=number
        )
        self.flush()

    def add_note(self, text: str, *, device: str, device_ns: int, host_ns: int, serious: bool = False) -> None:
        """One line about the data at a time."""
        message = Log(level=Log.WARNING if serious else Log.INFO, message=text, name=device)
        self._send(self._log_channel, message, device_ns=device_ns, host_ns=host_ns)

    def flush(self) -> None:
        """Close the chunk and hand it to the system: from then on it survives this process."""
        self._writer.flush()

    def close(self, account: Mapping[str, Any]) -> None:
        """Write the account, the index and the footer, and see them onto the disk."""
        self._writer.flush()
        self._writer.add_metadata(ACCOUNT, {name: str(value) for name, value in account.items()})
        self.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())


def full_disk(path: Path, error: OSError) -> BadDataError:
    """The one line for a recording that could not be written on."""
    return BadDataError(
        f"cannot be written on ({error.strerror})",
        way_out="what was recorded until then is in it; make room, then `tactile-bayes repair` it",
        path=str(path),
    )
