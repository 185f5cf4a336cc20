"""Writing the files of an export: one file, or a folder that holds those of no other export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from tactile_bayes.errors import UsageError
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.exports.run import Exported
    from tactile_bayes.files.file_names import Format

_WRITTEN: Final[dict[str, Format]] = {"csv": "CSV", "fhir": "JSON", "nrrd": "NRRD"}
"""Formats of exports that are one file."""


@dataclass(frozen=True, slots=True)
class Outputs:
    """What an export writes.

    Parameters
    ----------
    path
        File, or the folder of several; None where only a dictionary is wanted.
    dictionary
        File of the data dictionary of REDCap's form; None for none.
    to
        Format of the export.
    force
        Overwrite files.
    """

    path: Path | None
    dictionary: Path | None = None
    to: str = "csv"
    force: bool = False

    def check(self, *, files: bool) -> None:
        """Refuse, before any work is done, what could not be written; `files` says whether something is exported.

        Raises
        ------
        UsageError
        """
        from tactile_bayes.files.atomic import refuse_existing
        from tactile_bayes.files.file_names import check_suffix, same_file

        if not files and self.dictionary is None:
            raise UsageError("no file was given to export; give a map, an estimate or both")
        if files and self.path is None:
            raise UsageError("there is nowhere to write to; give the path (-o OUT)")
        if self.path is not None and not files:
            raise UsageError(f"no file was given to export to {self.path}; give a map, an estimate or both")
        if self.dictionary is not None and self.to != "csv":
            raise UsageError("--dictionary is REDCap's; give it with --to csv")
        if self.path is not None and self.dictionary is not None and same_file(self.path, self.dictionary):
            raise UsageError(f"{self.path} is to hold records and dictionary; choose another name for one of them")
        for path, written in ((self.dictionary, "CSV"), (self.path, _WRITTEN.get(self.to))):
            if path is not None and written is not None:
                check_suffix(path, written)
                refuse_existing(path, force=self.force)

    def write(self, exported: Exported | None) -> tuple[Path, ...]:
        """Write the files of the export, and the dictionary: all of them, or none.

        Raises
        ------
        UsageError
            When a file exists and `force` is false, or the folder holds files of another export.
        """
        from tactile_bayes.exports.redcap import dictionary_csv
        from tactile_bayes.files.atomic import write_all

        paths, folder = dict[Path, bytes](), None
        if exported is not None and self.path is not None:
            if "" not in exported.files:
                folder = _prepared_folder(self.path, set(exported.files), force=self.force)
            paths = {self.path / name if name else self.path: data for name, data in exported.files.items()}
        if self.dictionary is not None:
            paths[self.dictionary] = dictionary_csv().encode()
        try:
            write_all(paths, force=self.force)
        except UsageError:
            if folder is not None:
                folder.rmdir()
            raise
        return tuple(paths)


def _prepared_folder(folder: Path, names: set[str], *, force: bool) -> Path | None:
    """Refuse a folder in which the files would stand beside those of another export; make it, and return a new one."""
    from tactile_bayes.files.atomic import refuse_existing, unwritable

    new = not folder.exists()
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        others = sorted({path.name for path in folder.glob("*.dcm")} - names)
    except FileExistsError:
        raise UsageError(f"{folder} is no folder; give the name of one for the DICOM files") from None
    except OSError as error:
        raise unwritable(folder, error) from None
    if others:
        raise UsageError(f"{folder} holds {others[0]} of another export; give another folder")
    for name in sorted(names):
        refuse_existing(folder / name, force=force)
    return folder if new else None
