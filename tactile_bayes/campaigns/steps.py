"""The steps of one exam: map, estimate, page; and the figures of a site."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.api.comparing import compare_answers, drawn_maps
from tactile_bayes.api.estimating import choose_calibration, estimate_file
from tactile_bayes.api.maps import map_provenance
from tactile_bayes.api.pooled import pool_answers
from tactile_bayes.api.repeatability import ExamFolder, learn_from_exams, repeatability_setting
from tactile_bayes.api.settings import Comparing, Settings
from tactile_bayes.api.sized import Answer, SizeEstimate, size_priors
from tactile_bayes.campaigns.match import OWN_AXES, NamedPlace, in_own_axes, matched
from tactile_bayes.campaigns.settings import CampaignSettings, Writes, digest_of, write_staged
from tactile_bayes.declarations import EXACT, Record, field, from_plain, replace, rounded, to_plain
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import sha256, write_bytes, write_text
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.imports import read_arrays
from tactile_bayes.files.manifest_csv import (
    COMPARED,
    COMPARED_FIGURE,
    ESTIMATE,
    EXAM_PAGE,
    GROWTH_PAGE,
    MAP,
    MAP_FIGURE,
    POOLED,
    POOLED_DRAWS,
    POSTERIOR,
    REPEATABILITY,
    SAME_IN_SCANS,
    SCAN,
    SHAPE,
    SIZE_FIGURE,
    SIZED,
    SIZED_FIGURE,
    THUMBNAIL,
    Exam,
)
from tactile_bayes.files.map_nc import read_map, read_map_and_scans, write_map
from tactile_bayes.files.npz import read_shape, write_shape
from tactile_bayes.files.provenance import Provenance, scan_facts
from tactile_bayes.files.reading import NETCDF_BYTES, fetched, kind_of, put, read_bytes
from tactile_bayes.files.reports import EstimateReport, json_text
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.findings import by_weight
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import MapOptions
from tactile_bayes.report.estimate_document import size_diagnostics
from tactile_bayes.report.estimate_figures import draw_comparison, draw_map, draw_size
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import Exam as ShownExam
from tactile_bayes.report.exam_words import exam_map
from tactile_bayes.report.growth_page import Course, growth_page
from tactile_bayes.report.quantities import side_of
from tactile_bayes.report.svg import thumbnail_svg
from tactile_bayes.scans import Scan
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import SIZES, SizePosterior
from tactile_bayes.size.pooling import size_alone

# --- Steps of a campaign: map, estimate, figures and size of an exam, repeatability, pooled size and growth of a mass.
#
# A step runs in any process. It gets all that its result depends on, writes its files into one folder, and returns
# their digests, so that a later run can tell whether they are still what it made.

FILES: Final = {
    "map": (SCAN, MAP),
    "estimate": (ESTIMATE, POSTERIOR, SHAPE),
    "figures": (MAP_FIGURE, SIZE_FIGURE),
    "repeatability": (REPEATABILITY,),
    "size": (SIZED, SIZED_FIGURE),
    "page": (EXAM_PAGE, THUMBNAIL),
    "pool": (POOLED, POOLED_DRAWS),
    "compare": (COMPARED, GROWTH_PAGE, COMPARED_FIGURE),
    "copy": (),
}
"""The files that each step may write."""
UNWRITTEN: Final = "unwritten"
"""Key of a result that the disk did not take: the campaign's fault, not the exam's."""
_KINDS: Final = {"a map or posterior (netCDF)": "map", "an archive (.npz or a spreadsheet)": "npz"}
"""What `kind_of` calls the files that are no scans."""

Result = dict[str, Any]


class Task(Record):
    """One step of one exam or mass."""

    step: str  #: One of `RUN`.
    name: str
    folder: Path
    """`name`, `folder`: Of the exam or mass."""
    digest: str  #: Of all that the step's files depend on.
    source: Path = Path()
    source_sha256: str = ""
    """`source`, `source_sha256`: Of a map: the exam's file."""
    expected: Mapping[str, str] = field(default_factory=dict)
    """Of a map and a page: what the table says of the exam, by its columns."""
    normalise: str = ""  #: Of a map: as the option of `map`.
    settings: Settings | None = None  #: Of all steps after the map: of the estimate.
    mass: str = ""
    places: tuple[NamedPlace, ...] = ()
    match_mm: float = 0.0
    """`mass`, `places`, `match_mm`: Of estimates and figures: where other exams of the breast have the mass; no places
    where the exam is not matched.
    """
    members: tuple[tuple[str, Path], ...] = ()  #: Of a pooled mass: names and folders of the exams.
    visits: tuple[tuple[tuple[str, Path], ...], ...] = ()
    days: tuple[float, ...] | None = None
    """`visits`, `days`: Of a comparison: the exams of each visit in order of time, and its day from the first."""
    address: str = ""  #: Of a map: the exam's file in an object store.
    copies: Mapping[str, str] = field(default_factory=dict)
    """Of a copy: addresses in an object store, by the names of the files."""
    repeats: tuple[ExamFolder, ...] = ()  #: Of the repeatability: the exams.
    figures: bool = False  #: Of sizes and comparisons: whether to draw them.
    report: str = ESTIMATE  #: Of a page: the file that holds the exam's size.
    course: Course = field(default_factory=Course)  #: Of a comparison: what the table says of the visits.

    @property
    def key(self) -> str:
        """Name in the store of the campaign's results."""
        return f"{self.step} {self.name} {self.digest}"


