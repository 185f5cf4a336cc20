"""No number, why, and what would help: each reason from the map that brings it."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_reports import full_text
from posterior_maps import bump_map, bump_values, grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.errors import CODES, NO_LUMP, NotConvergedError, UsageError
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior import draw as methods
from tactile_bayes.posterior import estimate
from tactile_bayes.posterior.bump import Detection
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.verdict import (
    WeighedRise,
    coverage_shortfall,
    no_bump_reason,
    shape_fault,
    stroke_advice,
    undetected_reason,
)
from tactile_bayes.posterior.white import AT_RIM, Candidate, MapDraws, fit_bump

FIELD = SamplerSettings(background="free", noise="field")
WHITE = 0.01 * np.random.default_rng(4).standard_normal((51, 51))
EMPTY = 1 + WHITE


@cache
def empty(centre_mm: tuple[float, float] | None) -> Estimate:
    """Of a map with nothing but noise."""
    return run(EMPTY, centre_mm=centre_mm)


def run(values: np.ndarray, *, count: np.ndarray | int = 40, **options: object) -> Estimate:
    settings = replace(FIELD, **options)  # type: ignore[arg-type]
    return estimate_map(grid_map(values, count=count), calibration=None, options=settings, rng=np.random.default_rng(1))


STEP = np.where(np.arange(51) < 25, 0.999, 1.0) * np.ones((51, 1))
"""Nothing rises above its surroundings."""


def cut(*, right: int) -> np.ndarray:
    values = bump_values(x=0.0, y=0.0, sigma_x=6.0, sigma_y=6.0) + WHITE
    values[:, 25 + right :] = np.nan
    return values


@pytest.mark.parametrize(
    ("values", "code", "advice"),
    [
        (np.full((9, 9), np.nan), "cannot_show", "map a scan"),
        (np.ones((51, 51)), "cannot_show", "what was saved"),
        (STEP, "empty", "go over the place again"),
        (EMPTY, "undetected", "go over the place again"),
        (cut(right=1), "window", "mm to the picture's right (+x)"),
        # half a lump beyond the rim, by whose probability there was no lump; to the left nothing is to be extended
        (
            bump_values(x=27.0, y=0.0, sigma_x=7.0, sigma_y=7.0) + WHITE,
            "window",
            "strokes 13 mm to the picture's right",
        ),
        (
            bump_values(x=32.0, y=0.0, amplitude=1.5, sigma_x=7.0, sigma_y=7.0) + WHITE,
            "window",
            "strokes 14 mm to the picture's right",
        ),
        (bump_values(x=36.0, y=0.0, amplitude=1.5, sigma_x=10.0, sigma_y=10.0) + WHITE, "window", "beyond it"),
    ],
)
def test_the_reason_has_a_code_and_a_way_out(values: np.ndarray, code: str, advice: str) -> None:
    found = empty(None) if values is EMPTY else run(values)
    assert found.status == "no_estimate"
    assert (found.code, found.code in CODES) == (code, True), found.reason
    assert advice in found.advice
    assert found.on_paper
    assert "--" not in found.on_paper  # a reader of the page has no command line
    text = full_text(found, grid_map(values))
    assert "What would help" in text or found.advice in text  # a caution may tell it already


@pytest.mark.long
def test_cells_too_large_to_show_a_lump_are_no_verdict_on_the_breast() -> None:
    """A lump of sigma 3 mm on cells of 10 mm once read "no lump found"; the control is the same map on fine cells."""
    coarse = grid_map(1.0 + WHITE[:9, :9], cell_mm=10.0)
    settings = FIELD
    found = estimate_map(coarse, calibration=None, options=settings, rng=np.random.default_rng(1))
    assert found.code == "cannot_show"
    assert found.reason == "the data cannot show whether there is a lump: its cells of 10 mm are too large"
    assert "smaller cells" in found.advice
    assert found.detection is None  # no probability beside it
    assert run(1 + WHITE).code == "undetected"
    few = replace(coarse, count=coarse.count * (np.arange(81).reshape(9, 9) % 16 == 0))
    found = estimate_map(few, calibration=None, options=settings, rng=np.random.default_rng(1))
    assert found.code == "cannot_show"  # it once read "no lump found: 6 covered cells for 5 parameters"


@pytest.mark.parametrize("own", [{"fit_radius_mm": 2.0}, {"amplitude_sd": 1e-4}])
def test_settings_that_can_hide_a_lump_exclude_none(own: dict[str, float]) -> None:
    """Over this lump both read "no lump found", and from which size on one would have shown."""
    found = run(bump_values(x=0.0, y=0.0, sigma_x=10.0, sigma_y=10.0) + WHITE, **own)
    ((name, value),) = own.items()
    assert found.code == "cannot_show"
    assert found.reason.endswith(f"lumps are not detected reliably with {name} = {value:g}")
    assert found.advice == f"leave {name} out of the settings"


@pytest.mark.parametrize(
    ("bump", "fault", "code", "advice"),
    [
        ({"sigma_x": 16.0, "sigma_y": 16.0}, "wider than the window", "window", "fit a larger window"),
        ({"sigma_x": 0.3, "sigma_y": 0.3, "x": 0.0, "y": 0.0}, "narrower than a cell", "unresolved", "--cell-mm"),
        ({"sigma_x": 12.0, "sigma_y": 1.5, "x": 0.0, "y": 0.0}, "a ridge", "ridge", "rib"),
        ({"amplitude": -0.3}, "a depression", "undetected", ""),
    ],
)
def test_a_bump_that_cannot_be_measured_has_its_code(
    bump: dict[str, float], fault: str, code: str, advice: str
) -> None:
    tactile_map = grid_map(bump_values(half_mm=45.0, **bump))
    fit, found = fit_bump(tactile_map, (bump.get("x", 1.3), bump.get("y", -0.8)), options=SamplerSettings())
    assert fault in found
    candidate = Candidate((0.0, 0.0), fit, found)
    lump = WeighedRise(Detection(50.0), (0.0, 0.0), (4.0, 0.0, 0.0, 0.0, 0.0), candidate)
    answer = no_bump_reason(tactile_map, [candidate], lump, where="here")
    assert answer.code == code
    assert advice in answer.advice
    assert answer.about_mm == (0.0, 0.0)
    assert "--" not in answer.on_paper


def test_a_wide_rise_at_the_rim_asks_for_strokes_and_not_for_a_larger_window() -> None:
    """On an empty scan a fault of the field's bump, sigma 13 mm, stood beside the least-squares one of 4 mm."""
    tactile_map = grid_map(bump_values(half_mm=45.0, x=0.0, y=0.0, sigma_x=4.0, sigma_y=4.0))
    fit, _ = fit_bump(tactile_map, (0.0, 0.0), options=SamplerSettings())
    candidate = Candidate((0.0, 0.0), fit, f"{AT_RIM} (with a sigma of 13.3 mm its flank to +y is 9 mm short)")
    lump = WeighedRise(Detection(50.0), (0.0, 0.0), (4.0, 0.0, 0.0, 0.0, 0.0), candidate)
    answer = no_bump_reason(tactile_map, [candidate], lump, where="here")
    assert answer.code == "window"
    assert answer.advice == answer.on_paper == "extend the strokes beyond it"


