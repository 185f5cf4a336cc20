"""How far an answer leans on its prior, and that every prior is printed."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.result import prior_sensitivity
from tactile_bayes.report.estimate_document import prior_line, sensitivity_line


def test_every_prior_is_printed() -> None:
    line = prior_line(BumpPrior(1.5, 4.5, 0.75, 0.25, 0.125), field=True)
    for number in ("1.5", "4.5", "0.75", "0.25", "0.125"):
        assert number in line


def test_weighing_draws_anew_is_the_other_posterior() -> None:
    """A normal likelihood of ln sigma times the normal prior: both posteriors are known."""
    prior, mean, sd = BumpPrior(), np.log(9.0), 0.4
    rng = np.random.default_rng(1)

    def posterior(prior_sd: float) -> tuple[float, float]:
        precision = 1 / sd**2 + 1 / prior_sd**2
        return (mean / sd**2 + np.log(prior.width_median_mm) / prior_sd**2) / precision, precision**-0.5

    (middle, narrow), (wider, wide) = posterior(prior.log_width_sd), posterior(2 * prior.log_width_sd)
    draws = np.exp(middle + narrow * rng.standard_normal((1, 200_000)))
    found = prior_sensitivity(draws, draws, {"sigma_x_mm": np.log(draws)}, prior)
    assert found.median["sigma_x_mm"] == pytest.approx((wider - middle) / narrow, abs=0.01)
    upper = (wider + 1.96 * wide - middle - 1.96 * narrow) / narrow
    assert found.ends["sigma_x_mm"] == pytest.approx(upper, abs=0.02)
    assert "would move the median of sigma_x by +0.16 SD" in sensitivity_line(found)
    # the negative control: a width that the data give alone does not move
    sharp = np.exp(np.log(5.0) + 0.01 * rng.standard_normal((1, 8000)))
    assert abs(prior_sensitivity(sharp, sharp, {"sigma_x_mm": sharp}, prior).median["sigma_x_mm"]) < 0.01