def run_step(task: Task) -> Result:
    """Run a step; returns digests of its files by name, where they wait, the seconds it took and what else it found.

    `put_in_place` brings the files to their place: a worker that outlives its command must not.

    What is wrong with the exam is a `TactileBayesError` without a path.
    """
    begun, begun_cpu = time.perf_counter(), time.thread_time()
    try:
        found, writes = RUN[task.step](task)
    except BadDataError as error:
        raise BadDataError(error.what, way_out=error.way_out) from None
    if UNWRITTEN in found:
        return found
    try:
        made = write_staged(task.folder, writes, step=task.step, digest=task.digest, names=FILES[task.step])
    except (UsageError, OSError) as error:
        return {UNWRITTEN: str(error)}
    spent = {"seconds": time.perf_counter() - begun, "cpu_seconds": time.thread_time() - begun_cpu}
    return {**made, **{name: round(one, 3) for name, one in spent.items()}, **found}


def _map(task: Task) -> tuple[Result, Writes]:
    """Make the exam's map from its scan or arrays, or take the map that it is; refuse what belongs to another exam."""
    if task.address:  # fetched for as long as the map is made
        with fetched(task.address) as path:
            return _map(replace(task, source=path, address=""))
    if sha256(task.source) != task.source_sha256:
        raise BadDataError("changed while the campaign ran", way_out="run the campaign again")
    kind = _KINDS.get(kind_of(task.source), "")
    if kind == "map":
        return _given_map(task)
    if kind == "npz":
        return _imported_map(task)
    return _scanned_map(task)


def _scanned_map(task: Task) -> tuple[Result, Writes]:
    scan = read_scan(task.source)
    check_facts(task.expected, scan.session)
    settings = map_settings(task.normalise)
    provenance: Provenance = map_provenance([task.source], [scan], settings)
    facts = scan_facts(scan.session, frames=scan.frames.sha256, file=task.source_sha256)
    return _built(task, scan, provenance, facts)


def _imported_map(task: Task) -> tuple[Result, Writes]:
    """Bring in arrays as `import` does, and map the scan that they are."""
    scan = read_arrays(task.source)
    made = Provenance("import", {"as": "scan", "lost": [], "correct": []}, inputs={"source": task.source_sha256})
    facts = scan_facts(scan.session, frames=scan.frames.sha256, file=task.source_sha256)
    inputs = {"scan_1": task.source_sha256}
    provenance = Provenance("map", map_settings(task.normalise), inputs, scans=[facts])
    found, writes = _built(task, scan, provenance, facts)
    return found, {SCAN: lambda path: write_scan(path, scan, provenance=made, force=True), **writes}


def _built(task: Task, scan: Scan, provenance: Any, facts: Mapping[str, str]) -> tuple[Result, Writes]:
    tactile_map = build_map(scan, normalise=task.normalise)
    found = {
        "scans": [dict(facts)],
        "synthetic": scan.session.get("source") == "simulated",
        "normalise": task.normalise,
    }
    return found, {MAP: lambda path: write_map(path, tactile_map, provenance=provenance, force=True)}


