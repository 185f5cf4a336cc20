"""The exams of a folder: their files, a first table of them, their masses and visits."""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.errors import Abstention, BadDataError, UsageError
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.manifest_csv import JOURNAL, SAME_IN_SCANS, Exam, natural_key
from tactile_bayes.files.map_nc import read_map, read_map_and_scans
from tactile_bayes.files.named_arrays import read_named
from tactile_bayes.files.reading import check_address, downloaded, files_below, is_address
from tactile_bayes.files.reports import Place
from tactile_bayes.files.scan_mcap import provenance_of, scan_records
from tactile_bayes.findings import Finding, finding
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import on_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.verdict import no_verdict
from tactile_bayes.trial.readings import day_of, visits_in_order

# --- Facts of an exam in its file: those of the session, and the files that it was made from.

ARRAYS: Final = (".npz", ".mat", ".h5", ".hdf5")  #: Of files that hold all arrays of a scan.
SCANS: Final = (".mcap", *ARRAYS)
MAP: Final = ".nc"
_ENDINGS: Final = (*SCANS, MAP)


class FileFacts(Record):
    """Facts of an exam that its file holds."""

    facts: Mapping[str, str] = field(default_factory=dict)  #: By the columns of the table of exams.
    sources: frozenset[str] = frozenset()  #: SHA-256 of the files that it was made from.


# --- Facts of an exam in its file's name, by a pattern such as ``{patient}_{visit}_{exam}.npz``.

_NAMED: Final = ("patient", "visit", "mass", "exam", "side", "reader", "date")
_SIDES: Final = {"l": "left", "r": "right", "left": "left", "right": "right"}


class NamePattern:
    """A pattern of file names; with a ``/`` in it of the last folders too, without an ending of any file's.

    A word in braces is one of `_NAMED` and stands for letters without those that part it from its neighbours; ``*``
    stands for anything within a name.
    """

    def __init__(self, pattern: str) -> None:
        self.pattern = pattern
        words = re.findall(r"\{(.*?)\}", pattern)
        unknown = [word for word in words if word not in _NAMED]
        stray = re.search(r"[{}]", re.sub(r"\{\w+\}", "", pattern))
        if unknown or stray or not words or len(set(words)) < len(words):
            known = ", ".join(f"{{{name}}}" for name in _NAMED)
            raise UsageError(f"{pattern!r} is no pattern of names; write each of {known} at most once, and one of them")
        if touching := re.search(r"\}(\{|\*)|\*\{", pattern):
            raise UsageError(f"{pattern!r} has nothing between two words ({touching[0]}); say what parts them")
        self._parts = 1 + pattern.count("/")
        self._with_ending = pattern.lower().endswith((*_ENDINGS, ".*"))
        parts = re.split(r"(\{\w+\}|\*)", pattern)
        self._names = re.compile("".join(map(self._part, ["", *parts], parts, [*parts[1:], ""])))

    def _part(self, before: str, part: str, following: str) -> str:
        if part == "{date}":
            return r"(?P<date>\d{4}-\d\d-\d\d|\d{8})"
        if part.startswith("{"):
            return f"(?P<{part[1:-1]}>[^/{re.escape(before[-1:] + following[:1])}]+)"
        return "[^/]*" if part == "*" else re.escape(part)

    def facts(self, name: str) -> dict[str, str]:
        """Facts in a file's name, by the columns of the table; a name that does not follow the pattern is refused."""
        folders = name.replace(os.sep, "/").split("/")
        tail = "/".join(folders[-self._parts :])
        match = self._names.fullmatch(tail if self._with_ending else tail.rpartition(".")[0])
        if match is None:
            raise BadDataError(f"its name does not follow {self.pattern}")
        facts = match.groupdict()
        if "side" in facts:
            facts["side"] = _SIDES.get(facts["side"].lower(), "")
            if not facts["side"]:
                raise BadDataError(f"its name has {match['side']!r} for the side; name it left, right, L or R")
        if "date" in facts:
            try:
                facts["date"] = date.fromisoformat(facts["date"]).isoformat()
            except ValueError:
                raise BadDataError(f"its name has {facts['date']!r} for the date; name it 2026-03-01") from None
        if "exam" in facts:
            number = facts.pop("exam")
            if not (number.isascii() and number.isdigit() and 0 < int(number) < 10**6):
                raise BadDataError(f"its name has {number!r} for the exam; name it with a number from 1")
            facts["replicate"] = str(int(number))
        return facts


