"""Reports of one size from several maps, made and in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from tactile_bayes.declarations import UNSET
from tactile_bayes.files.provenance import Provenance, repeated_scans, scans_of
from tactile_bayes.files.reports import POOLED, EstimateReport, Interval, MassReport, PooledMap, PooledReport
from tactile_bayes.findings import Finding, finding, finding_lines, finding_summary, first_lines, first_of, verdict
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.posterior.verdict import chance_text
from tactile_bayes.presets import MATCH_MM, RESEARCH_USE
from tactile_bayes.report import estimate_text
from tactile_bayes.report.calibration import site_words, unknowns_text
from tactile_bayes.report.estimate_document import another_exam, supposed_line, supposed_lines, suppositions
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import EXTREMES, LEAST_PROBABILITY
from tactile_bayes.size.pooling import DISAGREE, PooledEstimate, Repeatability
from tactile_bayes.size.terms import UNLIKE_LEARNED, unknown_head

# --- The mass of each map that is pooled: by its place in the patient.
#
# A report is about the surest mass of its map, so of two maps of one breast each may report another one. With
# landmarks the masses of all maps have places in patient axes, and the one that most maps show is pooled.


def maps_of_another_mass(reports: Sequence[EstimateReport]) -> dict[int, tuple[float, float]]:
    """Maps that report another mass than the common one, with its place on each, mm; empty without landmarks."""
    maps = _masses_by_map(reports)
    common = _common_mass(maps)
    nearest = {} if common is None else {i: _matching_mass(masses, common) for i, masses in maps.items()}
    return {i: one.centre_mm.median for i, one in nearest.items() if one is not None and not one.reported}


def maps_lying_apart(reports: Sequence[EstimateReport]) -> dict[int, str] | None:
    """Maps whose reported mass lies elsewhere than the common one, in words; None where that cannot be told."""
    reported = {i: [one for one in masses if one.reported] for i, masses in _masses_by_map(reports).items()}
    if len(reported) < 2:
        return None
    all_masses = [mass for masses in reported.values() for mass in masses]
    common = _common_mass(reported) or max(all_masses, key=_amplitude, default=None)
    distances = {i: _distance_mm(one, common) for i, masses in reported.items() for one in masses if common is not None}
    words = "its mass lies {:.0f} mm from that of the other maps and may be another one"
    return {i: words.format(mm) for i, mm in distances.items() if mm > MATCH_MM}


def _masses_by_map(reports: Sequence[EstimateReport]) -> dict[int, tuple[MassReport, ...]]:
    """Masses of the maps with a lump, by the map's place in the list; none where one has no place in the patient."""
    by_map = {i: one.masses for i, one in enumerate(reports) if one.masses}
    return {} if any(mass.centre_patient_mm is None for masses in by_map.values() for mass in masses) else by_map


def _distance_mm(one: MassReport, other: MassReport) -> float:
    assert one.centre_patient_mm is not None  # see `_masses_by_map`
    assert other.centre_patient_mm is not None
    return float(np.hypot(*np.subtract(one.centre_patient_mm.median, other.centre_patient_mm.median)))


def _amplitude(mass: MassReport) -> float:
    return 0.0 if mass.amplitude is None else mass.amplitude.median


def _common_mass(maps: Mapping[int, Sequence[MassReport]]) -> MassReport | None:
    """A mass at the place where most maps show one, sized by most, then reported by most; None where all are apart."""

    def worth(common: MassReport) -> tuple[int, int, int, float]:
        """On how many maps it is found, sized and reported, and the median of its amplitudes."""
        matches = [one for one in (_matching_mass(masses, common) for masses in maps.values()) if one is not None]
        sized, reported = sum(match.max_size_mm is not None for match in matches), sum(one.reported for one in matches)
        return len(matches), sized, reported, float(np.median([_amplitude(one) for one in matches]))

    best = max((mass for masses in maps.values() for mass in masses), key=worth, default=None)
    return best if best is not None and worth(best)[0] > 1 else None


def _matching_mass(masses: Sequence[MassReport], common: MassReport) -> MassReport | None:
    """The mass nearest to a place, if it lies within `MATCH_MM` of it."""
    near = min(masses, key=lambda one: _distance_mm(one, common), default=None)
    return near if near is not None and _distance_mm(near, common) <= MATCH_MM else None


# --- The report made.