def _given_map(task: Task) -> tuple[Result, Writes]:
    """Take a map that was made before, byte for byte."""
    tactile_map, scans = read_map_and_scans(task.source)
    for facts in scans:
        check_facts(task.expected, facts)
    data = read_bytes(task.source, most=NETCDF_BYTES)
    found = {"scans": list(scans), "synthetic": None, "normalise": tactile_map.recipe.normalise}
    return found, {MAP: lambda path: write_bytes(path, data, force=True)}


def map_settings(normalise: str) -> dict[str, Any]:
    """Settings of `map` by its options: their defaults, but for the normalisation."""
    settings: dict[str, Any] = to_plain(from_plain(MapOptions, {"normalise": normalise}), digits=EXACT)
    return settings


def check_facts(expected: Mapping[str, str], facts: Mapping[str, str]) -> None:
    """Refuse a file that says it is of another exam than the table does.

    What either leaves out is not compared, nor are capitals: the table has no two codes that differ by these alone.
    """
    both = {ours: facts[theirs] for ours, theirs in SAME_IN_SCANS.items() if facts.get(theirs) and expected.get(ours)}
    differs = [name for name, value in both.items() if value.casefold() != expected[name].casefold()]
    if not differs:
        return
    shown = list(dict.fromkeys([*(name for name in ("patient", "side") if name in both), *differs]))
    here, there = (", ".join(f"{name} {one[name]}" for name in shown) for one in (expected, both))
    way_out = "is it another exam's file? correct the row or the file"
    raise BadDataError(f"the table says {here}; the file says {there}", way_out=way_out)


def _estimate(task: Task) -> tuple[Result, Writes]:
    found = _estimated(task)
    answer = found.answer
    assert answer.report is not None
    report = answer.report.checked()
    writes: Writes = {ESTIMATE: lambda path: write_text(path, json_text(report), force=True)}
    if found.status == "estimate":
        writes[POSTERIOR] = lambda path: found.write(path, force=True)
    shape = answer.shape
    if shape is not None:
        writes[SHAPE] = lambda path: write_shape(path, shape, force=True)
    return {"exit_code": answer.exit_code}, writes


def _estimated(task: Task) -> SizeEstimate:
    """The exam's estimate: of the mass that its row names, where other exams have it."""
    assert task.settings is not None
    path = task.folder / MAP
    if not task.places:
        return estimate_file(path, task.settings)
    found = matched(path, task.settings, mass=task.mass, places=task.places, most_mm=task.match_mm)
    if not in_own_axes(found.tactile_map, task.places):
        return found
    findings = by_weight((*found.estimate.findings, OWN_AXES))
    return replace(found, estimate=replace(found.estimate, findings=findings))


def _figures(task: Task) -> tuple[Result, Writes]:
    """Draw the figures of `estimate`; the estimate is made again, for it is not stored whole."""
    found = _estimated(task)
    tactile_map, estimate = found.tactile_map, found.estimate
    size, writes = estimate.size, Writes()
    if tactile_map.covered.any():
        writes[MAP_FIGURE] = lambda path: draw_map(tactile_map, estimate, path, name=task.name, force=True)
    if size is not None:
        probability, findings = found.probability, estimate.findings
        writes[SIZE_FIGURE] = lambda path: draw_size(
            size, path, name=task.name, probability=probability, findings=findings, force=True
        )
    return {}, writes


def _page(task: Task) -> tuple[Result, Writes]:
    """Make the exam's page and its thumbnail from what its steps left; the table tells what the scans do not."""
    tactile_map, scans = read_map_and_scans(task.folder / MAP)
    told = {SAME_IN_SCANS[name]: text for name, text in task.expected.items() if name in SAME_IN_SCANS}
    facts = [told | scan for scan in scans or [{}]]
    report = read_record(task.folder / task.report, EstimateReport)
    shown = exam_map(tactile_map, report, side=side_of(facts))
    title = f"Tactile exam {task.expected['replicate']}"
    page = exam_page(ShownExam((shown,), None, facts, title=title, day=task.expected.get("date", "")))
    writes: Writes = {EXAM_PAGE: lambda path: write_text(path, page, force=True)}
    if tactile_map.covered.any():
        picture = thumbnail_svg(shown, label=f"Map of {task.name}")
        writes[THUMBNAIL] = lambda path: write_text(path, picture, force=True)
    return {}, writes


