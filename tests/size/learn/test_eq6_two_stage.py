"""Eq 6 in two stages: against tables made from a known Eq 6, and against the study's own two-stage fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from plain_calibration import RECIPE

from tactile_bayes.errors import BadDataError
from tactile_bayes.report.calibration import calibration_text
from tactile_bayes.size.eq6 import AxisCalibration
from tactile_bayes.size.learn.eq6 import (
    AxisRows,
    SizeTable,
    axis_at_mode,
    axis_in_two_stages,
    learn_two_stage,
    other_fit,
    width_changes,
)
from tactile_bayes.studies.paper import StudyRow, learn_as_printed

TRUTH = np.array([6.6, -6.8, 0.59, -0.32])
DEPTHS = (0.6, 0.8, 1.0, 1.2, 1.5)
DIAMETERS = (5.0, 10.0, 15.0, 20.0, 25.0)
AMPLITUDES = np.array([1.1, 0.37, 0.59 ** (1 / 0.32), 0.09, 0.035])
"""By depth; at one diameter depth that at which Delta sigma is 1."""


def known_eq6(seed: int, *, scatter: float) -> SizeTable:
    """A table of the paper's grid for which Eq 6 holds, but for scatter in ln d that grows as the maps grow fainter.

    d_i = [m sigma_i / (e a_i^f) + b] exp(scatter (a_i / 0.17)^-0.57 N(0, 1)), solved for sigma_i.
    """
    rng = np.random.default_rng(seed)
    d, h = (z.ravel() for z in np.meshgrid(DIAMETERS, DEPTHS, indexing="ij"))
    a = np.tile(AMPLITUDES, len(DIAMETERS))
    noise = np.clip(scatter * (a / 0.17) ** -0.57 * rng.standard_normal(len(d)), -1.2, 1.2)
    m, b, e, f = TRUTH
    sigma = (d * np.exp(-noise) - b) * e * a**f / m
    change = width_changes(sigma, depth_ratio=h, group=[(one,) for one in d])
    return SizeTable(d, a, sigma, None, change, None, None, h)


def rows_of(table: SizeTable) -> AxisRows:
    return AxisRows(table.d_mm, table.amplitude, table.sigma_x_mm, table.width_change_x, table.depth_ratio)


Fit = Callable[[AxisRows], AxisCalibration]


def fitted(fit: Fit, *, scatter: float, tables: int = 30) -> np.ndarray:
    """(tables, 4) m, b, e, f of simulated tables."""
    return np.array([fit(rows_of(known_eq6(seed, scatter=scatter))).draws[0, :4] for seed in range(tables)])


@pytest.mark.parametrize("fit", [axis_in_two_stages, axis_at_mode])
def test_both_fits_recover_a_known_eq_6(fit: Fit) -> None:
    np.testing.assert_allclose(fitted(fit, scatter=1e-3, tables=1)[0], TRUTH, rtol=1e-2)


def test_depths_given_to_the_wrong_rows_do_not_give_eq_6_back() -> None:
    """Negative control of the recovery: another depth is called one diameter."""
    table = known_eq6(1, scatter=1e-3)
    assert table.depth_ratio is not None
    wrong = np.roll(table.depth_ratio, 1)
    change = width_changes(table.sigma_x_mm, depth_ratio=wrong, group=[(one,) for one in table.d_mm])
    found = axis_in_two_stages(AxisRows(table.d_mm, table.amplitude, table.sigma_x_mm, change, wrong)).draws[0]
    assert abs(found[0] / TRUTH[0] - 1.0) > 0.1


def test_the_joint_fit_is_the_tighter_where_eq_6_holds() -> None:
    """Spread of m over 30 tables of 5 % scatter: joint less than half that of two stages; both without bias.

    Negative control: against a truth that is 10 % off, the joint fit's bias shows.
    """
    two, joint = fitted(axis_in_two_stages, scatter=0.05), fitted(axis_at_mode, scatter=0.05)
    assert joint[:, 0].std() < 0.5 * two[:, 0].std()
    for found in (two, joint):
        error = (found[:, 0].mean() - TRUTH[0]) / (found[:, 0].std() / np.sqrt(30))
        assert abs(error) < 4
    assert abs(joint[:, 0].mean() - 1.1 * TRUTH[0]) / (joint[:, 0].std() / np.sqrt(30)) > 4


def test_draws_are_about_the_fit_of_the_study() -> None:
    """`learn_as_printed` of the study, another implementation, has the same four coefficients."""
    table = known_eq6(4, scatter=0.1)
    assert table.depth_ratio is not None
    columns = zip(table.d_mm, table.depth_ratio, table.amplitude, table.sigma_x_mm, strict=True)
    printed = learn_as_printed([StudyRow("centred", d, h, 100.0, a, s, 0.001, True) for d, h, a, s in columns])
    calibration = learn_two_stage(table, recipe=RECIPE, rng=np.random.default_rng(1))
    draws = calibration.x.draws
    assert printed is not None
    assert draws.shape == (1000, 6)
    np.testing.assert_allclose(draws[:, :4].mean(axis=0), [printed.m, printed.b_mm, printed.e, printed.f], rtol=1e-9)
    assert (draws[:, [2, 4]] > 0).all()
    assert (draws[:, :4].std(axis=0) > 0).all()
    # from exact rows there is next to nothing to be unsure of
    exact = learn_two_stage(known_eq6(4, scatter=1e-6), recipe=RECIPE, rng=np.random.default_rng(1)).x.draws
    assert (exact.std(axis=0)[:4] < 1e-3 * draws.std(axis=0)[:4]).all()


@pytest.mark.slow
def test_intervals_of_the_two_stage_fit_hold_as_few_diameters_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nominal 90 % over 80 tables of a known Eq 6 with 17 % of scatter, m, b, e and f together.

    Negative control: the bootstrap of five diameters as it comes holds 77 %.
    """

    def held() -> float:
        inside = []
        for i in range(80):
            draws = learn_two_stage(known_eq6(i, scatter=0.17), recipe=RECIPE, rng=np.random.default_rng(i)).x.draws[
                :, :4
            ]
            low, high = np.quantile(draws, [0.05, 0.95], axis=0)
            inside.append((low <= TRUTH) & (high >= TRUTH))
        return float(np.mean(inside))

    assert 0.85 < held() < 0.96
    monkeypatch.setattr("tactile_bayes.size.learn.eq6._stretch", lambda *_, **__: None)
    assert held() < 0.83


