"""A trial's readings, a mass and a visit at a time."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import date
from itertools import groupby, pairwise, product
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from tactile_bayes.declarations import Record, field, set_fields
from tactile_bayes.errors import BadDataError

# --- Readings of masses by several modalities, checked for consistency and grouped by mass.

FloatArray = npt.NDArray[np.float64]
MassKey = tuple[str, str]  # patient, mass


class CellFault(Protocol):
    """Makes the error for a faulty cell, naming the file and line of its row."""

    def __call__(self, row: int, column: str, problem: str, /, *, way_out: str) -> BadDataError: ...


class Interval(Record):
    """A credible interval of a size, in mm, with its nominal probability."""

    low_mm: float
    high_mm: float
    probability: float


class Reading(Record):
    """One reading of one mass: a size in mm when detected, nothing otherwise."""

    key: MassKey
    modality: str
    replicate: int
    status: str
    size_mm: float | None = None
    interval: Interval | None = None
    synthetic: bool = False
    sd_mm: float | None = None
    reader: str | None = None
    visit: str | None = None
    day: date | None = None


class ModalitySizes(Record, eq=False):
    """Sizes of n masses by one modality, ordered by patient and mass whatever the order of the rows."""

    name: str
    patient: npt.NDArray[np.int64]  #: (n,) array, the patient of each mass by number.
    ex_vivo_mm: FloatArray  #: (n,) array, above 0.
    size_mm: FloatArray  #: (n,) array: mean over the detected replicates; 0 where none was detected.
    replicates_mm: tuple[FloatArray, ...]  #: n arrays: the detected replicates of each mass.
    readings: int = 0
    masses_not_done: int = 0
    masses_without_reading: int = 0
    """`masses_not_done`, `masses_without_reading`: Excised masses left out: looked for in no replicate, or not in the
    table."""
    mass: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(n,) array, the number of each mass among the excised ones; counted from 0 when not given."""

    def __post_init__(self) -> None:
        if len(self.mass) != len(self.ex_vivo_mm):
            set_fields(self, mass=np.arange(len(self.ex_vivo_mm)))

    @property
    def detected(self) -> npt.NDArray[np.bool_]:
        """(n,) array: True for a mass detected in at least one replicate."""
        return self.size_mm > 0

    @property
    def patients(self) -> npt.NDArray[np.int64]:
        """The distinct patients, in order."""
        return np.unique(self.patient)

    def only(self, keep: npt.NDArray[np.bool_]) -> ModalitySizes:
        """Copy with only the masses where `keep` is true; counts of readings and of masses left out become 0."""
        return self.take(np.flatnonzero(keep))

    def take(self, masses: npt.NDArray[np.int64]) -> ModalitySizes:
        """Copy with the masses at these indices, repeated as given; for resampling."""
        return ModalitySizes(
            name=self.name,
            patient=self.patient[masses],
            ex_vivo_mm=self.ex_vivo_mm[masses],
            size_mm=self.size_mm[masses],
            replicates_mm=tuple(self.replicates_mm[i] for i in masses),
            mass=self.mass[masses],
        )

    def only_detected(self) -> ModalitySizes:
        """Copy with only the masses that this modality detected."""
        return self.only(self.detected)

    def only_replicated(self) -> ModalitySizes:
        """Copy with only the masses that have two or more detected replicates."""
        return self.only(np.array([len(sizes) > 1 for sizes in self.replicates_mm], dtype=bool))


_COLUMNS = (
    *("patient", "mass", "modality", "replicate", "status", "size_mm", "low_mm", "high_mm", "probability"),
    *("synthetic", "sd_mm", "reader", "visit", "date"),
)


def readings_from_columns(columns: Mapping[str, Sequence[Any]], *, fault: CellFault) -> list[Reading]:
    """Make readings from a trial table's columns, checking rules between the cells of a row.

    Columns are as ``data_schema/trial.table.json`` names and types them; `fault` makes the error for a cell. Refused
    are a size without detection, detection without a size, and an interval that is incomplete, upside down, does not
    contain the reading's own size, or is stated for a mass that was not detected.
    """
    blank: list[None] = [None] * len(columns["patient"])
    readings = []
    for row, cells in enumerate(zip(*(columns.get(name, blank) for name in _COLUMNS), strict=True)):
        patient, mass, modality, replicate, status, size_mm, low_mm, high_mm, probability, synthetic, *details = cells
        status = _status(row, status, size_mm, fault=fault)
        interval = _interval(row, status, size_mm, (low_mm, high_mm, probability), fault=fault)
        key = (patient, mass)
        readings.append(Reading(key, modality, replicate, status, size_mm, interval, bool(synthetic), *details))
    return readings


