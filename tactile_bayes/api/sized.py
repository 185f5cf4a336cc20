"""Results of estimates: draws, sizes, tables, report and files, of a mass and of a map."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import PathLike, dataframe, door, options_as_keywords, output_path, path_of
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE, BadDataError, UsageError
from tactile_bayes.files.posterior_nc import OF_A_MAP, write_posterior
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.findings import Finding, Verdict, finding_lines, verdict
from tactile_bayes.inference.draws import Draws
from tactile_bayes.inference.ensemble import DrawGroup, inference_data
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.result import Estimate, Mass, inference_groups
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_document import estimate_report, patient_mm, side_of
from tactile_bayes.report.estimate_figures import draw_fit, draw_map, draw_size
from tactile_bayes.report.estimate_text import estimate_summary, estimate_text, exams_label
from tactile_bayes.report.exam_words import PageLabels, ShownExam, exam_map
from tactile_bayes.report.figure_file import exam_title
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.scans import HeadShape
from tactile_bayes.size.draws import EXTREMES, SIZES, BetweenMaps, ShapeDraws, SizePosterior
from tactile_bayes.size.pooling import Calibration, PooledEstimate, SizePriors
from tactile_bayes.size.terms import head_profile

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

# --- Base of all size results, and the masses of a map.


class SizeResult(Record, eq=False, dict=True):
    """Base of the estimates from one map, of one of its masses, and from several maps."""

    @property
    def _result(self) -> Estimate | PooledEstimate:
        raise NotImplementedError

    @property
    def _size(self) -> SizePosterior | None:
        return self._result.size

    @property
    def why(self) -> str:
        """Reason for no size or no estimate; empty where there is a size."""
        return "" if self._size is not None else self._result.reason

    def _draws(self, size: SizePosterior | None, name: str) -> Draws | None:
        if size is None:
            return None
        return Draws(np.atleast_2d(getattr(size, name)), "mm", self.probability, size.replicates)

    @property
    def probability(self) -> float:
        """Probability of the intervals shown by default."""
        raise NotImplementedError

    @property
    def max_size_mm(self) -> Draws | None:
        """Largest diameter if exams differ as simulated ones do, or by the spread of the site; None without a size.

        These draws are the posterior's that `save` writes and `validate` reads. Where `max_size_another_exam_mm` is not
        None, that is the one that reports lead with (docs/decisions/0130).
        """
        return self._draws(self._size, "max_size_mm")

    @property
    def min_size_mm(self) -> Draws | None:
        """Smallest diameter; None without a size."""
        return self._draws(self._size, "min_size_mm")

    @property
    def max_size_another_exam_mm(self) -> Draws | None:
        """Largest diameter if another exam of the mass may come out as far apart as the paper's maps.

        None without a size, or where the spread between exams was stated or learned at the site: `max_size_mm` has it
        then.
        """
        return self._draws(None if self._size is None else self._size.another_exam, "max_size_mm")

    def _columns(self) -> dict[str, Draws | None]:
        return {name: self._draws(self._size, name) for name in SIZES}

    def to_dataframe(self) -> pandas.DataFrame:
        """One row for each draw: chain, draw and the quantities, NaN without a size; no rows without an estimate."""
        columns = self._columns()
        shape = next((draws.values.shape for draws in columns.values() if draws is not None), (0, 0))
        chain, draw = (index.ravel() for index in np.indices(shape))
        values = {name: np.full(shape, np.nan) if draws is None else draws.values for name, draws in columns.items()}
        return dataframe({"chain": chain, "draw": draw} | {name: one.ravel() for name, one in values.items()})

    @door
    def to_arviz(self) -> Any:
        """The draws as arviz has them, with the groups that `save` writes beside them for the estimate of a map.

        Raises
        ------
        UsageError
            Without an estimate: there are no draws.
        """
        values = {name: draws.values for name, draws in self._columns().items() if draws is not None}
        if not values:
            raise UsageError(f"there are no draws: {self.why}")
        return inference_data(values, self._groups())

    def _groups(self) -> dict[str, DrawGroup]:
        """The groups besides ``posterior``."""
        return {}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against the size, cautions first."""
        return self._result.findings

    @property
    def verdict(self) -> Verdict:
        """``"sound"``, ``"doubtful"`` where a caution stands, or ``"no_answer"`` without a size."""
        return verdict(self.findings, answered=self._size is not None)

    def __repr__(self) -> str:
        cautions = finding_lines(self.findings, "caution", paper=True)
        return f"<{type(self).__name__} {' '.join([*cautions, self._words()])}>"

    def _words(self) -> str:
        size = self.max_size_another_exam_mm or self.max_size_mm
        return f"no size: {self.why}" if size is None else f"largest size {size}"

    def _rows(self) -> Iterator[tuple[str, str]]:
        """Names and values of the notebook's table."""
        if (size := self._size) is not None:
            for name, words in zip(EXTREMES, ("largest size", "smallest size"), strict=True):
                yield words, repr(self._draws(size.leading, name))
            if size.another_exam is not None:
                yield f"largest size {exams_label(size.figures.get('between_map_sd'))}", repr(self.max_size_mm)
        if (chance := getattr(self, "detected_probability", None)) is not None:
            yield "probability of a lump", f"{chance:.2f}"

    def _repr_html_(self) -> str:
        lines = "".join(f"<p>{escape(line)}</p>" for line in finding_lines(self.findings, paper=True))
        cells = [f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in self._rows()]
        why = "" if self._size is not None else f"<p>No size: {escape(self.why)}</p>"
        table = f"<table>{''.join(cells)}</table>" if cells else ""
        return f"{lines}{why}{table}<p><small>{escape(RESEARCH_USE)}</small></p>"


