"""Estimates in Python: `estimate`, `pool`, `exam_report`, and what they return."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from tactile_bayes.api.arguments import check_keywords, door, in_keywords, plain, sequence_of
from tactile_bayes.api.estimating import Answer, Outcome, answer_of, estimate_one
from tactile_bayes.api.exam_report import EstimatedMap, ExamFiles, Given, make_exam, read_exam
from tactile_bayes.api.maps import Map, PathLike, map_of, output_path, path_of
from tactile_bayes.api.pooled import elsewhere, pool_answers
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.api.sized import Draws, MassEstimate, Sized
from tactile_bayes.declarations import names_of, replace
from tactile_bayes.errors import UsageError, check_number
from tactile_bayes.files.size_json import read_repeatability
from tactile_bayes.findings import Finding, findings_in
from tactile_bayes.report.estimate_document import patient_mm
from tactile_bayes.report.estimate_figures import draw_fit, draw_map, draw_size
from tactile_bayes.report.exam_page import PageFiles
from tactile_bayes.report.exam_words import Exam, headline
from tactile_bayes.report.figure_file import named_exam

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tactile_bayes.api.pooled import PooledOutcome
    from tactile_bayes.size.draws import SizePosterior
    from tactile_bayes.size.pooling import Repeatability


# --- Estimates of a lump's size: from one map, or from several maps of one mass.

_KEYWORDS = tuple(name for name in names_of(Settings) if name != "settings_file")
_SHAPES = ("amplitude", "sigma_x_mm", "sigma_y_mm", "x_mm", "y_mm", "angle_rad", "background", "noise_sd")


class SizedExam(Sized):
    """Base of the estimates of a whole exam, from one map or from several."""

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
        exam_report(self, path, pdf=pdf, title=title, name=name, day=day, force=force)


@dataclass(frozen=True, eq=False, repr=False)
class SizeEstimate(SizedExam):
    """The estimate of one map.

    Parameters
    ----------
    outcome
        Map, posterior, settings and provenance.
    name
        Of the map, for figures.
    """

    outcome: Outcome
    name: str = ""

    @property
    def probability(self) -> float:  # type: ignore[override]
        """Probability of the intervals shown by default."""
        return self.outcome.settings.interval

    @property
    def _size(self) -> SizePosterior | None:
        return self.outcome.estimate.size

    @property
    def status(self) -> str:
        """``"estimate"`` or ``"no_estimate"``."""
        return self.outcome.estimate.status

    @property
    def why(self) -> str:
        """Why there is no size, or no estimate at all; empty where there is a size."""
        return "" if self._size is not None else self.outcome.estimate.reason

    @property
    def advice(self) -> str:
        """What would help where there is no size."""
        return in_keywords(self.outcome.estimate.advice)

    @property
    def detected_probability(self) -> float | None:
        """Probability that the lump, or the likeliest rise, is one where half of the exams hold one; None untested."""
        return self.outcome.estimate.probability

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against the answer, cautions first."""
        return self.outcome.estimate.findings

    def _rows(self) -> Iterator[tuple[str, str]]:
        yield from super()._rows()
        if self.detected_probability is not None:
            yield "probability of a lump", f"{self.detected_probability:.2f}"

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
        found, tactile_map = self.outcome.estimate, self.outcome.tactile_map
        return tuple(
            MassEstimate(
                number,
                mass,
                patient_mm(tactile_map, mass.x_mm, mass.y_mm),
                self.probability,
                "" if mass.estimate.size is not None else found.reason if mass.reported else mass.estimate.reason,
            )
            for number, mass in enumerate(found.masses, start=1)
        )

    def _of_shape(self, name: str) -> Draws | None:
        found = self.outcome.estimate
        if found.map_posterior is None or found.draws is None:
            return None
        unit = "mm" if name.endswith("_mm") else "rad" if name.endswith("_rad") else ""
        values = getattr(found.map_posterior, name)
        return Draws(values, unit, self.probability, found.draws.labels, found.draws.effective_draws)

    def _columns(self) -> dict[str, Draws]:
        shapes = {name: draws for name in _SHAPES if (draws := self._of_shape(name)) is not None}
        return {**super()._columns(), **shapes}

    def _groups(self) -> dict[str, Any]:
        return {name: (group.arrays, group.notes) for name, group in self.outcome.groups().items()}

    @cached_property
    def answer(self) -> Answer:
        """The report: `document` is what ``estimate --json`` prints, `text` what it prints for people."""
        return answer_of(self.outcome)

    @door
    def plot(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the posterior of the size; without a size the map with the places looked at.

        Parameters
        ----------
        path
            Also write it there, as PNG, PDF or SVG.
        """
        size = self.outcome.estimate.size
        if size is None:
            return self.plot_map(path, force=force)
        return draw_size(
            size,
            path_of(path),
            name=self._titled,
            probability=self.probability,
            findings=self.findings,
            force=force,
        )

    @door
    def plot_map(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the map with the lump's ellipse and size, or with the places looked at."""
        return draw_map(self.outcome.tactile_map, self.outcome.estimate, path_of(path), name=self._titled, force=force)

    @door
    def plot_fit(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw data, fit and residual of the fit window side by side; without an estimate the map.

        Parameters
        ----------
        path
            Also write it there, as PNG, PDF or SVG.
        """
        if self.status != "estimate":
            return self.plot_map(path, force=force)
        return draw_fit(self.outcome.tactile_map, self.outcome.estimate, path_of(path), name=self._titled, force=force)

    @property
    def _titled(self) -> str:
        """Name for the titles of figures, with the subject's code and the scan's digest."""
        return named_exam(self.name, self.outcome.provenance.scans)

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
        self.outcome.write(output_path(path, "netCDF"), document=self.answer.document, force=force)


@dataclass(frozen=True, eq=False, repr=False)
class PooledSize(SizedExam):
    """One size from several maps of one mass.

    Parameters
    ----------
    outcome
        The pooled size, its JSON object, its provenance.
    maps
        The estimates of the maps alone.
    probability
        Of the intervals that are shown where none is asked for.
    """

    outcome: PooledOutcome
    maps: tuple[SizeEstimate, ...]
    probability: float
    name: str = field(default="")
    settings: Settings = field(default_factory=Settings)

    @property
    def _size(self) -> SizePosterior | None:
        return self.outcome.pooled.size

    @property
    def why(self) -> str:
        """Why there is no size; empty where there is one."""
        return "" if self._size is not None else self.outcome.pooled.reason

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against the size, cautions first."""
        return findings_in(self.document["findings"])

    @property
    def document(self) -> dict[str, Any]:
        """What ``estimate --pool --json`` prints."""
        return self.outcome.document

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
        name = self.name or f"{len(self.maps)} maps pooled"
        return draw_size(
            size, path_of(path), name=name, probability=self.probability, findings=self.findings, force=force
        )


def settings_of(options: Mapping[str, Any]) -> Settings:
    """Make settings from keywords; the defaults are the command line's.

    Raises
    ------
    TypeError
        Naming a keyword that is none, and those that are.
    """
    check_keywords("estimate", options, _KEYWORDS)
    given = {name: plain(value) for name, value in options.items()}
    if "size_calibration" in given:
        given["size_calibration"] = _calibration(given["size_calibration"])
    if "known" in given:
        given["known"] = _properties(given["known"])
    if "repeatability" in given:
        given["repeatability"] = _repeatability(given["repeatability"])
    if "checkpoint" in given:
        given["checkpoint"] = path_of(given["checkpoint"])
    if isinstance(given.get("centre_mm"), Sequence | np.ndarray) and not isinstance(given["centre_mm"], str):
        given["centre_mm"] = tuple(plain(one) for one in given["centre_mm"])
    return Settings(**given)


def _calibration(given: Any) -> Any:
    """A name, or the calibration itself."""
    if given is None or isinstance(given, str) or hasattr(given, "recipe"):
        return given
    return str(path_of(given))


def _properties(given: Any) -> tuple[tuple[str, float], ...]:
    """Known properties of a body from a mapping, or from pairs."""
    pairs = list(given.items()) if isinstance(given, Mapping) else given
    if isinstance(pairs, str) or not isinstance(pairs, Sequence) or any(np.shape(one) != (2,) for one in pairs):
        raise UsageError(f'known is {given!r}; give a mapping such as {{"seat": 1.2}}')
    for name, value in pairs:
        check_number(f"known {name}", value)
    return tuple((str(name), plain(value)) for name, value in pairs)


def _repeatability(given: Any) -> Repeatability | None:
    if given is None or hasattr(given, "between_maps"):
        return cast("Repeatability | None", given)
    return read_repeatability(path_of(given))


@door
def estimate(tactile_map: Any, *, progress: Callable[[int, int], None] | None = None, **settings: Any) -> SizeEstimate:
    """Estimate a lump's size from one map.

    Parameters
    ----------
    tactile_map
        A map, or the path of one.
    progress
        Called with effective draws done and wanted.
    **settings
        As of `tactile_bayes.api.settings.Settings`, by default as on the command line; `size_calibration` is a
        name, a path or a calibration from `calibrate_size`, `known` a mapping such as ``{"seat": 1.2}``,
        `repeatability` a path or what `calibrate_repeatability` returns.

    Returns
    -------
    SizeEstimate
        Without a number where the map shows no lump that can be measured: `why` says the reason.

    Raises
    ------
    BadDataError
        When a file is not what it must be, or the calibration does not fit the map.
    UsageError
        When settings contradict each other, or a value cannot be one.
    NotConvergedError
        When the method asked for does not converge.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> found = tb.estimate(tb.demo_map())
    >>> low, high = found.max_size_mm.interval(0.9)
    >>> bool(low < 15.0 < high)
    True
    """
    given = map_of(tactile_map)
    inputs = {} if given.path is None else {"map": given.path}
    outcome = estimate_one(
        given.tactile_map, settings_of(settings), inputs=inputs, scans=given.scans, progress=progress
    )
    return SizeEstimate(outcome, "" if given.path is None else given.path.stem)


@door
def pool(maps: Iterable[Any], **settings: Any) -> PooledSize:
    """Estimate one size from several maps of one mass, whose spread is learned.

    Parameters
    ----------
    maps
        Maps, paths or estimates; each map once, in any order.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Raises
    ------
    UsageError
        When there is no map, one is given twice, or the calibration cannot pool.
    BadDataError
        As of `estimate`, and when the maps were normalised in several ways.
    """
    used = settings_of(settings)
    refuse_checkpoint(used)
    found = estimated(_several(maps), settings)
    if not found:
        raise UsageError("there is no map to pool; give at least one")
    prints = [one.outcome.tactile_map.fingerprint for one in found]
    if len(set(prints)) < len(prints):
        raise UsageError("a map is given twice; give each map once")
    found = of_one_mass(found)
    names = [one.name or f"map {i}" for i, one in enumerate(found, start=1)]
    outcome = pool_answers([one.answer for one in found], used, names=names, inputs={})
    return PooledSize(outcome, found, used.interval, settings=used)


def estimated(given: Iterable[Any], settings: Mapping[str, Any]) -> tuple[SizeEstimate, ...]:
    """Estimates of maps, or of their paths; those that are estimates already keep their own settings."""
    return tuple(one if isinstance(one, SizeEstimate) else estimate(one, **settings) for one in given)


def of_one_mass(found: Sequence[SizeEstimate]) -> tuple[SizeEstimate, ...]:
    """The estimates; one of another mass than most maps show is made again at that one's place.

    Estimates of a place that somebody gave stay as they are.
    """
    same = list(found)
    for i, place in elsewhere([one.answer.document for one in found]).items():
        outcome = same[i].outcome
        if outcome.settings.centre_mm is None:
            again = replace(outcome.settings, centre_mm=place)
            at_place = estimate_one(outcome.tactile_map, again, scans=outcome.provenance.scans)
            provenance = replace(at_place.provenance, inputs=outcome.provenance.inputs)
            same[i] = SizeEstimate(replace(at_place, provenance=provenance), same[i].name)
    return tuple(same)


def listed(given: Any) -> list[Any]:
    """One map, estimate, pooled size or path as a list of it; a list of them as it is."""
    if isinstance(given, str | Path | Map | SizeEstimate | PooledSize):
        return [given]
    return list(sequence_of("files", given, "maps, estimates or paths"))


def _several(maps: Iterable[Any]) -> Sequence[Any]:
    if isinstance(maps, str | Path | Map | SizeEstimate | PooledSize):
        raise UsageError("pool takes several maps; give a list")
    return sequence_of("maps", maps, "maps, paths or estimates")


def _signature() -> inspect.Signature:
    """The signature of `estimate` with every setting and its default, for help and completion."""
    defaults = Settings()
    more = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=getattr(defaults, name)) for name in _KEYWORDS
    ]
    first = [one for one in inspect.signature(estimate).parameters.values() if one.kind is not one.VAR_KEYWORD]
    return inspect.Signature([*first, *more])


