"""Extremes as a table: what each method answers to a map that nobody ordered. Warnings are errors throughout."""

from __future__ import annotations

import numpy as np
import pytest
from plain_reports import full_text
from posterior_maps import bump_values, grid_map

from tactile_bayes.declarations import names_of, replace
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import METHODS

NOISE = 0.02 * np.random.default_rng(81).standard_normal((51, 51))
FREE = SamplerSettings(background="free")


def unknown_level(values: np.ndarray) -> TactileMap:
    return grid_map(values, background=None, normalise="none")


def few(n: int) -> TactileMap:
    values = np.full((9, 9), np.nan)
    values[4, 4 : 4 + n] = 1.3
    return grid_map(values)


def without_a_quadrant() -> TactileMap:
    values = bump_values() + NOISE
    values[26:, 26:] = np.nan
    return grid_map(values)


def float32() -> TactileMap:
    return grid_map((bump_values() + NOISE).astype(np.float32))


# name: map, options, then either words of the reason or (sigma_x, sigma_y) with a relative tolerance
NOTHING = {
    "all NaN": (grid_map(np.full((9, 9), np.nan)), SamplerSettings(), "no covered cell"),
    "no readings": (grid_map(np.ones((9, 9)), count=0), SamplerSettings(), "no covered cell"),
    "one cell": (few(1), SamplerSettings(), "too few covered cells"),
    "three cells": (few(3), SamplerSettings(), "too few covered cells"),
    "one row": (grid_map(bump_values()[25:26]), SamplerSettings(), "all in one line"),
    "flat": (grid_map(np.ones((51, 51))), SamplerSettings(), "nothing was felt"),
    "flat, level unknown": (unknown_level(np.full((51, 51), 7.0)), FREE, "nothing was felt"),
    "noise only": (grid_map(1 + NOISE), SamplerSettings(), ""),
    "a depression": (grid_map(bump_values(amplitude=-0.3) + NOISE), SamplerSettings(), ""),
    "narrower than a cell": (
        grid_map(bump_values(sigma_x=0.2, sigma_y=0.2, x=0.0, y=0.0)),
        SamplerSettings(),
        "",
    ),
    "wider than the map": (grid_map(bump_values(sigma_x=80.0, sigma_y=80.0) + 0.1 * NOISE), SamplerSettings(), ""),
    "needle": (grid_map(bump_values(sigma_x=15.0, sigma_y=1.0) + NOISE), SamplerSettings(), ""),
    "over the edge": (grid_map(bump_values(x=26.0) + NOISE), SamplerSettings(), ""),
    "a ramp": (grid_map(1 + 0.01 * np.arange(51.0) + np.zeros((51, 1))), SamplerSettings(), ""),
    "one huge cell": (grid_map(1 + 1e6 * (np.arange(2601).reshape(51, 51) == 1300)), SamplerSettings(), ""),
}
FOUND = {
    "amplitude 1e-6": (unknown_level(5 + 1e-6 * (bump_values(amplitude=1.0) + NOISE)), FREE, (6.0, 4.5), 0.05),
    "amplitude 1e6": (unknown_level(1e6 * (bump_values(amplitude=1.0) + NOISE)), FREE, (6.0, 4.5), 0.05),
    "offset 1e6": (unknown_level(1e6 + bump_values() + NOISE), FREE, (6.0, 4.5), 0.1),
    "float32": (float32(), SamplerSettings(), (6.0, 4.5), 0.1),
    "no noise": (grid_map(bump_values()), SamplerSettings(), (6.0, 4.5), 1e-4),
    "no noise, exactly round": (grid_map(bump_values(sigma_x=5.0, sigma_y=5.0)), SamplerSettings(), (5.0, 5.0), 1e-4),
    "exactly round": (grid_map(bump_values(sigma_x=5.0, sigma_y=5.0) + NOISE), SamplerSettings(), (5.0, 5.0), 0.1),
    "round, rotation on": (
        grid_map(bump_values(sigma_x=5.0, sigma_y=5.0) + NOISE),
        SamplerSettings(rotation="on"),
        (5.0, 5.0),
        0.1,
    ),
    "a quadrant missing": (without_a_quadrant(), SamplerSettings(), (6.0, 4.5), 0.15),
    "a million readings a cell": (
        grid_map(bump_values() + NOISE, count=10**6, variance=0.04),
        SamplerSettings(),
        (6.0, 4.5),
        0.1,
    ),
}


def answer(tactile_map: TactileMap, method: str, fit: SamplerSettings) -> Estimate:
    options = replace(fit, method=method)
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert "nan" not in full_text(found, tactile_map).lower()
    return found


MARKS = {"optimise": [pytest.mark.long], "laplace": [pytest.mark.long], "ensemble": [pytest.mark.slow]}
METHOD = pytest.mark.parametrize("method", [pytest.param(m, marks=MARKS.get(m, [])) for m in METHODS])


FIELD_HAS_THEM = ("a depression", "needle", "noise only", "over the edge")
"""They take a second each, and other tests show the same of the default method."""


@METHOD
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name in FIELD_HAS_THEM)) for name in NOTHING]
)
def test_no_number_where_there_is_nothing_to_measure(name: str, method: str) -> None:
    tactile_map, fit, words = NOTHING[name]
    found = answer(tactile_map, method, fit)
    assert found.status == "no_estimate"
    assert found.reason
    assert words in found.reason
    assert found.map_posterior is None


@METHOD
@pytest.mark.parametrize("name", list(FOUND))
def test_a_sane_answer_where_there_is_a_lump(name: str, method: str) -> None:
    tactile_map, fit, widths, tolerance = FOUND[name]
    found = answer(tactile_map, method, fit)
    assert found.status == "estimate", found.reason
    posterior = found.map_posterior
    assert posterior is not None
    for one in set(names_of(posterior)) - {"labels", "oblique", "irregular"}:
        assert np.isfinite(getattr(posterior, one)).all(), one
    medians = [np.median(posterior.sigma_x_mm), np.median(posterior.sigma_y_mm)]
    np.testing.assert_allclose(medians, widths, rtol=tolerance)