def _status(row: int, status: str | None, size_mm: float | None, *, fault: CellFault) -> str:
    """Status of a row, checked against the size; a row without both was not done."""
    if status is None and size_mm is None:
        return "not_done"
    if status is None:
        raise fault(row, "status", f"is blank beside size_mm {size_mm:g}", way_out="give status detected")
    if status == "detected" and size_mm is None:
        way_out = "give the size, or status not_detected or not_done"
        raise fault(row, "size_mm", "is blank while status is detected", way_out=way_out)
    if status != "detected" and size_mm is not None:
        way_out = "leave size_mm blank, or give status detected"
        raise fault(row, "size_mm", f"is {size_mm:g} while status is {status}", way_out=way_out)
    return status


def _interval(
    row: int, status: str, size_mm: float | None, cells: Sequence[float | None], *, fault: CellFault
) -> Interval | None:
    """Interval of a row, checked; None where its three cells are blank."""
    low_mm, high_mm, probability = cells
    if low_mm is None or high_mm is None or probability is None:
        blank = [name for name, cell in zip(("low_mm", "high_mm", "probability"), cells, strict=True) if cell is None]
        if len(blank) == len(cells):
            return None
        way_out = "an interval needs low_mm, high_mm and probability, or all three blank"
        raise fault(row, blank[0], "is blank while the interval's other cells are not", way_out=way_out)
    if size_mm is None:
        way_out = "leave the interval blank, or give status detected"
        raise fault(row, "low_mm", f"is {low_mm:g} while status is {status}", way_out=way_out)
    if low_mm > high_mm:
        raise fault(row, "low_mm", f"is {low_mm:g}, above high_mm {high_mm:g}", way_out="exchange or correct them")
    if not low_mm <= size_mm <= high_mm:
        problem = f"is {size_mm:g}, outside its own interval {low_mm:g} to {high_mm:g}"
        raise fault(row, "size_mm", problem, way_out="correct the size, low_mm or high_mm; all three are in mm")
    return Interval(low_mm, high_mm, probability)


def mass_numbers(masses: Iterable[MassKey]) -> dict[MassKey, int]:
    """Number of each mass, in order of patient and mass."""
    return {key: index for index, key in enumerate(sorted(masses))}


def same_code(code: str) -> str:
    """What codes share that differ by capitals alone, or by leading zeros, which spreadsheets take off numbers."""
    return code.lstrip("0") if code.isascii() and code.isdigit() else code.casefold()


def _spelling_doubts(masses: Iterable[MassKey]) -> list[str]:
    """Sentences on codes of patients, or of a patient's masses, that `same_code` makes one; empty without any."""
    first, pairs = dict[tuple[str, str], str](), list[str]()
    for patient, mass in masses:
        for whose, code in (("patients", patient), (f"masses of {patient},", mass)):
            if (other := first.setdefault((whose, same_code(code)), code)) != code:
                pairs.append(f"{whose} {other} and {code}")
    return [f"{one} differ by capitals or leading zeros alone: are they one?" for one in dict.fromkeys(pairs)]


# --- Plausibility of a trial's units: impossible sizes, and modalities that differ from excision tenfold.

# Palpable masses measure well between these; a size outside is more likely in another unit or in the wrong column.
LEAST_MM, MOST_MM = 2.0, 150.0
UNITS = {"cm": 10.0, "inches": 25.4, "m": 1000.0}
NEAR = 1.6  #: A median ratio this near to a unit's factor is doubted: no modality is wrong sixfold in the median.

LEAST_COPIED = 5  #: Fewest masses whose sizes are doubted where all are those after excision.