def pooled_report(
    pooled: PooledEstimate,
    names: Sequence[str],
    reports: Sequence[EstimateReport],
    calibration: BodyCalibration,
    *,
    probability: float,
    provenance: Provenance,
    repeatability: Repeatability | None = None,
) -> PooledReport:
    """Report of a mass from what `estimate` says of its maps; `repeatability`: the site's, where the size is by it."""
    size, sized_by = pooled.size, pooled.calibration or calibration
    head = unknown_head(sized_by.recipe.head)
    largest, smallest = (None if size is None else size.summarise(one, probability=probability) for one in EXTREMES)
    return PooledReport(
        schema=POOLED,
        status=pooled.status,
        verdict=verdict(pooled.findings, answered=size is not None),
        findings=pooled.findings,
        reason=pooled.reason,
        max_size_mm=largest,
        min_size_mm=smallest,
        another_exam=another_exam(size, probability=probability),
        supposing=suppositions(size, largest),
        maps=tuple(_pooled_map(i, name, reports[i], pooled) for i, name in enumerate(names)),
        one_size_probability=pooled.one_size,
        one_place_probability=pooled.one_place,
        variance_share=None if size is None else dict(size.variance_share),
        figures={} if size is None else dict(size.figures),
        left_out=(*([head] if any(head in report.left_out for report in reports) else []), *sized_by.omissions()),
        fat_mm=sized_by.fat_mm,
        unknowns=dict(sized_by.unknowns),
        site=None if sized_by.site is None else site_words(sized_by.site),
        repeatability=UNSET if repeatability is None else repeatability.words(),
        research_use=RESEARCH_USE,
        provenance=provenance.as_dict(),
    ).rounded


def _pooled_map(index: int, name: str, report: EstimateReport, pooled: PooledEstimate) -> PooledMap:
    size, reported = report.max_size_mm, [mass.number for mass in report.masses if mass.reported]
    return PooledMap(
        map=name,
        mass=(*reported, len(report.masses)) if len(report.masses) > 1 and reported else (),
        status=report.status,
        reason=report.reason,
        detected_probability=report.detected_probability,
        max_size_mm=None if size is None else Interval(size.median, size.low, size.high, size.probability),
        outlying=index in pooled.outlying,
    )


def pooled_findings(pooled: PooledEstimate, reports: Sequence[EstimateReport]) -> Iterator[Finding]:
    """Findings on each map, named by its number, also on one that shows no lump, and on the maps together."""
    if pooled.status == DISAGREE and pooled.one_place is not None and pooled.one_place < LEAST_PROBABILITY:
        yield disagreement(pooled.reason, pooled.one_place)
    elif pooled.status == DISAGREE and pooled.one_size is not None:
        yield disagreement(pooled.reason, pooled.one_size, pooled.one_size_apart)
    for index, report in enumerate(reports):
        for one in report.findings:
            if one.kind != "outside_calibration":  # of the size alone
                yield one.labelled(_number(index))
    apart = maps_lying_apart(reports)
    for index, words in (apart or {}).items():
        yield finding("another_mass", words, about=_number(index))
    for index, earlier in repeated_scans([scans_of(one.provenance) for one in reports]).items():
        words = f"a map of the same scan as {_number(earlier)} is no repeat: the interval is too narrow"
        yield finding("same_scan", words, about=_number(index))
    if pooled.fat_apart_mm is not None:
        yield fat_apart(pooled.fat_apart_mm)
    for text in pooled.outside:
        yield finding("outside_calibration", f"{UNLIKE_LEARNED}: {text}")
    for index in pooled.outlying:
        yield finding("outlying", "lies apart from the others: look at this map", about=_number(index))
    for index, report in enumerate(reports):
        for rise in () if apart == {} else report.other_rises:
            text = f"another rise stands at ({rise.x_mm:.1f}, {rise.y_mm:.1f}) mm"
            same = "check that every map was sized at the same mass"
            yield finding("several_masses", text, same, same, _number(index))


def disagreement(reason: str, probability: float, if_exams_differ: float | None = None) -> Finding:
    """Caution where maps are not of one size or mass: one gives maps so far apart with these probabilities only."""
    patients = ""
    if if_exams_differ is not None:
        patients = f" ({chance_text(if_exams_differ, 3)} if exams differ as those of patients did)"
    text = f"{reason}; one mass gives maps so far apart with a probability of {chance_text(probability, 3)}{patients}"
    on_paper = "look at each map: one may be of another mass or of another day"
    return finding("maps_disagree", text, f"{on_paper}, or exams differ more at this site (--repeatability)", on_paper)


def _number(index: int) -> str:
    """A map by its number: a file's name may be a patient's."""
    return f"map {index + 1}"


def fat_apart(depths_mm: tuple[float, float]) -> Finding:
    """Caution where maps differ too much in the depth of fat to be of one breast."""
    text = "the fat under the head is {:.1f} mm deep on one map and {:.1f} mm on another: they may be of two bodies"
    return finding("fat_apart", text.format(*depths_mm))


