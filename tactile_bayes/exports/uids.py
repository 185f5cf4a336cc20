"""Unique identifiers that follow from content: equal content, equal identifier, on every machine."""

from __future__ import annotations

import uuid
from typing import Final

_ROOT: Final = uuid.UUID("5d0f8a6c-54d1-5c0e-9a2b-3f5a3c1c9d47")
"""Name space of this program's identifiers; it must never change."""


def content_uuid(role: str, *parts: str) -> uuid.UUID:
    """UUID of version 5 (RFC 9562) of a role and of what identifies the content in it, such as digests."""
    return uuid.uuid5(_ROOT, "\x1f".join((role, *parts)))


def content_uid(role: str, *parts: str) -> str:
    """DICOM unique identifier ``2.25.`` and the number of `content_uuid` (PS3.5 B.2); at most 44 characters."""
    return f"2.25.{content_uuid(role, *parts).int}"
