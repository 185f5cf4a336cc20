"""How balls' maps look, learned from tables made with a known curve and spread."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.size_fat_json import _round_coefficients
from tactile_bayes.files.size_parts_json import parse_round_spread
from tactile_bayes.size.fat_depth import ROUND
from tactile_bayes.size.hidden import RoundLumps, RoundSpread
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.learn.round_lumps import learn_round
from tactile_bayes.size.polynomials import monomials, powers

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
    coefficients, spread = learn_round(rows, terms)
    np.testing.assert_allclose(coefficients, TRUE, atol=0.004)
    assert spread.body_sd == pytest.approx(BODY_SD, rel=0.15)
    assert spread.map_factor == pytest.approx(FACTOR, rel=0.2)
    standardised = (rows.half_log_ratio - terms @ coefficients) / np.sqrt(spread.variance(rows.covariance[:, 2, 2]))
    assert standardised.std() == pytest.approx(1.0, abs=0.05)
    # least squares without the maps' own variances, as before: clear maps would be taken for ovals three times as long
    plain = rows.half_log_ratio - terms @ np.linalg.lstsq(terms, rows.half_log_ratio, rcond=None)[0]
    clear = rows.covariance[:, 2, 2] < 1e-5
    assert plain.std() > 2.5 * np.sqrt(spread.variance(rows.covariance[clear, 2, 2])).mean()


def test_maps_of_one_mass_average_what_each_is_off_and_not_the_bodys():
    spread = RoundSpread(0.01, 0.02, 3.0)
    assert spread.variance(np.array(0.0), maps=4) == pytest.approx(0.01**2 + 0.02**2 / 4)
    assert spread.variance(np.array(1e-4)) == pytest.approx(0.01**2 + 0.02**2 + 3e-4)


def test_three_coefficients_of_an_earlier_file_are_a_plane():
    plane = RoundLumps(np.array([0.05, -0.03, 0.01]), RoundSpread(0.04, 0.03))
    u, v = np.array([0.5, -1.0]), np.array([0.2, 0.3])
    np.testing.assert_allclose(plane.excess(u, v), 0.05 - 0.03 * u + 0.01 * v)
    assert len(ROUND) == 10


def test_files_of_earlier_versions_are_read_as_they_were():
    powers_then = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]]
    balls = {"coefficients": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "body_sd": 0.04, "exam_sd": 0.03}
    read = dict(zip(ROUND, _round_coefficients({"round_powers": powers_then, "round_lumps": balls}), strict=True))
    expected = {tuple(power): value for power, value in zip(powers_then, balls["coefficients"], strict=True)}
    assert read == {power: expected.get(power, 0.0) for power in ROUND}
    assert parse_round_spread(balls) == RoundSpread(0.04, 0.03, 1.0)
    with pytest.raises(BadDataError, match="5 coefficients of 6 terms"):
        _round_coefficients(
            {"round_powers": powers_then, "round_lumps": {**balls, "coefficients": [1.0, 2.0, 3.0, 4.0, 5.0]}}
        )
