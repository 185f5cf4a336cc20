"""Export of maps and estimates to the files that other systems take."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tactile_bayes.api.arguments import check_keywords, door
from tactile_bayes.api.estimates import listed
from tactile_bayes.api.maps import Map, PathLike, path_of
from tactile_bayes.api.pooled import PooledSize
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import UsageError, check_choice
from tactile_bayes.exports.exam import EstimateFile, MapFile, estimate_of, read_exam, shared_facts
from tactile_bayes.exports.identity import identity_of
from tactile_bayes.exports.run import FORMATS, TAKES, Outputs, refuse_untaken
from tactile_bayes.exports.run import ExportFormat as Format
from tactile_bayes.exports.run import export as exported_files
from tactile_bayes.files.atomic import sha256

_IN_PYTHON = Path("what was given in Python")
"""What messages call a map or an estimate that is in no file."""


class ExportedFiles(Record):
    """What an export wrote.

    Parameters
    ----------
    paths
        Of the files.
    notes
        What a user should know of them, such as that they name no patient.
    """

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = ()


@door
def export(
    files: Any = (),
    path: PathLike | None = None,
    *,
    to: Format,
    worklist: PathLike | None = None,
    patient_id_from_scan: bool = False,
    dictionary: PathLike | None = None,
    force: bool = False,
    **identity: str,
) -> ExportedFiles:
    """Write maps and estimates as the files that other systems take, as ``tactile-bayes export`` does.

    Parameters
    ----------
    files
        Maps, estimates and pooled sizes, or the paths of their files; one, or a list. An estimate brings its map where
        `to` is ``"dicom"``. None at all where only a dictionary is wanted.
    path
        File to write; for ``"dicom"`` the folder of the files.
    to
        ``"dicom"``, ``"fhir"``, ``"nrrd"`` (3D Slicer) or ``"csv"`` (REDCap).
    worklist
        File of a modality worklist item, or of plain keys in JSON, that says who was examined.
    patient_id_from_scan
        Use the scan's subject code as the patient ID.
    dictionary
        With ``"csv"``: also write the data dictionary of the REDCap form there.
    **identity
        patient_id, patient_name, birth_date, sex, issuer, accession, referring_physician, study_id, study_description,
        study_uid, study_date and content_date, each a text; a format refuses what it does not hold.

    Raises
    ------
    UsageError
        When files do not fit the format or each other, something that the format needs is missing, its extra is not
        installed, or a file exists and `force` is false.
    BadDataError
        When a file is damaged or of another kind.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> tb.export(tb.estimate(tb.demo_map()), "records.csv", to="csv").paths  # doctest: +SKIP
    (PosixPath('records.csv'),)
    """
    check_choice("to", to, FORMATS)
    check_keywords("export", identity, TAKES["dicom"])
    for name, value in identity.items():
        if not isinstance(value, str):
            raise UsageError(f"{name} is {value!r}; give a text")
    refuse_untaken(to, identity)
    several = listed(files)
    outputs = Outputs(path_of(path), path_of(dictionary), to=to, force=force)
    outputs.check(files=bool(several))
    exported = None
    if several:
        exported = exported_files(
            _read_all(several, to),
            to=to,
            identity=identity_of(path_of(worklist), identity),
            id_from_scan=patient_id_from_scan,
        )
    return ExportedFiles(outputs.write(exported), () if exported is None else exported.notes)


def _read_all(given: Sequence[Any], to: Format) -> list[MapFile | Sequence[EstimateFile]]:
    """What is exported of all that was given; estimates bring their maps where a report refers to them."""
    read = [_read(one) for one in given]
    if to != "dicom" or any(isinstance(one, MapFile) for one in read):
        return read
    return [*(_map_file(*one) for estimate in given for one in _maps_of(estimate)), *read]


def _read(given: Any) -> MapFile | Sequence[EstimateFile]:
    if isinstance(given, str | Path):
        return read_exam(path_of(given))
    if isinstance(given, Map):
        return _map_file(given)
    if isinstance(given, SizeEstimate | PooledSize):
        document = given.answer.document if isinstance(given, SizeEstimate) else given.document
        digests = tuple(_map_file(*one).digest for one in _maps_of(given))
        return [replace(estimate_of(document, _IN_PYTHON), maps=digests)]
    raise UsageError(f"{type(given).__name__} is nothing to export; give a map, an estimate, or the path of one")


def _maps_of(given: Any) -> list[tuple[Map, str]]:
    """The maps of an estimate, with the digests of the files that they were read from, empty for a map in none."""
    found = (given,) if isinstance(given, SizeEstimate) else given.maps if isinstance(given, PooledSize) else ()
    return [
        (Map(one.tactile_map, scans=tuple(map(dict, one.provenance.scans))), one.provenance.inputs.get("map", ""))
        for one in found
    ]


def _map_file(given: Map, digest: str = "") -> MapFile:
    """A map as an export takes it; one that is in no file has the digest of the file that `save` would write."""
    facts = shared_facts(given.scans)
    if digest or given.path is not None:
        path = given.path or _IN_PYTHON
        return MapFile(path, digest or sha256(path), given.tactile_map, facts)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.nc"
        given.save(path)
        return MapFile(_IN_PYTHON, sha256(path), given.tactile_map, facts)
