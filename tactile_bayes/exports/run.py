"""Exports: inputs and options are checked, then the files written; and maps for 3D Slicer."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, names_of, replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.exports import exam
from tactile_bayes.exports.dicom import VALUES, dicom_files
from tactile_bayes.exports.fhir import bundle_json
from tactile_bayes.exports.redcap import dictionary_csv, records_csv
from tactile_bayes.files.atomic import Format, check_suffix, refuse_existing, same_file, unwritable, write_all
from tactile_bayes.findings import finding_lines
from tactile_bayes.presets import RESEARCH_USE, ExportFormat

# --- Maps as NRRD, the format of 3D Slicer: one slice in the patient's frame.


def nrrd_bytes(source: exam.MapFile) -> bytes:
    """A map as the bytes of a NRRD file: float32 values (nx, ny, 1), NaN where there are none.

    The axes are the plane's, in ``left-posterior-superior`` and mm; the slice is as thick as a cell is wide.
    """
    nrrd = exam.import_extra("nrrd")
    one = source.tactile_map
    transform = exam.lps_from_plane(one)
    if transform is None:
        fault = "has no landmarks, so its place in the patient is not known"
        way_out = "3D Slicer takes maps of scans in which sternal notch and xiphoid were touched"
        raise BadDataError(fault, way_out=way_out, path=str(source.path))
    values = np.where(one.covered, one.mean, np.nan).T[:, :, None].astype("<f4")
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "kinds": ["domain", "domain", "domain"],
        "space units": ["mm", "mm", "mm"],
        "space directions": transform[:3, :3].T * one.recipe.cell_mm,
        "space origin": exam.lps_point(transform, (float(one.x_mm[0]), float(one.y_mm[0]))),
        "encoding": "gzip",
        "content": "tactile map",
        "tactile_bayes_values": one.recipe.value_words.encode("ascii", "replace").decode(),
        "tactile_bayes_map_sha256": source.digest,
        "tactile_bayes_findings": " ".join(finding_lines(one.findings, paper=True)).encode("ascii", "replace").decode(),
        "tactile_bayes_research_use": RESEARCH_USE,
    }
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the library asks for the time in an old way
        nrrd.write(buffer, values, header, index_order="F", compression_level=9)
    head, _, data = buffer.getvalue().partition(b"\n\n")
    lines = [line for line in head.split(b"\n") if not line.startswith(b"#")]  # one has the time of day
    return b"\n".join(lines) + b"\n\n" + data


# --- Writing the files of an export: one file, or a folder of its own.

_SINGLE_FILES: Final[dict[str, Format]] = {"csv": "CSV", "fhir": "JSON", "nrrd": "NRRD"}
"""Formats of exports that are one file."""


class Outputs(Record):
    """Files that an export writes."""

    path: Path | None  #: File, or the folder of several; None where only a dictionary is wanted.
    dictionary: Path | None = None  #: File of the data dictionary of REDCap's form; None for none.
    to: str = "csv"  #: Format of the export.
    force: bool = False  #: Overwrite files.

    def check(self, *, files: bool) -> None:
        """Refuse, before any work is done, files that could not be written; `files` is true if anything is exported."""
        if files and self.path is None:
            raise UsageError("there is nowhere to write to; give the path (-o OUT)")
        if not files and (self.dictionary is None or self.path is not None):
            where = "" if self.dictionary is None else f" to {self.path}"
            raise UsageError(f"no file was given to export{where}; give a map, an estimate or both")
        if self.dictionary is not None and self.to != "csv":
            raise UsageError("--dictionary is REDCap's; give it with --to csv")
        if self.to == "dicom" and self.path is not None and self.path.suffix.lower() == ".dcm":
            raise UsageError(f"{self.path} is to be a folder of several files; leave out the ending .dcm")
        if self.path is not None and self.dictionary is not None and same_file(self.path, self.dictionary):
            raise UsageError(f"{self.path} is to hold records and dictionary; choose another name for one of them")
        for path, written in ((self.dictionary, "CSV"), (self.path, _SINGLE_FILES.get(self.to))):
            if path is not None and written is not None:
                check_suffix(path, written)
                refuse_existing(path, force=self.force)

    def write(self, exported: Mapping[str, bytes]) -> tuple[Path, ...]:
        """Write the files of the export, as `export` names them, and the dictionary: all of them, or none."""
        paths, folder = dict[Path, bytes](), None
        if exported and self.path is not None:
            if "" not in exported:
                folder = _make_folder(self.path, set(exported))
            paths = {self.path / name if name else self.path: data for name, data in exported.items()}
        if self.dictionary is not None:
            paths[self.dictionary] = dictionary_csv().encode()
        try:
            write_all(paths, force=self.force)
        except UsageError:
            if folder is not None:
                folder.rmdir()
            raise
        return tuple(paths)


def _make_folder(folder: Path, names: set[str]) -> Path | None:
    """Make the folder, and return it if it is new; one with files of another export is refused."""
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
    return folder if new else None


# --- One call for every export: inputs are recognised by their content, and one line says which does not fit.

IDENTITY_FIELDS: Final[dict[ExportFormat, tuple[str, ...]]] = {
    "dicom": names_of(exam.Identity),
    "fhir": ("patient_id", "patient_name", "birth_date", "sex", "issuer", "accession", "study_date"),
    "nrrd": (),
    "csv": ("patient_id", "study_date"),
}
"""Parts of an identity that each format holds."""
Exported = tuple[dict[str, bytes], tuple[str, ...]]
"""Bytes by file name, for a folder, or by the empty name, for one file; and remarks for the user."""


def refuse_unsupported(to: ExportFormat, options: Iterable[str]) -> None:
    """Refuse parts of an identity that a format does not hold, rather than drop them."""
    for name in options:
        if name not in IDENTITY_FIELDS[to]:
            held = ", ".join(_option(field) for field in IDENTITY_FIELDS[to]) or "nothing of a patient or study"
            raise UsageError(f"{_option(name)} has no place in {to} files; they hold {held}")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def export(
    files: Sequence[exam.MapFile | Sequence[exam.EstimateFile]],
    *,
    to: ExportFormat,
    identity: exam.Identity,
    id_from_scan: bool,
) -> Exported:
    """Export maps and estimates.

    `files` are as `read_exam` returns them for maps, estimates (JSON) and posteriors, in any order. Parts of the
    `identity` that the format does not hold are left out. With `id_from_scan` the scans' subject code is the patient ID
    where none is given.
    """
    maps = [file for file in files if isinstance(file, exam.MapFile)]
    estimates = [one for several in files if not isinstance(several, exam.MapFile) for one in several]
    path_of = dict[str, Path]()
    inputs: list[exam.MapFile | exam.EstimateFile] = [*maps, *estimates]
    for one in inputs:
        if one.digest in path_of:
            other = path_of[one.digest]
            fault = "is given twice" if other == one.path else f"holds what {other} holds"
            raise UsageError(f"{one.path} {fault}; give each once")
        path_of[one.digest] = one.path
    of_maps = dict[frozenset[str], Path]()
    for estimate in estimates:
        if estimate.maps and (other := of_maps.setdefault(frozenset(estimate.maps), estimate.path)) != estimate.path:
            raise UsageError(f"{other} and {estimate.path} are estimates of one exam; give one of them")
    exam.check_pairs(maps, estimates)
    identity = replace(identity, **{name: "" for name in identity.given if name not in IDENTITY_FIELDS[to]})
    if to == "nrrd":
        if id_from_scan:
            raise UsageError("nrrd files hold no patient; leave out --patient-id-from-scan")
        if estimates:
            raise UsageError(f"nrrd files hold a map; {estimates[0].path} is none")
        if len(maps) > 1:
            raise UsageError("a nrrd file holds one map; give one")
        return {"": nrrd_bytes(maps[0])}, ()
    if to == "csv":
        _refuse_maps(maps, estimates, to)
        return {"": records_csv(estimates, identity, id_from_scan=id_from_scan).encode()}, ()
    if id_from_scan and not identity.patient_id:
        subjects = {one.facts.get("subject", "") for one in inputs}
        if len(subjects) != 1 or "" in subjects:
            way_out = "give --patient-id instead of --patient-id-from-scan"
            raise UsageError(f"the scans name no subject, or several; {way_out}")
        identity = replace(identity, patient_id=subjects.pop())
    no_patient = "the patient ID is empty; --patient-id, --worklist or --patient-id-from-scan gives one"
    notes = [] if identity.patient_id else [no_patient]
    if " " in identity.patient_name and "^" not in identity.patient_name:
        notes.append(f"{identity.patient_name!r} is written as a family name; give FAMILY^GIVEN where it is not")
    if to == "fhir" and identity.study is not None and identity.study.time and not identity.study.zone:
        notes.append("FHIR takes a time of day only with its zone, so the date stands alone; give +HH:MM with the time")
    if to == "dicom":
        written, remarks = _dicom(maps, estimates, identity)
        return written, (*notes, *remarks)
    _refuse_maps(maps, estimates, to)
    return {"": bundle_json(_one_estimate(estimates, to), identity).encode()}, tuple(notes)


def _one_estimate(estimates: Sequence[exam.EstimateFile], to: ExportFormat) -> exam.EstimateFile:
    if len(estimates) > 1:
        where = f"{estimates[0].path} holds" if len({one.path for one in estimates}) == 1 else "the files hold"
        raise UsageError(f"{where} {len(estimates)} estimates; {to} takes one exam at a time (csv takes several)")
    return estimates[0]


def _dicom(maps: Sequence[exam.MapFile], estimates: Sequence[exam.EstimateFile], identity: exam.Identity) -> Exported:
    if not maps:
        raise UsageError(f"a DICOM report refers to its map; give it too: export MAP.nc {estimates[0].path} --to dicom")
    estimate = _one_estimate(estimates, "dicom") if estimates else None
    if estimate is None and len(maps) > 1:
        raise UsageError("several maps without an estimate may be of several exams; give one map, or their pooled size")
    files, notes = dicom_files(maps, estimate, identity=identity), list[str]()
    if estimate is None:
        one = maps[0].path
        notes.append(f"no estimate was given, so there is no report; `tactile-bayes estimate {one} --json` makes one")
    if not any(name.startswith(VALUES) for name in files):
        why = "no landmarks" if maps[0].tactile_map.patient_from_plane is None else "no posture of a person"
        notes.append(f"the map has {why}, so its values have no place in a patient: there is its picture only")
    return files, tuple(notes)


def _refuse_maps(maps: Sequence[exam.MapFile], estimates: Sequence[exam.EstimateFile], to: ExportFormat) -> None:
    if maps and not estimates:
        one = maps[0].path
        way_out = f"give what `tactile-bayes estimate {one} --json` prints"
        raise UsageError(f"{to} files hold sizes, and {one} is a map; {way_out}")
    if maps:
        raise UsageError(f"{to} files hold no map; leave out {maps[0].path}")
