"""Names for the titles of figures: a map's, with the subject's code and the scan's digest."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

_CODE: Final = re.compile(r"[A-Za-z0-9_-]{1,32}")
_DIGEST_LETTERS: Final = 8
_MOST: Final = 3


def named_exam(name: str, scans: Sequence[Mapping[str, str]]) -> str:
    """Such as ``"exam (P07, scan 3dbf3ce1)"``; what is no code is left out, and `$` starts no formula.

    Parameters
    ----------
    name
        Of the map; may be empty.
    scans
        As `Provenance.scans` has them.
    """
    subjects = dict.fromkeys(scan.get("subject", "") for scan in scans)
    codes = [code for code in subjects if _CODE.fullmatch(code)]
    digests = [one for one in (scan.get("sha256", "")[:_DIGEST_LETTERS] for scan in scans) if _CODE.fullmatch(one)]
    more = f" and {len(digests) - _MOST} more" if len(digests) > _MOST else ""
    codes += [f"scan{'s' if len(digests) > 1 else ''} {', '.join(digests[:_MOST])}{more}"] if digests else []
    plain = name.replace("$", r"\$")
    if not codes:
        return plain
    return f"{plain} ({', '.join(codes)})" if plain else ", ".join(codes)
