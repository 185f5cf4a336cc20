"""Estimates from Python: `estimate`, `pool`, the page of an exam, and exports of maps and estimates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tactile_bayes.api.arguments import PathLike, list_of, path_of, plain, takes
from tactile_bayes.api.estimating import Notice, estimate_file, estimate_one
from tactile_bayes.api.maps import Map, map_of
from tactile_bayes.api.pooled import PooledSize, pool_estimates
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError, check_choice, check_number
from tactile_bayes.exports.exam import EstimateFile, MapFile, merged_identity, parse_estimate, read_exam, shared_facts
from tactile_bayes.exports.run import FORMATS, Outputs, refuse_unsupported
from tactile_bayes.exports.run import ExportFormat as Format
from tactile_bayes.exports.run import export as exported_files
from tactile_bayes.files.atomic import first_duplicate, sha256
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.estimate_json import checked_report
from tactile_bayes.files.map_nc import read_map_and_scans
from tactile_bayes.files.posterior_nc import is_posterior, read_estimate
from tactile_bayes.files.provenance import scans_of
from tactile_bayes.files.reading import HDF5_MAGIC, first_bytes
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.files.size_json import read_repeatability
from tactile_bayes.options import IdentityOptions
from tactile_bayes.report.estimate_document import side_of
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import PageLabels, ShownExam, exam_map, headline
from tactile_bayes.report.pages import PageFiles

# --- One map estimate_each, and several of one mass pooled.


def settings_of(options: Mapping[str, Any]) -> Settings:
    """Make settings from keywords; the defaults are the command line's."""
    given = {name: plain(value) for name, value in options.items()}
    calibration, repeatability = given.get("size_calibration"), given.get("repeatability")
    if not (calibration is None or isinstance(calibration, str) or hasattr(calibration, "recipe")):
        given["size_calibration"] = str(path_of(calibration))
    if "known" in given:
        given["known"] = _properties(given["known"])
    if not (repeatability is None or hasattr(repeatability, "between_maps")):
        given["repeatability"] = read_repeatability(path_of(repeatability))
    if "checkpoint" in given:
        given["checkpoint"] = path_of(given["checkpoint"])
    if isinstance(given.get("centre_mm"), Sequence | np.ndarray) and not isinstance(given["centre_mm"], str):
        given["centre_mm"] = tuple(plain(one) for one in given["centre_mm"])
    return Settings(**given)


def _properties(given: Any) -> tuple[tuple[str, float], ...]:
    """Known properties of a body from a mapping, or from pairs."""
    pairs = list(given.items()) if isinstance(given, Mapping) else given
    if isinstance(pairs, str) or not isinstance(pairs, Sequence) or any(np.shape(one) != (2,) for one in pairs):
        raise UsageError(f'known is {given!r}; give a mapping such as {{"seat": 1.2}}')
    for name, value in pairs:
        check_number(f"known {name}", value)
    return tuple((str(name), plain(value)) for name, value in pairs)


@takes(Settings, without=["settings_file"])
def estimate(tactile_map: Any, *, progress: Callable[[int, int], None] | None = None, **settings: Any) -> SizeEstimate:
    """Estimate a lump's size from one map.

    Parameters
    ----------
    tactile_map
        A map, or the path of one.
    progress
        Called with effective draws done and wanted.
    **settings
        As of `tactile_bayes.api.settings.Settings`, by default as on the command line; `size_calibration` is a
        name, a path or a calibration from `calibrate_size`, `known` a mapping such as ``{"seat": 1.2}``,
        `repeatability` a path or what `calibrate_repeatability` returns.

    Returns
    -------
    SizeEstimate
        Without a number where the map shows no lump that can be measured: `why` says the reason.

    Raises
    ------
    BadDataError
        When a file is not what it must be, or the calibration does not fit the map.
    UsageError
        When settings contradict each other, or a value cannot be one.
    NotConvergedError
        When the method asked for does not converge.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> found = tb.estimate(tb.demo_map())
    >>> low, high = found.max_size_mm.interval(0.9)
    >>> bool(low < 15.0 < high)
    True
    """
    given = map_of(tactile_map)
    inputs, used = {"map": given.path}, settings_of(settings)
    found = estimate_one(given.tactile_map, used, inputs=inputs, scans=given.scans, progress=progress)
    return replace(found, name="" if given.path is None else given.path.stem)