estimate.__signature__ = _signature()  # type: ignore[attr-defined]


# --- The page of an exam from Python.


@door
def exam_report(
    files: Any,
    path: PathLike,
    *,
    pdf: PathLike | None = None,
    title: str = "",
    name: str = "",
    day: str = "",
    force: bool = False,
    **settings: Any,
) -> str:
    """Write one page of an exam as HTML, as ``tactile-bayes report`` does.

    Parameters
    ----------
    files
        Maps, estimates and pooled sizes, or the paths of their files; one, or a list. Several maps are repeats of one
        mass and are pooled. A path of an estimate (JSON or posterior) goes alone, or with the path of its map.
    path
        Usually ``*.html``.
    pdf
        Also print the page there, by an installed Chromium or WeasyPrint.
    title, name, day
        To print on the page; nothing is where they are not given. The day as YEAR-MONTH-DAY.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Returns
    -------
    str
        The page's headline.

    Raises
    ------
    UsageError
        When files do not fit each other, settings are given for an estimate's file, nothing is installed that prints,
        or a file exists and `force` is false.
    BadDataError
        When a file is damaged or of another kind, or the maps are of different exams.
    """
    page = PageFiles(path_of(path), path_of(pdf), force)
    page.check()
    given = listed(files)
    if not given:
        raise UsageError("nothing was given to report; give maps, or an estimate")
    exam = _exam(given, Given(title, name, day), settings)
    page.write(exam)
    return headline(exam)


def _exam(given: Sequence[Any], words: Given, settings: dict[str, Any]) -> Exam:
    """The exam of files alone, or of what Python holds."""
    if all(isinstance(one, str | Path) for one in given):
        files = ExamFiles.sort([path_of(one) for one in given])
        if files.estimates and settings:
            raise UsageError(f"an estimate has settings of its own; leave out {next(iter(settings))}, or give the map")
        return read_exam(files, settings_of(settings), words)
    found, used = _estimates(given, settings)
    maps = [EstimatedMap(one.outcome.tactile_map, one.answer, one.outcome.provenance.scans) for one in found]
    return make_exam(maps, used, words)


def _estimates(given: Sequence[Any], settings: dict[str, Any]) -> tuple[tuple[SizeEstimate, ...], Settings]:
    """Estimates of all maps, and the settings that pool them."""
    if len(given) == 1 and isinstance(given[0], PooledSize):
        return given[0].maps, given[0].settings
    used = settings_of(settings)
    if len(given) > 1:
        refuse_checkpoint(used)
    found = of_one_mass(estimated(given, settings))
    return found, found[0].outcome.settings if len(found) == 1 else used
