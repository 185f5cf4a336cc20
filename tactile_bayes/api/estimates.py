"""Estimates from Python: `estimate`, `pool`, the page of an exam, and exports of maps and estimates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

from tactile_bayes.api.arguments import PathLike, list_of, output_path, path_of, plain, takes
from tactile_bayes.api.estimating import Notice, estimate_file, estimate_one
from tactile_bayes.api.maps import Map, map_of
from tactile_bayes.api.pooled import PooledSize, pool_estimates, refuse_repeated_maps
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError, check_choice, check_number
from tactile_bayes.exports.exam import EstimateFile, MapFile, merged_identity, parse_estimate, read_exam, shared_facts
from tactile_bayes.exports.run import Outputs, refuse_unsupported
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
from tactile_bayes.findings import counted, finding_lines
from tactile_bayes.options import IdentityOptions
from tactile_bayes.presets import ExportFormat
from tactile_bayes.report.estimate_document import side_of
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import PageLabels, ShownExam, exam_map, headline
from tactile_bayes.report.pages import PageFiles

# --- One map estimated, and several of one mass pooled.


def settings_of(options: Mapping[str, Any]) -> Settings:
    """Make settings from keywords, with the command line's defaults."""
    values = dict(options)
    calibration, repeatability = values.get("size_calibration"), values.get("repeatability")
    if not (calibration is None or isinstance(calibration, str) or hasattr(calibration, "recipe")):
        values["size_calibration"] = str(path_of(calibration))
    if "known" in values:
        values["known"] = _properties(values["known"])
    if not (repeatability is None or hasattr(repeatability, "between_maps")):
        values["repeatability"] = read_repeatability(path_of(repeatability))
    if "checkpoint" in values:
        values["checkpoint"] = path_of(values["checkpoint"])
    if isinstance(values.get("centre_mm"), list):
        values["centre_mm"] = tuple(values["centre_mm"])
    return Settings(**values)


