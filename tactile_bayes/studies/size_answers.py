"""The reported numbers of one estimate, and how far they lie from a reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.declarations import Record, field
from tactile_bayes.inference.draws import Quantity, summarise
from tactile_bayes.posterior.result import Estimate

SIZE = "max_size_mm"
WIDTHS = ("sigma_x_mm", "sigma_y_mm")


class SizeAnswer(Record):
    """Reported numbers of one estimate."""

    reason: str
    """Why there is no number; empty where there is one."""
    probability: float | None = None
    """Of a lump; None where nothing could be tested."""
    quantities: dict[str, Quantity] = field(default_factory=dict)
    """The largest size and the two widths by name, mm: the size is missing without a calibration, all are without an
    estimate.
    """
    method: str = ""
    """The method that drew; empty where none did."""
    shares: dict[str, float] = field(default_factory=dict)
    """Percent of the variance of ln(largest size) by source, see `SizePosterior.variance_share`."""
    code: str = ""
    """Of the reason, see `posterior.abstention`; ``"method"`` where no method converged."""

    @property
    def reported(self) -> Quantity | None:
        """The largest size; without a calibration the width across the head, without an estimate None."""
        return self.quantities.get(SIZE, self.quantities.get(WIDTHS[0]))

    @property
    def half_width_mm(self) -> float:
        """Half the width of the reported interval; NaN where there is none."""
        found = self.reported
        return float("nan") if found is None else 0.5 * (found.high - found.low)


def answer_of(estimate: Estimate, *, probability: float) -> SizeAnswer:
    """An estimate as its reported numbers, with intervals of the given probability."""
    if estimate.map_posterior is None or estimate.draws is None:
        return SizeAnswer(estimate.reason, estimate.probability, code=estimate.code)
    replicates = estimate.draws.replicates
    found = {
        name: summarise(getattr(estimate.map_posterior, name), probability=probability, replicates=replicates)
        for name in WIDTHS
    }
    shares: dict[str, float] = {}
    if estimate.size is not None:
        found[SIZE] = estimate.size.summarise(SIZE, probability=probability)
        shares = estimate.size.variance_share
    return SizeAnswer("", estimate.probability, found, estimate.draws.method, shares)


class Deviation(Record):
    """Root mean square distances from a reference, mm."""

    median: float
    ends: float
    """`median`, `ends`: Of the reported quantity: its median, and both ends of its interval."""
    width_ends: float
    """Of both widths: the ends of their intervals."""


UNKNOWN = Deviation(float("nan"), float("nan"), float("nan"))


def deviation(answers: Sequence[SizeAnswer], reference: SizeAnswer | None) -> Deviation:
    """How far answers lie from a reference; NaN where one of them, or the reference, has no number of the same kind."""
    if reference is None or not answers or any(one.quantities.keys() != reference.quantities.keys() for one in answers):
        return UNKNOWN
    if reference.reported is None:
        return UNKNOWN
    name = SIZE if SIZE in reference.quantities else WIDTHS[0]
    return Deviation(
        _rms([one.quantities[name].median - reference.quantities[name].median for one in answers]),
        _rms([gap for one in answers for gap in _gaps(one, reference, name)]),
        _rms([gap for one in answers for width in WIDTHS for gap in _gaps(one, reference, width)]),
    )


def _gaps(answer: SizeAnswer, reference: SizeAnswer, name: str) -> tuple[float, float]:
    one, other = answer.quantities[name], reference.quantities[name]
    return one.low - other.low, one.high - other.high


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
