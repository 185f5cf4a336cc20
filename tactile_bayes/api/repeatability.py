"""A site's repeatability, learned from the repeated exams of a campaign's folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import ndtri

from tactile_bayes.api.arguments import PathLike, door, output_path, required_path
from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files import size_json
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.manifest_csv import DONE, ESTIMATE, EXAMS, SHAPE, exam_name, mass_name
from tactile_bayes.files.npz import read_shape
from tactile_bayes.files.provenance import Provenance, exam_with_any, recordings, scans_of
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.files.tables import read_raw
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.learn.site import FEWEST_MASSES, PRIOR_LOG_SD, PRIOR_MEDIAN, RepeatedExams, learn_repeatability
from tactile_bayes.size.pooling import PROBABILITY, Repeatability, log_size_alone

_AGAIN: Final = "run the campaign again"


class ExamFolder(Record):
    """An exam that was estimated, of a mass at a visit."""

    name: str  #: Of the exam.
    of_mass: str  #: Name of the mass at this visit.
    mass: str  #: And at any.
    folder: Path  #: Which holds what its estimate left.


class _Repeat(Record, eq=False):
    """A repeated exam with a size."""

    exam: ExamFolder
    calibration: str  #: That sized it, as its estimate names it.
    calibration_sha256: str
    scans: tuple[str, ...]
    """Recordings that it came from, as `recordings` names them; empty where its estimate does not say."""
    digest: str  #: Of the draws that pooling keeps.
    size: Quantity  #: The largest, with its interval.
    spread: float  #: Between exams, that the size was estimated with.


def exams_of_campaign(folder: Path) -> list[ExamFolder]:
    """List the exams that a campaign estimated, from its ``exams_done.csv``."""
    table = folder / DONE
    if not table.is_file():
        raise BadDataError(f"holds no {DONE}", way_out="give a folder of `campaign run`", path=str(folder))
    exams = dict[str, ExamFolder]()
    for row in read_raw(table).rows:
        try:
            patient, visit, mass, replicate = (row[name] for name in ("patient", "visit", "mass", "replicate"))
        except KeyError as missing:
            raise BadDataError(f"has no column {missing}", way_out=_AGAIN, path=str(table)) from None
        of_mass = mass_name(patient=patient, visit=visit, mass=mass)
        name = exam_name(of_mass, replicate)
        if Path(name).name != name or not name.isprintable():
            raise BadDataError(f"names an exam {name!r}", way_out=_AGAIN, path=str(table))
        if name in exams:
            raise BadDataError(f"names the exam {name} twice", way_out=_AGAIN, path=str(table))
        exams[name] = ExamFolder(name, of_mass, f"{patient} {mass}", folder / EXAMS / name)
    return list(exams.values())


def learn_from_exams(
    exams: Sequence[ExamFolder], *, size_calibration: str | None = None, fewest: int = FEWEST_MASSES
) -> size_json.RepeatabilityFile:
    """Learn the spread between exams of one mass from those that were repeated within a visit.

    Exams without a size, and those of a scan that another exam has, are left out. `size_calibration`: name or path of
    that by which they were sized, where it is in no file that they name; `fewest`: masses with repeats that it takes.
    """
    groups, left_out = _repeats(exams)
    repeats, masses = [repeat for group in groups for repeat in group], []
    if not groups:
        learn_repeatability([], fewest=fewest)  # refuses them
    calibration, sizing = _calibration(repeats, size_calibration)
    for group in groups:
        alone = [log_size_alone(calibration, read_shape(one.exam.folder / SHAPE)) for one in group]
        first, values = group[0].exam, np.array(alone)
        masses.append(RepeatedExams(first.of_mass, first.mass, values[:, 0], values[:, 1]))
    learned = learn_repeatability(masses, fewest=fewest)
    spread = learned.repeatability
    entries = [
        size_json.RepeatedMass(
            name=mass.name,
            exams=[repeat.exam.name for repeat in group],
            log_size=list(mass.centre),
            map_sd=[math.sqrt(value) for value in mass.noise],
            by_chance=chance,
        )
        for mass, group, chance in zip(masses, groups, learned.by_chance, strict=True)
    ]
    settings = {"prior": {"median": PRIOR_MEDIAN, "log_sd": PRIOR_LOG_SD}}
    inputs = {f"draws_{i}": repeat.digest for i, repeat in enumerate(repeats, start=1)}
    provenance = Provenance("calibrate repeatability", settings, {"size_calibration": sizing.sha256, **inputs})
    return size_json.RepeatabilityFile(
        schema="tactile-bayes/repeatability/1",
        research_use=RESEARCH_USE,
        between_map_sd=spread.sd,
        probability=PROBABILITY,
        calibration=sizing,
        half_width=_half_widths(repeats, spread.sd),
        repeats=entries,
        left_out=left_out,
        provenance=provenance.as_dict(),
        **{name: getattr(spread, name) for name in size_json.SPREAD},
    )


def _repeats(exams: Sequence[ExamFolder]) -> tuple[list[list[_Repeat]], list[str]]:
    """Group repeated exams with a size by mass and visit; also say why others of these masses are left out."""
    by_mass: dict[str, list[ExamFolder]] = {}
    for exam in exams:
        by_mass.setdefault(exam.of_mass, []).append(exam)
    groups, left_out = [], []
    for same in by_mass.values():
        if len(same) < 2:
            continue
        group: list[_Repeat] = []
        scans: dict[str, str] = {}
        for exam in same:
            repeat = _read_repeat(exam)
            if isinstance(repeat, str):
                left_out.append(f"{exam.name}: it has no size ({repeat})")
                continue
            if twin := exam_with_any(repeat.scans, exam.name, scans):
                left_out.append(f"{exam.name}: of the same scan as {twin}")
                continue
            group.append(repeat)
        if len(group) > 1:
            groups.append(group)
    return groups, left_out


def _read_repeat(exam: ExamFolder) -> _Repeat | str:
    """Read an exam's size and where it came from, or the reason for no size."""
    path = exam.folder / ESTIMATE
    report = read_record(path, EstimateReport, way_out=_AGAIN)
    if report.max_size_mm is None:
        return report.reason or "no calibration"
    origin = report.origin
    if "size_calibration" not in origin.settings or "inputs" not in report.provenance:
        raise BadDataError("does not say by which calibration", way_out=_AGAIN, path=str(path))
    calibration = str(origin.settings["size_calibration"]).removesuffix(" (shipped)")
    digests = {one.role: one.sha256 for one in origin.inputs}
    return _Repeat(
        exam,
        calibration,
        digests.get("size_calibration", ""),
        tuple(recordings(scans_of(report.provenance))),
        sha256(exam.folder / SHAPE),
        report.max_size_mm,
        report.diagnostics.get("between_map_sd") or 0.0,
    )


