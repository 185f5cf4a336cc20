"""The maps of two visits and more, compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api import pooled
from tactile_bayes.api.arguments import PathLike, TextResult, door, list_of, output_path, path_of, plain, takes
from tactile_bayes.api.estimates import estimate_each, settings_of
from tactile_bayes.api.settings import Settings, days_from_first, refuse_checkpoint
from tactile_bayes.api.sized import Answer, SizeEstimate, size_priors
from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.errors import CANNOT_SHOW, EXIT_DONE, EXIT_NO_ESTIMATE, UsageError
from tactile_bayes.files.provenance import Provenance, repeated_scans, scans_of
from tactile_bayes.findings import Finding, Verdict, by_severity, finding, finding_lines, verdict
from tactile_bayes.inference.draws import Draws
from tactile_bayes.options import GROWTH_SHARES, CompareOptions
from tactile_bayes.presets import REGISTRATION_MM
from tactile_bayes.report.compare import CompareReport, compare_report, compare_summary, compare_text
from tactile_bayes.report.estimate_document import at_place
from tactile_bayes.report.exam_words import PageLabels
from tactile_bayes.report.growth_page import Course, DrawnMap, draw_comparison, growth_page
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.report.pooled import disagreement, fat_apart
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import LEAST_PROBABILITY, BetweenMaps, ShapeDraws, one_size_by_draws
from tactile_bayes.size.pooling import MOST_INVALID, log_sizes
from tactile_bayes.size.terms import UNLIKE_LEARNED
from tactile_bayes.size.visits import (
    Change,
    JointSizes,
    PatientPlace,
    PlaceShift,
    VisitComparison,
    contradictions,
    joint_sizes,
    one_place_probability,
    place_shift,
    visit_calibrations,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LARGEST_SHARE = 3.0  #: Of a growth that is asked for; what is larger is surely in percent.

# --- Two visits and more compared: whether they are of one mass, and the change of its size.


class Comparison(TextResult, eq=False):
    """The size of one mass at several visits, and its change from the first to the last."""

    compared: VisitComparison
    report: CompareReport
    settings: Settings
    visits: tuple[tuple[SizeEstimate, ...], ...] = ()
    """The estimates of each visit's maps alone, where they are at hand."""
    dates: tuple[str, ...] = ()  #: Of the visits; empty where they were not given.

    @property
    def probability(self) -> float:
        """Probability of the intervals shown by default."""
        return self.settings.interval

    @property
    def exit_code(self) -> int:
        """0 for a comparison, else 6."""
        return EXIT_DONE if self.compared.joint is not None else EXIT_NO_ESTIMATE

    @property
    def _change(self) -> Change | None:
        joint = self.compared.joint
        return None if joint is None else joint.change(0, len(self.report.visits) - 1)

    @property
    def status(self) -> str:
        """``"compared"``, ``"not_one_mass"`` or ``"no_estimate"``."""
        return self.compared.status

    @property
    def why(self) -> str:
        """Reason for no comparison; empty where there is one."""
        return self.compared.reason

    @property
    def change_percent(self) -> Draws | None:
        """Change of the diameter in percent; None where nothing is compared."""
        change = self._change
        if change is None:
            return None
        return Draws(np.atleast_2d(100.0 * np.expm1(change.log_ratio)), "%", self.probability, change.replicates)

    @property
    def sizes_mm(self) -> tuple[Draws, ...]:
        """Largest diameter at each visit; empty where nothing is compared."""
        joint = self.compared.joint
        if joint is None:
            return ()
        drawn = np.exp(joint.log_size)
        return tuple(Draws(np.atleast_2d(one), "mm", self.probability, joint.replicates) for one in drawn)

    def probability_grown(self, share: float = 0.0) -> float | None:
        """Probability that the diameter has grown by more than a share of it (0.2: by more than 20 %)."""
        change = self._change
        return None if change is None else change.probability_above(share)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against the comparison, cautions first."""
        return self.compared.findings

    @property
    def verdict(self) -> Verdict:
        """``"sound"``, ``"doubtful"`` where a caution stands, or ``"no_answer"`` where nothing is compared."""
        return verdict(self.findings, answered=self._change is not None)

    @property
    def growth(self) -> str | None:
        """``"grown"``, ``"shrunk"`` or ``"no_change_shown"``; None where nothing is compared."""
        changes = self.report.changes
        return changes[-1].verdict if changes else None

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``compare --json`` prints."""
        return self.report.document

    @property
    def text(self) -> str:
        """The text that ``compare`` prints."""
        return compare_summary(self.report)

    @property
    def full_text(self) -> str:
        """The text that ``compare -v`` prints."""
        return compare_text(self.report)

    @door
    def page(
        self, path: PathLike, *, pdf: PathLike | None = None, title: str = "", name: str = "", force: bool = False
    ) -> None:
        """Write one page of the mass over time as HTML, as ``compare -o`` does, and with `pdf` also print it."""
        files = PageFiles(output_path(path, "HTML"), path_of(pdf), force)
        PageLabels(title, name)
        files.write(self.page_text(title=title, name=name))

    def page_text(self, *, title: str, name: str) -> str:
        """The page's HTML."""
        visit_codes = tuple(_common_fact("visit", visit) for visit in self.visits)
        patient, side, mass = (_common_fact(fact, [*chain(*self.visits)]) for fact in ("subject", "side", "mass"))
        distinct = visit_codes if all(visit_codes) and len(set(visit_codes)) == len(visit_codes) else ()
        course = Course(title, name, patient, side, mass, visits=distinct, dates=self.dates)
        return growth_page(self.compared, self.report, self._drawn(), course)

    @door
    def plot(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the visits' maps, their difference and the change; with a path also write it."""
        return draw_comparison(self.compared, self.report, self._drawn(), path_of(path), force=force)

    def _drawn(self) -> list[list[DrawnMap]]:
        return [[DrawnMap(one.tactile_map, one.answer.report) for one in visit] for visit in self.visits]

    def __repr__(self) -> str:
        cautions = finding_lines(self.findings, "caution", paper=True)
        words = f"not compared: {self.why}" if self.growth is None else f"{self.change_percent}, {self.growth}"
        return f"<Comparison {' '.join([*cautions, f'of {len(self.report.visits)} visits: {words}'])}>"


Visits = Sequence[Sequence[SizeEstimate]]
Names = Sequence[Sequence[str]]  #: Of the maps of each visit, for the report.
Files = Sequence[Sequence[Path]]  #: That the maps of each visit came from.


def compare_answers(
    visits: Sequence[Sequence[Answer]],
    settings: Settings,
    comparing: CompareOptions,
    *,
    names: Names,
    files: Files = (),
    numbers: Sequence[str] = (),
) -> Comparison:
    """Compare the visits of one mass, from answers for their maps in order of time.

    `numbers` of the visits for findings and reasons, with codes where these are others; by default from 1 on.
    """
    if not all(visits):
        raise UsageError("a comparison needs two visits of a map or more each: `compare VISIT1.nc --with VISIT2.nc`")
    comparing.check_visits(len(visits))
    if settings.size_calibration == "none":
        raise UsageError("a comparison needs a size calibration; leave out --size-calibration none")
    answers = list(chain.from_iterable(visits))
    all_names = list(chain.from_iterable(names))
    inputs = {f"visit_{v}_map_{i}": path for v, maps in enumerate(files, 1) for i, path in enumerate(maps, 1)}
    calibration, named, digests = pooled.common_calibration(answers, settings, names=all_names, inputs=inputs)
    for index, earlier in repeated_scans([_scans([one]) for one in answers]).items():  # they are no two exams
        raise UsageError(f"{all_names[index]} and {all_names[earlier]} are of one scan; give one map of each scan")
    by_number = dict(zip(numbers or map(str, range(1, len(visits) + 1)), visits, strict=True))
    compared = _compared(by_number, calibration, settings, comparing)
    of_visits = (
        one.labelled(f"visit {number}" if len(maps) == 1 else f"visit {number}, map {i}")
        for number, maps in by_number.items()
        for i, answer in enumerate(maps, start=1)
        for one in (*answer.report.findings, *(() if numbers else _which_mass(answer)))
        if one.kind != "outside_calibration"  # of a size alone: judged anew
    )
    compared = replace(compared, findings=by_severity((*compared.findings, *of_visits)))
    scans = _scans(answers)
    recorded = {name: value for name, value in settings.recorded(size_calibration=named).items() if name in _RECORDED}
    provenance = Provenance("compare", recorded | as_dict(comparing), digests, seed=settings.seed, scans=scans)
    report = compare_report(
        compared,
        [[answer.report for answer in one] for one in visits],
        names,
        comparing,
        probability=settings.interval,
        provenance=provenance,
        repeatability=settings.repeatability,
    )
    return Comparison(compared, report, settings)


def _which_mass(answer: Answer) -> Iterator[Finding]:
    """A check that names the mass of a map of several that is compared; a campaign's table says which it is."""
    masses = answer.report.masses
    for mass in masses if len(masses) > 1 else ():
        if mass.reported:
            x, y = mass.centre_mm.median
            text = f"the map shows {len(masses)} masses, and the one {at_place(x, y)} is compared"
            yield finding("several_masses", text)


def _common_fact(fact: str, maps: Sequence[SizeEstimate]) -> str:
    """This fact as the scans of all maps that name it have it; empty without any, and where they differ."""
    values = {scan[fact] for one in maps for scan in one.provenance.scans if scan.get(fact)}
    return values.pop() if len(values) == 1 else ""


def compare_estimates(
    visits: Visits, settings: Settings, comparing: CompareOptions, *, names: Names, files: Files = ()
) -> Comparison:
    """Compare visits, maps estimated again where they are of another mass; see `compare_answers`."""
    codes = [_common_fact("visit", visit) for visit in visits]
    if comparing.days is None and all(map(str.isdecimal, codes)) and sorted(codes, key=int) != codes:
        listed = ", ".join(f"visit {number} is coded {code}" for number, code in enumerate(codes, 1))
        raise UsageError(
            f"in the scans {listed}; give visits in order of time, or their --dates if codes do not tell it"
        )
    estimates = iter(pooled.reestimate_at_common_mass([one for visit in visits for one in visit]))
    by_visit = tuple(tuple(next(estimates) for _ in visit) for visit in visits)
    answers = [[one.answer for one in visit] for visit in by_visit]
    return replace(compare_answers(answers, settings, comparing, names=names, files=files), visits=by_visit)


def _compared(
    visits: Mapping[str, Sequence[Answer]], calibration: BodyCalibration, settings: Settings, comparing: CompareOptions
) -> VisitComparison:
    """Compare the visits, by their numbers, unless codes, places or missing lumps forbid it."""
    shown = {number: [answer for answer in maps if answer.shape is not None] for number, maps in visits.items()}
    missing = [words for number, maps in visits.items() if (words := _missing(maps, f"visit {number}"))]
    contradicted = contradictions({number: _scans(maps) for number, maps in visits.items()})
    if contradicted:
        advice = "compare exams of one mass; where a code is wrong, correct it in the scans' session and map them again"
        return VisitComparison("not_one_mass", "; ".join(contradicted), advice)
    if missing:
        return VisitComparison("no_estimate", "; ".join(missing), "scan the mass again, or leave that visit out")
    if why := pooled.without_calibration([one.report for maps in visits.values() for one in maps]):
        return VisitComparison("no_estimate", why, "compare maps that have a size each")
    map_places = [
        [place for answer in maps if (place := pooled.patient_place(answer.report)) is not None]
        for maps in shown.values()
    ]
    places = [PatientPlace.mean_of(of_visit) for of_visit in map_places]
    shifts = tuple(
        None if first is None or later is None else place_shift(first, later, registration_mm=comparing.registration_mm)
        for first, later in ((places[0], later) for later in places[1:])
    )
    first, *later = visits
    doubts = [
        f"the masses of visits {first} and {number} lie {one.distance_mm:.0f} mm apart "
        f"(one mass: SD {one.sd_mm:.0f} mm each way)"
        for number, one in zip(later, shifts, strict=True)
        if one is not None and one.doubtful
    ]
    doubts += [
        f"the masses on the maps of visit {number} lie too far apart for one"
        for number, maps in zip(visits, map_places, strict=True)
        if one_place_probability(maps, registration_mm=comparing.registration_mm) < LEAST_PROBABILITY
    ]
    unknown = [number for number, place in zip(visits, places, strict=True) if place is None]
    if not comparing.same_mass and doubts:
        advice = "compare exams of one mass; if it is one, --same-mass says so (a wider posture: --registration-mm)"
        on_paper = "look whether they are of one mass"
        return VisitComparison("not_one_mass", "; ".join(doubts), advice, shifts, on_paper=on_paper)
    if not comparing.same_mass and unknown:
        reason = f"no landmarks show where the mass of visit {' and '.join(unknown)} lies in the patient"
        touch = "touch both landmarks"
        return VisitComparison("not_one_mass", reason, f"{touch}, or say --same-mass", shifts, on_paper=touch)
    doubts += [f"no landmarks show where the mass of visit {number} lies" for number in unknown]
    findings = [finding("taken_as_one", f"{text}; taken as one mass because you say so") for text in doubts]
    return _sized(shown, calibration, settings, shifts=shifts, doubts=findings)


def _missing(maps: Sequence[Answer], visit: str) -> str:
    """Reason for a visit without a size: too few of the maps that could show a lump show one; else empty."""
    lumps = sum(answer.shape is not None for answer in maps)
    silent = [one.report for one in maps if one.report.reason_code == CANNOT_SHOW]
    if lumps and 2 * lumps >= len(maps) - len(silent):
        return ""
    if silent and len(silent) == len(maps):
        return f"{visit}: {silent[0].reason}"
    return f"a lump was found on {lumps} of {len(maps)} maps of {visit}"


def _sized(
    visits: Mapping[str, Sequence[Answer]],
    calibration: BodyCalibration,
    settings: Settings,
    *,
    shifts: tuple[PlaceShift | None, ...],
    doubts: Sequence[Finding],
) -> VisitComparison:
    """Compare the sizes of visits of one mass, or say why they have none."""
    # sorted, so that the result does not depend on the order of a visit's maps
    by_number: dict[str, list[ShapeDraws]] = {
        number: sorted((answer.shape for answer in maps if answer.shape is not None), key=lambda one: one.order)
        for number, maps in visits.items()
    }
    shapes = list(by_number.values())
    fitted = visit_calibrations(shapes, calibration)
    far = _by_visit(by_number, fitted, far=True)
    if far:
        return VisitComparison("no_estimate", f"too {UNLIKE_LEARNED}: {'; '.join(far)}", "", shifts)
    priors = size_priors(settings)
    fingerprints = sorted(answer.fingerprint for maps in visits.values() for answer in maps)

    def joint(between: BetweenMaps | None) -> JointSizes:
        rng = np.random.default_rng([settings.seed, *fingerprints])
        return joint_sizes(shapes, calibration=calibration, priors=priors, rng=rng, between=between)

    sizes = joint(None)
    if np.isnan(sizes.log_size).mean() > MOST_INVALID:
        return VisitComparison("no_estimate", "too many draws have no positive size", "", shifts)
    outside = _by_visit(by_number, fitted)
    fat = calibration.depth
    depths = None if fat is None else fat.disagreement_mm([one.profile for maps in shapes for one in maps])
    findings = [
        *doubts,
        *(finding("outside_calibration", f"{UNLIKE_LEARNED}: {text}") for text in outside),
        *([] if depths is None else [fat_apart(depths)]),
    ]
    for (number, maps), at in zip(by_number.items(), fitted, strict=True):
        chance = one_size_by_draws(log_sizes(at, maps), priors.between_maps)
        if chance < LEAST_PROBABILITY:
            findings.append(disagreement("its maps show different sizes", chance).labelled(f"visit {number}"))
    another = None if priors.another_exam is None else joint(priors.another_exam)
    return VisitComparison("compared", "", "", shifts, tuple(findings), sizes, another)


def _by_visit(
    shapes: Mapping[str, Sequence[ShapeDraws]], fitted: Sequence[BodyCalibration], *, far: bool = False
) -> list[str]:
    """Texts on maps whose medians lie outside the calibration of their visit, or `far` outside, each once."""
    texts = [
        f"visit {number}: {text}"
        for (number, maps), at in zip(shapes.items(), fitted, strict=True)
        for one in maps
        for text in at.outside(*one.middle, far=far)
    ]
    return list(dict.fromkeys(texts))


def _scans(answers: Sequence[Answer]) -> list[Mapping[str, str]]:
    return [scan for answer in answers for scan in scans_of(answer.report.provenance)]


_RECORDED = ("size_calibration", "method", "interval", "scene", "between_map_sd", "repeatability")


@takes(Settings, without=["settings_file"])
def compare(
    first: Any,
    second: Any,
    *more: Any,
    days: Sequence[float] | None = None,
    dates: Sequence[str] | None = None,
    grown_by: Sequence[float] = GROWTH_SHARES,
    same_mass: bool = False,
    registration_mm: float = REGISTRATION_MM,
    **settings: Any,
) -> Comparison:
    """Compare the size of a mass at two visits and more.

    Parameters
    ----------
    first, second, *more
        A visit each, in order of time: a map, a path or an estimate, or a list of them.
    days
        Days from the first visit to each later one; adds growth rates.
    dates
        The visits' dates, in place of days, such as ``["2026-01-15", "2026-04-20"]``.
    grown_by
        Growths of the diameter, as shares (0.2 for 20 %): adds the probability of having grown by more.
    same_mass
        Say that the visits are of one mass where landmarks are missing, or place it too far apart.
    registration_mm
        SD along each axis of one mass's place between visits, by posture and landmarks.
    **settings
        As of `estimate`, for visits that are not estimated yet.

    Raises
    ------
    UsageError
        When a visit has no map, a map or a scan is given twice, or days do not fit.
    BadDataError
        As of `estimate`, and when the maps were normalised in several ways.
    """
    own_settings = settings_of(settings)
    refuse_checkpoint(own_settings)
    later = None if days is None else map(plain, list_of("days", days, "numbers, one for each later visit"))
    visit_dates = None if dates is None else list_of("dates", dates, "dates, one for each visit")
    times = days_from_first(None if later is None else list(later), visit_dates)
    shares = tuple(plain(one) for one in list_of("grown_by", grown_by, "shares, such as 0.2 for 20 %"))
    for share in shares:
        if isinstance(share, int | float) and share > _LARGEST_SHARE:
            raise UsageError(f"grown_by {share:g} is {100 * share:g} %; give a share: {share / 100:g} for {share:g} %")
    comparing = CompareOptions(times, shares, same_mass, plain(registration_mm))
    comparing.check_visits(2 + len(more))
    visits = [
        estimate_each(one if isinstance(one, Sequence) and not isinstance(one, str) else [one], settings)
        for one in (first, second, *more)
    ]
    pooled.refuse_repeated_maps(list(chain.from_iterable(visits)), way_out="give each map once, at its own visit")
    names = [[one.name or f"visit {v} map {i}" for i, one in enumerate(visit, 1)] for v, visit in enumerate(visits, 1)]
    comparison = compare_estimates(visits, own_settings, comparing, names=names)
    return replace(comparison, dates=tuple(map(str, visit_dates or ())))