def _read_facts(path: Path, name: str, pattern: NamePattern | None) -> FileFacts:
    """Facts on which all scans of a scan or map agree, and those in its name, which may not contradict each other."""
    sessions: Sequence[Mapping[str, Any]] = ()
    made: Any = ()
    if name.lower().endswith(MAP):
        _, made = read_map_and_scans(path)
        sessions = made
    elif name.lower().endswith(ARRAYS):
        read_named(path, lambda _: ())  # opened, so that what cannot be read is left out
    else:
        records = scan_records(path, keep=())
        sessions, made = [records.metadata.get("session", {})], provenance_of(records).get("inputs")
    values = {column: {session.get(key) or "" for session in sessions} for column, key in SAME_IN_SCANS.items()}
    facts = {column: min(texts) for column, texts in values.items() if len(texts) == 1 and texts != {""}}
    named = {} if pattern is None else pattern.facts(name)
    for column, value in named.items():
        inside = facts.get(column, value)
        if inside.casefold() != value.casefold():
            raise BadDataError(f"its name says {column} {value}, the file says {inside}")
    inputs = [one for one in made if isinstance(one, dict)] if isinstance(made, list | tuple) else []
    return FileFacts({**named, **facts}, frozenset(str(one["sha256"]) for one in inputs if "sha256" in one))


# --- Files of a folder that may be exams, and which of them are the same exam twice.


class FolderExams(Record):
    """Rows for exams.csv from a folder, and notes on its other files."""

    rows: list[dict[str, Any]] = field(default_factory=list)  #: Of files that the table does not list yet.
    skipped: list[str] = field(default_factory=list)  #: Files that give none, with the reason.
    spelled: list[str] = field(default_factory=list)
    """Codes that a file writes in other capitals than the table, in words."""
    gone: list[str] = field(default_factory=list)  #: Files that the table lists and that are not there.
    others: Counter[str] = field(default_factory=Counter)
    """How many files are no exams by their names, by the ends of these."""


_ASIDE: Final = (".", "~$")  #: Names of what systems and spreadsheets leave beside files begin so.


