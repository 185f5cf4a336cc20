"""Every kind of finding is followed through every output: its sentence stands in each of them, and the verdict with it.

`OUTPUTS` is the one list of outputs. A module that prints the line "Research use only" prints a result; each such
module, and each that draws a figure with that line at its foot, is behind an output of the list or named among those
that print no size, so that a new one cannot be forgotten.
"""

from __future__ import annotations

import csv
import html
import json
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import run_here
from posterior_maps import bump_map

import tactile_bayes as tb
from tactile_bayes.api.comparing import Comparison
from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.maps import Map
from tactile_bayes.api.pooled import PooledSize
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.campaigns.report import ExamRow, _pooled_findings, done_line, grown_line
from tactile_bayes.declarations import replace
from tactile_bayes.exports.exam import Identity, MapFile, parse_estimate
from tactile_bayes.exports.fhir import bundle_of
from tactile_bayes.exports.redcap import records_csv
from tactile_bayes.files.manifest_csv import Exam as Listed
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.findings import KINDS, LEADS, Finding, by_severity, finding, verdict
from tactile_bayes.geometry import rigid
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.mapping.select import scan_findings
from tactile_bayes.report.campaign_page import ExamEntry, MassEntry, VisitEntry, campaign_html
from tactile_bayes.report.compare import VisitMap, compare_summary, compare_text, growths
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.growth_page import DrawnMap, draw_comparison
from tactile_bayes.report.map import map_figure, map_summary, map_text
from tactile_bayes.report.pages import Growth
from tactile_bayes.report.pooled import pooled_summary, pooled_text

FAST = Settings(method="laplace")
SCANS = ({"sha256": "ab" * 32, "side": "right", "posture": "supine"},)
NO_LUMP = VisitMap("b.nc", "no_estimate", "no lump found", 0.1)


def one_of(kind: str) -> Finding:
    return finding(kind, f"words for {kind}", f"give --{kind}", f"ask about {kind}")


def plain_map(seed: int, *, amplitude: float = 0.3) -> TactileMap:
    """A map with a lump 60 mm to the patient's right of the xiphoid, and no finding."""
    noise = 0.01 * np.random.default_rng(seed).standard_normal((51, 51))
    made = bump_map(noise=noise, amplitude=amplitude, x=0.0, y=0.0, sigma_x=4.0, sigma_y=4.0)
    return replace(
        made,
        recipe=MapRecipe("scan", "gain", 1.0, (5.0, 14.0)),
        plane_from_base=np.eye(4),
        patient_from_plane=rigid(np.eye(3), np.array([60.0, 90.0, 0.0])),
        quality={"gain_passes": 3.0, "gain_last_change": 1e-7},
    )


@cache
def sound() -> tuple[SizeEstimate, PooledSize, Comparison]:
    """An estimate, a pooled size and a comparison that nothing speaks against."""
    ones = [
        replace(estimate_one(plain_map(seed), FAST, scans=({**SCANS[0], "sha256": f"{seed:064x}"},)), name="exam")
        for seed in (1, 2)
    ]
    return ones[0], tb.pool(ones, method="laplace"), tb.compare(*ones, method="laplace")


class Made:
    """The same three results with findings."""

    def __init__(self, findings: Sequence[Finding]) -> None:
        self.findings = by_severity(findings)
        one, pooled, compared = sound()
        told: Any = {"findings": self.findings}
        told["verdict"] = verdict(findings, answered=True)
        self.map = replace(one.tactile_map, findings=self.findings)
        estimate = replace(one.estimate, findings=self.findings)
        self.estimate = replace(one, tactile_map=self.map, estimate=estimate)
        self.answer = self.estimate.answer
        together = replace(pooled.pooled, findings=self.findings)
        self.pooled = replace(pooled, pooled=together, pooled_report=replace(pooled.pooled_report, **told))
        inside = replace(compared.compared, findings=self.findings)
        self.compared = replace(compared, compared=inside, report=replace(compared.report, **told))

    @property
    def exported(self) -> Any:
        return parse_estimate(self.answer.document, Path("e.json"))

    @property
    def pooled_export(self) -> Any:
        return parse_estimate(self.pooled.document, Path("p.json"))

    @property
    def map_file(self) -> MapFile:
        return MapFile(Path("m.nc"), "ab" * 32, self.map, {"side": "right"})


