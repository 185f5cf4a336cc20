"""What an estimate is in Python: its draws, sizes and tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import door
from tactile_bayes.declarations import Record
from tactile_bayes.errors import UsageError, check_number
from tactile_bayes.findings import Finding, Verdict, finding_lines, verdict
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels, Quantity, summarise
from tactile_bayes.presets import INTERVAL, RESEARCH_USE
from tactile_bayes.report.estimate_text import exams_label
from tactile_bayes.report.quantities import leading_size
from tactile_bayes.size.draws import EXTREMES, SIZES

if TYPE_CHECKING:
    import pandas

    from tactile_bayes.posterior.result import Mass
    from tactile_bayes.size.draws import SizePosterior


# --- Posterior draws of one quantity, with its median and intervals.


class Draws(Record, eq=False):
    """Posterior draws of one quantity.

    Parameters
    ----------
    values : (chain, draw) array
        NaN where a draw has no value.
    unit
        Such as ``"mm"``; empty for a ratio.
    probability
        Of the interval that is shown where none is asked for.
    replicates : (chain * draw,) array
        Label of the independent replicate of each draw; their spread is the Monte-Carlo error.
    effective_draws
        How many independent draws they are worth, where there are no replicates.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> size = tb.estimate(tb.demo_map()).max_size_mm
    >>> low, high = size.interval(0.9)
    >>> bool(low < size.median < high)
    True
    """

    values: FloatArray
    unit: str = ""
    probability: float = INTERVAL
    replicates: Labels | None = None
    effective_draws: float | None = None

    def summary(self, probability: float | None = None) -> Quantity:
        """Median, mean, SD, equal-tailed interval and its Monte-Carlo error, as the command line prints them.

        Parameters
        ----------
        probability
            Of the interval, between 0 and 1.

        Raises
        ------
        UsageError
            When the probability is not between 0 and 1.
        """
        wanted = self.probability if probability is None else probability
        check_number("the probability of an interval", wanted, 0, 1, open_ends=True)
        return summarise(
            self.values, probability=wanted, effective_draws=self.effective_draws, replicates=self.replicates
        )

    def interval(self, probability: float | None = None) -> tuple[float, float]:
        """Ends of the equal-tailed credible interval."""
        found = self.summary(probability)
        return found.low, found.high

    @property
    def median(self) -> float:
        """The posterior's median."""
        return self.summary().median

    @property
    def mean(self) -> float:
        """The posterior's mean."""
        return self.summary().mean

    @property
    def sd(self) -> float:
        """The posterior's standard deviation."""
        return self.summary().sd

    @property
    def mc_error(self) -> float:
        """Monte-Carlo standard error of the interval's ends."""
        return self.summary().mc_error

    def __array__(self, dtype: object = None, copy: bool | None = None) -> FloatArray:
        """The draws as an array."""
        del copy
        return np.asarray(self.values, dtype=dtype)  # type: ignore[call-overload, no-any-return]

    def __repr__(self) -> str:
        found = self.summary()
        unit = f" {self.unit}" if self.unit else ""
        return f"{found.median:.3g}{unit} ({found.low:.3g} to {found.high:.3g}, {100 * found.probability:g} % interval)"


# --- What all estimates of a size have in common, and the masses of a map.