@pytest.mark.long_repeats
@pytest.mark.parametrize("centre", [None, (3.0, 2.0)])
def test_no_lump_is_said_first_with_the_place(centre: tuple[float, float] | None) -> None:
    found = empty(centre)
    first = full_text(found, grid_map(EMPTY)).splitlines()[0]
    assert first.startswith("No lump found ")
    assert ("on the 26 cm2 that the map covers" if centre is None else "near (3.0, 2.0) mm") in first
    assert "strokes" not in found.advice
    assert "probability" not in first
    assert found.probability is None or found.probability < 0.5


def test_rises_at_the_rim_of_an_empty_map_do_not_ask_for_strokes() -> None:
    """The heads of an empty scan press harder at the map's rim: no reason to send anybody back."""
    across = np.linspace(-1.0, 1.0, 51)
    found = run(1 + 0.3 * across**8 + WHITE)
    assert found.code == "undetected"
    assert found.reason.startswith("no lump found on the 26 cm2")
    assert "strokes" not in found.advice


def test_a_spot_that_a_few_frames_made_is_no_lump() -> None:
    """In cells of 3 readings for 29, as at the corner of an empty scan; the control has 15 there."""
    values = bump_values(x=18.0, y=-18.0, sigma_x=2.0, sigma_y=2.0) + WHITE
    x = np.arange(51) - 25.0
    corner = (x[None, :] > 12.0) & (x[:, None] < -12.0)
    few, enough = (run(values, count=np.where(corner, readings, 29), method="laplace") for readings in (3, 15))
    assert few.status == "no_estimate"
    assert any("its cells hold 3 readings, where 29 are typical" in one.fault for one in few.candidates)
    assert enough.status == "estimate"


