"""Parser for Ascension Flock of Birds and miniBIRD trackers, position and quaternion.

A record is seven words of 14 bits, each sent as two bytes of seven; bit 7 marks the first byte of a record and no
other, so that a lost byte costs one record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from tactile_bayes.hardware.readings import MM_PER_INCH, PoseReading, RecordParser, plausible

SCALE_INCH: Final = 36.0
_WORDS: Final = 7


class BirdParser(RecordParser):
    """Parser of Flock of Birds records.

    Parameters
    ----------
    scale_inch
        Full scale of a position: 36, or 72 with the long scaling, 144 with the extended range transmitter.
    group
        Group mode: the bird's address follows each record.
    """

    def __init__(self, *, scale_inch: float = SCALE_INCH, group: bool = False) -> None:
        super().__init__()
        self.record_bytes = 2 * _WORDS + group
        self._scale = scale_inch
        self._group = group

    def _record(self, record: bytes) -> PoseReading | None:
        if not record[0] & 0x80 or any(byte & 0x80 for byte in record[1:]):
            return None
        x, y, z, *turn = (word(record[i], record[i + 1]) for i in range(0, 2 * _WORDS, 2))
        w, i, j, k = (number / 32768 for number in turn)
        step = self._scale / 32768 * MM_PER_INCH
        if not plausible((x * step, y * step, z * step), (w, i, j, k)):
            return None
        return PoseReading((x * step, y * step, z * step), (w, i, j, k), station=record[-1] if self._group else 1)


def word(low: int, high: int) -> int:
    """Decode a signed word from its two bytes of seven bits; the two lowest bits are not sent."""
    number = (low & 0x7F) << 2 | (high & 0x7F) << 9
    return number - 65536 if number & 0x8000 else number


def record_bytes(
    position_inch: Sequence[float], quaternion_wxyz: Sequence[float], *, scale_inch: float = SCALE_INCH
) -> bytes:
    """Encode a pose as the device would: truncated to 14 bits."""
    scaled = [value / scale_inch * 32768 for value in position_inch] + [value * 32768 for value in quaternion_wxyz]
    out = bytearray()
    for value in scaled:
        number = max(-32768, min(32767, math.floor(value))) & 0xFFFF
        out += bytes([number >> 2 & 0x7F, number >> 9 & 0x7F])
    out[0] |= 0x80
    return bytes(out)