def _calibration(repeats: Sequence[_Repeat], named: str | None) -> tuple[BodyCalibration, size_json.UsedCalibration]:
    """The one calibration that sized all exams: of this name or path, else of its own name, else a shipped one."""
    name, digest = repeats[0].calibration, repeats[0].calibration_sha256
    digests = list(dict.fromkeys(repeat.calibration_sha256 for repeat in repeats))
    if len(digests) > 1:
        another = next(one for one in repeats if one.calibration_sha256 == digests[1])
        examples = ", ".join(f"{one.exam.name} by {one.calibration}" for one in (repeats[0], another))
        way_out = "their spreads are not comparable: run the campaign with one"
        raise BadDataError(f"the exams were sized by {len(digests)} calibrations ({examples})", way_out=way_out)
    names = [name, *size_json.SHIPPED] if named is None else [named]
    paths = [path for one in names if (path := size_json.size_calibration_path(one)) is not None]
    path = next((path for path in paths if (named is not None or path.is_file()) and sha256(path) == digest), None)
    if path is None and named is not None:
        what = f"{named} is not the calibration that the exams were sized by ({name})"
        raise BadDataError(what, way_out="give that one, or run the campaign again with this one")
    if path is None:
        raise UsageError(f"calibration {name}, which sized the exams, is not found; name it by --size-calibration")
    calibration = size_json.read_size_calibration(path)
    if not isinstance(calibration, BodyCalibration):
        raise UsageError(f"the spread between exams is learned through a calibration over bodies, which {name} is not")
    shown = Path(name).name  # a file's folder may say whose it is
    return calibration, size_json.UsedCalibration(shown, digest, calibration.recipe.normalise)


def _half_widths(repeats: Sequence[_Repeat], sd: float) -> size_json.HalfWidth:
    """Half width of a single exam's 95 % interval, as estimated and with this spread: medians over the exams.

    Each interval is taken as a normal of ln d, of which the spread that it was made with is a part.
    """
    before, after = [], []
    for repeat in repeats:
        size, spread = repeat.size, repeat.spread
        score = float(ndtri(0.5 + 0.5 * size.probability))
        variance = (math.log(size.high / size.low) / (2.0 * score)) ** 2
        before.append(variance)
        after.append(max(variance - spread**2, 0.0) + sd**2)
    return size_json.HalfWidth(*(math.expm1(1.96 * float(np.median(np.sqrt(one)))) for one in (before, after)))


@door
def calibrate_repeatability(
    folder: PathLike, *, size_calibration: PathLike | None = None, path: PathLike | None = None, force: bool = False
) -> Repeatability:
    """Learn how far sizes of one mass lie apart between its exams at a site.

    Parameters
    ----------
    folder
        Of a ``campaign run`` with at least 3 masses that have repeated exams.
    size_calibration
        Calibration that the exams were sized by, where the name in their estimates does not lead to its file.
    path
        Also write it there.

    Returns
    -------
    Repeatability
        For ``estimate(..., repeatability=...)``: `median`, `low` and `high` of the spread, a share of the size.

    Raises
    ------
    BadDataError
        When there are too few masses with repeated exams, or the exams were sized by several calibrations.
    UsageError
        When the calibration's file is not found.
    """
    target = None if path is None else output_path(path, "JSON")
    named = None if size_calibration is None else str(size_calibration)
    learned = learn_from_exams(exams_of_campaign(required_path(folder, "folder")), size_calibration=named)
    if target is not None:
        learned.write(target, force=force)
    return learned.spread()