def _files_of(folder: Path, table: Path, listing: FolderExams) -> dict[str, Path]:
    """Files of a folder of this computer and of those below it that may be exams, in a fixed order.

    Folders that a campaign wrote are passed over, and names are paths from the table's folder, which must hold the
    folder (else a `UsageError`). Other files are counted, and folders that cannot be read are noted.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a directory; give the folder of the scans")
    base, table_file = Path(os.path.realpath(table.parent)), Path(os.path.realpath(table))
    if not Path(os.path.realpath(folder)).is_relative_to(base):
        way_out = "write the table beside the scans"
        raise UsageError(f"{folder} is not inside {table.parent}, the table's folder; {way_out}")
    paths: dict[str, Path] = {}
    for path in _walk(folder, listing.skipped):
        if path.name.lower().endswith(_ENDINGS):
            paths[os.path.relpath(os.path.realpath(path.parent) + os.sep + path.name, base)] = path
        elif Path(os.path.realpath(path)) != table_file:
            listing.others[path.suffix.lower() or "no ending"] += 1
    return paths


def _duplicates(
    paths: Mapping[str, Path], facts_of: Mapping[str, FileFacts], listed: Collection[str]
) -> dict[str, str]:
    """Files that repeat another exam, each with the reason; `facts_of`: facts of the files that can be read.

    Of files of the same bytes the one that is listed stays, else that of the shortest name. Of a scan and its map, and
    of a scan and the arrays that it was imported from, the scan stays, unless the other is listed.
    """
    digest_of = cache(lambda name: sha256(paths[name]))
    of_size, alike = defaultdict[int, list[str]](list), defaultdict[str, list[str]](list)
    for name in facts_of:
        of_size[paths[name].stat().st_size].append(name)
    for name in (name for names in of_size.values() if len(names) > 1 for name in names):
        alike[digest_of(name)].append(name)
    reasons: dict[str, str] = {}
    for names in alike.values():
        first, *copies = sorted(names, key=lambda name: (name not in listed, len(name), name))
        reasons |= {name: f"holds the same bytes as {first}" for name in copies if name not in listed}
    sources_of = {name: one.sources for name, one in facts_of.items() if name not in reasons}
    scans = [name for name in sources_of if not name.lower().endswith(MAP)] if any(sources_of.values()) else []
    by_digest = {digest_of(name): name for name in scans}
    for made, sources in sources_of.items():
        original = next((by_digest[digest] for digest in sorted(sources) if digest in by_digest), made)
        if original == made:
            continue
        arrays = original.lower().endswith(ARRAYS)  # which say less of the exam than the scan that they became
        first, second = (made, original) if arrays else (original, made)
        if second in listed and first not in listed:
            first, second = second, first
        if second not in listed:
            words = "was made from" if second == made else "was made into"
            reasons.setdefault(second, f"{words} {first}, which is an exam")
    return reasons


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


# --- A table of exams from a folder of scans and what they carry, new or added to one that is there.

_DEFAULTS: Final = {"patient": "", "visit": "1", "mass": "1", "side": ""}
"""Cells of a scan that does not say; patient and side are left blank, for somebody to fill in."""
_CODES: Final = ("patient", "visit", "mass")


def find_exams(
    folder: Path | str, table: Path, *, listed: Sequence[Mapping[str, str]] = (), names: str | None = None
) -> FolderExams:
    """Look through a folder and those below it for scans (.mcap), arrays of scans (`ARRAYS`) and maps (.nc).

    The folder may be an address in an object store, whose maps are passed over. `listed` are rows that the table has
    already; paths are written from the table's folder; `names`: see `NamePattern`.
    """
    known = {row["file"] if is_address(row["file"]) else os.path.normpath(row["file"]): row for row in listed}
    pattern, listing, facts_of = None if names is None else NamePattern(names), FolderExams(), dict[str, FileFacts]()
    paths = {} if isinstance(folder, str) else _files_of(folder, table, listing)
    stored = files_below(check_address(folder), *SCANS) if isinstance(folder, str) else ()
    for name in (*paths, *(one for one in stored if one not in known)):
        try:
            if name[0] in "=+@-" or name != name.strip() or not name.isprintable() or len(name) > 1000:
                raise BadDataError("the table takes no such file name: rename it")
            with nullcontext(paths[name]) if name in paths else downloaded(name) as path:
                facts_of[name] = _read_facts(path, name, None if name in known else pattern)
        except BadDataError as error:
            if name not in known:
                listing.skipped.append(f"{name}: {error.what}")
    repeated = _duplicates(paths, facts_of, known) if paths else {}
    listing.skipped.extend(f"{name}: {reason}" for name, reason in repeated.items())
    new = (name for name in facts_of if name not in repeated and name not in known)
    listing.rows.extend({"file": name, **_DEFAULTS, **facts_of[name].facts} for name in new)
    listing.spelled.extend(_spell_as(listed, listing.rows))
    listing.rows.sort(
        key=lambda row: (natural_key(row["patient"].casefold()), natural_key(row["visit"]), row["mass"], row["file"])
    )
    _number(listing.rows, listed)
    gone = (name for name in known if not is_address(name) and not os.path.lexists(table.parent / name))
    listing.gone.extend(known[name]["file"] for name in gone)
    return listing


def _spell_as(listed: Iterable[Mapping[str, str]], rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Write codes that differ by capitals alone as the table or the first file does; `campaign run` takes one way."""
    first: dict[tuple[str, str, str], str] = {}
    for row in listed:
        for column in _CODES:
            first.setdefault(_code_key(row, column), row[column])
    for new in sorted(rows, key=lambda row: str(row["file"])):
        for column in _CODES:
            code = new[column]
            new[column] = first.setdefault(_code_key(new, column), code)
            if code != new[column]:
                yield f"{new['file']}: its {column} {code} is written {new[column]}, as in another row"


def _code_key(row: Mapping[str, str], column: str) -> tuple[str, str, str]:
    """Key shared by codes that differ in capitals alone; visits and masses are of one patient."""
    return column, "" if column == "patient" else row["patient"].casefold(), row[column].casefold()


