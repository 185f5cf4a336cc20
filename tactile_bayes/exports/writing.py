"""Writing the files of an export: one file, or a folder that holds those of no other export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tactile_bayes.errors import UsageError

if TYPE_CHECKING:
    from tactile_bayes.exports.run import Exported


def write_exported(exported: Exported, output: Path, *, force: bool = False) -> tuple[Path, ...]:
    """Write an export's files atomically; `output` is the file, or the folder of several.

    Raises
    ------
    UsageError
        When a file exists and `force` is false, or the folder holds files of another export.
    """
    from tactile_bayes.files.atomic import write_bytes

    if "" not in exported.files:
        _prepare_folder(output, set(exported.files), force=force)
    paths = {output / name if name else output: data for name, data in exported.files.items()}
    for path, data in paths.items():
        write_bytes(path, data, force=force)
    return tuple(paths)


def _prepare_folder(folder: Path, names: set[str], *, force: bool) -> None:
    """Make the folder, and refuse one in which the files would stand beside those of another export."""
    from tactile_bayes.files.atomic import refuse_existing, unwritable

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