def _properties(known: Any) -> tuple[tuple[str, float], ...]:
    """Known properties of a body from a mapping, or from pairs."""
    pairs = list(known.items()) if isinstance(known, Mapping) else known
    if (
        isinstance(pairs, str)
        or not isinstance(pairs, Sequence)
        or not all(isinstance(pair, Sequence) and len(pair) == 2 for pair in pairs)
    ):
        raise UsageError(f'known is {known!r}; give a mapping such as {{"seat": 1.2}}')
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
        Called with the numbers of effective draws done and required.
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
        When a file is damaged or of another kind, or the calibration does not fit the map.
    UsageError
        When settings contradict each other, or a value is out of range.
    NotConvergedError
        When the method asked for does not converge.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> estimate = tb.estimate(tb.demo_map())
    >>> low, high = estimate.max_size_mm.interval(0.9)
    >>> bool(low < 15.0 < high)
    True
    """
    source = map_of(tactile_map)
    inputs, own_settings = {"map": source.path}, settings_of(settings)
    result = estimate_one(source.tactile_map, own_settings, inputs=inputs, scans=source.scans, progress=progress)
    return replace(result, name="" if source.path is None else source.path.stem)


@takes(Settings, without=["settings_file"])
def pool(maps: Iterable[Any], **settings: Any) -> PooledSize:
    """Estimate one size from several maps of one mass, whose spread is learned.

    Parameters
    ----------
    maps
        Maps, paths or estimates; each map once, in any order.
    **settings
        As of `estimate`; estimates keep their own.

    Raises
    ------
    UsageError
        When there is no map, one is given twice, or the calibration cannot pool.
    BadDataError
        As of `estimate`, and when the maps were normalised in several ways.
    """
    own_settings = settings_of(settings)
    refuse_checkpoint(own_settings)
    if isinstance(maps, str | Path | Map | SizeEstimate | PooledSize):
        raise UsageError("pool takes several maps; give a list")
    estimates = estimate_each(list_of("maps", maps, "maps, paths or estimates"), settings)
    if not estimates:
        raise UsageError("there is no map to pool; give at least one")
    refuse_repeated_maps(estimates)
    names = [one.name or f"map {i}" for i, one in enumerate(estimates, start=1)]
    return pool_estimates(estimates, own_settings, names=names)


def estimate_each(maps: Iterable[Any], settings: Mapping[str, Any]) -> tuple[SizeEstimate, ...]:
    """Estimate maps or paths of maps; estimates are returned as they are."""
    return tuple(one if isinstance(one, SizeEstimate) else estimate(one, **settings) for one in maps)


def as_list(files: Any) -> list[Any]:
    """Return a list of maps, estimates, pooled sizes or paths, also from a single one."""
    if isinstance(files, str | Path | Map | SizeEstimate | PooledSize):
        return [files]
    return list(list_of("files", files, "maps, estimates or paths"))


# --- The page of an exam from files: maps are estimated, an estimate is taken as it is, repeats are pooled.


def exam_from_files(
    paths: Sequence[Path],
    make_settings: Callable[[], Settings],
    *,
    typed: Collection[str],
    notice: Notice | None = None,
) -> ShownExam:
    """Make the exam of a page from the files of maps, or of an estimate and its map, in any order.

    `paths`: maps of one mass; or an estimate, best with its map: what ``estimate`` printed with ``--json`` or wrote
    with ``-o``; `make_settings`: makes the settings, of which an estimate takes none; `typed`: names of those that
    were typed; `notice`: called with a line that a user may want to read while waiting.
    """
    if twice := first_duplicate(paths):
        raise UsageError(f"{twice} is given twice; give each file once")
    estimate_paths = [
        path
        for path in paths
        if path.suffix.lower() == ".json" or (first_bytes(path, len(HDF5_MAGIC)) == HDF5_MAGIC and is_posterior(path))
    ]
    map_paths = [path for path in paths if path not in estimate_paths]
    if len(estimate_paths) > 1 or (estimate_paths and len(map_paths) > 1):
        raise UsageError("an estimate goes with one map; several maps are estimated and pooled: give maps alone")
    if estimate_paths:
        for name in typed:  # they would change nothing
            option = "--settings" if name == "settings_file" else f"--{name.replace('_', '-')}"
            raise UsageError(f"an estimate has settings of its own; leave out {option}, or give the map alone")
        return _from_estimate(estimate_paths[0], map_paths[0] if map_paths else None)
    settings = make_settings()
    if len(map_paths) > 1:
        refuse_checkpoint(settings)
    estimates = []
    for path in map_paths:
        map_notice = None if notice is None else lambda line, path=path: notice(f"{path}: {line}")
        estimates.append(estimate_file(path, settings, notice=map_notice))
    return exam_from_estimates(estimates, settings, files=map_paths)


def exam_from_estimates(
    estimates: Sequence[SizeEstimate], settings: Settings, *, files: Sequence[Path] = ()
) -> ShownExam:
    """Make the exam of a page from the estimates of its maps; several are pooled."""
    if len(estimates) == 1:
        return estimates[0].exam()
    names = [f"map {number}" for number in range(1, len(estimates) + 1)]
    return pool_estimates(estimates, settings, names=names, files=files).exam()


def _from_estimate(estimate_path: Path, map_path: Path | None) -> ShownExam:
    """Make the exam of a page from an estimate's file, and its map's, whose digest the estimate must name."""
    if estimate_path.suffix.lower() == ".json":
        document = load_json(estimate_path, way_out="give what `estimate --json` printed for one map")
        if isinstance(document, list):
            fault = f"holds {counted(len(document), 'estimate')} in a list, and a page takes one"
            raise BadDataError(fault, way_out="give the maps: they are pooled if of one mass", path=str(estimate_path))
        report = checked_report(document, EstimateReport, path=estimate_path)
    else:
        report = read_estimate(estimate_path)
    tactile_map, scans = None, scans_of(report.provenance)
    if map_path is not None:
        if sha256(map_path) not in [one.sha256 for one in report.origin.inputs if one.role == "map"]:
            raise BadDataError(
                f"is not the estimate of {map_path}", way_out="give the map it names", path=str(estimate_path)
            )
        tactile_map, scans = read_map_and_scans(map_path)
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
        To print on the page; empty ones are left out. The day as YEAR-MONTH-DAY.
    **settings
        As of `estimate`; estimates keep their own.

    Returns
    -------
    str
        The page's headline, below its cautions.

    Raises
    ------
    UsageError
        When files do not fit each other, settings are given for an estimate's file, nothing is installed that prints,
        or a file exists and `force` is false.
    BadDataError
        When a file is damaged or of another kind, or the maps are of different exams.
    """
    page, labels = PageFiles(output_path(path, "HTML"), path_of(pdf), force), PageLabels(title, name, day)
    sources = as_list(files)
    if not sources:
        raise UsageError("nothing was given to report; give maps, or an estimate")
    exam: ShownExam
    if all(isinstance(source, str | Path) for source in sources):
        exam = exam_from_files([path_of(one) for one in sources], lambda: settings_of(settings), typed=settings)
    elif len(sources) == 1 and isinstance(sources[0], PooledSize):
        exam = sources[0].exam()
    else:
        own_settings = settings_of(settings)
        if len(sources) > 1:
            refuse_checkpoint(own_settings)
        estimates = estimate_each(sources, settings)
        refuse_repeated_maps(estimates)
        exam = exam_from_estimates(estimates, own_settings)
    exam = replace(exam, labels=labels)
    page.write(exam_page(exam))
    return "\n".join([*finding_lines(exam.report.findings, "caution", paper=True), headline(exam)])