def test_the_report_tells_how_far_the_other_fit_lies() -> None:
    table = known_eq6(4, scatter=0.1)
    calibration = learn_two_stage(table, recipe=RECIPE, rng=np.random.default_rng(1))
    other = other_fit(calibration, table)
    assert other is not None
    assert other.name == "joint"
    ours, theirs = (
        one.size_mm(table.sigma_x_mm, table.amplitude) for one in (calibration.x, axis_at_mode(rows_of(table)))
    )
    assert other.difference[0] == pytest.approx(np.mean(np.abs(ours - theirs) / table.d_mm))
    text = calibration_text(calibration, other_fit=other)
    assert "two-stage fit as printed +- SD of a bootstrap" in text
    assert f"joint fit of all rows: m {other.coefficients[0][0]:.2f}" in text
    # an exact table leaves nothing between them
    exact = known_eq6(4, scatter=1e-3)
    same = other_fit(learn_two_stage(exact, recipe=RECIPE, rng=np.random.default_rng(1)), exact)
    assert same is not None
    assert same.difference[0] < 0.01


def test_without_depths_two_stages_are_refused_and_not_told() -> None:
    table = known_eq6(2, scatter=0.05)
    bare = SizeTable(table.d_mm, table.amplitude, table.sigma_x_mm, None)
    with pytest.raises(BadDataError, match="no depth_ratio"):
        learn_two_stage(bare, recipe=RECIPE, rng=np.random.default_rng(1))
    few = SizeTable(
        table.d_mm, table.amplitude, table.sigma_x_mm, None, table.width_change_x, None, None,
        np.where(table.d_mm > 10, 2.0, table.depth_ratio),
    )  # fmt: skip
    with pytest.raises(BadDataError, match="2 diameters at depth_ratio 1"):
        learn_two_stage(few, recipe=RECIPE, rng=np.random.default_rng(1))
