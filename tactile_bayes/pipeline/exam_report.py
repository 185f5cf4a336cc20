"""The page of an exam from files: maps are estimated, an estimate's JSON is taken as it is, repeats are pooled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.pipeline.one_map import Answer, answer_of, estimate_one
from tactile_bayes.pipeline.pooled import pool_answers
from tactile_bayes.pipeline.settings import Settings
from tactile_bayes.records import dataclass
from tactile_bayes.report.exam import Exam, exam_map
from tactile_bayes.report.lump_place import side_of

Notice = Callable[[str], None]
Scans = Sequence[Mapping[str, str]]
SHARED: Final = ("subject", "side", "mass")
"""Facts in which the maps of one page must not differ."""


@dataclass(frozen=True, slots=True)
class Given:
    """What was given for the page besides maps: title, name and date, empty where they were not."""

    title: str = ""
    name: str = ""
    day: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class EstimatedMap:
    """A map with its answer and the scans it was made from."""

    tactile_map: TactileMap
    answer: Answer
    scans: Scans


def read_exam(paths: Sequence[Path], settings: Settings, given: Given, *, notice: Notice | None = None) -> Exam:
    """Read maps, or one map and the JSON of its estimate, and put a page's exam together.

    Parameters
    ----------
    paths
        Maps of one mass; or one map and what ``estimate --json`` printed for it, in any order.
    notice
        Called with a line that a user may want to read while waiting.

    Raises
    ------
    BadDataError
        When a file is not what it must be, or the maps are of different exams.
    UsageError
        When a file is given twice, no map is given, or a JSON goes with none of them.
    """
    maps = [path for path in paths if path.suffix.lower() != ".json"]
    documents = [path for path in paths if path.suffix.lower() == ".json"]
    twice = [path for index, path in enumerate(paths) if path in paths[:index]]
    if twice:
        raise UsageError(f"{twice[0]} is given twice; give each file once")
    if not maps:
        raise UsageError(f"{documents[0]} is an estimate's JSON; give its map, too")
    if documents:
        return _from_document(maps, documents, given)
    found = [_estimated(path, settings, notice) for path in maps]
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
    _check_one_exam(scans)
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
    from tactile_bayes.files.map_nc import read_map_and_scans

    tactile_map, scans = read_map_and_scans(path)
    told = None if notice is None else lambda line: notice(f"{path}: {line}")
    try:
        outcome = estimate_one(tactile_map, settings, inputs={"map": path}, scans=scans, notice=told)
    except BadDataError as error:
        raise error.at(path) from None
    return EstimatedMap(tactile_map, answer_of(outcome), scans)


def _from_document(maps: Sequence[Path], documents: Sequence[Path], given: Given) -> Exam:
    """Exam of one map and its estimate's JSON, which must name the map by its digest."""
    from tactile_bayes.files.atomic import sha256
    from tactile_bayes.files.documents import load_json
    from tactile_bayes.files.map_nc import read_map_and_scans
    from tactile_bayes.files.schema import check_document

    if len(maps) > 1 or len(documents) > 1:
        raise UsageError("an estimate's JSON goes with one map; several maps are estimated and pooled: give maps alone")
    (path,), (source,) = maps, documents
    document: Any = load_json(source, way_out="give what `estimate --json` printed for one map")
    check_document(document, "estimate.schema.json", path=source)
    digests = [one.get("sha256") for one in document["provenance"].get("inputs", []) if one.get("role") == "map"]
    if sha256(path) not in digests:
        raise BadDataError(f"is not the estimate of {path}", way_out="give the map it names", path=str(source))
    tactile_map, scans = read_map_and_scans(path)
    shown = exam_map(tactile_map, document, side=side_of(scans))
    return Exam((shown,), None, scans, title=given.title, name=given.name, day=given.day)


def _check_one_exam(scans: Scans) -> None:
    for name in SHARED:
        values = sorted({scan[name] for scan in scans if scan.get(name)})
        if len(values) > 1:
            raise BadDataError(
                f"the maps differ in {name} ({', '.join(values)})",
                way_out="give the maps of one mass; make a page for each other exam",
            )