@takes(Settings, without=["settings_file"])
def pool(maps: Iterable[Any], **settings: Any) -> PooledSize:
    """Estimate one size from several maps of one mass, whose spread is learned.

    Parameters
    ----------
    maps
        Maps, paths or estimates; each map once, in any order.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Raises
    ------
    UsageError
        When there is no map, one is given twice, or the calibration cannot pool.
    BadDataError
        As of `estimate`, and when the maps were normalised in several ways.
    """
    used = settings_of(settings)
    refuse_checkpoint(used)
    if isinstance(maps, str | Path | Map | SizeEstimate | PooledSize):
        raise UsageError("pool takes several maps; give a list")
    found = estimate_each(list_of("maps", maps, "maps, paths or estimates"), settings)
    if not found:
        raise UsageError("there is no map to pool; give at least one")
    prints = [one.tactile_map.fingerprint for one in found]
    if len(set(prints)) < len(prints):
        raise UsageError("a map is given twice; give each map once")
    names = [one.name or f"map {i}" for i, one in enumerate(found, start=1)]
    return pool_estimates(found, used, names=names)


def estimate_each(given: Iterable[Any], settings: Mapping[str, Any]) -> tuple[SizeEstimate, ...]:
    """Estimates of maps, or of their paths; those that are estimates already keep their own settings."""
    return tuple(one if isinstance(one, SizeEstimate) else estimate(one, **settings) for one in given)


def as_list(given: Any) -> list[Any]:
    """One map, estimate, pooled size or path as a list of it; a list of them as it is."""
    if isinstance(given, str | Path | Map | SizeEstimate | PooledSize):
        return [given]
    return list(list_of("files", given, "maps, estimates or paths"))


# --- The page of an exam from files: maps are estimate_each, an estimate is taken as it is, repeats are pooled.


def exam_from_files(
    paths: Sequence[Path], given: Callable[[], Settings], *, typed: Collection[str], notice: Notice | None = None
) -> ShownExam:
    """Read maps, or an estimate and its map, in any order, and put a page's exam together.

    `paths`: maps of one mass; or an estimate, best with its map: what ``estimate`` printed with ``--json`` or wrote
    with ``-o``; `given`: makes the settings, of which an estimate takes none; `typed`: those that somebody gave;
    `notice`: called with a line that a user may want to read while waiting.
    """
    if twice := first_duplicate(paths):
        raise UsageError(f"{twice} is given twice; give each file once")
    estimates = [
        path
        for path in paths
        if path.suffix.lower() == ".json" or (first_bytes(path, len(HDF5_MAGIC)) == HDF5_MAGIC and is_posterior(path))
    ]
    maps = [path for path in paths if path not in estimates]
    if len(estimates) > 1 or (estimates and len(maps) > 1):
        raise UsageError("an estimate goes with one map; several maps are estimate_each and pooled: give maps alone")
    if estimates:
        for name in typed:  # they would change nothing
            option = "--settings" if name == "settings_file" else f"--{name.replace('_', '-')}"
            raise UsageError(f"an estimate has settings of its own; leave out {option}, or give the map alone")
        return _from_estimate(estimates[0], maps[0] if maps else None)
    settings = given()
    if len(maps) > 1:
        refuse_checkpoint(settings)
    found = []
    for path in maps:
        tell = None if notice is None else lambda line, path=path: notice(f"{path}: {line}")
        found.append(estimate_file(path, settings, notice=tell))
    return exam_from_estimates(found, settings, files=maps)


def exam_from_estimates(found: Sequence[SizeEstimate], settings: Settings, *, files: Sequence[Path] = ()) -> ShownExam:
    """Exam of maps that were estimated; several are pooled."""
    if len(found) == 1:
        return found[0].exam()
    names = [f"map {number}" for number in range(1, len(found) + 1)]
    return pool_estimates(found, settings, names=names, files=files).exam()


def _from_estimate(source: Path, path: Path | None) -> ShownExam:
    """Exam of an estimate, and of its map where that is given: the estimate must name it by its digest."""
    if source.suffix.lower() == ".json":
        document = load_json(source, way_out="give what `estimate --json` printed for one map")
        report = checked_report(document, EstimateReport, path=source)
    else:
        report = read_estimate(source)
    tactile_map, scans = None, scans_of(report.provenance)
    if path is not None:
        if sha256(path) not in [one.sha256 for one in report.origin.inputs if one.role == "map"]:
            raise BadDataError(f"is not the estimate of {path}", way_out="give the map it names", path=str(source))
        tactile_map, scans = read_map_and_scans(path)
    return ShownExam((exam_map(tactile_map, report, side=side_of(scans)),), None, scans)