def _pool(task: Task) -> tuple[Result, Writes]:
    """Pool the exams of a mass as `estimate --pool` does, from what their estimates left in their folders."""
    assert task.settings is not None
    answers = [_answer(folder) for _, folder in task.members]
    inputs = {f"map_{i}": folder / MAP for i, (_, folder) in enumerate(task.members, start=1)}
    names = [name for name, _ in task.members]
    found = pool_answers(answers, task.settings, names=names, inputs=inputs)
    report = found.pooled_report.checked()
    writes: Writes = {POOLED: lambda path: write_text(path, json_text(report), force=True)}
    if found.pooled.size is not None:
        writes[POOLED_DRAWS] = lambda path: found.write(path, force=True)
    return {}, writes


def _compare(task: Task) -> tuple[Result, Writes]:
    """Compare the visits of a mass as `compare` does; the table says that they are of one where landmarks do not."""
    assert task.settings is not None
    answers = [[_answer(folder) for _, folder in exams] for exams in task.visits]
    found = [one for maps in answers for one in maps if one.shape is not None]
    placed = all(one.report is not None and one.report.centre_patient_mm is not None for one in found)
    numbered = [(v, i, folder) for v, exams in enumerate(task.visits, 1) for i, (_, folder) in enumerate(exams, 1)]
    compared = compare_answers(
        answers,
        task.settings,
        comparing=Comparing(days=task.days, same_mass=not placed),
        names=[[name for name, _ in exams] for exams in task.visits],
        inputs={f"visit_{v}_map_{i}": folder / MAP for v, i, folder in numbered},
    )
    report = compared.report.checked()
    writes: Writes = {COMPARED: lambda path: write_text(path, json_text(report), force=True)}
    maps = [[read_map(folder / MAP) for _, folder in exams] for exams in task.visits]
    drawn = drawn_maps(maps, answers)
    page = growth_page(compared.compared, report, drawn, task.course)
    writes[GROWTH_PAGE] = lambda path: write_text(path, page, force=True)
    if task.figures and compared.compared.joint is not None:
        writes[COMPARED_FIGURE] = lambda path: draw_comparison(compared.compared, report, drawn, path, force=True)
    return {}, writes


def _answer(folder: Path) -> Answer:
    """An exam's answer for pooling, from its folder."""
    tactile_map: TactileMap = read_map(folder / MAP)
    return Answer(
        read_record(folder / ESTIMATE, EstimateReport),
        text="",
        exit_code=0,
        shape=read_shape(folder / SHAPE) if (folder / SHAPE).exists() else None,
        normalise=tactile_map.recipe.normalise,
        fingerprint=tactile_map.fingerprint,
        head=tactile_map.head,
    )


# --- Copies of a campaign's files in an object store: a step for each exam and mass, after those that make its files.


def copy_tasks(folder: Path, names: Sequence[str], results: Sequence[Mapping[str, Result]], *, to: str) -> list[Task]:
    """Tasks that copy what steps made of exams or of masses, keyed by the files' digests and by where they go.

    The folder, and the address, hold a folder for each of the names.
    """
    tasks = []
    for name in names:
        made = [found[name]["files"] for found in results if name in found]
        files = {file: digest for one in made for file, digest in one.items()}
        if files:
            copies = {file: f"{to}/{name}/{file}" for file in files}
            digest = digest_of({"to": f"{to}/{name}", "files": files})
            tasks.append(Task("copy", name, folder / name, digest, copies=copies))
    return tasks


def copy_step(task: Task) -> tuple[Result, Writes]:
    """Copy files into an object store."""
    try:
        for name, address in task.copies.items():
            put(task.folder / name, address)
    except UsageError as error:
        return {UNWRITTEN: str(error)}, {}
    return {}, {}


# --- A campaign's own repeatability: the step that learns it from the repeats, and the one that sizes exams by it.
#
# Neither fits a map: both start from the draws that each estimate left for pooling.

FEWEST_MASSES: Final = 5  #: Masses with repeats from which a campaign learns by itself.
NOT_LEARNED: Final = "not_learned"  #: Key of the reason in the result of a step that did not learn.
_ANOTHER_STREAM: Final = 1
"""Of random numbers: the sizes' points must not be those that drew the map's posterior."""


def taught_by(exams: Sequence[Exam], settings: CampaignSettings) -> int:
    """Count the masses that may teach the spread; 0 where one was given or is not wanted."""
    given = settings.estimate
    if not settings.own_repeatability or given.repeatability or given.between_map_sd is not None:
        return 0
    return repeated_masses(exams)


