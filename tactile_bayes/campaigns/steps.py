"""The steps of a campaign: its settings, what each step makes, and how its files come to their place."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes import __version__
from tactile_bayes.api.comparing import compare_answers
from tactile_bayes.api.estimating import choose_calibration, estimate_file
from tactile_bayes.api.pooled import pool_answers
from tactile_bayes.api.repeatability import ExamFolder, learn_from_exams
from tactile_bayes.api.settings import Settings, days_from_first
from tactile_bayes.api.sized import Answer, SizeEstimate, size_priors
from tactile_bayes.campaigns.exams import ARRAYS, OWN_AXES, Match, estimate_matched, map_of_exam
from tactile_bayes.declarations import EXACT, Record, field, from_plain, replace, rounded, to_plain
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files import manifest_csv as layout
from tactile_bayes.files import reading
from tactile_bayes.files.atomic import sha256, write_bytes, write_text
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.imports import read_arrays
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.files.map_nc import read_map, read_map_and_scans, write_map
from tactile_bayes.files.npz import read_shape, write_shape
from tactile_bayes.files.provenance import Provenance, scan_facts
from tactile_bayes.files.reports import EstimateReport, json_text
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.findings import Finding, by_severity, verdict
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap, side_findings
from tactile_bayes.options import CampaignOptions, CompareOptions, MapOptions
from tactile_bayes.report.estimate_document import patient_mm, side_of, size_diagnostics
from tactile_bayes.report.estimate_figures import draw_map, draw_size
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import PageLabels, ShownExam, exam_map
from tactile_bayes.report.growth_page import Course, DrawnMap, draw_comparison, growth_page
from tactile_bayes.report.svg import thumbnail_svg
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import SIZES, SizePosterior
from tactile_bayes.size.pooling import size_alone


def digest_of(key: object) -> str:
    """Digest of plain data and the program's version."""
    text = json.dumps([__version__, key], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def stamp(path: Path) -> str:
    """Size, times and inode of a file, which differ when it was written to or replaced."""
    known = path.stat()
    return f"{known.st_size} {known.st_mtime_ns} {known.st_ctime_ns} {known.st_ino}"


class CampaignSettings(CampaignOptions, kw_only=True):
    """Settings of all exams: the campaign's options, and those of `estimate`."""

    estimate: Settings = field(default_factory=Settings)
    """As of `estimate`; a row of the table may replace place, known values and calibration."""
    own_repeatability: bool = True
    """True to learn the spread between exams from the campaign's own repeats, where enough masses have them and the
    estimate's settings do not state it.
    """

    def of(self, exam: Exam) -> Settings:
        """Settings of one exam's estimate."""
        own: dict[str, Any] = {"centre_mm": exam.centre_mm, "size_calibration": exam.calibration, "known": exam.known}
        return replace(self.estimate, **{name: value for name, value in own.items() if value})


# --- The way of a step's files to their place: a worker writes them beside it, and the command puts them there.
#
# A worker of a cluster may end a step after the command that asked for it was killed, while another command goes on
# in the same folder with other settings. So workers write into a folder named by the step's key, and nothing but
# the command that holds the journal changes what tables and later steps read.

STAGED: Final = "staged"
"""Key of a result whose files wait beside their place: the folder they are in, and the names that have no file."""
WAITING: Final = ".new-"  #: With it begin the names of such folders.
_DIGITS: Final = 16

Writes = dict[str, Callable[[Path], object]]


def put_in_place(result: Mapping[str, Any]) -> dict[str, Any]:
    """Move the files of a result to their place, and remove those of earlier runs; returns it with their stamps."""
    if STAGED not in result:
        return dict(result)
    staged = Path(result[STAGED]["folder"])
    folder = staged.parent
    for name in result["files"]:
        (staged / name).replace(folder / name)
    for name in result[STAGED]["without"]:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(staged, ignore_errors=True)
    stamps = {name: stamp(folder / name) for name in result["files"]}
    placed = {"files": result["files"], "stamps": stamps}
    return {**placed, **{name: value for name, value in result.items() if name not in (*placed, STAGED)}}


# --- Steps of a campaign: map, estimate, figures and size of an exam, repeatability, pooled size and growth of a mass.
#
# A step runs in any process. It gets all that its result depends on, writes its files into one folder, and returns
# their digests, so that a later run can tell whether they are still what it made.

FILES: Final = {
    "map": (layout.SCAN, layout.MAP),
    "estimate": (layout.ESTIMATE, layout.POSTERIOR, layout.SHAPE),
    "figures": (layout.MAP_FIGURE, layout.SIZE_FIGURE),
    "repeatability": (layout.REPEATABILITY,),
    "size": (layout.SIZED, layout.SIZED_FIGURE),
    "page": (layout.EXAM_PAGE, layout.THUMBNAIL),
    "pool": (layout.POOLED, layout.POOLED_DRAWS),
    "compare": (layout.COMPARED, layout.GROWTH_PAGE, layout.COMPARED_FIGURE),
    "copy": (),
}
"""The files that each step may write."""
UNWRITTEN: Final = "unwritten"  #: Key of a result that the disk did not take: the campaign's fault, not the exam's.

Result = dict[str, Any]
Made = tuple[Result, Writes]  #: Results of a step, and a writer for each of its files.


class Task(Record):
    """One step of one exam or mass."""

    step: str  #: A key of `FILES`.
    name: str
    folder: Path
    """`name`, `folder`: Of the exam or mass."""
    digest: str  #: Of all that the step's files depend on.
    make: Callable[[], Made]  #: A partial of a function of this module: workers get it.

    @property
    def key(self) -> str:
        """Name in the store of the campaign's results."""
        return f"{self.step} {self.name} {self.digest}"


def _write_staged(task: Task, writes: Writes) -> Result:
    """Write a step's files beside their place; returns their digests and where they are.

    Equal files have equal folders. Those of earlier runs are removed when the others are put in place.
    """
    staged = task.folder / f"{WAITING}{task.step}-{task.digest[:_DIGITS]}"
    try:
        if writes:
            staged.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, write in writes.items():
            write(staged / name)
        files = {name: sha256(staged / name) for name in writes}
    except BaseException:
        shutil.rmtree(staged, ignore_errors=True)
        raise
    without = [name for name in FILES[task.step] if name not in writes]
    return {"files": files, STAGED: {"folder": str(staged), "without": without}}


def run_step(task: Task) -> Result:
    """Run a step; returns the digests of its files by name, their staging folder, its seconds, and its other results.

    `put_in_place` moves the files to their place: a worker that outlives its command must not. A fault of the exam is a
    `TactileBayesError` without a path.
    """
    begun, begun_cpu = time.perf_counter(), time.thread_time()
    try:
        facts, writes = task.make()
    except BadDataError as error:
        raise BadDataError(error.what, way_out=error.way_out) from None
    if UNWRITTEN in facts:
        return facts
    try:
        staged = _write_staged(task, writes)
    except (UsageError, OSError) as error:
        return {UNWRITTEN: str(error)}
    spent = {"seconds": time.perf_counter() - begun, "cpu_seconds": time.thread_time() - begun_cpu}
    return {**staged, **{name: round(one, 3) for name, one in spent.items()}, **facts}


def make_map(
    source: Path, *, source_sha256: str, expected: Mapping[str, str], normalise: str, address: str = ""
) -> Made:
    """The exam's map from its scan or its arrays (brought in as `import` does), or the map that its file is.

    `expected`: the table's facts of the exam, by column; a file of another exam is refused. `address`: of a file in an
    object store, downloaded for as long as the map is made.
    """
    if address:
        with reading.downloaded(address) as path:
            return make_map(path, source_sha256=source_sha256, expected=expected, normalise=normalise)
    if sha256(source) != source_sha256:
        raise BadDataError("changed while the campaign ran", way_out="run the campaign again")
    kind, arrays = reading.kind_of(source), source.suffix.lower() in ARRAYS
    if kind == reading.MAP and not arrays:
        return _copy_map(source, expected)
    writes: Writes = {}
    if kind == reading.ARCHIVE or arrays:
        scan = read_arrays(source)
        made = Provenance("import", {"as": "scan", "lost": [], "correct": []}, inputs={"source": source_sha256})
        writes[layout.SCAN] = lambda path: write_scan(path, scan, provenance=made, force=True)
    else:
        scan = read_scan(source)
        check_facts(expected, scan.session)
    facts = scan_facts(scan, source_sha256)
    settings = to_plain(from_plain(MapOptions, {"normalise": normalise}), digits=EXACT)
    provenance = Provenance("map", settings, {"scan_1": source_sha256}, scans=[facts])
    tactile_map = build_map(scan, normalise=normalise)
    writes[layout.MAP] = lambda path: write_map(path, tactile_map, provenance=provenance, force=True)
    simulated = scan.session.get("source") == "simulated"
    return {"scans": [facts], "synthetic": simulated, "normalise": normalise}, writes


def _copy_map(source: Path, expected: Mapping[str, str]) -> Made:
    """A map that was made before, byte for byte."""
    tactile_map, scans = read_map_and_scans(source)
    for facts in scans:
        check_facts(expected, facts)
    data = reading.read_bytes(source, most=reading.NETCDF_BYTES)
    result = {"scans": list(scans), "synthetic": None, "normalise": tactile_map.recipe.normalise}
    return result, {layout.MAP: lambda path: write_bytes(path, data, force=True)}


def check_facts(expected: Mapping[str, str], facts: Mapping[str, str]) -> None:
    """Refuse a file whose facts contradict the table's; one that either lacks is not compared, nor are capitals."""
    in_file = {ours: facts.get(theirs) for ours, theirs in layout.SAME_IN_SCANS.items()}
    both = {name: value for name, value in in_file.items() if value and expected.get(name)}
    differs = [name for name, value in both.items() if value.casefold() != expected[name].casefold()]
    if not differs:
        return
    shown = list(dict.fromkeys([*(name for name in ("patient", "side") if name in both), *differs]))
    table_words, file_words = (", ".join(f"{name} {one[name]}" for name in shown) for one in (expected, both))
    way_out = "is it another exam's file? correct the row, or the file's session (import --session)"
    raise BadDataError(f"the table says {table_words}; the file says {file_words}", way_out=way_out)


def make_estimate(folder: Path, settings: Settings, match: Match | None, side: str) -> Made:
    """Estimate, draws of its size, and the draws from which masses are pooled and sized by the site."""
    estimate = _estimate_exam(folder, settings, match, side)
    answer = estimate.answer
    report, shape = answer.report.checked(), answer.shape
    writes: Writes = {layout.ESTIMATE: lambda path: write_text(path, json_text(report), force=True)}
    if estimate.status == "estimate":
        writes[layout.POSTERIOR] = lambda path: estimate.write(path, force=True)
    if shape is not None:
        writes[layout.SHAPE] = lambda path: write_shape(path, shape, force=True)
    return {"exit_code": answer.exit_code}, writes


def _estimate_exam(folder: Path, settings: Settings, match: Match | None, side: str) -> SizeEstimate:
    """The exam's estimate; with a match, of the mass that lies where other exams place it.

    `side`: of the breast by the table, where no scan says it; the landmarks are held against it.
    """
    path, findings = folder / layout.MAP, list[Finding]()
    if match is None:
        sized = estimate_file(path, settings)
    else:
        sized = estimate_matched(path, settings, match)
        tactile_maps = (sized.tactile_map, *(map_of_exam(path, one) for one in match.named))
        findings += [OWN_AXES] if any(tactile_map.patient_from_plane is None for tactile_map in tactile_maps) else []
    if side:
        lump = next(((mass.x_mm, mass.y_mm) for mass in sized.estimate.masses if mass.reported), None)
        place = patient_mm(sized.tactile_map, *(lump or (0.0, 0.0)))  # the plane's origin is the middle of the frames
        findings += side_findings(side, place, "the lump" if lump else "the scanned place", in_table=True)
    if not findings:
        return sized
    return replace(sized, estimate=replace(sized.estimate, findings=by_severity((*sized.estimate.findings, *findings))))


def make_figures(folder: Path, settings: Settings, match: Match | None, side: str) -> Made:
    """The figures of `estimate`; the estimate is made again, for it is not stored whole."""
    sized = _estimate_exam(folder, settings, match, side)
    tactile_map, estimate, report = sized.tactile_map, sized.estimate, sized.answer.report
    name, size, writes = folder.name, estimate.size, Writes()
    if tactile_map.covered.any():
        writes[layout.MAP_FIGURE] = lambda path: draw_map(tactile_map, report, path, name=name, force=True)
    if size is not None:
        looks: dict[str, Any] = {"probability": sized.probability, "findings": estimate.findings}
        writes[layout.SIZE_FIGURE] = lambda path: draw_size(size, path, name=name, force=True, **looks)
    return {}, writes


def make_page(folder: Path, expected: Mapping[str, str], *, report: str) -> Made:
    """The exam's page and thumbnail from the files of earlier steps, its size from the file `report`.

    Facts that the scans lack are the table's.
    """
    tactile_map, scans = read_map_and_scans(folder / layout.MAP)
    from_table = {layout.SAME_IN_SCANS[name]: text for name, text in expected.items() if name in layout.SAME_IN_SCANS}
    facts = [from_table | scan for scan in scans or [{}]]
    shown = exam_map(tactile_map, read_record(folder / report, EstimateReport), side=side_of(facts))
    title = f"Tactile exam {expected['replicate']}"
    page = exam_page(ShownExam((shown,), None, facts, PageLabels(title, day=expected.get("date", ""))))
    writes: Writes = {layout.EXAM_PAGE: lambda path: write_text(path, page, force=True)}
    if tactile_map.covered.any():
        picture = thumbnail_svg(shown, label=f"Map of {folder.name}")
        writes[layout.THUMBNAIL] = lambda path: write_text(path, picture, force=True)
    return {}, writes


def make_pool(folder: Path, names: Sequence[str], settings: Settings) -> Made:
    """Pool exams of a mass as `estimate --pool` does, from the files of their estimates in folders below this."""
    answers = [_answer(folder / name) for name in names]
    pooled = pool_answers(answers, settings, names=names, files=[folder / name / layout.MAP for name in names])
    report = pooled.pooled_report.checked()
    writes: Writes = {layout.POOLED: lambda path: write_text(path, json_text(report), force=True)}
    if pooled.pooled.size is not None:
        writes[layout.POOLED_DRAWS] = lambda path: pooled.write(path, force=True)
    return {}, writes


def make_growth(
    folder: Path,
    visits: Sequence[Sequence[str]],
    settings: Settings,
    *,
    course: Course,
    findings: Sequence[Finding],
    figures: bool,
) -> Made:
    """Compare the visits of a mass as `compare` does; the table says that they are of one where landmarks do not.

    `visits`: names of each visit's exams in order of time, with folders below `folder`; `course`, `findings`: what the
    tables say of them.
    """
    answers = [[_answer(folder / name) for name in names] for names in visits]
    with_draws = [one for maps in answers for one in maps if one.shape is not None]
    placed = all(answer.report.centre_patient_mm is not None for answer in with_draws)
    files = [[folder / name / layout.MAP for name in names] for names in visits]
    days = days_from_first(None, course.dates if course.dates and all(course.dates) else None)
    comparing = CompareOptions(days=days, same_mass=not placed)
    compared = compare_answers(answers, settings, comparing, names=visits, files=files, numbers=course.numbers)
    comparison, found = compared.compared, by_severity((*findings, *compared.report.findings))
    told = verdict(found, answered=comparison.joint is not None)
    report = replace(compared.report, findings=found, verdict=told).checked()
    drawn_maps = [
        [DrawnMap(read_map(path), one.report) for path, one in zip(paths, maps, strict=True)]
        for paths, maps in zip(files, answers, strict=True)
    ]
    page = growth_page(comparison, report, drawn_maps, course)
    writes: Writes = {layout.COMPARED: lambda path: write_text(path, json_text(report), force=True)}
    writes[layout.GROWTH_PAGE] = lambda path: write_text(path, page, force=True)
    if figures and comparison.joint is not None:
        writes[layout.COMPARED_FIGURE] = lambda path: draw_comparison(comparison, report, drawn_maps, path, force=True)
    return {}, writes


def _answer(folder: Path) -> Answer:
    """An exam's answer for pooling, from its folder."""
    tactile_map: TactileMap = read_map(folder / layout.MAP)
    return Answer(
        read_record(folder / layout.ESTIMATE, EstimateReport),
        shape=read_shape(folder / layout.SHAPE) if (folder / layout.SHAPE).exists() else None,
        normalise=tactile_map.recipe.normalise,
        fingerprint=tactile_map.fingerprint,
        head=tactile_map.head,
    )


def copy_files(folder: Path, files: Sequence[str], *, to: str) -> Made:
    """Copy files into an object store."""
    try:
        for name in files:
            reading.upload(folder / name, f"{to}/{name}")
    except UsageError as error:
        return {UNWRITTEN: str(error)}, {}
    return {}, {}


# --- A campaign's own repeatability: the step that learns it from the repeats, and the one that sizes exams by it.
#
# Neither fits a map: both start from the draws that each estimate left for pooling.

FEWEST_MASSES: Final = 5  #: Masses with repeats from which a campaign learns by itself.
NOT_LEARNED: Final = "not_learned"  #: Key of the reason in the result of a step that did not learn.
_ANOTHER_STREAM: Final = 1  #: Of random numbers: the sizes' points must not be those that drew the map's posterior.


def count_repeated_masses(exams: Iterable[Exam], settings: CampaignSettings) -> int:
    """Count the masses with several exams at one visit, which may teach the spread; 0 where none is wanted."""
    estimate = settings.estimate
    if not settings.own_repeatability or estimate.repeatability or estimate.between_map_sd is not None:
        return 0
    count = Counter((exam.patient, exam.mass, exam.of_mass) for exam in exams)
    return len({(patient, mass) for (patient, mass, _), number in count.items() if number > 1})


def learn_repeatability(repeats: Sequence[ExamFolder]) -> Made:
    """Learn the spread between exams of one mass; the result is the reason where that cannot be."""
    try:
        learned = learn_from_exams(repeats, fewest=FEWEST_MASSES)
    except BadDataError as error:
        return {NOT_LEARNED: f"{error.what}; {error.way_out}"}, {}
    return {}, {layout.REPEATABILITY: lambda path: learned.write(path, force=True)}


def make_size(folder: Path, settings: Settings, *, figures: bool) -> Made:
    """Size an exam by the site's repeatability: its estimate with other sizes. Nothing where it had no size.

    The size is from the draws of the exam, in the axes of its map as `estimate` has it.
    """
    report = read_record(folder / layout.ESTIMATE, EstimateReport)
    if report.max_size_mm is None:
        return {}, {}
    tactile_map = read_map(folder / layout.MAP)
    _, calibration, _ = choose_calibration(settings, tactile_map)
    assert isinstance(calibration, BodyCalibration)
    shape = replace(read_shape(folder / layout.SHAPE), turn_rad=0.0)
    rng = np.random.default_rng([settings.seed, tactile_map.fingerprint, _ANOTHER_STREAM])
    size = size_alone(shape, calibration=calibration, priors=size_priors(settings), rng=rng)
    sized = _with_sizes(report, size, settings).checked()
    writes: Writes = {layout.SIZED: lambda path: write_text(path, json_text(sized), force=True)}
    if figures:
        looks: dict[str, Any] = {"probability": settings.interval, "findings": sized.findings}
        writes[layout.SIZED_FIGURE] = lambda path: draw_size(size, path, name=folder.name, force=True, **looks)
    return {}, writes


def _with_sizes(report: EstimateReport, size: SizePosterior, settings: Settings) -> EstimateReport:
    """The estimate with the sizes, their sources and their provenance replaced."""
    repeatability = settings.repeatability
    assert repeatability is not None
    replaced: dict[str, Any] = {name: size.summarise(name, probability=settings.interval).rounded for name in SIZES}
    replaced["another_exam"] = None
    diagnostics = {**report.diagnostics, **size_diagnostics(size), "repeatability": repeatability.words()}
    diagnostics["convergence"] = {
        name: value for name, value in diagnostics.get("convergence", {}).items() if name not in SIZES
    }
    if not diagnostics["convergence"]:
        del diagnostics["convergence"]
    provenance = dict(report.provenance)
    provenance["settings"] = {**provenance["settings"], "repeatability": repeatability.as_dict()}
    provenance["inputs"] = [*provenance["inputs"], {"role": "repeatability", "sha256": repeatability.sha256}]
    return replace(
        report,
        **replaced,
        masses=tuple(replace(mass, **replaced) if mass.reported else mass for mass in report.masses),
        variance_share=rounded(dict(size.variance_share)),
        diagnostics=diagnostics,
        provenance=provenance,
    )
