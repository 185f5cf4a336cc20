"""Contents of an exam's page, and its sentences."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import date
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record, replace, set_fields
from tactile_bayes.errors import CANNOT_SHOW, NO_LUMP, UsageError
from tactile_bayes.files.reports import EstimateReport, MassReport, Place, Point, PooledReport, centre_of
from tactile_bayes.findings import capitalised, counted, first_of
from tactile_bayes.geometry import apply
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.clock import ClockPosition, clock_position, clock_text
from tactile_bayes.mapping.map import FEW_READINGS, TactileMap
from tactile_bayes.mapping.plausibility import WHY_NOT
from tactile_bayes.posterior.verdict import chance_text
from tactile_bayes.report.estimate_document import (
    from_xiphoid,
    other_masses,
    patient_mm,
    share_words,
    side_of,
    size_words,
)
from tactile_bayes.report.estimate_text import shape_text, smallest_text, spread_percent
from tactile_bayes.report.map import ellipse_of
from tactile_bayes.report.pages import cut
from tactile_bayes.size.pooling import DISAGREE

_LONGEST: Final = {"title": 60, "name": 50}
_DATE: Final = re.compile(r"\d{4}-\d{2}-\d{2}", re.ASCII)

# --- What the page of an exam shows: its maps, the masses on them, and what the scans say of the exam.


class ExamMass(Record, eq=False):
    """One mass on a map."""

    number: int  #: On the map, from 1.
    centre_mm: tuple[float, float]  #: x and y in `plane`.
    axes_mm: tuple[float, float] | None = None  #: Diameters along its own axes; None without a size.
    angle_deg: float = 0.0  #: From x to the first of them.
    largest: Quantity | None = None  #: Largest size with the interval that leads; None without.
    probability: float | None = None  #: That it is a lump; None where it is not told.
    place: ClockPosition | None = None  #: About the nipple; None where that is not known.
    patient_mm: tuple[float, float] | None = None  #: Right of the xiphoid and up; None without landmarks.
    why: str = ""  #: Why there is no size; empty where there is one.


class ExamMap(Record, eq=False):
    """One map of an exam, with its estimate and its masses, the reported one first."""

    tactile_map: TactileMap | None  #: None where only the estimate is at hand.
    report: EstimateReport
    masses: tuple[ExamMass, ...]


class PageLabels(Record):
    """Title, name and date to print on a page; each may be empty."""

    title: str = ""
    name: str = ""
    day: str = ""

    def __post_init__(self) -> None:
        for option, longest in _LONGEST.items():
            value = getattr(self, option)
            if not isinstance(value, str):
                raise UsageError(f"{option} is {value!r}; give a text")
            if not value.isprintable() or len(value) > longest:
                fault = f"{option} is of {len(value)} letters or not printable"
                raise UsageError(f"{fault}; give up to {longest} letters")
        day, is_date = str(self.day or ""), False
        with suppress(ValueError):
            is_date = bool(_DATE.fullmatch(day) and date.fromisoformat(day))
        if day and not is_date:
            raise UsageError(f"date {day[:40]!r} is no date; give it as YEAR-MONTH-DAY, such as 2026-03-01")
        set_fields(self, day=day)


class ShownExam(Record, eq=False):
    """Contents of one page."""

    maps: tuple[ExamMap, ...]  #: Several are repeats of one mass.
    pooled: PooledReport | None = None  #: The size from all maps; None with one map.
    scans: Sequence[Mapping[str, str]] = ()  #: The scans at the beginning, as `Provenance.scans` has them.
    labels: PageLabels = PageLabels()

    @property
    def main_number(self) -> int:
        """Number, from 1, of the map that is drawn large: the first on which there is a mass, else the first."""
        return next((number for number, one in enumerate(self.maps, start=1) if one.masses), 1)

    @property
    def main(self) -> ExamMap:
        return self.maps[self.main_number - 1]

    @property
    def drawn(self) -> ExamMap:
        """The map that is drawn large; of several maps its first mass has the pooled size, in its own shape."""
        if self.pooled is None or not self.main.masses:
            return self.main
        first, *others = self.main.masses
        size, alone = self.pooled.leading.max_size_mm, first.largest
        if size is None or first.axes_mm is None or alone is None:
            return self.main
        along, across = (axis * size.median / alone.median for axis in first.axes_mm)
        return replace(self.main, masses=(replace(first, axes_mm=(along, across), largest=size), *others))

    @property
    def report(self) -> EstimateReport | PooledReport:
        """The report of the size that the page tells: the pooled one of several maps."""
        return self.main.report if self.pooled is None else self.pooled

    @property
    def largest(self) -> Quantity | None:
        """The largest size that the page reports: the pooled one of several maps."""
        return self.report.leading.max_size_mm

    @property
    def elsewhere(self) -> bool:
        """True if a mass was looked for at a place without a lump, and the masses of the map lie elsewhere."""
        return self.main.report.centre_mm is None and len(self.main.masses) > 0

    @property
    def disagrees(self) -> bool:
        """True if the maps are not of one size, or not of one mass."""
        return self.pooled is not None and self.pooled.status == DISAGREE


def exam_map(tactile_map: TactileMap | None, report: EstimateReport, *, side: str) -> ExamMap:
    """A map with its masses, from its estimate; `side` is the breast, as the scans have it."""
    number = next((one.number for one in report.masses if one.reported), 1)
    masses = [] if report.centre_mm is None else [_mass(number, report, report.centre_mm, tactile_map, side)]
    masses += [_mass(mass.number, mass, mass.centre_mm, tactile_map, side) for mass in other_masses(report.masses)]
    return ExamMap(tactile_map, report, tuple(masses))


def _mass(
    number: int, report: EstimateReport | MassReport, centre: Point | Place, tactile_map: TactileMap | None, side: str
) -> ExamMass:
    """A mass with its place: by the map, or as its estimate has `report` it where that is all there is."""
    if tactile_map is None:
        place, patient = ClockPosition.of(report.position), centre_of(report.centre_patient_mm)
    else:
        variances = (centre.x.sd**2, centre.y.sd**2) if isinstance(centre, Point) else (0.0, 0.0)
        place = clock_position(tactile_map, centre.median, side=side, covariance_mm2=np.diag(variances))
        patient = patient_mm(tactile_map, *centre.median)
    return ExamMass(
        number,
        centre.median,
        *ellipse_of(report),
        largest=report.leading.max_size_mm,
        probability=report.detected_probability,
        place=place,
        patient_mm=patient,
        why="" if report.max_size_mm is not None else report.reason,
    )


# --- Sentences of an exam's page, in plain words: the size and its intervals, what was covered, how good the exam was.

_LEFT_OUT: Final = WHY_NOT | {
    "dropped_no_pose": "without the tracker's position",
    "dropped_elements": "with too few working sensor points",
}


def headline(exam: ShownExam) -> str:
    """The finding in a few words."""
    size, masses = exam.largest, exam.main.masses
    if size is not None:
        lead = "Lump of" if len(masses) < 2 else f"{len(masses)} masses, mass {masses[0].number}"
        interval = f"{share_words(size)} interval {size.low:.1f} to {size.high:.1f} mm"
        return f"{lead} about {size.median:.1f} mm, {interval}"
    if exam.disagrees:
        return capitalised(exam.report.reason)
    if masses and not exam.elsewhere:
        return f"{'Lump' if len(masses) < 2 else f'{len(masses)} masses'} seen, no size"
    if exam.main.report.reason_code == CANNOT_SHOW:
        return "No answer: the data cannot show whether there is a lump"
    where = "at the place looked at" if exam.elsewhere else "in the area covered"
    return f"No lump found {where}" if exam.main.report.reason_code in NO_LUMP else "No size"


def reason_on_paper(report: EstimateReport) -> str:
    """Why there is no size, for a list on paper, where a place in mm of the map says nothing."""
    rib = report.reason_code == "ridge"
    return "no lump found: what rises is long like a rib, not round like a lump" if rib else report.reason


def size_sentences(exam: ShownExam, size: Quantity) -> Iterator[str]:
    """The largest size with both intervals and the smallest size; `size`: the largest."""
    report, share = exam.report, share_words(size)
    yield f"The largest diameter is about {size.median:.1f} mm (the middle of its probable values)."
    yield f"With a probability of {share} it lies between {size.low:.1f} and {size.high:.1f} mm{_supposed(exam)}."
    alike, spread = report.max_size_mm, report.figures.get("between_map_sd")
    if report.another_exam is not None and alike is not None:
        differ = "did not differ" if spread is None else f"differed by {spread_percent(spread)} only"
        learned = "as these maps suggest" if exam.pooled is not None else "as those of simulated bodies do"
        yield (
            f"If exams of one lump {differ}, {learned}, it would lie between {alike.low:.1f} and {alike.high:.1f} mm "
            f"({share}): repeat exams of patients here can show whether they do."
        )
    least = report.leading.min_size_mm
    if least is not None:
        ends = f"{share}: {least.low:.1f} to {least.high:.1f} mm"
        yield f"The smallest diameter is about {least.median:.1f} mm ({ends})."
    if "oval_probability" in report.figures:
        yield shape_text(report.figures)


def _supposed(exam: ShownExam) -> str:
    """Spread between exams that the size's interval supposes, and its source."""
    report, spread = exam.report, exam.report.figures.get("between_map_sd")
    if report.another_exam is not None:
        after = " after these maps" if exam.pooled is not None else ""
        share = f"{100 * report.another_exam.between_map_sd:.0f} %"
        return f", if exams of a lump differ by {share}{after}, as those of patients did in the published trial"
    if spread is None:
        return ""
    at_site = report.figures.get("repeatability") if exam.pooled is None else exam.pooled.site_words
    if at_site and exam.pooled is None:
        return f"; {at_site}"
    words = f"; exams of a lump are taken to differ by {spread_percent(spread)}"
    if at_site:
        return f"{words}, by these maps and this site's other exams"
    if report.origin.settings.get("between_map_sd") is not None:
        return f"{words}, as was stated"
    if exam.pooled is not None:
        return f"{words}, learned from these maps"
    return f", if exams of a lump differ by {spread_percent(spread)}, as those of simulated bodies do"