def repeated_masses(exams: Sequence[Exam]) -> int:
    """Masses that have several of these exams at one visit."""
    count: dict[tuple[str, str], int] = defaultdict(int)
    for exam in exams:
        count[exam.patient, exam.of_mass] += 1
    of_mass = {exam.of_mass: (exam.patient, exam.mass) for exam in exams}
    return len({of_mass[name] for (_, name), n in count.items() if n > 1})


def too_few(masses: int) -> str:
    """Why nothing is learned from so few masses with repeats."""
    return f"{masses} {'mass has' if masses == 1 else 'masses have'} repeated exams, and it takes {FEWEST_MASSES}"


def exam_folders(exams: Sequence[Exam], folder: Path) -> list[ExamFolder]:
    """Exams as `learn_from_exams` takes them; `folder` holds one folder for each."""
    return [ExamFolder(one.name, one.of_mass, f"{one.patient} {one.mass}", folder / one.name) for one in exams]


def learn_step(task: Task) -> tuple[Result, Writes]:
    """Learn the spread between exams of one mass; where that cannot be, the reason is the result."""
    try:
        learned = learn_from_exams(task.repeats, fewest=FEWEST_MASSES)
    except BadDataError as error:
        return {NOT_LEARNED: f"{error.what}; {error.way_out}"}, {}
    return {}, {REPEATABILITY: lambda path: learned.write(path, force=True)}


def size_step(task: Task) -> tuple[Result, Writes]:
    """Size an exam by the site's repeatability: its estimate with other sizes. Nothing where it had no size."""
    assert task.settings is not None
    settings = task.settings
    report = read_record(task.folder / ESTIMATE, EstimateReport)
    if report.max_size_mm is None:
        return {}, {}
    size = _exam_size(task.folder, settings)
    sized = _resized(report, size, settings).checked()
    writes: Writes = {SIZED: lambda path: write_text(path, json_text(sized), force=True)}
    if task.figures:
        findings = sized.findings
        writes[SIZED_FIGURE] = lambda path: draw_size(
            size, path, name=task.name, probability=settings.interval, findings=findings, force=True
        )
    return {}, writes


def _exam_size(folder: Path, settings: Settings) -> SizePosterior:
    """Size from the draws of an exam, in the axes of its map as `estimate` has it."""
    tactile_map = read_map(folder / MAP)
    _, calibration, _ = choose_calibration(settings, tactile_map)
    assert isinstance(calibration, BodyCalibration)
    shape = replace(read_shape(folder / SHAPE), turn_rad=0.0)
    rng = np.random.default_rng([settings.seed, tactile_map.fingerprint, _ANOTHER_STREAM])
    return size_alone(shape, calibration=calibration, priors=size_priors(settings), rng=rng)


def _resized(report: EstimateReport, size: SizePosterior, settings: Settings) -> EstimateReport:
    """The estimate with the sizes, their sources and their provenance replaced."""
    found = settings.repeatability
    assert found is not None
    own: dict[str, Any] = {name: size.summarise(name, probability=settings.interval).rounded for name in SIZES}
    own["another_exam"] = None
    diagnostics = {**report.diagnostics, **size_diagnostics(size), "repeatability": found.words()}
    diagnostics["convergence"] = {
        name: value for name, value in diagnostics.get("convergence", {}).items() if name not in SIZES
    }
    if not diagnostics["convergence"]:
        del diagnostics["convergence"]
    provenance = dict(report.provenance)
    provenance["settings"] = {**provenance["settings"], **repeatability_setting(settings)}
    provenance["inputs"] = [*provenance["inputs"], {"role": "repeatability", "sha256": found.sha256}]
    return replace(
        report,
        **own,
        masses=tuple(replace(one, **own) if one.reported else one for one in report.masses),
        variance_share=rounded(dict(size.variance_share)),
        diagnostics=diagnostics,
        provenance=provenance,
    )


RUN: Final[dict[str, Callable[[Task], tuple[Result, Writes]]]] = {
    "map": _map,
    "estimate": _estimate,
    "figures": _figures,
    "repeatability": learn_step,
    "size": size_step,
    "page": _page,
    "pool": _pool,
    "compare": _compare,
    "copy": copy_step,
}
"""What makes each step's files: what it found, and how to write each file."""