def _number(rows: Sequence[dict[str, Any]], listed: Iterable[Mapping[str, str]]) -> None:
    """Number the exams of each mass at each visit that have no number, in the order of their files, after others."""
    last: dict[tuple[str, ...], int] = {}
    for row in (*listed, *(new for new in rows if "replicate" in new)):
        key = tuple(row[name] for name in _CODES)
        last[key] = max(last.get(key, 0), int(row["replicate"]) if row["replicate"].isdecimal() else 0)
    for new in rows:
        key = tuple(new[name] for name in _CODES)
        if "replicate" not in new:
            new["replicate"] = last[key] = last.get(key, 0) + 1


# --- Matching of a campaign's exams to masses that the table names by place in another exam of the same breast.
#
# A row with a place (`centre_x_mm`, `centre_y_mm`, on its own map) says where a mass lies. Other exams of the
# breast, at any visit, are matched to it: of the masses that their map lists, the one within a stated distance in
# patient axes, or in the maps' own axes where a scan has no landmarks.

SAME_MM: Final = 6.0  #: Centres on one map nearer than this are of one mass: candidates of a search are so far apart.
OWN_AXES: Final = finding(
    "own_axes", "its mass was matched by place in the maps' own axes, because a scan has no landmarks"
)


class Match(Record):
    """Where to look for an exam's mass on its map: places of the breast's masses on other exams' maps."""

    mass: str  #: Code of the exam's mass, which one of the places is of.
    named: tuple[Exam, ...]  #: Exams that say where a mass lies on their map, one for each of the breast's masses.
    most_mm: float  #: Within this distance of its place a mass of the map is it.


class Breasts:
    """Index of exams by breast."""

    def __init__(self, exams: Sequence[Exam]) -> None:
        self._exams: dict[tuple[str, str | None], list[Exam]] = defaultdict(list)
        for exam in exams:
            self._exams[exam.patient, exam.side].append(exam)

    def exams_with_places(self, exam: Exam, of: Container[str] | None = None) -> list[Exam]:
        """Exams that place the breast's masses, one for each mass, of the exam's visit if possible.

        Empty if the exam has a place itself, or no exam places its mass; `of`: names of the exams to choose from.
        """
        if exam.centre_mm is not None:
            return []
        breast = [one for one in self._exams[exam.patient, exam.side] if of is None or one.name in of]
        by_mass: dict[str, Exam] = {}
        for one in sorted(breast, key=lambda one: (one.visit != exam.visit, natural_key(one.visit), one.replicate)):
            if one.centre_mm is not None:
                by_mass.setdefault(one.mass, one)
        return list(by_mass.values()) if exam.mass in by_mass else []


def estimate_matched(path: Path, settings: Settings, match: Match) -> SizeEstimate:
    """Estimate the mass of a map that lies within a distance of its place on another exam's map.

    Without a mass there the estimate is of the place, with the reason for no size. Several masses that may be the one,
    and a place off the map, are a `BadDataError`.
    """
    mass, most_mm = match.mass, match.most_mm
    outcome = estimate_file(path, settings)
    tactile_map, masses = outcome.tactile_map, outcome.estimate.masses
    places = places_on(tactile_map, path, match.named)
    near = [one for one in masses if nearest_mass(places, (one.x_mm, one.y_mm), most_mm) == mass]
    if len(near) > 1:
        words = " and ".join(f"({one.x_mm:.1f}, {one.y_mm:.1f}) mm" for one in near)
        way_out = "give the row its centre_x_mm and centre_y_mm, or a smaller --match-mm"
        raise BadDataError(f"shows masses at {words} within {most_mm:g} mm of mass {mass}'s place", way_out=way_out)
    if near:
        at_mass = replace(settings, centre_mm=(near[0].x_mm, near[0].y_mm))
        return outcome if near[0].reported else estimate_file(path, at_mass)
    place = places[mass]
    if not on_map(tactile_map, *place):
        words = f"mass {mass} would lie at ({place[0]:.1f}, {place[1]:.1f}) mm, off the map"
        raise BadDataError(words, way_out="check the landmarks, or give the row its centre_x_mm and centre_y_mm")
    at_place = estimate_file(path, replace(settings, centre_mm=place))
    estimate = at_place.estimate
    reported = next((one for one in estimate.masses if one.reported), None)
    if estimate.status != "estimate" or reported is None:
        return at_place
    if np.hypot(reported.x_mm - place[0], reported.y_mm - place[1]) <= most_mm:
        return at_place
    reason = f"no lump found within {most_mm:g} mm of mass {mass}'s place, ({place[0]:.1f}, {place[1]:.1f}) mm"
    why = no_verdict(tactile_map) or Abstention("undetected", reason)
    none = Estimate(
        "no_estimate",
        why.reason,
        candidates=estimate.candidates,
        code=why.code,
        masses=tuple(replace(one, reported=False) for one in estimate.masses),
        findings=at_place.tactile_map.findings,
    )
    return replace(at_place, estimate=none)