def unit_doubts(sizes: Mapping[str, ModalitySizes], ex_vivo_mm: FloatArray) -> list[str]:
    """One sentence for each column that seems to be in another unit than mm, or a copy; empty if none does.

    `ex_vivo_mm` is of all excised masses.
    """
    doubts = _outside("ex-vivo sizes", ex_vivo_mm)
    for name, detected in (
        (name, modality.only_detected()) for name, modality in sizes.items() if modality.detected.any()
    ):
        doubts += _outside(f"{name} sizes", np.concatenate(detected.replicates_mm))
        with np.errstate(over="ignore", under="ignore"):
            ratios = np.maximum(detected.size_mm / detected.ex_vivo_mm, 1e-300)
            sides = (("ex-vivo", ratios, "{:g} times"), (name, 1 / ratios, "1/{:g} of"))
        in_median, of_some = list[str](), list[str]()
        for (unit, factor), (wrong, quotients, words) in product(UNITS.items(), sides):
            near = (factor / NEAR < quotients) & (quotients < factor * NEAR)
            if factor / NEAR < np.median(quotients) < factor * NEAR:
                comparison = f"{name} sizes are {np.median(ratios):.3g} times the ex-vivo sizes in the median"
                in_median.append(f"{comparison}: are the {wrong} sizes in {unit}?")
            elif near.any():
                some = f"{near.sum()} of {len(near)} {name} sizes about {words.format(factor)} the ex-vivo size"
                of_some.append(f"{some}: is the {wrong} size there in {unit}?")
        doubts += in_median or of_some
        if len(ratios) >= LEAST_COPIED and np.all(ratios == 1):
            doubts.append(f"all {len(ratios)} {name} sizes are the ex-vivo sizes: were they copied from there?")
    return doubts


def _outside(name: str, values_mm: FloatArray) -> list[str]:
    """Sentence on the values outside `LEAST_MM` to `MOST_MM`; empty without any."""
    outside = (values_mm < LEAST_MM) | (values_mm > MOST_MM)
    text = (
        f"{int(outside.sum())} of {len(values_mm)} {name} outside {LEAST_MM:g} to {MOST_MM:g} mm "
        f"(from {values_mm.min(initial=np.inf):.6g} to {values_mm.max(initial=0.0):.6g}): are they in mm?"
    )
    return [text] if outside.any() else []


# --- The readings to compare with excision: those of the last visit on or before it.

_NUMBERED = re.compile(r"(\D*)([0-9]{1,9})")
Row = tuple[int, Reading]


class OtherVisits(Record):
    """Numbers of readings left out of a trial's analysis because they are of another visit."""

    masses: int = 0  #: Masses read at several visits.
    earlier: int = 0
    later: int = 0
    """`earlier`, `later`: Readings at visits before the last one, and after the excision."""
    only_there: Mapping[str, int] = field(default_factory=dict)  #: Masses read at other visits alone, by modality.

    def lines(self) -> list[str]:
        """Text of what is left out, a line each; empty where nothing is."""
        if not self.earlier and not self.later:
            return []
        parts = [f"{self.earlier} of earlier visits"] if self.earlier else []
        parts += [f"{self.later} after excision"] if self.later else []
        masses = "1 mass was" if self.masses == 1 else f"{self.masses} masses were"
        heading = f"{masses} read at several visits: the last one before excision is analysed, readings left out: "
        lost_masses = [
            f"{name}: {n} mass{'es' * (n > 1)} left out, read at other visits alone"
            for name, n in self.only_there.items()
        ]
        return [heading + ", ".join(parts), *lost_masses]