class MassEstimate(SizeResult, eq=False, dict=True):
    """One of the masses on a map."""

    number: int  #: By evidence, the surest first; those without a size come last.
    mass: Mass  #: Its place and its own estimate.
    patient_mm: tuple[float, float] | None
    """x and y from the xiphoid, to the patient's right and up; None where the map has no landmarks."""
    probability: float  #: Of the intervals shown by default.
    why: str  #: Why it has no size; empty where it has one.

    @property
    def _result(self) -> Estimate:
        return self.mass.estimate

    @property
    def centre_mm(self) -> tuple[float, float]:
        """x and y of its centre on the map."""
        return self.mass.x_mm, self.mass.y_mm

    @property
    def detected_probability(self) -> float:
        """Probability that it is a lump, where half of the exams hold one."""
        return self.mass.probability

    @property
    def reported(self) -> bool:
        """True for the mass whose size the estimate itself reports."""
        return self.mass.reported

    def _words(self) -> str:
        x, y = self.centre_mm
        return f"{self.number} at ({x:.1f}, {y:.1f}) mm: {super()._words()}"


# --- The answer for one map, which worker processes return, and the whole estimate.


class Answer(Record):
    """Answer for one map: its report and its text, without map and draws."""

    report: EstimateReport
    shape: ShapeDraws | None  #: Draws for pooling; None where no lump was found.
    normalise: str  #: How the map's frames were normalised.
    fingerprint: int  #: Hash of the map's values, part of the random seed.
    head: HeadShape | None  #: Head that the map was made with.
    text: str = ""  #: The report in at most 12 lines.
    full_text: str = ""  #: All of the report.

    @property
    def exit_code(self) -> int:
        """0 for an estimate, else 6."""
        return EXIT_DONE if self.report.status == "estimate" else EXIT_NO_ESTIMATE

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``estimate --json`` prints."""
        return self.report.document


class Failure(Record):
    """Error of one map of several, with its exit code."""

    text: str
    exit_code: int


class SizedExam(SizeResult, eq=False, dict=True, kw_only=True):
    """Base of the estimates of a whole exam, from one map or from several."""

    provenance: Provenance
    settings: Settings
    name: str = ""  #: For figures.

    @property
    def probability(self) -> float:
        """Probability of the intervals shown by default."""
        return self.settings.interval

    @property
    def _title(self) -> str:
        """Name for the titles of figures: the scans' codes of the exam, and the map's name."""
        return exam_title(self.name, self.provenance.scans)

    def _draw_size(self, size: SizePosterior, path: Path | None, *, force: bool) -> Figure:
        return draw_size(
            size, path, name=self._title, probability=self.probability, findings=self.findings, force=force
        )

    def exam(self) -> ShownExam:
        """Make the exam of a page: its map, or all maps and their pooled size."""
        scans = self.provenance.scans
        check_one_mass(scans)
        maps: Sequence[Any] = getattr(self, "maps", (self,))
        exam_maps = tuple(exam_map(one.tactile_map, one.answer.report, side=side_of(scans)) for one in maps)
        return ShownExam(exam_maps, getattr(self, "pooled_report", None), scans)

    @door
    def report(
        self,
        path: PathLike,
        *,
        pdf: PathLike | None = None,
        title: str = "",
        name: str = "",
        day: str = "",
        force: bool = False,
    ) -> None:
        """Write one page of the exam as HTML, repeat maps on it, and with `pdf` also print it; see `exam_report`."""
        from tactile_bayes.report.exam_page import exam_page  # a plain estimate has no page

        page, labels = PageFiles(output_path(path, "HTML"), path_of(pdf), force), PageLabels(title, name, day)
        page.write(exam_page(replace(self.exam(), labels=labels)))


class SizeEstimate(SizedExam, eq=False, dict=True, kw_only=True):
    """The estimate of one map."""

    tactile_map: TactileMap
    estimate: Estimate  #: Posterior and size, or the reason for none.
    calibration: Calibration | None = None  #: The one that sized the lump, at its depth.

    @property
    def _result(self) -> Estimate:
        return self.estimate

    @property
    def status(self) -> str:
        """``"estimate"`` or ``"no_estimate"``."""
        return self.estimate.status

    @property
    def advice(self) -> str:
        """Advice where there is no size."""
        return options_as_keywords(self.estimate.advice)

    @property
    def detected_probability(self) -> float | None:
        """Probability that the lump, or the likeliest rise, is one where half of the exams hold one; None untested."""
        return self.estimate.probability

    @property
    def amplitude(self) -> Draws | None:
        """Height of the map's Gaussian over its level; None without an estimate."""
        return self._of_shape("amplitude")

    @property
    def sigma_x_mm(self) -> Draws | None:
        """Width of the map's Gaussian along its first axis; None without an estimate."""
        return self._of_shape("sigma_x_mm")

    @property
    def sigma_y_mm(self) -> Draws | None:
        """Width of the map's Gaussian along its second axis; None without an estimate."""
        return self._of_shape("sigma_y_mm")

    @property
    def x_mm(self) -> Draws | None:
        """Centre of the lump on the map, across the head; None without an estimate."""
        return self._of_shape("x_mm")

    @property
    def y_mm(self) -> Draws | None:
        """Centre of the lump on the map, along the head; None without an estimate."""
        return self._of_shape("y_mm")

    @property
    def masses(self) -> tuple[MassEstimate, ...]:
        """All masses of the map, the surest first; this estimate is of the one that is `reported`."""
        estimate, tactile_map = self.estimate, self.tactile_map
        return tuple(
            MassEstimate(
                number,
                mass,
                patient_mm(tactile_map, mass.x_mm, mass.y_mm),
                self.probability,
                "" if mass.estimate.size is not None else estimate.reason if mass.reported else mass.estimate.reason,
            )
            for number, mass in enumerate(estimate.masses, start=1)
        )

    def _of_shape(self, name: str) -> Draws | None:
        estimate = self.estimate
        if estimate.map_posterior is None or estimate.draws is None:
            return None
        unit = "mm" if name.endswith("_mm") else "rad" if name.endswith("_rad") else ""
        values = np.array(getattr(estimate.map_posterior, name))
        return Draws(values, unit, self.probability, estimate.draws.labels, estimate.draws.effective_draws)

    def _columns(self) -> dict[str, Draws | None]:
        return super()._columns() | {name: self._of_shape(name) for name in OF_A_MAP}

    def _groups(self) -> dict[str, DrawGroup]:
        rng = np.random.default_rng([self.settings.seed, self.tactile_map.fingerprint, 1])
        priors = size_priors(self.settings)
        return inference_groups(self.estimate, calibration=self.calibration, size_priors=priors, rng=rng)

    @cached_property
    def answer(self) -> Answer:
        """The report with its text; its `document` is printed by ``estimate --json``, `text` by ``estimate``."""
        tactile_map, estimate, settings = self.tactile_map, self.estimate, self.settings
        prior, provenance, probability = settings.prior, self.provenance, settings.interval
        report = estimate_report(estimate, tactile_map, probability=probability, prior=prior, provenance=provenance)
        return Answer(
            report,
            pooling_shape(tactile_map, estimate),
            tactile_map.recipe.normalise,
            tactile_map.fingerprint,
            tactile_map.head,
            estimate_summary(estimate, report),
            estimate_text(estimate, report),
        )

    @door
    def plot(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the posterior of the size, or else the map; with a path also write it, as PNG, PDF or SVG."""
        size = self.estimate.size
        if size is None:
            return self.plot_map(path, force=force)
        return self._draw_size(size, path_of(path), force=force)

    @door
    def plot_map(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the map with the lump's ellipse and size, or with the places looked at."""
        return draw_map(self.tactile_map, self.answer.report, path_of(path), name=self._title, force=force)

    @door
    def plot_fit(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw data, fit and residual of the fit window, or else the map; with a path also write it."""
        if self.status != "estimate":
            return self.plot_map(path, force=force)
        return draw_fit(self.tactile_map, self.estimate, path_of(path), name=self._title, force=force)

    @door
    def save(self, path: PathLike, *, force: bool = False) -> None:
        """Write all draws as netCDF that arviz opens, as ``estimate -o`` does.

        Raises
        ------
        UsageError
            Without an estimate, or when the file exists and `force` is false.
        """
        if self.status != "estimate":
            raise UsageError(f"there are no draws to write: {self.why}")
        self.write(output_path(path, "netCDF"), force=force)

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write the draws of an estimate, and what goes with them."""
        groups, report = self._groups(), self.answer.report
        write_posterior(path, self.estimate, provenance=self.provenance, groups=groups, report=report, force=force)


def size_priors(settings: Settings) -> SizePriors:
    """Priors of a size; with a stated or learned spread between maps it has one interval instead of two."""
    fixed, learned = settings.between_map_sd, settings.repeatability
    if learned is None and fixed is None:
        return SizePriors(known=dict(settings.known))
    between = learned.between_maps if learned is not None else BetweenMaps(fixed or 0.0, 0.0)
    return SizePriors(between_maps=between, another_exam=None, known=dict(settings.known))


def pooling_shape(tactile_map: TactileMap, estimate: Estimate) -> ShapeDraws | None:
    """Draws of a map for pooling, with the direction of its axes if landmarks define it."""
    posterior, turn = estimate.map_posterior, tactile_map.patient_from_plane
    if posterior is None:
        return None
    angle = 0.0 if turn is None else math.atan2(float(turn[1, 0]), float(turn[0, 0]))
    return ShapeDraws.of(posterior, turn_rad=angle, profile=head_profile(tactile_map.quality))


def check_one_mass(scans: Sequence[Mapping[str, str]]) -> None:
    """Refuse scans that say they are of different masses, or of one mass at different visits."""
    for name in ("subject", "side", "mass", "visit"):
        values = sorted({scan[name].casefold(): scan[name] for scan in scans if scan.get(name)}.values())
        if len(values) > 1:
            visits = "; `compare` takes several visits" if name == "visit" else ""
            way_out = f"give the maps of one mass at one visit, and others by themselves{visits}"
            raise BadDataError(f"the maps differ in {name} ({', '.join(values)})", way_out=way_out)
