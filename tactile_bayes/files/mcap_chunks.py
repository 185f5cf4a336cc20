"""Decompression of MCAP chunks within the declared and the total size limit."""

from __future__ import annotations

import zlib
from typing import Any, Final

from tactile_bayes.files.reading import check_limit, unpacked_limit

_MOST_WINDOW: Final = 2**27


class Unpacker:
    """Unpacks chunks and counts the bytes that come out.

    Parameters
    ----------
    file_bytes
        Size of the file.
    """

    def __init__(self, file_bytes: int) -> None:
        self._most = unpacked_limit(file_bytes)
        self._unpacked = 0

    def count(self, number: int) -> None:
        """Add to the number of unpacked bytes.

        Raises
        ------
        BadDataError
            When it is over the limit.
        """
        self._unpacked += number
        check_limit(self._unpacked, self._most, what="it unpacks to {} bytes or more")

    def unpack(self, chunk: Any) -> bytes:
        """The records of a chunk.

        Raises
        ------
        BadDataError
            When the file unpacks to more than its limit.
        Exception
            Of many kinds, when the chunk is damaged; `damage` says it in words.
        """
        data = self._decompress(chunk)
        if len(data) != chunk.uncompressed_size:
            raise ValueError(f"it holds {len(data)} bytes and declares {chunk.uncompressed_size}")
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise ValueError("its checksum does not match")
        return data

    def _decompress(self, chunk: Any) -> bytes:
        """The unpacked bytes, at most one more than the chunk declares."""
        most = chunk.uncompressed_size
        match chunk.compression:
            case "":
                return bytes(chunk.data)
            case "zstd":
                return self._zstd(chunk.data, most)
            case "lz4":
                import lz4.frame

                self.count(most)
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most + 1))
        raise ValueError(f"it is compressed by {chunk.compression[:20]!r}, which this program does not know")

    def _zstd(self, data: bytes, most: int) -> bytes:
        import zstandard

        declared = zstandard.frame_content_size(data)  # -1 where the frame does not say
        if declared not in (-1, most):
            raise ValueError(f"its frame unpacks to {declared} bytes and it declares {most}")
        self.count(most)
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW)
        return decompressor.decompress(data, max_output_size=most) if most else b""


def damage(error: Exception) -> str:
    """Describe what is wrong with a chunk or a record, in a few words."""
    if type(error) is ValueError:
        return str(error)
    if type(error).__module__.startswith(("zstandard", "zstd", "lz4")):
        return "it cannot be decompressed"
    return f"its records make no sense: {' '.join(str(error).split())[:100] or type(error).__name__}"