# --- The page of an exam from Python.


@takes(Settings, without=["settings_file"])
def exam_report(
    files: Any,
    path: PathLike,
    *,
    pdf: PathLike | None = None,
    title: str = "",
    name: str = "",
    day: str = "",
    force: bool = False,
    **settings: Any,
) -> str:
    """Write one page of an exam as HTML, as ``tactile-bayes report`` does.

    Parameters
    ----------
    files
        Maps, estimates and pooled sizes, or the paths of their files; one, or a list. Several maps are repeats of one
        mass and are pooled. A path of an estimate (JSON or posterior) goes alone, or with the path of its map.
    path
        Usually ``*.html``.
    pdf
        Also print the page there, by an installed Chromium or WeasyPrint.
    title, name, day
        To print on the page; nothing is where they are not given. The day as YEAR-MONTH-DAY.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Returns
    -------
    str
        The page's headline.

    Raises
    ------
    UsageError
        When files do not fit each other, settings are given for an estimate's file, nothing is installed that prints,
        or a file exists and `force` is false.
    BadDataError
        When a file is damaged or of another kind, or the maps are of different exams.
    """
    page, words = PageFiles(path_of(path), path_of(pdf), force), PageLabels(title, name, day)
    page.check()
    given = as_list(files)
    if not given:
        raise UsageError("nothing was given to report; give maps, or an estimate")
    exam: ShownExam
    if all(isinstance(one, str | Path) for one in given):
        exam = exam_from_files([path_of(one) for one in given], lambda: settings_of(settings), typed=settings)
    elif len(given) == 1 and isinstance(given[0], PooledSize):
        exam = given[0].exam()
    else:
        used = settings_of(settings)
        if len(given) > 1:
            refuse_checkpoint(used)
        exam = exam_from_estimates(estimate_each(given, settings), used)
    exam = replace(exam, labels=words)
    page.write(exam_page(exam))
    return headline(exam)


# --- Export of maps and estimates to the files that other systems take.

_IN_PYTHON = Path("what was given in Python")  #: What messages call a map or an estimate that is in no file.


class ExportedFiles(Record):
    """What an export wrote."""

    paths: tuple[Path, ...]  #: Of the files.
    notes: tuple[str, ...] = ()  #: What a user should know of them, such as that they name no patient.


@takes(IdentityOptions)
def export(
    files: Any = (),
    path: PathLike | None = None,
    *,
    to: Format,
    worklist: PathLike | None = None,
    patient_id_from_scan: bool = False,
    dictionary: PathLike | None = None,
    force: bool = False,
    **identity: Any,
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
    for name, value in identity.items():
        if not isinstance(value, str):
            raise UsageError(f"{name} is {value!r}; give a text")
    refuse_unsupported(to, identity)
    several = as_list(files)
    outputs = Outputs(path_of(path), path_of(dictionary), to=to, force=force)
    outputs.check(files=bool(several))
    exported, notes = dict[str, bytes](), tuple[str, ...]()
    if several:
        read = [_read(one) for one in several]
        if to == "dicom" and not any(isinstance(one, MapFile) for one in read):  # a report refers to its maps
            read = [*(_map_file(*one) for estimate in several for one in _maps_of(estimate)), *read]
        who = merged_identity(path_of(worklist), identity)
        exported, notes = exported_files(read, to=to, identity=who, id_from_scan=patient_id_from_scan)
    return ExportedFiles(outputs.write(exported), notes)


def _read(given: Any) -> MapFile | Sequence[EstimateFile]:
    if isinstance(given, str | Path):
        return read_exam(path_of(given))
    if isinstance(given, Map):
        return _map_file(given)
    if isinstance(given, SizeEstimate | PooledSize):
        document = given.answer.document if isinstance(given, SizeEstimate) else given.document
        digests = tuple(_map_file(*one).digest for one in _maps_of(given))
        return [replace(parse_estimate(document, _IN_PYTHON), maps=digests)]
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
