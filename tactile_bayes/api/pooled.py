"""The maps of one mass: estimated again at its common place, and pooled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import PathLike, door, path_of
from tactile_bayes.api.estimating import estimate_one, input_digests, named_calibration
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import Answer, SizedExam, SizeEstimate, check_one_mass, size_priors
from tactile_bayes.declarations import replace
from tactile_bayes.errors import CANNOT_SHOW, BadDataError, UsageError
from tactile_bayes.files.posterior_nc import write_posterior
from tactile_bayes.files.provenance import Provenance, scans_of
from tactile_bayes.files.reports import EstimateReport, PooledReport
from tactile_bayes.files.size_json import default_for
from tactile_bayes.findings import by_severity
from tactile_bayes.options import PRIORS
from tactile_bayes.posterior.estimate import way_to_head
from tactile_bayes.report.pooled import maps_of_another_mass, pooled_findings, pooled_report
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import LEAST_PROBABILITY
from tactile_bayes.size.pooling import DISAGREE, PooledEstimate, pool_maps
from tactile_bayes.size.visits import PatientPlace, one_place_probability

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# --- The maps of one mass, estimated again where they report another one.


def reestimate_at_common_mass(estimates: Sequence[SizeEstimate]) -> tuple[SizeEstimate, ...]:
    """Estimate the mass that most maps show, where a map reported another; keep estimates at a stated centre."""
    result = list(estimates)
    for i, place in maps_of_another_mass([estimate.answer.report for estimate in estimates]).items():
        estimate = estimates[i]
        if estimate.settings.centre_mm is None:
            settings, made = replace(estimate.settings, centre_mm=place), estimate.provenance
            again = estimate_one(estimate.tactile_map, settings, scans=made.scans)
            result[i] = replace(again, provenance=replace(again.provenance, inputs=made.inputs), name=estimate.name)
    return tuple(result)


def pool_estimates(
    estimates: Sequence[SizeEstimate], settings: Settings, *, names: Sequence[str], files: Sequence[Path] = ()
) -> PooledSize:
    """Pool the estimates of several maps, re-estimated at their common mass; see `pool_answers`."""
    of_one_mass = reestimate_at_common_mass(estimates)
    return replace(
        pool_answers([one.answer for one in of_one_mass], settings, names=names, files=files), maps=of_one_mass
    )


def refuse_repeated_maps(estimates: Sequence[SizeEstimate], *, way_out: str = "give each map once") -> None:
    """Refuse a map that is given twice: its readings would count twice, and the interval would be too narrow."""
    if len({estimate.tactile_map.fingerprint for estimate in estimates}) < len(estimates):
        raise UsageError(f"a map is given twice; {way_out}")


def patient_place(report: EstimateReport) -> PatientPlace | None:
    """Place of a map's reported mass in the patient; None without a lump or landmarks."""
    centre = report.centre_patient_mm
    return None if centre is None else PatientPlace(np.array(centre.median), np.diag([centre.x.sd**2, centre.y.sd**2]))


# --- One size from several maps of one mass.


