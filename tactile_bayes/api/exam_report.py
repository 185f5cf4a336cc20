"""The page of an exam from files: maps are estimated, an estimate is taken as it is, repeats are pooled."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final

from tactile_bayes.api.estimating import Answer, answer_of, estimate_one
from tactile_bayes.api.pooled import check_one_mass, elsewhere, pool_answers
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import given_twice, sha256
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.estimate_json import check_estimate
from tactile_bayes.files.map_nc import is_posterior, read_estimate, read_map_and_scans
from tactile_bayes.files.provenance import scans_of
from tactile_bayes.files.reading import HDF5_MAGIC, open_input
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.report.exam_words import Exam, exam_map
from tactile_bayes.report.quantities import side_of

Notice = Callable[[str], None]
Scans = Sequence[Mapping[str, str]]
_LONGEST: Final = {"title": 60, "name": 50}
_DATE: Final = re.compile(r"\d{4}-\d{2}-\d{2}", re.ASCII)


class Given(Record):
    """What was given for the page besides maps: title, name and date, empty where they were not.

    Raises
    ------
    UsageError
        When a text is too long for the page or not printable, or the day is no date.
    """

    title: str = ""
    name: str = ""
    day: str = ""

    def __post_init__(self) -> None:
        for option, longest in _LONGEST.items():
            value = getattr(self, option)
            if not isinstance(value, str):
                raise UsageError(f"{option} is {value!r}; give a text")
            if not value.isprintable() or len(value) > longest:
                what = f"{option} is of {len(value)} letters or not printable"
                raise UsageError(f"{what}; give up to {longest} letters")
        if self.day and not _is_date(str(self.day)):
            raise UsageError(f"date {str(self.day)[:40]!r} is no date; give it as YEAR-MONTH-DAY, such as 2026-03-01")


def _is_date(text: str) -> bool:
    try:
        return bool(_DATE.fullmatch(text)) and bool(date.fromisoformat(text))
    except ValueError:
        return False


class EstimatedMap(Record, eq=False):
    """A map with its answer and the scans it was made from."""

    tactile_map: TactileMap
    answer: Answer
    scans: Scans


class ExamFiles(Record):
    """Files of a page: maps, and estimates as JSON or as a posterior's file."""

    maps: tuple[Path, ...]
    estimates: tuple[Path, ...]

    @classmethod
    def sort(cls, paths: Sequence[Path]) -> ExamFiles:
        """Tell maps from estimates, in any order.

        Raises
        ------
        BadDataError
            When a file is neither.
        UsageError
            When a file is given twice, or several estimates are.
        """
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

    Parameters
    ----------
    files
        Maps of one mass; or an estimate, best with its map: what ``estimate`` printed with ``--json`` or wrote with
        ``-o``.
    notice
        Called with a line that a user may want to read while waiting.

    Raises
    ------
    BadDataError
        When a file is not what it must be, or the maps are of different exams.
    """
    maps = files.maps
    if files.estimates:
        return _from_estimate(files.estimates[0], maps[0] if maps else None, given)
    if len(maps) > 1:
        refuse_checkpoint(settings)
    found = [_estimated(path, settings, notice) for path in maps]
    if settings.centre_mm is None:
        for i, place in elsewhere([one.answer.document for one in found]).items():
            found[i] = _estimated(maps[i], replace(settings, centre_mm=place), notice)
    inputs = {f"map_{number}": path for number, path in enumerate(maps, start=1)}
    return make_exam(found, settings, given, inputs=inputs)


def make_exam(
    maps: Sequence[EstimatedMap], settings: Settings, given: Given, *, inputs: Mapping[str, Path] | None = None
) -> Exam:
    """Exam of maps that were estimated; several are pooled.

    Raises
    ------
    BadDataError
        When the maps are of different exams, or cannot be pooled.
    """
    scans = [scan for one in maps for scan in one.scans]
    check_one_mass(scans)
    pooled = None
    if len(maps) > 1:
        names = [f"map {number}" for number in range(1, len(maps) + 1)]
        answers = [one.answer for one in maps]
        pooled = pool_answers(answers, settings, names=names, inputs=inputs or {}).document
    side = side_of(scans)
    shown = tuple(exam_map(one.tactile_map, _document(one.answer), side=side) for one in maps)
    return Exam(shown, pooled, scans, title=given.title, name=given.name, day=given.day)


def _document(answer: Answer) -> dict[str, Any]:
    assert answer.document is not None
    return answer.document


def _estimated(path: Path, settings: Settings, notice: Notice | None) -> EstimatedMap:
    tactile_map, scans = read_map_and_scans(path)
    told = None if notice is None else lambda line: notice(f"{path}: {line}")
    try:
        outcome = estimate_one(tactile_map, settings, inputs={"map": path}, scans=scans, notice=told)
    except BadDataError as error:
        raise error.at(path) from None
    return EstimatedMap(tactile_map, answer_of(outcome), scans)


def _from_estimate(source: Path, path: Path | None, given: Given) -> Exam:
    """Exam of an estimate, and of its map where that is given: the estimate must name it by its digest."""
    document = _read_estimate(source)
    scans: Scans = scans_of(document["provenance"])
    tactile_map = None
    if path is not None:
        digests = [one.get("sha256") for one in document["provenance"].get("inputs", []) if one.get("role") == "map"]
        if sha256(path) not in digests:
            raise BadDataError(f"is not the estimate of {path}", way_out="give the map it names", path=str(source))
        tactile_map, scans = read_map_and_scans(path)
    shown = exam_map(tactile_map, document, side=side_of(scans))
    return Exam((shown,), None, scans, title=given.title, name=given.name, day=given.day)


def _read_estimate(source: Path) -> dict[str, Any]:
    """An estimate's JSON object, from its JSON or its posterior's file."""
    if not _is_json(source):
        return read_estimate(source)
    document: Any = load_json(source, way_out="give what `estimate --json` printed for one map")
    check_estimate(document, "estimate.schema.json", path=source)
    found: dict[str, Any] = document
    return found
