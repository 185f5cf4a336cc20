"""A campaign's own repeatability: the step that learns it from the repeats, and the one that sizes exams by it.

Neither fits a map: both start from the draws that each estimate left for pooling.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.campaign_names import ESTIMATE, MAP, REPEATABILITY, SHAPE, SIZED, SIZED_FIGURE
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.campaign_staging import Writes
from tactile_bayes.pipeline.campaign_steps import Result, Task
from tactile_bayes.pipeline.repeatability import ExamFolder, learn_from_exams, repeatability_setting

if TYPE_CHECKING:
    from tactile_bayes.pipeline.campaign_settings import CampaignSettings
    from tactile_bayes.pipeline.settings import Settings
    from tactile_bayes.size.draws import SizePosterior

FEWEST_MASSES: Final = 5
"""Masses with repeats from which a campaign learns by itself."""
NOT_LEARNED: Final = "not_learned"
"""Key of the reason in the result of a step that did not learn."""
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
    from tactile_bayes.files.atomic import write_text
    from tactile_bayes.files.documents import load_json
    from tactile_bayes.files.schema import check_document, dump_json
    from tactile_bayes.findings import findings_in

    assert task.settings is not None
    settings = task.settings
    document: Any = load_json(task.folder / ESTIMATE)
    if document["max_size_mm"] is None:
        return {}, {}
    size = _size(task.folder, settings)
    sized = _resized(document, size, settings)
    check_document(sized, "estimate.schema.json", path=Path("the report"))
    writes: Writes = {SIZED: lambda path: write_text(path, dump_json(sized), force=True)}
    if task.figures:
        from tactile_bayes.report.estimate_figures import draw_size

        findings = findings_in(sized["findings"])
        writes[SIZED_FIGURE] = lambda path: draw_size(
            size, path, name=task.name, probability=settings.interval, findings=findings, force=True
        )
    return {}, writes


def _size(folder: Path, settings: Settings) -> SizePosterior:
    """Size from the draws of an exam, in the axes of its map as `estimate` has it."""
    import numpy as np

    from tactile_bayes.files.map_nc import read_map
    from tactile_bayes.files.shape_npz import read_shape
    from tactile_bayes.pipeline.one_map import choose_calibration, size_priors
    from tactile_bayes.size.bodies import BodyCalibration
    from tactile_bayes.size.site import size_alone

    tactile_map = read_map(folder / MAP)
    _, calibration, _ = choose_calibration(settings, tactile_map)
    assert isinstance(calibration, BodyCalibration)
    shape = replace(read_shape(folder / SHAPE), turn_rad=0.0)
    rng = np.random.default_rng([settings.seed, tactile_map.fingerprint, _ANOTHER_STREAM])
    return size_alone(shape, calibration=calibration, priors=size_priors(settings), rng=rng)


def _resized(document: dict[str, Any], size: SizePosterior, settings: Settings) -> dict[str, Any]:
    """The estimate's JSON object with the sizes, their sources and their provenance replaced."""
    from tactile_bayes.report.estimate_document import rounded, size_diagnostics
    from tactile_bayes.report.quantities import ANOTHER_EXAM
    from tactile_bayes.size.draws import SIZES

    found = settings.repeatability
    assert found is not None
    sizes = {name: size.summarise(name, probability=settings.interval).as_dict() for name in SIZES}
    own = {**sizes, ANOTHER_EXAM: None}
    masses = [{**mass, **own} if mass["reported"] else mass for mass in document["masses"]]
    diagnostics = {**document["diagnostics"], **size_diagnostics(size), "repeatability": found.words()}
    diagnostics["convergence"] = {
        name: value for name, value in diagnostics.get("convergence", {}).items() if name not in SIZES
    }
    if not diagnostics["convergence"]:
        del diagnostics["convergence"]
    provenance = dict(document["provenance"])
    provenance["settings"] = {**provenance["settings"], **repeatability_setting(settings)}
    provenance["inputs"] = [*provenance["inputs"], {"role": "repeatability", "sha256": found.sha256}]
    return {
        **document,
        **sizes,
        ANOTHER_EXAM: None,
        "masses": masses,
        "variance_share": rounded(dict(size.variance_share)),
        "diagnostics": diagnostics,
        "provenance": provenance,
    }