@pytest.fixture(autouse=True, scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what `folder` makes among pytest's own folders, which go."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("findings")))
        yield


def folder() -> Path:
    return Path(tempfile.mkdtemp())


def shown(path: Path) -> str:
    return run_here("show", path.name, cwd=path.parent).stdout


def words_of(page: str) -> str:
    return html.unescape(re.sub("<[^>]*>", " ", page))


def figure_words(figure: Any) -> str:
    return " ".join(text.get_text() for text in figure.findobj(lambda one: hasattr(one, "get_text")))


def stored_map(made: Made) -> str:
    path = folder() / "map.nc"
    write_map(path, made.map, provenance=Provenance("test", {}, scans=SCANS))
    assert read_map(path).findings == made.findings
    return shown(path)


def stored_estimate(made: Made, *words: str) -> str:
    path = folder() / "post.nc"
    made.estimate.write(path)
    return run_here(*(words or ("show",)), path.name, cwd=path.parent).stdout


def stored_pool(made: Made) -> str:
    path, found = folder() / "post.nc", made.pooled
    assert found.pooled.size is not None
    found.write(path)
    return shown(path)


def stored_scan(made: Made) -> str:
    """Through the file of a scan to its map."""
    path = folder() / "scan.mcap"
    scan = replace(tb.demo_scan(), findings=made.findings)
    write_scan(path, scan, provenance=Provenance("import", {}))
    back = read_scan(path)
    assert back.findings == made.findings == scan_findings(back)
    assert set(made.findings) <= set(build_map(back, every=4).findings)
    return shown(path)


def exam_words(made: Made, *, several: bool) -> str:
    exam = made.estimate.exam()
    return words_of(exam_page(replace(exam, pooled=made.pooled.pooled_report) if several else exam))


def nrrd(made: Made) -> str:
    pytest.importorskip("nrrd")
    from tactile_bayes.exports.run import nrrd_bytes

    return nrrd_bytes(made.map_file).partition(b"\n\n")[0].decode()


@cache
def dicom_of(findings: tuple[Finding, ...]) -> Path:
    """The folder of an exam's files."""
    out = folder() / "out"
    tb.export(Made(findings).estimate, out, to="dicom", study_date="2026-11-24T10:30")
    return out


def dicom(made: Made, name: str) -> str:
    """All texts of a file of the exam: its comments and those of its content."""
    pytest.importorskip("highdicom")
    pydicom = pytest.importorskip("pydicom")
    out = dicom_of(tuple(made.findings))
    file = pydicom.dcmread(out / f"{name}.dcm")
    return " ".join(str(one.value) for one in file.iterall() if one.keyword in ("TextValue", "ImageComments"))


def campaign_row(made: Made) -> str:
    row = ExamRow.of(Listed("a.nc", Path("a.nc"), "P", "1", "1", 1), made.answer.report, scans=SCANS)
    cells = done_line(replace(row, findings=made.findings))
    return f"{cells['verdict']} {cells['findings'] or ''}"


def growth_of(made: Made) -> Growth:
    (row,) = growths("P", "1", ["1", "2"], made.compared.report, "")
    return row


def growth_table(made: Made) -> str:
    cells = grown_line(growth_of(made))
    return cells["findings"] or ""


def campaign_card(made: Made) -> str:
    size = Quantity(median=15.0, mean=15.0, sd=1.0, low=13.0, high=17.0, probability=0.95, kind="eti")
    exam = ExamEntry("visit 1, exam 1", size=size, findings=made.findings)
    rows = [MassEntry("a", "1", (VisitEntry("1", (exam,), size),))]
    return words_of(campaign_html(rows, lines=(), links={}))


def drawn(made: Made) -> Any:
    maps = [[DrawnMap(made.map, made.answer.report)] for _ in range(2)]
    return draw_comparison(made.compared.compared, made.compared.report, maps, None)


@dataclass(frozen=True)
class Output:
    """How an output is made, whether for paper, whether it counts a third finding and more, how it says the verdict.

    Of the kinds by twos every so many are tried.
    """

    made: Callable[[Made], str]
    paper: bool
    shortens: bool = False
    verdict: str = ""
    every: int = 1


def fhir(file: Any) -> str:
    return json.dumps(bundle_of(file, Identity()))


OUTPUTS: dict[str, Output] = {
    "scan: show": Output(stored_scan, paper=False),
    "map: text": Output(lambda made: map_summary(made.map, written="a.nc"), paper=False, verdict="{}: "),
    "map: text -v": Output(lambda made: map_text(made.map), paper=False),
    "map: file, show": Output(stored_map, paper=False),
    "map: figure": Output(lambda made: figure_words(map_figure(made.map, None)), paper=True),
    "map: Python": Output(lambda made: words_of(Map(made.map)._repr_html_()) and repr(Map(made.map)), paper=True),
    "map: NRRD": Output(nrrd, paper=True),
    "estimate: text": Output(lambda made: made.answer.text, paper=False, shortens=True),
    "estimate: text -v": Output(lambda made: made.answer.full_text, paper=False),
    "estimate: JSON": Output(lambda made: told_in(made.answer.document), paper=False, verdict="{}"),
    "estimate: file, show": Output(stored_estimate, paper=False, verdict="{}"),
    "estimate: file, diagnose": Output(lambda made: stored_estimate(made, "diagnose"), paper=False),
    "estimate: figure of the size": Output(lambda made: figure_words(made.estimate.plot()), paper=True),
    "estimate: figure of the map": Output(lambda made: figure_words(made.estimate.plot_map()), paper=True),
    "estimate: figure of the fit": Output(lambda made: figure_words(made.estimate.plot_fit()), paper=True),
    "estimate: notebook": Output(lambda made: words_of(made.estimate._repr_html_()), paper=True),
    "estimate: page": Output(lambda made: exam_words(made, several=False), paper=True, shortens=True),
    "map: DICOM": Output(lambda made: dicom(made, "map"), paper=True),
    "estimate: DICOM": Output(lambda made: dicom(made, "report"), paper=True, verdict="Verdict: {}."),
    "estimate: FHIR": Output(lambda made: fhir(made.exported), paper=True, verdict="Verdict: {}."),
    "estimate: REDCap": Output(lambda made: records_csv([made.exported], Identity(), id_from_scan=False), paper=True),
    "pool: text": Output(lambda made: pooled_summary(made.pooled.pooled_report), paper=False, shortens=True),
    "pool: text -v": Output(lambda made: pooled_text(made.pooled.pooled_report), paper=False),
    "pool: JSON": Output(lambda made: told_in(made.pooled.document), paper=False, verdict="{}"),
    "pool: file, show": Output(stored_pool, paper=False, verdict="{}"),
    "pool: figure": Output(lambda made: figure_words(made.pooled.plot()), paper=True),
    "pool: notebook": Output(lambda made: words_of(made.pooled._repr_html_()), paper=True),
    "pool: page": Output(lambda made: exam_words(made, several=True), paper=True, shortens=True),
    "pool: FHIR": Output(lambda made: fhir(made.pooled_export), paper=True, verdict="Verdict: {}."),
    "compare: text": Output(lambda made: compare_summary(made.compared.report), paper=False, shortens=True),
    "compare: text -v": Output(lambda made: compare_text(made.compared.report), paper=False),
    "compare: JSON": Output(lambda made: told_in(made.compared.document), paper=False, verdict="{}"),
    "compare: figure": Output(lambda made: figure_words(drawn(made)), paper=False, shortens=True, every=6),
    "compare: page": Output(lambda made: words_of(made.compared.page_text(title="", name="")), paper=True),
    "compare: notebook": Output(lambda made: words_of(made.compared._repr_html_()), paper=False, shortens=True),
    "campaign: growth, table": Output(growth_table, paper=False),
    "campaign: growth, page": Output(lambda made: growth_of(made).words, paper=True),
    "campaign: table": Output(campaign_row, paper=False, verdict="{}"),
    "campaign: page": Output(campaign_card, paper=True),
}
PRINTERS = {
    # behind the outputs above
    "actions/estimate", "api/maps", "api/sized", "exports/dicom",
    "exports/fhir", "exports/run", "exports/redcap", "files/posterior_nc",
    "report/growth_page", "report/compare", "report/estimate_document",
    "report/estimate_figures", "report/estimate_text", "report/map",
    "report/pages", "report/pooled",
    # of draws, not of a size; names of files that were written
    "actions/pages", "actions/show", "actions/campaign", "actions/live_view", "actions/record",
    # of trials, calibrations, devices and studies
    "actions/calibrate", "actions/devices", "api/diagnosing", "api/repeatability", "api/trials",
    "campaigns/campaign", "actions/bring_in", "actions/exam",
    "actions/simulation", "actions/study",
    "files/size_json", "presets", "report/calibration",
    "report/figure_file", "report/paper_head", "report/laboratory",
    "report/study", "report/tradeoff", "report/trial_html", "trial/summary",
}  # fmt: skip


def told_in(document: Any) -> str:
    """Verdict and findings of a JSON object as `Finding.sentence` puts them together."""
    lines = [f"{LEADS[one['severity']]}{one['text']}; {one['remedy']}" for one in document["findings"]]
    return " ".join([document["verdict"], *lines])


def plain(text: str) -> str:
    return " ".join(text.split())


@cache
def said(output: str, kinds: tuple[str, ...]) -> str:
    return plain(OUTPUTS[output].made(Made([one_of(kind) for kind in kinds])))


def in_twos() -> list[tuple[str, ...]]:
    """The kinds of either severity by twos: as many as the shortest list has."""
    each = [[kind for kind, severity in KINDS.items() if severity == one] for one in LEADS]
    return [kinds for one in each for kinds in zip_longest(one[::2], one[1::2], fillvalue=one[0])]


@pytest.mark.parametrize("output", OUTPUTS)
def test_every_finding_is_said(output: str) -> None:
    """With its remedy for that reader; where a list is short, a lead is for all of a severity."""
    how = OUTPUTS[output]
    for kinds in in_twos()[:: how.every] if how.shortens else [tuple(KINDS)]:
        text = said(output, kinds)
        for number, one in enumerate(map(one_of, kinds)):
            lead = LEADS[one.severity] if not (how.shortens and number) else ""
            assert f"{lead}{one.sentence(paper=how.paper)}" in text
            assert (one.remedy in text) is not how.paper


@pytest.mark.parametrize("output", [name for name, how in OUTPUTS.items() if how.shortens])
def test_a_list_that_is_short_leaves_out_checks_and_no_caution(output: str) -> None:
    text = said(output, tuple(KINDS))
    left_out = [kind for kind in KINDS if one_of(kind).sentence(paper=OUTPUTS[output].paper) not in text]
    assert left_out
    assert not any(KINDS[kind] == "caution" for kind in left_out)


@pytest.mark.parametrize("output", OUTPUTS)
def test_nothing_is_said_where_nothing_speaks_against_it_and_the_verdict_is_reported(output: str) -> None:
    clear, doubted = said(output, ()), said(output, tuple(KINDS) if not OUTPUTS[output].shortens else ("side",))
    assert "words for" not in clear
    assert not any(lead in clear for lead in LEADS.values())
    if words := OUTPUTS[output].verdict:
        assert words.format("sound") in clear
        assert words.format("doubtful") in doubted


@pytest.mark.parametrize("kind", [kind for kind, severity in KINDS.items() if severity == "caution"])
def test_python_begins_with_the_caution(kind: str) -> None:
    made = Made([one_of("few_strokes"), one_of(kind)])
    for one in (made.estimate, made.pooled, made.compared):
        assert repr(one).split(" ", 1)[1].startswith(f"CAUTION: words for {kind}; ask about {kind}.")
        assert [each.kind for each in one.findings] == [kind, "few_strokes"]
        assert one.verdict == "doubtful"
    assert all("CAUTION" not in repr(one) and one.verdict == "sound" for one in sound())  # the control


def test_a_notebook_has_both_intervals_and_the_probability() -> None:
    table = words_of(sound()[0]._repr_html_())
    assert re.search(r"largest size if exams differ by 2\.\d % +\d+\.\d mm", table)
    assert re.search(r"probability of a lump +0\.9\d", table)


@pytest.mark.long
def test_what_speaks_against_a_map_reaches_pool_comparison_and_campaign(tmp_path: Path) -> None:
    """Written to a file, estimated by commands; only what is of one size alone is judged anew from all maps."""
    for number in (1, 2, 3):
        speaks_against = {2: (one_of("late_poses"),), 3: (one_of("side"),)}.get(number, ())
        made = replace(plain_map(number, amplitude=0.0 if number == 3 else 0.3), findings=speaks_against)
        scans = ({"sha256": f"{number:064x}", "side": "right", "subject": "P"},)
        write_map(tmp_path / f"{number}.nc", made, provenance=Provenance("test", {}, scans=scans))
    sentence = "CAUTION: {}words for late_poses; give --late_poses"

    def run(*words: object) -> str:
        method = () if words[0] == "report" else ("--method", "laplace")
        done = run_here(*words, *method, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert run("estimate", "2.nc").startswith(sentence.format(""))
    (tmp_path / "2.json").write_text(run("estimate", "2.nc", "--json"))
    assert run("report", "2.json", "-o", "2.html").startswith(sentence.format(""))
    paper = "CAUTION: words for late_poses; ask about late_poses.\nLump of about"
    assert tb.exam_report(tmp_path / "2.json", tmp_path / "p.html").startswith(paper)
    # a map without a lump is part of the answer, too
    assert "map 2: words for side" in run("estimate", "1.nc", "3.nc", "--pool")
    assert run("estimate", "1.nc", "2.nc", "--pool").startswith(sentence.format("map 2: "))
    assert run("compare", "1.nc", "--with", "2.nc").startswith(sentence.format("visit 2: "))
    assert "CAUTION" not in run("estimate", "1.nc")
    (tmp_path / "exams.csv").write_text("file,patient,visit,mass,replicate\n1.nc,P,1,1,1\n2.nc,P,1,1,2\n")
    assert "exams with a caution, see their findings: P.v1.m1.r2\n" in run("campaign", "run", "exams.csv", "-o", "out")
    with (tmp_path / "out" / "exams_done.csv").open(newline="") as lines:
        told = {row["file"]: (row["verdict"], sentence.format("") in row["findings"]) for row in csv.DictReader(lines)}
    assert told == {"1.nc": ("sound", False), "2.nc": ("doubtful", True)}
    assert "words for late_poses" in (tmp_path / "out" / "index.html").read_text()


def test_maps_without_a_size_that_are_not_listed_are_counted() -> None:
    _, pooled, compared = sound()
    one, visit = pooled.pooled_report.maps[0], compared.report.visits[0]
    bare = replace(pooled.pooled_report, max_size_mm=None, maps=(replace(one, max_size_mm=None),) * 6)
    apart = replace(compared.report, status="no_estimate", visits=(replace(visit, maps=(NO_LUMP,) * 6),))
    for text in (pooled_summary(bare), compare_summary(apart)):
        assert "And 2 more: -v." in text


def test_a_mass_whose_visits_were_not_compared_keeps_what_speaks_against_them() -> None:
    report = replace(Made([one_of("side")]).compared.report, status="not_one_mass", reason="far apart", changes=())
    (row,) = growths("P", "1", ["1", "2"], report, "")
    assert one_of("side").sentence(paper=True) in row.words


def test_what_a_pool_finds_of_all_its_maps_stands_in_each_exams_row() -> None:
    """Bodies that differ: said by `estimate --pool`, and by the table of a campaign."""
    both, second = one_of("fat_apart"), replace(one_of("late_poses"), about="map 2")
    report = Made([both, second]).pooled.pooled_report
    names = [one.map for one in report.maps]
    assert _pooled_findings([report]) == {names[0]: (both,), names[1]: (both, one_of("late_poses"))}


def test_the_live_view_says_a_caution_before_the_size() -> None:
    from tactile_bayes.actions.live_view import RiseRotation, live_estimate

    shipped = Path(tb.__file__).parent / "calibrations" / "solid.json"
    live = replace(plain_map(1), findings=(one_of("late_poses"), one_of("few_strokes")))
    assert live_estimate(live, str(shipped), RiseRotation()).text.startswith(
        "CAUTION: words for late_poses; give --late_poses."
    )


def test_every_module_that_prints_a_result_is_behind_an_output_or_prints_no_size() -> None:
    package = Path(tb.__file__).parent
    modules = {path.relative_to(package).with_suffix("").as_posix(): path for path in package.rglob("*.py")}
    prints = re.compile(r"RESEARCH_USE|figure_file\(")
    assert {name for name, path in modules.items() if prints.search(path.read_text())} == PRINTERS


def test_every_kind_is_made_somewhere() -> None:
    """A kind that nothing makes any more is dead; each is listed for users."""
    made = "".join(path.read_text() for path in Path(tb.__file__).parent.rglob("*.py"))
    listed = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    for kind in KINDS:
        assert f"`{kind}`" in listed
        assert len(re.findall(rf'"{kind}"', made)) > 1, kind