def nothing_sentences(exam: ShownExam) -> Iterator[str]:
    """Reason for no size, lumps that the map could have missed, and the remedy."""
    if exam.disagrees:
        yield "No common size is given: look at each map."
        for number, one in enumerate(exam.maps, start=1):
            size = one.report.leading.max_size_mm
            if size is not None:
                ends = f"{share_words(size)}: {size.low:.1f} to {size.high:.1f} mm"
                yield f"By map {number} alone the largest diameter is about {size.median:.1f} mm ({ends})."
        return
    report, tactile_map = exam.main.report, exam.main.tactile_map
    if exam.pooled is not None:
        yield f"{capitalised(exam.pooled.reason)}."
    if report.reason_code in NO_LUMP:
        area = "" if tactile_map is None else f": {covered_text(tactile_map)}"
        covered = f"in the area that was covered{area}"
        where = "at the place looked at; the masses below lie elsewhere" if exam.elsewhere else covered
        yield f"No lump was found {where}."
        if report.reason_code == "ridge":
            yield "What rises at the cross on the picture is long like a rib, not round like a lump."
        if report.smallest_lump is not None:
            yield f"{smallest_text(report.smallest_lump)}."
        yield "A lump may be smaller, deeper or softer than these, or lie outside the area that was covered."
    else:
        yield f"{capitalised(report.reason)}."
    if report.on_paper:
        yield f"What would help: {report.on_paper}."


