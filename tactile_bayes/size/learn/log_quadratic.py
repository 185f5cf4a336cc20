"""Learning of the log-quadratic calibration from maps of a population of bodies, see `regression`."""

from __future__ import annotations

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.hidden import RoundLumps
from tactile_bayes.size.learn.fat_depth import learn_fat_cubic
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable, figures, hidden_terms
from tactile_bayes.size.log_quadratic import LogQuadratic, quadratic_terms

LEAST_BODIES = 20


def learn_log_quadratic(table: PopulationTable, *, recipe: Recipe, source: str = "") -> LogQuadratic:
    """Learn the calibration; where the table has profiles of the head, also the one that knows the fat's depth.

    Parameters
    ----------
    table
        At least twenty bodies; exams in pairs or more tell the spread between exams.

    Raises
    ------
    BadDataError
        When bodies are too few or do not vary.
    NotConvergedError
        When the posterior has no mode.
    """
    _check(table)
    centre = (round(float(table.log_amplitude.mean()), 3), round(float(table.log_width.mean()), 3))

    def terms_of(log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        return quadratic_terms(log_amplitude - centre[0], log_width - centre[1])

    data = BodyRegression.of(table, terms_of)
    mean, covariance = data.posterior()
    inverse, most_leverage = data.leverage()
    return LogQuadratic(
        centre=centre,
        mean=mean,
        covariance=covariance,
        round_lumps=RoundLumps(*data.oval(table, data.terms[:, :3])),
        information_inverse=inverse,
        most_leverage=most_leverage,
        domain=_domain(table),
        recipe=recipe,
        hidden=hidden_terms(table, data, mean),
        fit=figures(table, data, mean),
        source=source,
        fat_cubic=learn_fat_cubic(table),
    )


def _check(table: PopulationTable) -> None:
    bodies = len(np.unique(table.body))
    if bodies < LEAST_BODIES:
        raise BadDataError(f"{bodies} bodies with a map", way_out=f"a quadratic needs at least {LEAST_BODIES}")
    for name, values in (("d_mm", table.d_mm), ("amplitude", table.log_amplitude), ("width", table.log_width)):
        if np.ptp(values) <= 0:
            raise BadDataError(f"all rows have one {name}", way_out="a calibration needs lumps that differ")
    finite = [table.d_mm, table.log_amplitude, table.log_width, table.half_log_ratio, table.covariance]
    if not all(np.isfinite(values).all() for values in finite):
        raise BadDataError("a row holds a number that is not finite", way_out="leave it out")


def _domain(table: PopulationTable) -> dict[str, tuple[float, float]]:
    values = {"amplitude": np.exp(table.log_amplitude), "sigma_mm": np.exp(table.log_width), "d_mm": table.d_mm}
    return {name: (float(v.min()), float(v.max())) for name, v in values.items()}
