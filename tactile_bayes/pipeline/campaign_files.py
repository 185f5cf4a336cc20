"""Files of a folder that may be exams, and which of them are the same exam twice."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Final

from tactile_bayes.errors import UsageError
from tactile_bayes.files.campaign_names import JOURNAL
from tactile_bayes.pipeline.campaign_said import MAP, SCANS, Said

_ENDINGS: Final = (*SCANS, MAP)
_ASIDE: Final = (".", "~$")
"""Names of what systems and spreadsheets leave beside files begin so."""


class FolderFiles:
    """Files of a folder of this computer and of those below it.

    Parameters
    ----------
    folder
        Folders in it that a campaign wrote are passed over.
    table
        Where the table of exams will be: names are paths from its folder.

    Attributes
    ----------
    paths
        By name, of files that may be exams, in a fixed order.
    others
        How many other files there are, by the ends of their names.
    closed
        Folders in it that cannot be read, with the reason.

    Raises
    ------
    UsageError
        When the folder is none or cannot be read, or the table would lie outside it and not above it.
    """

    def __init__(self, folder: Path, table: Path) -> None:
        if not folder.is_dir():
            raise UsageError(f"{folder} is not a directory; give the folder of the scans")
        base = Path(os.path.realpath(table.parent))
        if not Path(os.path.realpath(folder)).is_relative_to(base):
            way_out = "write the table beside the scans"
            raise UsageError(f"{folder} is not inside {table.parent}, the table's folder; {way_out}")
        self.paths: dict[str, Path] = {}
        self.others: Counter[str] = Counter()
        self.closed: list[str] = []
        self._digests: dict[str, str] = {}
        own = Path(os.path.realpath(table))
        for path in _walk(folder, self.closed):
            if path.name.lower().endswith(_ENDINGS):
                name = os.path.relpath(os.path.realpath(path.parent) + os.sep + path.name, base)
                self.paths[name] = path
            elif Path(os.path.realpath(path)) != own:
                self.others[path.suffix.lower() or "no ending"] += 1

    def repeated(self, said: Mapping[str, Said], listed: Collection[str]) -> dict[str, str]:
        """Names of files that are no further exam, each with the reason.

        Of files of the same bytes the one that is listed stays, else that of the shortest name. Of a scan and its map,
        and of a scan and the arrays that it was imported from, the scan stays, unless the other is listed.

        Parameters
        ----------
        said
            By name, of the files that can be read.
        listed
            Names that the table of exams has already.
        """
        found: dict[str, str] = {}
        for names in self._alike(said):
            first, *copies = sorted(names, key=lambda name: (name not in listed, len(name), name))
            found |= {name: f"holds the same bytes as {first}" for name in copies if name not in listed}
        for made, original in self._made_of({name: one for name, one in said.items() if name not in found}):
            arrays = original.lower().endswith(".npz")  # which say less of the exam than the scan that they became
            first, second = (made, original) if arrays else (original, made)
            if second in listed and first not in listed:
                first, second = second, first
            if second not in listed:
                words = "was made from" if second == made else "was made into"
                found.setdefault(second, f"{words} {first}, which is an exam")
        return found

    def _alike(self, said: Mapping[str, Said]) -> Iterator[list[str]]:
        """Names of readable files of the same bytes."""
        of_size: dict[int, list[str]] = defaultdict(list)
        for name in said:
            of_size[self.paths[name].stat().st_size].append(name)
        for names in of_size.values():
            same: dict[str, list[str]] = defaultdict(list)
            for name in names if len(names) > 1 else ():
                same[self._digest(name)].append(name)
            yield from (alike for alike in same.values() if len(alike) > 1)

    def _made_of(self, said: Mapping[str, Said]) -> Iterator[tuple[str, str]]:
        """Maps and imported scans, each with the name of a file that it was made from."""
        made = {name: one.sources for name, one in said.items() if one.sources}
        if not made:
            return
        by_digest = {self._digest(name): name for name in said if not name.lower().endswith(MAP)}
        for name, sources in made.items():
            original = next((by_digest[digest] for digest in sorted(sources) if digest in by_digest), None)
            if original is not None and original != name:
                yield name, original

    def _digest(self, name: str) -> str:
        from tactile_bayes.files.atomic import sha256

        if name not in self._digests:
            self._digests[name] = sha256(self.paths[name])
        return self._digests[name]


def _walk(folder: Path, closed: list[str]) -> Iterator[Path]:
    """Files in a fixed order, without those that systems leave beside others; folders that cannot be read are noted."""

    def skip(error: OSError) -> None:
        if error.filename == os.fspath(folder):
            raise UsageError(f"{folder} cannot be read ({error.strerror}); give a folder that can")
        closed.append(f"{error.filename}: cannot be read ({error.strerror})")

    for place, folders, names in os.walk(folder, onerror=skip):
        if JOURNAL in names:
            folders.clear()
            continue
        folders.sort()
        yield from (Path(place) / name for name in sorted(names) if not name.startswith(_ASIDE))
