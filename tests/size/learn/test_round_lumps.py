"""How balls' maps look, learned from tables made with a known curve and spread."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.size.learn.regression import PopulationTable, learn_round_lumps
from tactile_bayes.size.terms import RoundLumps, monomials, powers

TRUE = np.array([0.04, -0.02, 0.06, 0.0, -0.05, -0.04])
BODY_SD, FACTOR = 0.007, 2.4


def table(bodies: int = 800) -> tuple[PopulationTable, np.ndarray]:
    """Clear maps and faint ones, whose own variances are a thousand times as large."""
    rng = np.random.default_rng(4)
    u, v = rng.normal(0, 1, bodies), rng.normal(0, 0.4, bodies)
    own = 10 ** rng.uniform(-5.5, -2.5, bodies)
    terms = monomials((u, v), powers(2))
    q = terms @ TRUE + np.sqrt(BODY_SD**2 + FACTOR * own) * rng.standard_normal(bodies)
    covariance = np.zeros((bodies, 3, 3))
    covariance[:, 2, 2] = own
    return PopulationTable(np.arange(bodies), np.full(bodies, 12.0), u, v, q, covariance), terms


def test_the_curve_and_both_parts_of_the_spread_are_found():
    rows, terms = table()
    spread = learn_round_lumps(rows, terms)
    np.testing.assert_allclose(spread.coefficients, TRUE, atol=0.004)
    assert spread.body_sd == pytest.approx(BODY_SD, rel=0.15)
    assert spread.map_factor == pytest.approx(FACTOR, rel=0.2)
    standardised = (rows.half_log_ratio - terms @ spread.coefficients) / np.sqrt(
        spread.variance(rows.covariance[:, 2, 2])
    )
    assert standardised.std() == pytest.approx(1.0, abs=0.05)
    # least squares without the maps' own variances, as before: clear maps would be taken for ovals three times as long
    plain = rows.half_log_ratio - terms @ np.linalg.lstsq(terms, rows.half_log_ratio, rcond=None)[0]
    clear = rows.covariance[:, 2, 2] < 1e-5
    assert plain.std() > 2.5 * np.sqrt(spread.variance(rows.covariance[clear, 2, 2])).mean()


def test_maps_of_one_mass_average_what_each_is_off_and_not_the_bodys():
    spread = RoundLumps(TRUE, 0.01, 0.02, 3.0)
    assert spread.variance(np.array(0.0), maps=4) == pytest.approx(0.01**2 + 0.02**2 / 4)
    assert spread.variance(np.array(1e-4)) == pytest.approx(0.01**2 + 0.02**2 + 3e-4)