class PooledSize(SizedExam, eq=False, dict=True, kw_only=True):
    """One size from several maps of one mass."""

    pooled: PooledEstimate  #: The size with what the maps together say of it, or why there is none.
    pooled_report: PooledReport
    maps: tuple[SizeEstimate, ...] = ()  #: The estimates of the maps alone, where they are at hand.

    @property
    def _result(self) -> PooledEstimate:
        return self.pooled

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``estimate --pool --json`` prints."""
        return self.pooled_report.document

    @door
    def plot(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the posterior of the size; with a path also write it.

        Raises
        ------
        UsageError
            Without a size.
        """
        size = self._size
        if size is None:
            raise UsageError(f"there is no size to draw: {self.why}")
        return self._draw_size(size, path_of(path), force=force)

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write the draws of a size, with its report."""
        assert self.pooled.size is not None
        write_posterior(path, self.pooled.size, provenance=self.provenance, report=self.pooled_report, force=force)


def pool_answers(
    answers: Sequence[Answer], settings: Settings, *, names: Sequence[str], files: Sequence[Path] = ()
) -> PooledSize:
    """Pool the maps of one mass, from the answer for each, by their `names` in the report; `files` that they are of."""
    reports = [answer.report for answer in answers]
    scans = [scan for report in reports for scan in scans_of(report.provenance)]
    check_one_mass(scans)
    inputs = {f"map_{i}": path for i, path in enumerate(files, start=1)}
    calibration, named, digests = common_calibration(answers, settings, names=names, inputs=inputs)
    # the maps' values in sorted order are part of the seed: the result does not depend on their order
    fingerprints = sorted(answer.fingerprint for answer in answers)
    places = [place for one in answers if one.shape is not None and (place := patient_place(one.report)) is not None]
    one_place = one_place_probability(places) if len(places) > 1 else None
    pooled = _abstention(reports, places, one_place) or pool_maps(
        [answer.shape for answer in answers],
        silent=sum(one.reason_code == CANNOT_SHOW for one in reports),
        calibration=calibration,
        priors=size_priors(settings),
        rng=np.random.default_rng([settings.seed, *fingerprints]),
    )
    pooled = replace(pooled, one_place=one_place)
    if pooled.status == DISAGREE and pooled.one_size is not None:
        *first, last = [f"{one.max_size_mm.median:.1f}" for one in reports if one.max_size_mm is not None]
        sizes = f"{', '.join(first)} and {last}" if first else last
        pooled = replace(pooled, reason=f"{pooled.reason}, {sizes} mm")
    pooled = replace(pooled, findings=by_severity(pooled_findings(pooled, reports)))
    # pooled files have the key `calibration`, and the priors together
    recorded = settings.recorded(size_calibration=named)
    prior = {name: recorded.pop(name) for name in PRIORS}
    recorded = {"calibration": recorded.pop("size_calibration"), **recorded, "prior": prior}
    provenance = Provenance("estimate --pool", recorded, digests, seed=settings.seed, scans=scans)
    report = pooled_report(
        pooled,
        list(names),
        reports,
        calibration,
        probability=settings.interval,
        provenance=provenance,
        repeatability=settings.repeatability,
    )
    name = f"{len(reports)} maps pooled"
    return PooledSize(pooled=pooled, pooled_report=report, provenance=provenance, settings=settings, name=name)


def _abstention(
    reports: Sequence[EstimateReport], places: Sequence[PatientPlace], one_place: float | None
) -> PooledEstimate | None:
    """No size: a map too far outside the calibration's range, cells too large, or several masses; else None."""
    for i, report in enumerate(reports, start=1):
        if report.reason_code == "extrapolated":
            return PooledEstimate("no_estimate", f"map {i}: {report.reason}")
    if why := without_calibration(reports):
        return PooledEstimate("no_estimate", why)
    if all(report.reason_code == CANNOT_SHOW for report in reports):
        why = reports[0].reason
        return PooledEstimate("no_estimate", f"map 1: {why}" if len(reports) > 1 else why)
    if one_place is None or one_place >= LEAST_PROBABILITY:
        return None
    most = max(float(np.hypot(*(a.centre_mm - b.centre_mm))) for a, b in combinations(places, 2))
    return PooledEstimate(DISAGREE, f"by the landmarks the masses of the maps lie up to {most:.0f} mm apart")


def without_calibration(reports: Sequence[EstimateReport]) -> str:
    """Reason of the first map that no calibration fits; empty where all have one."""
    reasons = (f"map {i}: {one.reason}" for i, one in enumerate(reports, start=1) if one.reason and not one.reason_code)
    return next(reasons, "")


def common_calibration(
    answers: Sequence[Answer], settings: Settings, *, names: Sequence[str], inputs: Mapping[str, Path]
) -> tuple[BodyCalibration, str, dict[str, str]]:
    """The one calibration for all maps, its name in a provenance, and the digests of all files by role."""
    ways = sorted({answer.normalise for answer in answers})
    if settings.size_calibration is None and len(ways) > 1:
        way_out = "give maps made by one recipe: make the others again with `map`"
        raise BadDataError(f"the maps were normalised in several ways ({', '.join(ways)})", way_out=way_out)
    path, calibration = named_calibration(settings, ways[0])
    if calibration is None:
        raise UsageError("--pool needs a size calibration; leave out --size-calibration none")
    if not isinstance(calibration, BodyCalibration):
        what = path or settings.calibration_name
        raise UsageError(
            f"--pool needs a calibration learned over bodies; {what} is of a study or phantoms: use solid or eq6"
        )
    for answer, name in zip(answers, names, strict=True):
        if differs := calibration.recipe.head_differences(answer.head):
            what = f"{name}: the calibration is for another head: {'; '.join(differs)}"
            raise BadDataError(what, way_out=way_to_head(answer.head))
    named = settings.calibration_name or f"{default_for(ways[0])} (shipped)"
    return calibration, named, input_digests({**inputs, "size_calibration": path}, settings, calibration)