@pytest.mark.parametrize("centre", [(26.0, 0.0), (0.0, -300.0)])
def test_a_place_off_the_map_is_a_usage_error(centre: tuple[float, float]) -> None:
    options = replace(FIELD, centre_mm=centre)
    with pytest.raises(UsageError, match=r"off the map, which has x from -25.5 to 25.5 mm and y from -25.5 to 25.5 mm"):
        estimate_map(grid_map(1 + WHITE), calibration=None, options=options, rng=np.random.default_rng(1))


def test_no_place_at_all_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match=r"centre_mm\[0\] is nan; give a number"):
        replace(FIELD, centre_mm=(float("nan"), 0.0))


def test_a_measurable_lump_has_no_reason_and_no_advice() -> None:
    found = run(bump_values() + WHITE)
    assert (found.status, found.code, found.advice) == ("estimate", "", "")


@pytest.mark.parametrize("reached", [3, 6, 9])
def test_missing_strokes_are_counted_from_the_centre(reached: int) -> None:
    short = coverage_shortfall(grid_map(cut(right=reached)), (0.0, 0.0), reach_mm=12.0)
    assert list(short) == ["the picture's right (+x)"]
    assert short["the picture's right (+x)"] == pytest.approx(12.0 - (reached - 0.5), abs=1.0)
    assert stroke_advice(short).startswith("extend the strokes ")
    assert coverage_shortfall(grid_map(bump_values()), (0.0, 0.0), reach_mm=12.0) == {}


@pytest.mark.parametrize(
    ("covered", "short_mm"),
    [
        (lambda _, y: y % 2 == 0, 0.0),  # half of the breadth
        (lambda _, y: y % 8 == 0, 6.5),  # an eighth
        (lambda x, y: abs(y) > x, 6.5),  # only what belongs to the sectors above and below
        (lambda _, y: abs(y) <= 1, 5.5),  # three cells: a quarter up to the sixth column
    ],
)
def test_a_flank_ends_where_less_than_a_quarter_of_its_breadth_is_covered(covered, short_mm: float) -> None:
    """Covered in full up to 5.5 mm and beyond that in part; no other side falls short."""
    x, y = np.arange(51) - 25, np.arange(51)[:, None] - 25
    values = np.where((x <= 5) | covered(x, y), bump_values(), np.nan)
    short = coverage_shortfall(grid_map(values), (0.0, 0.0), reach_mm=12.0)
    assert short == ({"the picture's right (+x)": short_mm} if short_mm else {})


@pytest.mark.parametrize(
    ("detection", "features", "code", "reason"),
    [
        (Detection(50.0, ridge="a ridge along x"), (4.0, 0.0, 0.0, 0.0, 0.0), "ridge", "is rather a ridge along x"),
        (Detection(-1.0), (0.0, 2.0, 2.0, 1.0, 0.0), "undetected", "errors of the map explain what rises"),
        (Detection(50.0), (4.0, np.log(6.0), 0.0, 0.0, 0.0), "ridge", "is a ridge, not a lump"),
        (Detection(50.0), (4.0, np.log(2.0), 2.0, 0.9, 0.0), "undetected", "is wider or less covered than a lump"),
    ],
    ids=["a ridge by its evidence", "errors", "a ridge by its shape", "too wide"],
)
def test_what_rises_and_is_no_lump_is_told_by_its_strongest_fault(
    detection: Detection, features: tuple[float, ...], code: str, reason: str
) -> None:
    answer = undetected_reason(WeighedRise(detection, (3.0, -4.0), features), where="here")
    assert answer.code == code
    assert reason in answer.reason
    assert answer.reason.startswith("no lump found here: ")
    assert ("feel whether it is a rib" in answer.advice) == (code == "ridge")
    # errors are at no place: nothing to look at is named
    assert (answer.about_mm == (3.0, -4.0)) == ("near (3.0, -4.0) mm" in answer.reason) == ("errors" not in reason)


def test_a_posterior_as_wide_as_its_prior_is_no_answer() -> None:
    rng = np.random.default_rng(2)
    vague = np.exp(np.log(5.0) + 0.8 * rng.standard_normal(4000))
    fault = shape_fault(vague, vague, cell_mm=1.0, prior=BumpPrior())
    assert fault is not None
    assert fault.code == "prior"
    of_prior = 0.8 / np.hypot(BumpPrior().log_width_sd, BumpPrior().log_ratio_sd)
    assert f"the SD of its widths is {of_prior:.2f} of what it is without a map (at most 0.5)" in fault.reason
    sharp = np.exp(np.log(5.0) + 0.2 * rng.standard_normal(4000))
    assert shape_fault(sharp, sharp, cell_mm=1.0, prior=BumpPrior()) is None


