"""Learning of the log-quadratic calibration from a population's maps, see `regression`."""

from __future__ import annotations

from collections.abc import Callable

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.fat_depth import FatTerms
from tactile_bayes.size.hidden import RoundLumps
from tactile_bayes.size.learn.fat_depth import learn_fat_cubic
from tactile_bayes.size.learn.hidden import hidden_terms
from tactile_bayes.size.learn.regression import (
    BodyRegression,
    PopulationTable,
    check_population,
    domain_of,
    figures,
    leverages,
)
from tactile_bayes.size.learn.round_lumps import learn_round
from tactile_bayes.size.log_quadratic import LogQuadratic, quadratic_terms


def learn_log_quadratic(
    table: PopulationTable,
    *,
    recipe: Recipe,
    source: str = "",
    learn_fat: Callable[[PopulationTable], FatTerms | None] = learn_fat_cubic,
) -> LogQuadratic:
    """Learn the calibration; with the part for the depth of fat where the table has head profiles.

    Parameters
    ----------
    table
        At least twenty bodies; exams in pairs or more tell the spread between exams.
    learn_fat
        Learns that part: `learn_fat_cubic` or `learn_fat_process`.

    Raises
    ------
    BadDataError
        When bodies are too few or do not vary.
    NotConvergedError
        When the posterior has no mode.
    """
    check_population(table)
    centre = (round(float(table.log_amplitude.mean()), 3), round(float(table.log_width.mean()), 3))

    def terms_of(log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        return quadratic_terms(log_amplitude - centre[0], log_width - centre[1])

    data = BodyRegression.of(table, terms_of)
    mean, covariance = data.posterior()
    inverse, leverage = leverages(data.terms)
    return LogQuadratic(
        centre=centre,
        mean=mean,
        covariance=covariance,
        round_lumps=RoundLumps(*learn_round(table, data.terms)),
        information_inverse=inverse,
        most_leverage=float(leverage.max()),
        domain=domain_of(table),
        recipe=recipe,
        hidden=hidden_terms(table, data, **data.bodies_left_out(mean), features=data.terms),
        fit=figures(table, data, mean),
        source=source,
        with_fat=learn_fat(table),
    )