def place_sentence(mass: ExamMass, probability: float) -> str:
    """Where a mass lies: by the clock, else from the xiphoid, else on the map."""
    if mass.place is not None:
        hours, (near, far) = mass.place.hours_between(probability), mass.place.distance_between(probability)
        clock = "" if hours is None else f"{clock_text(hours[0])} to {clock_text(hours[1])} o'clock, "
        return f"{short_place(mass)}; {100 * probability:g} %: {clock}{near:.0f} to {far:.0f} mm."
    return f"{short_place(mass)}{'' if mass.patient_mm is not None else '; the scan names no landmarks'}."


def short_place(mass: ExamMass) -> str:
    """Where a mass lies, without intervals."""
    if mass.place is not None:
        return capitalised(mass.place.text())
    if mass.patient_mm is not None:
        return capitalised(from_xiphoid(*mass.patient_mm))
    return "At ({:.0f}, {:.0f}) mm on the map".format(*mass.centre_mm)


def why_no_clock(exam: ShownExam) -> str:
    """The facts missing for a clock position on a patient's scan with a mass; empty if there is one, or no patient."""
    tactile_map = exam.main.tactile_map
    by_clock = any(mass.place is not None for mass in exam.main.masses)
    if by_clock or tactile_map is None or tactile_map.patient_from_plane is None:
        return ""
    lacks = ["nipple"] if tactile_map.nipple_mm is None else []
    lacks += [] if side_of(exam.scans) in ("left", "right") else ["side"]
    return f"No clock position: the scan names no {' and no '.join(lacks)}."


def quality_rows(exam: ShownExam) -> Iterator[tuple[str, str]]:
    """Rows of the table on the exam's quality."""
    if exam.main.tactile_map is not None:
        yield from _scan_rows(exam.main.tactile_map)
    days = [scan["array_calibration_days"] for scan in exam.scans if "array_calibration_days" in scan]
    known = [int(text) for text in days if re.fullmatch(r"-?[0-9]{1,6}", text)]
    age = f"{counted(max(known), 'day')} old at the exam" if known else "age not stated in the scan"
    yield "sensor calibration", age
    calibration = exam.main.report.origin.settings.get("size_calibration")
    if calibration:
        yield "size calibration", str(calibration)[:60]


