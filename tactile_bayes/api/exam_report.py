"""The page of an exam from files: maps are estimated, an estimate is taken as it is, repeats are pooled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactile_bayes.api.arguments import door
from tactile_bayes.api.estimates import estimated, listed, settings_of
from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.maps import PathLike, path_of
from tactile_bayes.api.pooled import PooledSize, pool_estimates
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import given_twice, sha256
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.estimate_json import checked_report
from tactile_bayes.files.map_nc import is_posterior, read_estimate, read_map_and_scans
from tactile_bayes.files.provenance import scans_of
from tactile_bayes.files.reading import HDF5_MAGIC, open_input
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.report.exam_page import PageFiles
from tactile_bayes.report.exam_words import Exam, Given, exam_map, headline
from tactile_bayes.report.quantities import side_of

Notice = Callable[[str], None]
Scans = Sequence[Mapping[str, str]]


class ExamFiles(Record):
    """Files of a page: maps, and estimates as JSON or as a posterior's file."""

    maps: tuple[Path, ...]
    estimates: tuple[Path, ...]

    @classmethod
    def sort(cls, paths: Sequence[Path]) -> ExamFiles:
        """Tell maps from estimates, in any order."""
        if twice := given_twice(paths):
            raise UsageError(f"{twice} is given twice; give each file once")
        estimates = tuple(path for path in paths if _is_json(path) or _is_posterior(path))
        maps = tuple(path for path in paths if path not in estimates)
        if len(estimates) > 1 or (estimates and len(maps) > 1):
            raise UsageError("an estimate goes with one map; several maps are estimated and pooled: give maps alone")
        return cls(maps, estimates)


def _is_json(path: Path) -> bool:
    return path.suffix.lower() == ".json"


def _is_posterior(path: Path) -> bool:
    with open_input(path) as file:
        netcdf = file.read(len(HDF5_MAGIC)) == HDF5_MAGIC
    return netcdf and is_posterior(path)


def read_exam(files: ExamFiles, settings: Settings, given: Given, *, notice: Notice | None = None) -> Exam:
    """Read maps, or an estimate and its map, and put a page's exam together.

    `files`: maps of one mass; or an estimate, best with its map: what ``estimate`` printed with ``--json`` or wrote
    with ``-o``; `notice`: called with a line that a user may want to read while waiting.
    """
    maps = files.maps
    if files.estimates:
        return _from_estimate(files.estimates[0], maps[0] if maps else None, given)
    if len(maps) > 1:
        refuse_checkpoint(settings)
    found = [_estimated(path, settings, notice) for path in maps]
    inputs = {f"map_{number}": path for number, path in enumerate(maps, start=1)}
    return exam_of(found, settings, given, inputs=inputs)


def exam_of(
    found: Sequence[SizeEstimate], settings: Settings, given: Given, *, inputs: Mapping[str, Path] | None = None
) -> Exam:
    """Exam of maps that were estimated; several are pooled."""
    if len(found) == 1:
        return given.on(found[0].exam())
    names = [f"map {number}" for number in range(1, len(found) + 1)]
    return given.on(pool_estimates(found, settings, names=names, inputs=inputs or {}).exam())


def _estimated(path: Path, settings: Settings, notice: Notice | None) -> SizeEstimate:
    return estimate_file(path, settings, notice=None if notice is None else lambda line: notice(f"{path}: {line}"))


def _from_estimate(source: Path, path: Path | None, given: Given) -> Exam:
    """Exam of an estimate, and of its map where that is given: the estimate must name it by its digest."""
    report = _read_estimate(source)
    scans: Scans = scans_of(report.provenance)
    tactile_map = None
    if path is not None:
        if sha256(path) not in [one.sha256 for one in report.origin.inputs if one.role == "map"]:
            raise BadDataError(f"is not the estimate of {path}", way_out="give the map it names", path=str(source))
        tactile_map, scans = read_map_and_scans(path)
    shown = exam_map(tactile_map, report, side=side_of(scans))
    return given.on(Exam((shown,), None, scans))


def _read_estimate(source: Path) -> EstimateReport:
    """An estimate, from its JSON or its posterior's file."""
    if not _is_json(source):
        return read_estimate(source)
    document = load_json(source, way_out="give what `estimate --json` printed for one map")
    return checked_report(document, EstimateReport, path=source)


# --- The page of an exam from Python.


@door
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
    page = PageFiles(path_of(path), path_of(pdf), force)
    page.check()
    given = listed(files)
    if not given:
        raise UsageError("nothing was given to report; give maps, or an estimate")
    exam = _exam(given, Given(title, name, day), settings)
    page.write(exam)
    return headline(exam)


def _exam(given: Sequence[Any], words: Given, settings: dict[str, Any]) -> Exam:
    """The exam of files alone, or of what Python holds."""
    if all(isinstance(one, str | Path) for one in given):
        files = ExamFiles.sort([path_of(one) for one in given])
        if files.estimates and settings:
            raise UsageError(f"an estimate has settings of its own; leave out {next(iter(settings))}, or give the map")
        return read_exam(files, settings_of(settings), words)
    if len(given) == 1 and isinstance(given[0], PooledSize):
        return words.on(given[0].exam())
    used = settings_of(settings)
    if len(given) > 1:
        refuse_checkpoint(used)
    return exam_of(estimated(given, settings), used, words)
