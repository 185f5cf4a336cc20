"""The short report of an estimate: 12 lines at most, and nothing in it that the whole report lacks."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from plain_reports import report_of
from posterior_maps import bump_values, correlated_field, grid_map

from tactile_bayes.declarations import from_plain, replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.reports import AnotherExam, EstimateReport, Supposed
from tactile_bayes.findings import finding, finding_summary
from tactile_bayes.inference.draws import summarise
from tactile_bayes.mapping.map import TactileMap, broken_assumptions
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.fit import Structure
from tactile_bayes.posterior.result import Estimate, Mass, Sensitivity
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_document import _width_changes, sensitivity_line, supposed_line
from tactile_bayes.report.estimate_text import (
    MOST_LINES,
    decimals,
    estimate_summary,
    estimate_text,
    width_lines,
)


def mass(seed: int, *, amplitude: float = 0.4, second: float = 0.0, **made) -> TactileMap:
    """A map of a lump at (-10, 2) mm, and of a second one where it is given an amplitude."""
    rng = np.random.default_rng(seed)
    values = bump_values(half_mm=35.0, x=-10.0, y=2.0, sigma_x=5.0, sigma_y=5.0, amplitude=amplitude)
    values += bump_values(half_mm=35.0, x=22.0, y=2.0, sigma_x=4.0, sigma_y=4.0, amplitude=second, level=0.0)
    values += 0.005 * correlated_field(rng, len(values), length_cells=3.0)
    return grid_map(values + 0.005 * rng.standard_normal(values.shape), **({"normalise": "gain"} | made))


MAPS = {
    "clear.nc": mass(1),
    "again.nc": mass(2),
    "two.nc": mass(3, second=0.2),
    "empty.nc": mass(4, amplitude=0.0),
    "outside.nc": mass(5, amplitude=8.0),
    "level.nc": mass(6, normalise="none", background=None),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("summary")
    for name, one in MAPS.items():
        write_map(place / name, one, provenance=Provenance("import", {}))
    return place


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "code", "first", "also"),
    [
        (["clear.nc"], 0, " ", "What makes the interval wide: "),
        (["two.nc"], 0, " ", "Mass 2 at (2"),
        (["empty.nc"], 6, "No lump found", "What would help: "),
        (["outside.nc"], 0, "CAUTION: unlike the lumps that sizes were learned from: ", "What would narrow it: "),
        (["level.nc"], 0, " ", "No size: the "),
        (["clear.nc", "--size-calibration", "none"], 0, " ", "No size: no size calibration"),
        (["clear.nc", "again.nc", "--pool"], 0, "A lump was found on 2 of 2 maps", "the maps of this mass differ by"),
        (["empty.nc", "--pool"], 6, "No estimate: a lump was found on 0 of 1", "Map 1: no lump found on"),
    ],
    ids=["clear", "two masses", "empty", "outside", "level unknown", "no calibration", "pooled", "pooled nothing"],
)
def test_an_answer_takes_at_most_12_lines(folder: Path, words: list[str], code: int, first: str, also: str) -> None:
    done = run_here("estimate", *words, "--method", "laplace", cwd=folder)
    assert done.returncode == code, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) <= MOST_LINES == 12
    assert lines[0].startswith(first)
    assert any(line.startswith(also) or also in line for line in lines)
    assert lines[-1] == RESEARCH_USE
    assert lines[-2].endswith("estimate -v.")


def test_the_whole_report_has_every_figure_of_the_short_one(folder: Path) -> None:
    short, whole = (
        run_here("estimate", "clear.nc", "--method", "laplace", *more, cwd=folder).stdout for more in ((), ("-v",))
    )
    rows = [line for line in short.splitlines() if line.startswith(("largest", "smallest", " "))]
    assert len(rows) == 3
    assert set(rows) <= set(whole.splitlines())
    for words in ("What makes the interval wide", "Scene in the fit window", "Priors: ", "map width sigma_x"):
        assert words in whole
    assert len(whole.splitlines()) > MOST_LINES
    size = json.loads(run_here("estimate", "clear.nc", "--method", "laplace", "--json", cwd=folder).stdout)[
        "max_size_mm"
    ]
    places = decimals(size["mc_error"], most=1)
    assert f"{size['median']:.{places}f}   {size['low']:.{places}f} to {size['high']:.{places}f} mm" in short


def test_what_a_soft_lump_would_measure_is_what_it_does_where_it_is_known(folder: Path) -> None:
    def document(*more: str) -> dict:
        return json.loads(run_here("estimate", "clear.nc", "--method", "laplace", "--json", *more, cwd=folder).stdout)

    supposed = from_plain(dict[str, Supposed], document()["supposing"])
    assert supposed["soft"].property == "stiffness_ratio"
    soft, hard = (
        document("--known", "stiffness_ratio", str(supposed[name].value))["max_size_mm"] for name in ("soft", "hard")
    )
    for name, told in (("soft", soft), ("hard", hard)):
        ends = supposed[name].max_size_mm
        assert [ends.low, ends.median, ends.high] == pytest.approx(
            [told[end] for end in ("low", "median", "high")], rel=0.01
        )
    assert soft["median"] > 1.02 * hard["median"]
    assert set(document("--known", "stiffness_ratio", "30")["supposing"]) == {"centred", "resting"}
    whole = run_here("estimate", "clear.nc", "--method", "laplace", "-v", cwd=folder).stdout
    assert "Were the lump soft (11 times as stiff as fat): " in whole
    assert "bodies unlike the calibration's (lumps 6 to 100 times as stiff as fat" in whole
    words = "No map shows stiffness: were the lump soft (11 times fat), {:.1f} mm; hard (70 times), {:.1f} mm"
    sizes = [supposed[name].max_size_mm.median for name in ("soft", "hard")]
    assert supposed_line(supposed, supposed_median := sum(sizes) / 2, places=1) == [
        f"{words.format(*sizes)}; softer still, larger."
    ]
    exchanged = {
        "soft": replace(supposed["soft"], max_size_mm=supposed["hard"].max_size_mm),
        "hard": replace(supposed["hard"], max_size_mm=supposed["soft"].max_size_mm),
    }
    assert supposed_line(exchanged, supposed_median, places=1) == [f"{words.format(*sizes[::-1])}."]


CHECKS = tuple(finding(kind, f"a reason for {kind}") for kind in ("coarse_cells", "uneven_level", "irregular"))


def crowded() -> tuple[Estimate, EstimateReport]:
    """An estimate with everything there is to say about it, and its report."""
    options = SamplerSettings(method="laplace", draws=400, background="free", noise="field")
    found = estimate_map(MAPS["clear.nc"], calibration=None, options=options, rng=np.random.default_rng(1))
    mass = Mass(10.0, 1.0, 0.97, Estimate("no_estimate", "a reason"))
    odd = {**found.diagnostics, "level_offset": 0.2, "places_share": 0.4}
    full = replace(
        found,
        masses=(Mass(-10.0, 2.0, 1.0, found, reported=True), *((mass,) * 9)),
        diagnostics=odd,
        findings=(*(finding("outside_calibration", f"reason {i}") for i in range(9)), *CHECKS),
        reason="of a reason",
        advice="advice",
    )
    return full, report_of(full, MAPS["clear.nc"], probability=0.9)


def test_the_worst_case_takes_at_most_12_lines_and_counts_what_it_does_not_show() -> None:
    full, report = crowded()
    size = summarise(np.linspace(10.0, 20.0, 99), probability=0.9)
    sized = replace(report, max_size_mm=size, min_size_mm=size)
    another = replace(sized, another_exam=AnotherExam(0.15, size, size, {}), reason="", advice="")
    for one in (report, sized, another):
        text = estimate_summary(full, one)
        assert len(text.splitlines()) <= MOST_LINES
        assert "Mass 1 of 10: probability of a lump 0.9" in text
        listed = re.findall(r"^Mass \d+ at .*$", text, re.MULTILINE)
        assert f"; and {9 - len(listed)} more masses." in listed[-1]
        assert "40 % of the width variance is tracker position error" in text
    whole = estimate_text(full, report)
    assert whole.count("CAUTION") == 9  # the control: there is more than 12 lines can hold
    assert len(re.findall(r"^Mass \d+ at ", whole, re.MULTILINE)) == 9
    assert "These odds are of this window alone; other masses of the map (2, 3, 4, " in whole


def test_a_broken_assumption_stands_first_and_one_to_check_after_the_size() -> None:
    full, report = crowded()
    told = (finding("curved_skin", "the skin is curved"), finding("lump_dragged", "the lump lags"))
    marked = replace(report, findings=(*told, *full.findings))
    short = estimate_summary(full, marked).splitlines()
    assert short[0] == f"CAUTION: the lump lags; {'; '.join(f'reason {n}' for n in range(9))}."
    assert len(short) <= MOST_LINES
    assert "To check: the skin is curved; a reason for coarse_cells (and 2 more)." in short
    whole = estimate_text(full, marked).splitlines()
    assert whole[0] == "CAUTION: the lump lags."
    assert "To check: the skin is curved." in whole[1:]
    # the control: an even scan's report has neither
    for line in estimate_text(full, report).splitlines():
        assert not line.startswith(("CAUTION: the", "To check: the skin"))


@pytest.mark.long
def test_a_pool_names_the_map_whose_strokes_see_the_lump_apart(folder: Path) -> None:
    lagging = tuple(broken_assumptions({"stroke_lag_mm": 3.0, "stroke_lag_sd_mm": 0.1}))
    lagging = replace(MAPS["again.nc"], findings=lagging)
    write_map(folder / "lagging.nc", lagging, provenance=Provenance("import", {}))
    for more in ((), ("-v",)):
        words = ("--pool", "--method", "laplace", *more)
        text = run_here("estimate", "clear.nc", "lagging.nc", *words, cwd=folder).stdout
        assert "CAUTION: map 2: strokes in opposite directions see the lump some 6 mm apart" in text
        assert "map 1: strokes" not in text
        assert "CAUTION" not in run_here("estimate", "clear.nc", "again.nc", *words, cwd=folder).stdout


def test_a_calibration_is_named_whole_whatever_its_name_holds() -> None:
    """A file "size (2).json" was called "size": the name was cut at the first bracket."""
    full, report = crowded()
    named = replace(full, sized_by="calibration size (2).json")
    assert "Quality: sizes by the calibration size (2).json; method" in estimate_summary(named, report)
    assert "sizes by" not in estimate_summary(full, report)  # the control: no calibration


def test_what_a_size_takes_as_known_of_the_body_stands_beside_it() -> None:
    full, report = crowded()
    named = replace(full, sized_by="shipped calibration solid")
    informed = replace(report, provenance={"settings": {"known": {"seat": 0.0, "depth_mm": 12.0}}})
    assert "solid; taken as known: seat 0, depth_mm 12; method" in estimate_summary(named, informed)
    assert "known:" not in estimate_summary(named, report)


@pytest.mark.long
def test_no_report_says_that_something_changed_by_nothing(folder: Path) -> None:
    """The control is the number that was printed so: minus 0.04 SD."""
    assert f"{-0.04:+.1f}" == "-0.0"
    for words in (["clear.nc"], ["two.nc"], ["clear.nc", "again.nc", "--pool"]):
        text = run_here("estimate", *words, "-v", cwd=folder).stdout
        assert not re.search(r"[-+]0\.0+ (of|SD)", text)
    still = Structure("tilt", 0.1, supported=False, used=False, change_sigma_x_sd=-0.04, change_sigma_y_sd=0.03)
    assert _width_changes(still, "with") == ": with it the widths would not change"
    moved = replace(still, change_sigma_x_sd=-0.04, change_sigma_y_sd=0.3)
    assert _width_changes(moved, "with") == ": with it sigma_y would change by +0.3 SD"
    shifted = sensitivity_line(Sensitivity(median={"sigma_x_mm": -0.001}, ends={"sigma_x_mm": 0.02}, pareto_k=0.1))
    assert "-0.00" not in shifted


def test_sources_of_variance_are_ranked_and_only_large_ones_have_a_remedy() -> None:
    lines = width_lines({"map": 9.0, "between_maps": 60.0, "body": 30.8, "shape": 0.2})
    assert lines[0].startswith("What makes the interval wide: 60 % spread between maps of one mass, 31 % properties")
    assert lines[0].endswith("9 % the map.")
    assert lines[1].startswith("What would narrow it: more exams of this mass")
    assert "--known" in lines[1]
    assert "strokes" not in lines[1]
    assert width_lines({"map": 100.0})[1] == "What would narrow it: a slower scan with more strokes over the lump."
    assert finding_summary([], "check", most=2) == []