def test_when_every_method_fails_there_is_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise NotConvergedError("too heavy", diagnostics={})

    for name in ("importance_draws", "ensemble_draws"):
        monkeypatch.setattr(methods, name, fails)
    found = run(bump_values() + WHITE)
    assert found.code == "method"
    assert "importance: too heavy; ensemble: too heavy" in found.reason


def test_where_no_lump_is_assumed_there_is_no_size() -> None:
    found = run(bump_values() + WHITE, scene="none")
    assert (found.status, found.code, found.reason) == ("no_estimate", "undetected", "no lump was assumed")


@pytest.mark.parametrize("options", [{"scene": "round"}, {"accuracy_mm": 0.1}])
def test_what_needs_a_field_is_refused_without(options: dict[str, object]) -> None:
    with pytest.raises(UsageError, match='give noise = "field"'):
        estimate_map(
            bump_map(noise=WHITE),
            calibration=None,
            options=SamplerSettings(**options),  # type: ignore[arg-type]
            rng=np.random.default_rng(1),
        )


@pytest.mark.parametrize(
    ("widths", "cell_mm", "drawn"), [((11.5, 0.6), 1.0, False), ((9.0, 2.0), 1.0, True), ((0.2, 0.2), 1.0, False)]
)
def test_a_shape_far_beyond_the_limits_at_its_mode_costs_no_draws(
    monkeypatch: pytest.MonkeyPatch, widths: tuple[float, float], cell_mm: float, drawn: bool
) -> None:
    """A stripe of readings took 30 s of chains; a shape only just beyond a limit is still drawn, and judged by that."""
    tactile_map = bump_map(noise=WHITE, cell_mm=cell_mm)
    options = replace(FIELD, method="laplace")
    candidates, seen = estimate.search(tactile_map, options)
    assert seen is not None

    class Odd:
        fit, detection, fault, scene = seen.fit, seen.detection, "", seen.scene
        drawings = 0

        def bump(self) -> object:
            return replace(seen.bump(), sigma_x_mm=widths[0], sigma_y_mm=widths[1])

        def draw(self, *given: object, **named: object) -> object:
            Odd.drawings += 1
            return seen.draw(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(estimate, "search", lambda *_: (candidates, Odd()))
    found = estimate.estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert (Odd.drawings > 0) == drawn
    assert found.status == ("estimate" if drawn else "no_estimate")
    assert drawn or found.code in ("unresolved", *NO_LUMP)


@pytest.mark.parametrize(
    ("widths", "code"), [((9.0, 2.0), "ridge"), ((2.0, 9.0), "ridge"), ((6.0, 5.0), "extrapolated")]
)
def test_a_ridge_by_its_draws_is_no_lump_though_no_calibration_holds_it_either(
    monkeypatch: pytest.MonkeyPatch, widths: tuple[float, float], code: str
) -> None:
    tactile_map, options = bump_map(noise=WHITE), replace(FIELD, method="laplace")
    candidates, seen = estimate.search(tactile_map, options)
    assert seen is not None

    def drawn(*given: Any, **named: Any) -> MapDraws:
        result = seen.draw(*given, **named)
        x, y = (np.full_like(result.posterior.x_mm, one) for one in widths)
        return replace(result, posterior=replace(result.posterior, sigma_x_mm=x, sigma_y_mm=y))

    calibration: Any = SimpleNamespace(
        at_depth_or_fallback=lambda *_: calibration, outside=lambda *_, **__: ["so wide a lump"], fat_mm=None
    )
    shape = {name: getattr(seen, name) for name in ("fit", "detection", "fault", "scene", "bump")}
    monkeypatch.setattr(estimate, "search", lambda *_: (candidates, SimpleNamespace(draw=drawn, **shape)))
    monkeypatch.setattr(estimate, "recipe_differences", lambda *_: [])
    monkeypatch.setattr(estimate, "calibration_for", lambda _, given: given)
    found = estimate_map(tactile_map, calibration=calibration, options=options, rng=np.random.default_rng(1))
    assert found.code == code
    assert (found.reason.count("no lump found on the ") == 1) == (code == "ridge")
    if code == "ridge":
        assert found.reason.endswith(": what rises is a ridge, not a lump (sigma 9 by 2 mm)")