def map_of_exam(path: Path, exam: Exam) -> TactileMap:
    """The map of another exam, whose folder is beside that of this map."""
    return read_map(path.parent.with_name(exam.name) / path.name)


def places_on(tactile_map: TactileMap, path: Path, named: Sequence[Exam]) -> dict[str, tuple[float, float]]:
    """Places of masses on a map, by code: transferred through patient axes, or as they are without landmarks."""
    places, from_plane = {}, tactile_map.patient_from_plane
    for one in named:
        assert one.centre_mm is not None
        other_from_plane = map_of_exam(path, one).patient_from_plane
        places[one.mass] = one.centre_mm
        if other_from_plane is not None and from_plane is not None:
            patient_mm = (other_from_plane @ np.array([*one.centre_mm, 0.0, 1.0]))[:2]
            x, y = np.linalg.solve(from_plane[:2, :2], patient_mm - from_plane[:2, 3])
            places[one.mass] = (float(x), float(y))
    return places


def nearest_mass(places: Mapping[str, tuple[float, float]], place: tuple[float, float], most_mm: float) -> str:
    """Code of the mass whose place is nearest, and within the distance; empty where none is."""
    distances_mm = {mass: float(np.hypot(x - place[0], y - place[1])) for mass, (x, y) in places.items()}
    first = min(distances_mm, key=lambda mass: distances_mm[mass])
    return first if distances_mm[first] <= most_mm else ""


MassPlace = tuple[Place, bool]  #: Where a mass lies on its map, and whether it is the reported one.


def unnamed_masses(masses: Sequence[Sequence[MassPlace]]) -> list[Finding]:
    """A finding for each mass of a scan that no row names; `masses`: of each row of the scan."""
    known = [place for of_row in masses for place, reported in of_row if reported]
    findings = []
    for place, _ in masses[0]:
        if all(np.hypot(place.x - one.x, place.y - one.y) > SAME_MM for one in known):
            known.append(place)
            text = f"a mass at ({place.x:.1f}, {place.y:.1f}) mm on the map is named by no row"
            findings.append(finding("unnamed_mass", text))
    return findings


# --- Visits of a campaign's masses.

Visits = dict[str, list[Exam]]  #: Exams of one mass by the code of the visit, in order of time.


def stated_days(exams: Iterable[Exam]) -> dict[str, date]:
    """Latest day that the exams of each mass at a visit state, by `Exam.of_mass`."""
    return dict(sorted((exam.of_mass, exam.day) for exam in exams if exam.day is not None))


def visits_by_mass(exams: Sequence[Exam], days: Mapping[str, date]) -> dict[str, Visits]:
    """Visits of each mass, by its name; `days`: `stated_days` of all exams of the table.

    `read_manifest` refuses visits whose order is not known by all exams: those that came through may not tell it.
    """
    by_mass: dict[str, Visits] = defaultdict(lambda: defaultdict(list))
    for exam in exams:
        by_mass[exam.of_visits][exam.visit].append(exam)
    return {
        name: {visit: visits[visit] for visit in visits_in_order(visit_dates(visits, days)) or visits}
        for name, visits in by_mass.items()
    }


def masses_with_visits(exams: Sequence[Exam], days: Mapping[str, date]) -> dict[str, Visits]:
    """Masses with exams at several visits, as `visits_by_mass` has them."""
    return {name: visits for name, visits in visits_by_mass(exams, days).items() if len(visits) > 1}


def visit_dates(visits: Visits, days: Mapping[str, date]) -> dict[str, date | None]:
    """Latest date of each visit's exams, else of the visit in `days`; None where none has one."""
    own = stated_days(exam for exams in visits.values() for exam in exams)
    of_visits = {visit: exams[0].of_mass for visit, exams in visits.items()}
    return {visit: own.get(name) or days.get(name) or day_of(visit) for visit, name in of_visits.items()}