# --- Export of maps and estimates to the files that other systems take.


class ExportedFiles(Record):
    """Paths and notes of an export."""

    paths: tuple[Path, ...]  #: Of the files.
    notes: tuple[str, ...] = ()  #: Remarks on them, such as that they name no patient.


@takes(IdentityOptions)
def export(
    files: Any = (),
    path: PathLike | None = None,
    *,
    to: ExportFormat,
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
        `to` is ``"dicom"``. None where only a dictionary is to be written.
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
        As of `tactile_bayes.options.IdentityOptions`, each a text; a format refuses what it does not hold.

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
    check_choice("to", to, get_args(ExportFormat))
    for name, value in identity.items():
        if not isinstance(value, str):
            raise UsageError(f"{name} is {value!r}; give a text")
    refuse_unsupported(to, identity)
    sources = [] if files is None else as_list(files)
    if to in ("fhir", "csv") and any(isinstance(one, Map) for one in sources):
        raise UsageError(f"{to} files hold sizes, and a map has none; give its estimate alone")
    outputs = Outputs(path_of(path), path_of(dictionary), to=to, force=force)
    outputs.check(files=bool(sources))
    exported, notes = dict[str, bytes](), tuple[str, ...]()
    if sources:
        named = [(Path(f"item {i}"), source) for i, source in enumerate(sources, start=1)]  # for error messages
        records = [_export_records(source, name) for name, source in named]
        if to == "dicom" and not any(isinstance(record, MapFile) for record in records):  # a report refers to its maps
            records = [
                *(_map_file(one, name, digest) for name, source in named for one, digest in _maps_of(source)),
                *records,
            ]
        patient = merged_identity(path_of(worklist), identity)
        exported, notes = exported_files(records, to=to, identity=patient, id_from_scan=patient_id_from_scan)
    return ExportedFiles(outputs.write(exported), notes)


def _export_records(source: Any, name: Path) -> MapFile | Sequence[EstimateFile]:
    """Convert a map, an estimate or the path of one to what the formats write; `name` stands for its path."""
    if isinstance(source, str | Path):
        return read_exam(path_of(source))
    if isinstance(source, Map):
        return _map_file(source, name)
    if isinstance(source, SizeEstimate | PooledSize):
        document = source.answer.document if isinstance(source, SizeEstimate) else source.document
        digests = tuple(_map_file(one, name, digest).digest for one, digest in _maps_of(source))
        return [replace(parse_estimate(document, name), maps=digests)]
    raise UsageError(f"{type(source).__name__} is nothing to export; give a map, an estimate, or the path of one")


def _maps_of(source: Any) -> list[tuple[Map, str]]:
    """Maps of an estimate with the digests of their files; empty for a map that was in none."""
    estimates = (source,) if isinstance(source, SizeEstimate) else source.maps if isinstance(source, PooledSize) else ()
    return [
        (Map(one.tactile_map, scans=tuple(map(dict, one.provenance.scans))), one.provenance.inputs.get("map", ""))
        for one in estimates
    ]


def _map_file(source: Map, name: Path, digest: str = "") -> MapFile:
    """Convert a map for export; one that is in no file gets the digest of the file that `save` would write."""
    facts = shared_facts(source.scans)
    if digest or source.path is not None:
        path = source.path or name
        return MapFile(path, digest or sha256(path), source.tactile_map, facts)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.nc"
        source.save(path)
        return MapFile(name, sha256(path), source.tactile_map, facts)