class Trial(Record, eq=False):
    """Readings and sizes after excision, as a trial's report is made from them."""

    readings: Sequence[Reading]  #: Those of each mass's last visit before excision, in any order.
    ex_vivo_mm: Mapping[MassKey, float]  #: Size after excision, of every mass of the readings.
    ex_vivo_sd_mm: Mapping[MassKey, float | None] = field(default_factory=dict)
    """Standard deviation of each ex-vivo size where it is known; enters the calibration in quadrature."""
    other_visits: OtherVisits = field(default_factory=OtherVisits)  #: Readings left out, of other visits.
    files: Mapping[str, Path] = field(default_factory=dict)  #: Files that they were read from, by role.

    def sizes(self) -> dict[str, ModalitySizes]:
        """Sizes of each modality: the mean over each mass's detected replicates. Tactile comes first, then by name."""
        ordered = sorted(self.readings, key=lambda r: (r.modality != "tactile", r.modality, r.key, r.replicate))
        ex_vivo_mm, mass_number = self.ex_vivo_mm, mass_numbers(self.ex_vivo_mm)
        patients = sorted({patient for patient, _ in ex_vivo_mm})
        patient_number = {patient: index for index, patient in enumerate(patients)}
        sizes = dict[str, ModalitySizes]()
        for name, group in groupby(ordered, key=lambda r: r.modality):
            rows = list(group)
            keys, done = {r.key for r in rows}, [r for r in rows if r.status != "not_done"]
            by_mass = {
                key: np.array([r.size_mm for r in of_mass if r.size_mm is not None], dtype=np.float64)
                for key, of_mass in groupby(done, key=lambda r: r.key)
            }
            with np.errstate(over="ignore"):  # figures refuse an infinite mean
                # equal readings are their own mean, to the last bit: rounding would be an error beside excision
                means = [np.clip(mm.mean(), mm.min(), mm.max()) if len(mm) else 0.0 for mm in by_mass.values()]
            sizes[name] = ModalitySizes(
                name=name,
                patient=np.array([patient_number[patient] for patient, _ in by_mass], dtype=np.int64),
                ex_vivo_mm=np.array([ex_vivo_mm[key] for key in by_mass], dtype=np.float64),
                size_mm=np.array(means),
                replicates_mm=tuple(by_mass.values()),
                readings=len(done),
                masses_not_done=len(keys) - len(by_mass),
                masses_without_reading=len(ex_vivo_mm) - len(keys),
                mass=np.array([mass_number[key] for key in by_mass], dtype=np.int64),
            )
        return sizes

    def doubts(self) -> list[str]:
        """What speaks against the tables: codes, units and copied sizes, a sentence each."""
        ex_vivo_mm = np.array(list(self.ex_vivo_mm.values()), dtype=np.float64)
        return [*_spelling_doubts(self.ex_vivo_mm), *unit_doubts(self.sizes(), ex_vivo_mm)]

    def sized_readings(self, modality: str) -> list[Reading]:
        """Readings of a modality that have a size, in order of mass and replicate."""
        sized = (reading for reading in self.readings if reading.modality == modality and reading.size_mm is not None)
        return sorted(sized, key=lambda one: (one.key, one.replicate))


def visits_in_order(visits: Mapping[str, date | None]) -> list[str] | None:
    """Codes of visits in order of time: by their dates, else by their numbers; None where neither gives an order.

    A code may itself be a date or end in a number, as in 2026-03-01, 2 or V2.
    """
    if len(visits) < 2:
        return list(visits)
    days = {code: day for code, stated in visits.items() if (day := stated or day_of(code)) is not None}
    if len(days) == len(visits):
        return sorted(days, key=lambda code: days[code]) if len(set(days.values())) == len(days) else None
    numbers = _numbers(visits)
    return None if numbers is None else sorted(visits, key=lambda code: numbers[code])


def day_of(code: str) -> date | None:
    """Date that a visit's code states; None where it is no date."""
    try:
        return date.fromisoformat(code) if len(code) == len("2026-03-01") else None
    except ValueError:
        return None


def _numbers(codes: Iterable[str]) -> dict[str, int] | None:
    """Number at the end of each visit's code; None where one has none, two are equal or the stems differ."""
    matches = {code: _NUMBERED.fullmatch(code) for code in codes}
    numbers = {code: int(match[2]) for code, match in matches.items() if match is not None}
    stems = {match[1].casefold() for match in matches.values() if match is not None}
    return numbers if len(numbers) == len(matches) == len(set(numbers.values())) and len(stems) <= 1 else None