def _scan_rows(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Rows on coverage, pressure, frames and landmarks."""
    quality = tactile_map.quality
    yield "covered", covered_text(tactile_map)
    if reach := reach_text(tactile_map):
        yield "reaches", reach
    if "mean_pressure_kpa" in quality:
        window = tactile_map.recipe.pressure_window_kpa
        wanted_range = "" if window is None else f" (wanted {window[0]:g} to {window[1]:g} kPa)"
        ends = f"{quality['level_p05_kpa']:.1f} to {quality['level_p95_kpa']:.1f} kPa"
        yield "pressure", f"mean {quality['mean_pressure_kpa']:.1f} kPa, nine frames in ten {ends}{wanted_range}"
    if "frames_total" in quality:
        frames = f"{quality['frames_used']:.0f} of {quality['frames_total']:.0f} used"
        out = [f"{quality[name]:.0f} {words}" for name, words in _LEFT_OUT.items() if quality.get(name)]
        yield "sensor frames", f"{frames}{'; left out: ' if out else ''}{', '.join(out)}"
    if tactile_map.masked_taxels:
        yield "sensor points", f"{len(tactile_map.masked_taxels)} left out as faulty"
    named = "none touched"
    if tactile_map.patient_from_plane is not None:
        named = "sternal notch, xiphoid" + (", nipple" if tactile_map.nipple_mm is not None else "; no nipple")
        repeats = quality.get("landmark_spread_mm")
        named += "" if repeats is None else f"; repeats within {repeats:.1f} mm"
    yield "landmarks", named


def covered_text(tactile_map: TactileMap) -> str:
    """Area with enough readings, holes in it, and the typical number of readings."""
    cell2 = tactile_map.recipe.cell_mm**2 / 100.0
    if not tactile_map.counts_known:
        return f"{_area_text(tactile_map.covered.sum() * cell2)} (how often each place was read is not known)"
    well = tactile_map.covered & (tactile_map.count >= FEW_READINGS)
    text = f"{_area_text(well.sum() * cell2)} read {FEW_READINGS} times or more"
    # cells not covered that have covered ones on all four sides
    sides = [np.logical_or.accumulate(well, axis=axis) for axis in (0, 1)]
    sides += [np.flip(np.logical_or.accumulate(np.flip(well, axis), axis=axis), axis) for axis in (0, 1)]
    holes = int((np.logical_and.reduce(sides) & ~well).sum())
    text += f"; {holes * cell2:.1f} cm² of gaps inside" if holes * cell2 >= 0.05 else "; no gaps inside"
    median = float(np.median(tactile_map.count[well])) if well.any() else 0.0
    return f"{text}; typically {median:.0f} times"


def _area_text(cm2: float) -> str:
    return f"{cm2:.0f} cm²" if cm2 >= 10 else f"{cm2:.2g} cm²"


def reach_text(tactile_map: TactileMap) -> str:
    """How far the covered area reaches, from the xiphoid; empty without landmarks."""
    if tactile_map.patient_from_plane is None:
        return ""
    rows, columns = np.nonzero(tactile_map.covered & ~tactile_map.few)
    if not len(rows):
        return ""
    points = np.stack([tactile_map.x_mm[columns], tactile_map.y_mm[rows], np.zeros(len(rows))], axis=1)
    x, y, _ = apply(tactile_map.patient_from_plane, points).T
    across = _between(float(x.min()), float(x.max()), ("to the patient's left", "to the patient's right"))
    up = _between(float(y.min()), float(y.max()), ("below", "above"))
    return f"{across} of the xiphoid, {up} it"


def _between(low: float, high: float, words: tuple[str, str]) -> str:
    if low >= 0:
        return f"{low:.0f} to {high:.0f} mm {words[1]}"
    if high <= 0:
        return f"{-high:.0f} to {-low:.0f} mm {words[0]}"
    return f"{-low:.0f} mm {words[0]} to {high:.0f} mm {words[1]}"


def mass_row(mass: ExamMass) -> tuple[str, str, str]:
    """Number, size with its interval, and place of a mass, for a table of several."""
    if mass.largest is None:
        chance = "" if mass.probability is None else f" (probability of a lump {chance_text(mass.probability)})"
        size = f"no size{chance}: {mass.why}"
    else:
        size = size_words(mass.largest)
    return str(mass.number), size, short_place(mass)


def facts(exam: ShownExam) -> Iterator[tuple[str, str]]:
    """Rows of an exam's facts: the page's labels, and codes from the scans."""
    if exam.labels.name:
        yield "Name", exam.labels.name
    for key in ("subject", "side", "mass", "visit", "posture", "examiner"):
        values = list(dict.fromkeys(scan[key] for scan in exam.scans if scan.get(key)))
        if values:
            text = first_of([cut(value, 32) for value in values], 2)
            if key == "mass" and exam.elsewhere:
                text += " (none of those on the map)"
            elif key == "mass" and len(exam.main.masses) > 1:
                text += f" (number {exam.main.masses[0].number} on the map)"
            yield key.capitalize(), text
    if exam.labels.day:
        yield "Date", exam.labels.day
