"""The page of an exam."""

from __future__ import annotations

from typing import Any, Final

from tactile_bayes.findings import finding_lines, first_lines
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.posterior.verdict import SHARE_WITH_LUMP, chance_text
from tactile_bayes.presets import INTERVAL
from tactile_bayes.report import exam_words, svg
from tactile_bayes.report.estimate_document import size_words
from tactile_bayes.report.estimate_text import spread_percent, width_lines
from tactile_bayes.report.exam_words import ShownExam, headline
from tactile_bayes.report.pages import cut, foot, page

# --- An exam as one self-contained page that prints to one side of A4: no script, nothing loaded, every text escaped.

TITLE: Final = "Tactile exam"
MOST_REPEATS: Final = 5
_FINDINGS: Final = ((2, 320), (1, 220))
"""Findings, of which cautions are never left out, and letters of each; and on a crowded page."""
_PICTURE_MM: Final = (108.0, 96.0)
_LOWER_MM: Final = 54.0
"""Height of the picture on a crowded page: one that has both repeats and several masses below it."""
_REPEAT_MM: Final = (30.0, 19.0)


def exam_page(exam: ShownExam) -> str:
    """Full HTML page of an exam; equal exams give equal text."""
    crowded = len(exam.maps) > 1 and len(exam.main.masses) > 1
    most, longest = _FINDINGS[crowded]
    size, several = exam.largest, len(exam.maps) > 1
    drawn, report, least = exam.main.tactile_map, exam.main.report, exam.main.report.smallest_lump
    height_mm = _LOWER_MM if crowded else _PICTURE_MM[1]
    frame = None if drawn is None else svg.Frame.within(drawn, width_mm=_PICTURE_MM[0], height_mm=height_mm)
    seed, cautions = report.provenance.get("seed"), finding_lines(exam.report.findings, "caution", paper=True)
    checks = finding_lines(exam.report.findings, "check", paper=True)
    checks = first_lines(checks, max(0, most - len(cautions)), ", which the full report tells.")
    masses = sorted(exam.main.masses, key=lambda one: one.number)
    masses = masses if len(masses) > 1 or exam.elsewhere else []
    made = f"method {report.origin.settings.get('method', 'unknown')}"
    made += f"; {exam.report.known_words}" if size and exam.report.known_words else ""
    shown = exam.maps[:MOST_REPEATS] if several else ()
    alone = ["no size" if (q := one.report.leading.max_size_mm) is None else size_words(q) for one in shown]
    return page(
        "exam",
        title=cut(exam.labels.title, 60) or TITLE,
        crowded=crowded,
        facts=list(exam_words.facts(exam)),
        headline=headline(exam),
        findings=[*cautions, *checks],
        longest_finding=longest,
        exam=exam,
        frame=frame,
        picture=frame and svg.exam_picture(exam.drawn, frame, label=f"Map: {headline(exam)}"),
        colours=frame and svg.colour_bar(exam.main),
        marked=frame and svg.marked_place(exam.main),
        smallest=[] if least is None or drawn is None else list(svg.smallest_pictures(drawn, least)),
        of_mass=f" of mass {exam.main.masses[0].number}" if masses else "",
        place=_place(exam) if exam.main.masses else None,
        size=size
        and {"ruler": svg.size_ruler(_intervals(exam, size)), "sentences": list(exam_words.size_sentences(exam, size))},
        nothing=[] if size else list(exam_words.nothing_sentences(exam)),
        narrowing=width_lines(exam.report.leading.variance_share, paper=True),
        masses=[exam_words.mass_row(mass) for mass in masses],
        maps=len(exam.maps),
        repeats=list(zip(svg.small_pictures(shown, room_mm=_REPEAT_MM), alone, strict=True)) if shown else [],
        of_map=f" (map {exam.main_number})" if several else "",
        quality=list(exam_words.quality_rows(exam)),
        foot=foot(exam.scans, made if seed is None else f"{made}; seed {seed}"),
    )


def _place(exam: ShownExam) -> dict[str, Any]:
    """Clock face of the breast, with sentences on the lump's place and probability."""
    mass = exam.main.masses[0]
    sentences = [exam_words.place_sentence(mass, INTERVAL if exam.largest is None else exam.largest.probability)]
    if mass.probability is not None:
        which = f"map {exam.main_number}" if len(exam.maps) > 1 else "this map"
        chance = f"Probability that it is a lump, by {which}: {chance_text(mass.probability)}"
        sentences.append(f"{chance}, if one such exam in {1 / SHARE_WITH_LUMP:g} shows one.")
    return {
        "dial": svg.breast_dial(exam.main.masses),
        "sentences": sentences,
        "no_clock": exam_words.why_no_clock(exam),
    }


def _intervals(exam: ShownExam, size: Quantity) -> list[tuple[str, Quantity]]:
    """Both intervals of the largest size, with what they suppose."""
    another, alike = exam.report.another_exam, exam.report.figures.get("between_map_sd")
    narrow_size = exam.report.max_size_mm
    if another is None or narrow_size is None:
        return [("this exam" if exam.pooled is None else "these exams", size)]
    narrow = "exams alike" if alike is None else f"if exams differ by {spread_percent(alike)}"
    return [(f"as exams of patients differ, {100 * another.between_map_sd:.0f} %", size), (narrow, narrow_size)]