def at_excision(
    readings: Sequence[Reading], excised_on: Mapping[MassKey, date | None], *, fault: CellFault
) -> tuple[list[Reading], OtherVisits]:
    """Readings of each mass at its last visit on or before excision, and the numbers of those left out.

    Readings, in the order of the table's rows, that name neither visit nor date stay, and so do those not done, such as
    blank cells of a wide table: they make no visit. Without dates the visits are ordered by their numbers, and the last
    one is taken to lie before excision. Refused are visits whose order is not known, an excision before every visit,
    and a reading without a visit beside others that have one.
    """
    by_mass: dict[MassKey, list[Row]] = defaultdict(list)
    for i, reading in enumerate(readings):
        if reading.status != "not_done":
            by_mass[reading.key].append((i, reading))
    several = later = 0  # masses of several visits, readings after excision
    dropped: set[int] = set()
    only_there: Counter[str] = Counter()
    for key, rows in by_mass.items():
        visits, after = _visits_around_excision(rows, excised_on.get(key), fault=fault)
        last = visits[-1] if visits else None
        others = {i for i, reading in rows if (name := _visit(reading)) is not None and name != last}
        several += len(visits) + len(after) > 1
        later += sum(_visit(readings[i]) in after for i in others)
        dropped |= others
        analysed_by = {reading.modality for i, reading in rows if i not in others}
        only_there.update({reading.modality for _, reading in rows} - analysed_by)
    analysed = [reading for i, reading in enumerate(readings) if i not in dropped]
    return analysed, OtherVisits(several, len(dropped) - later, later, dict(sorted(only_there.items())))


def _visit(reading: Reading) -> str | None:
    """Code of a reading's visit, or else its date."""
    return reading.visit or (None if reading.day is None else reading.day.isoformat())


def _visits_around_excision(
    rows: Sequence[Row], excised: date | None, *, fault: CellFault
) -> tuple[list[str], set[str]]:
    """Visits of a mass up to its excision, in order, and those after it."""
    first_row = {name: i for i, reading in reversed(rows) if (name := _visit(reading)) is not None}
    days = {}
    for name in first_row:
        stated = {reading.day: i for i, reading in rows if _visit(reading) == name and reading.day is not None}
        days[name] = max(stated, default=day_of(name))
        if excised is not None and stated and min(stated) <= excised < max(stated):
            problem = f"is {max(stated)}, after excision on {excised}, and visit {name} has readings before it"
            way_out = "correct the date, or give readings after excision a visit of their own"
            raise fault(stated[max(stated)], "date", problem, way_out=way_out)
    after = {name for name, day in days.items() if excised is not None and day is not None and day > excised}
    numbers = _numbers(days) or {}
    first_after = min((numbers[name] for name in after & numbers.keys()), default=math.inf)
    after |= {name for name, number in numbers.items() if number > first_after and days[name] is None}
    before = {name: day for name, day in days.items() if name not in after}
    if after and not before:
        first = min(after, key=lambda name: first_row[name])
        problem = f"visit {first} is after excision on {excised}, and so is every other of this mass"
        way_out = "correct the date here or of excision, or leave the readings out"
        raise fault(first_row[first], "date", problem, way_out=way_out)
    if len(first_row) > 1:
        _check_visits_named(rows, fault=fault)
    order = visits_in_order(before)
    if order is None:
        names = " and ".join(sorted(before, key=lambda name: first_row[name]))
        problem = f"{names} of one mass do not say which was first"
        way_out = "give each reading its date, or number the visits in order of time"
        raise fault(max(first_row[name] for name in before), "visit", problem, way_out=way_out)
    _check_dates(days if numbers else before, first_row, fault=fault)
    return order, after


def _check_visits_named(rows: Sequence[Row], *, fault: CellFault) -> None:
    """Refuse readings of a mass of several visits that name no visit beside others that do."""
    any_visit_code = any(reading.visit for _, reading in rows)
    modalities_with_visits = {reading.modality for _, reading in rows if _visit(reading) is not None}
    for i, reading in rows:
        if reading.visit is None and (
            (any_visit_code and reading.day is not None)
            or (reading.day is None and reading.modality in modalities_with_visits)
        ):
            problem = "is blank while other readings of the mass are of several visits"
            raise fault(i, "visit", problem, way_out="give every reading of the mass its visit")


def _check_dates(days: Mapping[str, date | None], first_row: Mapping[str, int], *, fault: CellFault) -> None:
    """Refuse dates that contradict the visits' numbers."""
    numbers = _numbers(days) or {}
    dated = {name: day for name, day in days.items() if day is not None and name in numbers}
    for earlier, later in pairwise(sorted(dated, key=lambda name: numbers[name])):
        if dated[later] < dated[earlier]:
            problem = f"visit {later} is of {dated[later]}, before visit {earlier} of {dated[earlier]}"
            raise fault(first_row[later], "date", problem, way_out="correct the date, or the visits' numbers")