class Sized:
    """Base of the estimates from one map, of one of its masses, and from several maps."""

    name: str
    probability: float

    @property
    def _size(self) -> SizePosterior | None:
        raise NotImplementedError

    @property
    def why(self) -> str:
        """Why there is no size, or no estimate at all; empty where there is a size."""
        raise NotImplementedError

    def _of_size(self, name: str) -> Draws | None:
        size = self._size
        if size is None:
            return None
        return Draws(np.atleast_2d(getattr(size, name)), "mm", self.probability, size.replicates)

    @property
    def max_size_mm(self) -> Draws | None:
        """Largest diameter if exams differ as simulated ones do, or by the spread of the site; None without a size.

        These draws are the posterior's that `save` writes and `validate` reads. Where `max_size_another_exam_mm` is not
        None, that is the one that reports lead with (docs/decisions/0130).
        """
        return self._of_size("max_size_mm")

    @property
    def min_size_mm(self) -> Draws | None:
        """Smallest diameter; None without a size."""
        return self._of_size("min_size_mm")

    @property
    def max_size_another_exam_mm(self) -> Draws | None:
        """Largest diameter if another exam of the mass may come out as far apart as the paper's maps.

        None without a size, or where the spread between exams was stated or learned at the site: `max_size_mm` has it
        then.
        """
        size = None if self._size is None else self._size.another_exam
        if size is None:
            return None
        return Draws(np.atleast_2d(size.max_size_mm), "mm", self.probability, size.replicates)

    def _columns(self) -> dict[str, Draws]:
        found = {name: self._of_size(name) for name in SIZES}
        return {name: draws for name, draws in found.items() if draws is not None}

    def to_dataframe(self) -> pandas.DataFrame:
        """One row for each draw: chain, draw and a column for each quantity; no rows without an estimate."""
        import pandas

        columns = self._columns()
        shape = next(iter(columns.values())).values.shape if columns else (0, 0)
        chain, draw = (index.ravel() for index in np.indices(shape))
        values = {name: draws.values.ravel() for name, draws in columns.items()}
        return pandas.DataFrame({"chain": chain, "draw": draw, **values})

    @door
    def to_arviz(self) -> Any:
        """The draws as arviz has them, with the groups that `save` writes beside them for the estimate of a map.

        Raises
        ------
        UsageError
            Without an estimate: there are no draws.
        """
        from tactile_bayes.inference.ensemble import inference_data

        columns = self._columns()
        if not columns:
            raise UsageError(f"there are no draws: {self.why}")
        return inference_data({name: draws.values for name, draws in columns.items()}, self._groups())

    def _groups(self) -> dict[str, Any]:
        """Arrays and notes of the groups besides ``posterior``."""
        return {}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against the size, cautions first."""
        raise NotImplementedError

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
        if self._size is None:
            return
        leads = leading_size(self._size)
        for name in EXTREMES:
            draws = Draws(np.atleast_2d(getattr(leads, name)), "mm", self.probability, leads.replicates)
            yield f"{'largest' if name == 'max_size_mm' else 'smallest'} size", repr(draws)
        if leads is not self._size:
            yield f"largest size {exams_label(self._size.figures.get('between_map_sd'))}", repr(self.max_size_mm)

    def _repr_html_(self) -> str:
        told = "".join(f"<p>{escape(line)}</p>" for line in finding_lines(self.findings, paper=True))
        cells = [f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in self._rows()]
        why = "" if self._size is not None else f"<p>No size: {escape(self.why)}</p>"
        table = f"<table>{''.join(cells)}</table>" if cells else ""
        return f"{told}{why}{table}<p><small>{escape(RESEARCH_USE)}</small></p>"


@dataclass(frozen=True, eq=False, repr=False)
class MassEstimate(Sized):
    """One of the masses on a map.

    Parameters
    ----------
    number
        By evidence, the surest first; those without a size come last.
    mass
        Its place and its own estimate.
    patient_mm
        x and y from the xiphoid, to the patient's right and up; None where the map has no landmarks.
    probability
        Of the intervals shown by default.
    reason
        Why it has no size; empty where it has one.
    """

    number: int
    mass: Mass
    patient_mm: tuple[float, float] | None
    probability: float
    reason: str

    @property
    def _size(self) -> SizePosterior | None:
        return self.mass.estimate.size

    @property
    def why(self) -> str:
        """Why there is no size; empty where there is one."""
        return self.reason

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against its size, cautions first."""
        return self.mass.estimate.findings

    def _rows(self) -> Iterator[tuple[str, str]]:
        yield from super()._rows()
        yield "probability of a lump", f"{self.detected_probability:.2f}"

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
        """Whether the estimate's own size is this mass's."""
        return self.mass.reported

    def _words(self) -> str:
        x, y = self.centre_mm
        return f"{self.number} at ({x:.1f}, {y:.1f}) mm: {super()._words()}"