def pooled_summary(report: PooledReport) -> str:
    """Report of a mass in at most 12 lines; `pooled_text` gives the rest."""
    findings, largest, figures = report.findings, report.max_size_mm, report.figures
    lines = finding_summary(findings, "caution")
    sizes = [one.max_size_mm for one in report.maps if one.max_size_mm is not None]
    if sizes:
        words = first_of([_size_words(size, with_ends=report.status == DISAGREE) for size in sizes], 4)
        alike = _alike(report) if report.status == DISAGREE else ""
        shown = f"A lump was found on {len(sizes)} of {len(report.maps)} maps"
        lines.append(f"{shown}, alone sized at {words} mm{alike}.")
    lines += finding_summary(findings, "check", most=2)
    if largest is None:
        lines.append(_no_size_line(report))
        bare = [f"Map {i}: {one.reason}." for i, one in enumerate(report.maps, 1) if one.max_size_mm is None]
        lines += first_lines(bare, 4, ": -v.")
    else:
        lines += estimate_text.size_table(report) + estimate_text.width_lines(report.leading.variance_share)
        parts = [
            f"sizes by {report.site}" if report.site else "",
            report.known_words,
            f"interval ends to {largest.mc_error / largest.sd:.3f} SD" if largest.sd > 0 else "",
            f"the maps of this mass differ by {100 * figures['between_map_sd']:.0f} %",
            report.site_words,
            "irregular outline, with a wider interval" if figures.get("irregular_outline") else "",
        ]
        lines.append(f"Quality: {'; '.join(filter(None, parts))}.")
        if len(lines) < estimate_text.MOST_LINES - 2:
            lines += supposed_line(report.supposing, largest.median, places=estimate_text.size_decimals(_sizes(report)))
    return "\n".join([*lines, estimate_text.MORE, RESEARCH_USE]) + "\n"


def _size_words(size: Interval, *, with_ends: bool) -> str:
    return f"{size.median:.1f}" + (f" ({size.low:.1f} to {size.high:.1f})" if with_ends else "")


def _alike(report: PooledReport) -> str:
    """What the intervals of single maps suppose, where no spread between exams was stated."""
    stated = report.site_words or report.provenance["settings"].get("between_map_sd") is not None
    return "" if stated else ", if exams repeat as simulated ones do"


def _no_size_line(report: PooledReport) -> str:
    head = "No common size" if report.status == DISAGREE else "No estimate"
    return f"{head}: {report.reason}."


def pooled_text(report: PooledReport) -> str:
    """Full report of a mass."""
    lines = finding_lines(report.findings, "caution")
    for number, one in enumerate(report.maps, start=1):
        outcome = f"no estimate ({one.reason})"
        if one.max_size_mm is not None:
            mass = "  (mass {} of {} on this map)".format(*one.mass) if one.mass else ""
            outcome = f"{_size_words(one.max_size_mm, with_ends=True)} mm alone{_alike(report)}{mass}"
        lines.append(f"{number}. {one.map}: {outcome}")
    lines += finding_lines(report.findings, "check")
    if report.max_size_mm is None:
        return "\n".join([*lines, _no_size_line(report), RESEARCH_USE]) + "\n"
    sizes, figures = _sizes(report), report.figures
    worst, places = max(sizes, key=lambda q: q.mc_error), estimate_text.size_decimals(sizes)
    lines += ["", *estimate_text.size_table(report), ""]
    lines += estimate_text.width_lines(report.leading.variance_share)
    lines += supposed_lines(report.supposing, report.max_size_mm.median, places=places)
    lines.append(f"Spread between the maps of this mass: {100 * figures['between_map_sd']:.0f} %.")
    if report.one_size_probability is not None:
        chance = chance_text(report.one_size_probability, 3)
        lines.append(f"Probability that maps of one mass are as far apart in size or farther: {chance}.")
    if report.site_words:
        lines.append(estimate_text.site_interval_text(report.site_words))
    lines.append(estimate_text.shape_text(figures))
    ends = estimate_text.ends_text("sizes", worst.mc_error, worst.sd)
    lines.append(f"Monte-Carlo error of the interval ends: {ends}.")
    lines.append(f"{unknowns_text(report.unknowns, report.fat_mm).capitalize()}.")
    lines += [f"Sizes by {report.site}."] if report.site else []
    lines += [f"{report.known_words.capitalize()}."] if report.known_words else []
    lines += [f"Left out: {'; '.join(report.left_out)}."] if report.left_out else []
    lines += [f"{report.reason}."] if report.reason else []
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _sizes(report: PooledReport) -> list[Quantity]:
    return [one for one in (report.max_size_mm, report.min_size_mm) if one is not None]
