"""From a map to a size posterior: coverage, the recipe, reports, and what an estimate says of itself."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_calibration import RECIPE
from plain_reports import full_text, report_of
from posterior_maps import TRUTH, bump_map, correlated_field, grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, NotConvergedError, UsageError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior import estimate
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.report.estimate_document import estimate_report
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.terms import Recipe

SIZE = 51
NOISE = 0.02
OFF = SamplerSettings(rotation="off")
DOMAIN = {"amplitude": (0.05, 0.8), "sigma_mm": (2.0, 9.0), "d_mm": (5.0, 25.0)}
WHITE = NOISE * np.random.default_rng(71).standard_normal((SIZE, SIZE))


def calibration(recipe: Recipe | None = None, *, b: float = 1.0) -> SizeCalibration:
    rows = np.array([[1.6, b, 0.6, -0.35, 0.1, 0.2]]) * np.exp(
        0.05 * np.random.default_rng(72).standard_normal((200, 6))
    )
    axis = AxisCalibration(rows, 0.3, DOMAIN)
    return SizeCalibration(axis, axis, 0.8, recipe or RECIPE)


def run(
    noise: np.ndarray | float = WHITE,
    *,
    method: str = "laplace",
    fit: SamplerSettings = OFF,
    use: SizeCalibration | None = None,
    seed: int = 1,
    **bump: float,
) -> Estimate:
    options = replace(fit, method=method)
    return estimate_map(
        bump_map(noise=noise, **bump), calibration=use, options=options, rng=np.random.default_rng(seed)
    )


def covers(estimate: Estimate, *, stretch: float = 1.0) -> list[bool] | None:
    """Whether the central 90 % of amplitude and both widths hold the truth."""
    posterior = estimate.map_posterior
    if posterior is None:
        return None
    found = []
    for name, truth in (("amplitude", "amplitude"), ("sigma_x_mm", "sigma_x"), ("sigma_y_mm", "sigma_y")):
        draws = getattr(posterior, name).ravel()
        middle = np.median(draws)
        low, high = np.quantile(middle + stretch * (draws - middle), [0.05, 0.95])
        found.append(bool(low <= TRUTH[truth] <= high))
    return found


def coverage(method: str, noise: str, *, maps: int, stretch: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(73)
    held = []
    for _ in range(maps):
        match noise:
            case "white":
                errors = rng.standard_normal((SIZE, SIZE))
            case length:
                errors = correlated_field(rng, SIZE, length_cells=float(length))
        held.append(covers(run(NOISE * errors, method=method), stretch=stretch))
    assert all(one is not None for one in held)
    return np.mean(held, axis=0)


@pytest.mark.slow
def test_intervals_of_90_percent_cover_9_in_10() -> None:
    """100 maps with white errors: the binomial error of each share is 3 %, of their mean at most that."""
    found = coverage("optimise", "white", maps=100)
    assert found.min() >= 0.80
    assert 0.85 <= found.mean() <= 0.96


@pytest.mark.slow
def test_half_the_noise_is_found_out() -> None:
    assert coverage("optimise", "white", maps=60, stretch=0.5).mean() < 0.75


@pytest.mark.slow
@pytest.mark.parametrize("method", ["optimise", "laplace"])
def test_coverage_with_white_errors(method: str) -> None:
    """200 maps: the binomial error of each share is 2.1 %."""
    found = coverage(method, "white", maps=200)
    assert found.min() >= 0.84
    assert found.max() <= 0.96


@pytest.mark.slow
@pytest.mark.parametrize(("length", "least"), [("1", 0.80), ("3", 0.70), ("6", 0.55)])
def test_coverage_with_correlated_errors(length: str, least: float) -> None:
    """An exponential field of 1, 3 and 6 mm under a lump of 6 by 4.5 mm: 200 maps, nominal 90 %.

    The residuals of one window of 20 mm do not hold enough of a field that long to judge it: intervals fall short.
    With independent errors assumed they would cover less than half of these.
    """
    assert coverage("laplace", length, maps=200).min() >= least


def test_the_size_is_equation_6_of_the_map() -> None:
    found = run(use=calibration())
    assert found.size is not None
    assert found.size.invalid == 0
    expected = 1.6 * TRUTH["sigma_x"] / (0.6 * TRUTH["amplitude"] ** -0.35) + 1.0
    assert np.median(found.size.d_x_mm) == pytest.approx(expected, rel=0.05)
    assert np.median(found.size.max_size_mm) >= np.median(found.size.d_x_mm)
    share = found.size.variance_share
    assert sum(share.values()) == pytest.approx(100)
    assert share["map"] < 10  # the calibration dominates on a clear map, and the report says so
    assert found.sensitivity is not None
    assert set(found.sensitivity.median) == {"sigma_x_mm", "sigma_y_mm", "max_size_mm"}


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        (replace(RECIPE, normalise="gain"), "normalise mean (the calibration: gain)"),
        (replace(RECIPE, background="free"), "background fixed (the calibration: free)"),
        (replace(RECIPE, radius_mm=15.0), "fit radius 20 mm (the calibration: 15 mm)"),
    ],
)
def test_a_calibration_by_another_recipe_is_refused(recipe: Recipe, words: str) -> None:
    with pytest.raises(BadDataError) as caught:
        run(use=calibration(recipe))
    assert caught.value.exit_code == 3
    assert words in str(caught.value)


def test_outside_the_calibration_is_flagged() -> None:
    flagged = run(use=calibration(), amplitude=1.2)
    (outside,) = (one.text for one in flagged.findings if one.kind == "outside_calibration")
    x, y = (f"{axis}: amplitude 1.2 (table: 0.05 to 0.8)" for axis in "xy")
    assert outside == f"unlike the lumps that sizes were learned from: {x} and {y}"
    text = full_text(flagged, bump_map())
    assert text.startswith("CAUTION: unlike the lumps that sizes were learned from: x: amplitude 1.2")
    assert not any(one.kind == "outside_calibration" for one in run(use=calibration()).findings)


@pytest.mark.parametrize(
    ("own", "named"),
    [
        ({"amplitude_sd": 0.02}, "amplitude_sd = 0.02"),
        ({"width_median_mm": 6.0, "log_width_sd": 0.01}, "width_median_mm = 6, log_width_sd = 0.01"),
        ({"log_ratio_sd": 0.03}, "log_ratio_sd = 0.03"),
        ({"amplitude_sd": 0.5, "width_median_mm": 6.0, "log_width_sd": 0.5, "tilt_sd": 1e-6}, None),
    ],
)
def test_priors_of_ones_own_that_set_the_size_are_a_caution(own: dict[str, float], named: str | None) -> None:
    cautions = [one.remedy for one in run(fit=replace(OFF, **own)).findings if one.kind == "own_settings"]
    assert [text.partition(":")[0] for text in cautions] == ([] if named is None else [named])
    # least squares have no priors
    unused = run(fit=replace(OFF, **own), method="optimise").findings
    assert not any(one.kind == "own_settings" for one in unused)


def test_errors_resolved_more_coarsely_than_the_calibrations_are_a_caution_that_pools_keep() -> None:
    field = {"noise": "field", "background": "free"}
    found = run(fit=replace(OFF, field_cosines=6, **field), use=calibration(replace(RECIPE, **field)))
    assert [one.kind for one in found.findings] == ["own_settings"]
    assert found.findings[0].remedy == "leave field_cosines out of the settings"


def test_far_outside_the_calibration_there_is_no_size() -> None:
    found = run(use=calibration(), amplitude=2.0)
    assert (found.status, found.code, found.size) == ("no_estimate", "extrapolated", None)
    assert "x: amplitude 2 (table: 0.05 to 0.8)" in found.reason


def test_a_calibration_that_gives_no_size_gives_no_estimate() -> None:
    found = run(use=calibration(b=-80.0))
    assert found.status == "no_estimate"
    assert "outside the calibration" in found.reason
    assert found.size is None


def test_without_a_calibration_there_are_widths_only() -> None:
    found = run()
    assert found.status == "estimate"
    assert found.size is None
    assert "widths only" in found.reason
    assert "No size: no size calibration was given" in full_text(found, bump_map())


def test_rotation_is_spent_where_the_map_asks_for_it() -> None:
    straight, turned = run(fit=SamplerSettings()), run(fit=SamplerSettings(), angle_deg=30.0)
    assert straight.diagnostics["rotated"] is False
    assert any("rotation of the ellipse" in note for note in straight.left_out)
    assert turned.diagnostics["rotated"] is True
    assert turned.map_posterior is not None
    assert np.degrees(np.median(turned.map_posterior.angle_rad)) == pytest.approx(30.0, abs=4.0)


def test_a_level_off_that_of_the_map_is_a_caution() -> None:
    assert run(method="optimise").findings == ()
    (found,) = run(WHITE - 0.06, method="optimise").findings
    assert found.kind == "uneven_level"
    assert re.match(r"the pressure round the lump is -\d\.\d % off that of the rest of the map: ", found.text)


def test_a_size_beyond_the_lumps_that_were_learned_is_a_caution_though_its_bump_is_within() -> None:
    drawn: Any = SimpleNamespace(medians=(0.3, 5.0, 5.0), irregular=False)
    calibration = SimpleNamespace(outside=lambda *_: ["amplitude 3"], beyond_lumps=lambda _: ["largest size 4 mm"])
    for size, words in ((None, "amplitude 3"), (SimpleNamespace(known_sds=0.0), "amplitude 3 and largest size 4 mm")):
        result: Any = SimpleNamespace(posterior=drawn, calibration=calibration, size=size, figures={})
        (found,) = estimate._findings(result, cell_mm=1.0)
        assert found.kind == "outside_calibration"
        assert found.text.endswith(f": {words}")


def test_coarse_cells_are_flagged() -> None:
    noise = 0.005 * np.random.default_rng(74).standard_normal((13, 13))
    tactile_map = bump_map(cell_mm=4.0, half_mm=24.0, noise=noise)
    found = estimate_map(
        tactile_map, calibration=None, options=replace(OFF, method="optimise"), rng=np.random.default_rng(1)
    )
    assert "coarse_cells" in [one.kind for one in found.findings]
    assert "smaller --cell-mm" in full_text(found, tactile_map)


def test_a_level_off_the_background_is_reported() -> None:
    tactile_map = grid_map(bump_map(noise=WHITE).mean + 0.05)
    found = estimate_map(
        tactile_map, calibration=None, options=replace(OFF, method="optimise"), rng=np.random.default_rng(1)
    )
    assert found.status == "estimate"
    level = [one.diagnostics["level_offset"] for one in (found, run(method="optimise"))]
    assert level[0] > 0.005 > 5 * abs(level[1])  # the bump widens to take most of the 0.05 upon itself


def test_too_few_steps_are_not_convergence() -> None:
    options = replace(OFF, method="ensemble", max_steps=150)
    with pytest.raises(NotConvergedError, match=r"run about .* times as long \(max_steps = "):
        estimate_map(bump_map(noise=WHITE), calibration=None, options=options, rng=np.random.default_rng(1))


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(UsageError, match="method is 'guess'; give one of optimise, laplace"):
        run(method="guess")


def test_the_map_is_left_as_it_was() -> None:
    tactile_map = bump_map(noise=WHITE)
    before = tactile_map.mean.copy()
    estimate_map(tactile_map, calibration=None, options=SamplerSettings(method="laplace"), rng=np.random.default_rng(1))
    np.testing.assert_array_equal(tactile_map.mean, before)


@pytest.mark.long
def test_documents_say_null_where_there_is_nothing() -> None:
    nothing = run(noise=WHITE, amplitude=0.0)
    report = report_of(nothing, bump_map())
    assert report.status == "no_estimate"
    assert report.reason
    for name in ("max_size_mm", "d_x_mm", "amplitude", "sigma_x_mm", "centre_mm", "variance_share", "noise_sd"):
        assert getattr(report, name) is None
    assert full_text(nothing, bump_map()).startswith("No lump found on the ")


def test_the_centre_is_told_in_the_patients_frame() -> None:
    patient = np.eye(4)
    patient[:3, 3] = [100.0, 50.0, 0.0]
    tactile_map = replace(bump_map(noise=WHITE), patient_from_plane=patient)
    found = estimate_map(
        tactile_map, calibration=None, options=replace(OFF, method="laplace"), rng=np.random.default_rng(1)
    )
    report = estimate_report(
        found, tactile_map, probability=0.95, prior=BumpPrior(), provenance=Provenance("estimate", {})
    )
    assert report.centre_mm is not None
    assert report.centre_patient_mm is not None
    x, y = report.centre_mm.median
    assert report.centre_patient_mm.median == pytest.approx((x + 100.0, y + 50.0), abs=1e-6)
