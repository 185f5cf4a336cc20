"""Other rises than the lump that was measured: named where they stand, and rarely where none does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from posterior_maps import bump_values, correlated_field, grid_map

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.masses import _stands_out, other_rises
from tactile_bayes.posterior.result import Estimate, Rise

HALF_MM = 35.0
SMALL = (15.0, 2.0)


def values(*, second: float, seed: int = 1) -> np.ndarray:
    """A lump at (-18, 2) mm on errors with a length of 3 mm, and 33 mm from it a second of some amplitude."""
    first = bump_values(half_mm=HALF_MM, x=-18.0, y=2.0, sigma_x=4.5, sigma_y=4.5, amplitude=0.5)
    other = bump_values(half_mm=HALF_MM, x=SMALL[0], y=SMALL[1], sigma_x=4.0, sigma_y=4.0, amplitude=second, level=0.0)
    return first + other + errors(seed)


def errors(seed: int) -> np.ndarray:
    """A field with a length of 3 mm and independent errors."""
    rng, n = np.random.default_rng(seed), 2 * round(HALF_MM) + 1
    return 0.005 * correlated_field(rng, n, length_cells=3.0) + 0.005 * rng.standard_normal((n, n))


def looked(
    mean: np.ndarray, centre: tuple[float, float] | None = None, *, count: np.ndarray | int = 40, hardly: bool = False
) -> tuple[Estimate, tuple[Rise, ...]]:
    """What was measured, and the rises that are lumps by the evidence, or those that the map hardly shows."""
    options = SamplerSettings(method="laplace", draws=400, background="free", centre_mm=centre, noise="field")
    tactile_map = grid_map(mean, count=count)
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    return found, other_rises(tactile_map, found, options)[int(hardly)]


@pytest.mark.filterwarnings("error")
def test_nothing_rises_on_a_map_without_a_covered_cell() -> None:
    empty = grid_map(np.full((9, 9), np.nan), normalise="none", background=None)
    asked = SamplerSettings(background="free", centre_mm=(0.0, 0.0))
    found = estimate_map(empty, calibration=None, options=asked, rng=np.random.default_rng(1))
    assert other_rises(empty, found, asked) == ((), ())


def test_another_lump_far_away_is_named_where_it_stands() -> None:
    found, rises = looked(values(second=0.1))
    assert found.fit is not None
    assert len(rises) == 1
    assert np.hypot(rises[0].x_mm - SMALL[0], rises[0].y_mm - SMALL[1]) < 1.0
    assert rises[0].distance_mm == pytest.approx(33.0, abs=1.0)
    assert rises[0].probability > 0.95
    assert rises[0].amplitude == pytest.approx(0.1, abs=0.03)


def test_one_lump_is_not_named_twice() -> None:
    """The control of the test above; `validation.scene_rates` has the shares over hundreds of maps."""
    for seed in range(3):
        assert looked(values(second=0.0, seed=seed))[1] == ()


def test_a_lump_close_to_a_larger_one_is_named() -> None:
    """Their centres are 2.3 widths of the larger one apart."""
    larger = bump_values(half_mm=HALF_MM, x=-18.0, y=2.0, sigma_x=6.0, sigma_y=6.0, amplitude=0.5) + errors(1)
    other = bump_values(half_mm=HALF_MM, x=-4.0, y=2.0, sigma_x=4.0, sigma_y=4.0, amplitude=0.1, level=0.0)
    (rise,) = looked(larger + other)[1]
    assert np.hypot(rise.x_mm + 4.0, rise.y_mm - 2.0) < 1.0
    assert looked(larger)[1] == ()  # the control: that one alone


@pytest.mark.parametrize("exponent", [1.7, 2.5])
def test_what_a_lump_that_is_no_gaussian_leaves_is_not_named(exponent: float) -> None:
    axis = np.arange(-HALF_MM, HALF_MM + 1.0)
    away = np.hypot(axis + 18.0, axis[:, None] - 2.0)
    found, rises = looked(1.0 + 0.5 * np.exp(-0.5 * (away / 6.0) ** exponent) + errors(1))
    assert found.status == "estimate"
    assert rises == ()


@pytest.mark.long
def test_a_lump_beside_a_rim_that_was_read_seldom_is_named() -> None:
    """The rim's errors are larger, and as part of the window they hid it."""
    rim = np.arange(-HALF_MM, HALF_MM + 1.0)[:, None] < -20.0
    count = np.where(rim & np.ones(71, dtype=bool), 8, 40)

    def named(second: float, count: np.ndarray | int) -> list[tuple[int, int]]:
        other = bump_values(half_mm=HALF_MM, x=15.0, y=-12.0, sigma_x=4.0, sigma_y=4.0, amplitude=second, level=0.0)
        uneven = np.where(rim, 0.1 * correlated_field(np.random.default_rng(2), 71, length_cells=4.0), 0.0)
        _, rises = looked(values(second=0.0) + other + uneven, count=count)
        return [(round(rise.x_mm), round(rise.y_mm)) for rise in rises]

    assert named(0.1, count) == [(15, -12)]
    # the controls: no lump there, and a rim that was read as often as the rest, where such errors are the map's own
    assert named(0.0, count) == []
    assert named(0.1, 40) == []


@pytest.mark.long
def test_a_low_rise_beside_a_lump_is_hardly_shown() -> None:
    """Errors with a length of 5 mm explain it nearly as well."""
    rng = np.random.default_rng(1)
    noise = 0.02 * correlated_field(rng, 71, length_cells=5.0) + 0.005 * rng.standard_normal((71, 71))

    def listed(lump: float, second: float, *, hardly: bool = True) -> list[tuple[int, int]]:
        first = bump_values(half_mm=HALF_MM, x=-18.0, y=2.0, sigma_x=4.5, sigma_y=4.5, amplitude=lump)
        other = bump_values(half_mm=HALF_MM, x=15.0, y=2.0, sigma_x=6.0, sigma_y=6.0, amplitude=second, level=0.0)
        _, rises = looked(first + other + noise, hardly=hardly)
        return [(round(rise.x_mm), round(rise.y_mm)) for rise in rises]

    assert listed(0.5, 0.12) == [(14, 4)]
    assert listed(0.5, 0.12, hardly=False) == []
    # the controls: the errors alone, with more evidence, beside a lump 8 times as high, and beside none
    assert listed(0.5, 0.0) == []
    assert (listed(0.5, 0.15), len(listed(0.5, 0.15, hardly=False))) == ([], 1)
    assert listed(0.9, 0.12) == []
    assert listed(0.0, 0.12) == []


@pytest.mark.long
def test_a_lump_that_goes_on_into_a_rim_that_was_read_seldom_is_hardly_shown() -> None:
    rng, rim = np.random.default_rng(1), np.arange(-HALF_MM, HALF_MM + 1.0)[:, None] < -20.0
    first = bump_values(half_mm=HALF_MM, x=-18.0, y=8.0, sigma_x=4.5, sigma_y=4.5, amplitude=0.3)
    uneven = np.where(rim, 0.2 * correlated_field(np.random.default_rng(2), 71, length_cells=4.0), 0.0)
    noise = 0.005 * correlated_field(rng, 71, length_cells=3.0) + 0.005 * rng.standard_normal((71, 71))

    def listed(second: float) -> list[tuple[int, int]]:
        other = bump_values(half_mm=HALF_MM, x=12.0, y=-25.0, sigma_x=6.0, sigma_y=6.0, amplitude=second, level=0.0)
        _, rises = looked(
            first + other + uneven + noise, count=np.where(rim & np.ones(71, dtype=bool), 8, 40), hardly=True
        )
        return [(round(rise.x_mm), round(rise.y_mm)) for rise in rises]

    assert listed(0.25) == [(12, -25)]
    assert listed(0.0) == []


@pytest.mark.long
def test_at_a_place_that_was_given_the_rest_of_the_map_is_named() -> None:
    found, rises = looked(values(second=0.1), SMALL)
    assert found.status == "estimate"
    assert [round(rise.x_mm) for rise in rises] == [-18]
    found, rises = looked(values(second=0.1), (0.0, -25.0))
    assert found.status == "no_estimate"
    assert [round(rise.x_mm) for rise in rises] == [-18, 15]
    assert rises[0].distance_mm is None


def test_a_larger_lump_far_away_is_no_rib_under_a_small_one() -> None:
    """A rib of sigma 10 mm was once laid through both masses of a scan, 2 mm from the smaller one's centre."""
    level = 0.02 * np.cos(np.arange(-HALF_MM, HALF_MM + 1) / 12.0)[:, None]  # a level that curves, as gains leave it
    found, _ = looked(values(second=0.1) + level, SMALL)
    assert found.scene is not None
    assert found.scene.fit.scene.extra != "rib"


@pytest.mark.long_repeats
@pytest.mark.parametrize(("second", "places"), [(0.15, [(24, 14)]), (0.0, [])])
def test_a_lump_on_the_rib_beside_another_lump_is_named_and_the_rib_is_not(
    second: float, places: list[tuple[int, int]]
) -> None:
    """A rib of the first lump's scene once hid all that lies along it."""
    rng, half = np.random.default_rng(1), 45.0
    first = bump_values(half_mm=half, x=-12.0, y=-4.0, sigma_x=5.0, sigma_y=5.0, amplitude=0.3)
    other = bump_values(half_mm=half, x=24.0, y=14.0, sigma_x=4.0, sigma_y=4.0, amplitude=second, level=0.0)
    rib = 0.1 * np.exp(-0.5 * ((np.arange(-half, half + 1)[:, None] - 14.0) / 5.0) ** 2)
    noise = 0.01 * rng.standard_normal(first.shape) + 0.005 * correlated_field(rng, len(first), length_cells=3.0)
    found, rises = looked(first + other + rib + noise)
    assert found.scene is not None
    assert found.scene.fit.scene.extra == "rib"
    assert [(round(rise.x_mm), round(rise.y_mm)) for rise in rises] == places


def test_a_place_without_a_mode_is_no_rise(monkeypatch: pytest.MonkeyPatch) -> None:
    tactile_map = grid_map(values(second=0.1))
    options = SamplerSettings(method="laplace", draws=400, background="free", noise="field")
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))

    def no_mode(*_: object, **__: object) -> None:
        raise NotConvergedError("no mode")

    monkeypatch.setattr("tactile_bayes.posterior.correlated.fit_and_test", no_mode)
    assert other_rises(tactile_map, found, options) == ((), ())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("two")
    for name, second in (("two.nc", 0.1), ("one.nc", 0.0)):
        write_map(place / name, grid_map(values(second=second)), provenance=Provenance("import", {}))
    return place


@pytest.mark.long
def test_text_json_and_pool_name_the_other_rise(folder: Path) -> None:
    def told(*words: str) -> str:
        return run_here("estimate", *words, "--method", "laplace", cwd=folder).stdout

    short = told("two.nc")
    assert "Mass 2 at (1" in short
    text = told("two.nc", "-v")
    assert "Mass 2 at (15." in text or "Mass 2 at (14." in text
    assert "These odds are of this window alone; other masses of the map (2) are above." in text
    assert "a second lump in this window (odds" in text
    assert "Scene in the fit window of 20 mm about the lump: " in text
    rise = json.loads(told("two.nc", "--json"))["other_rises"][0]
    assert (rise["x_mm"], rise["y_mm"]) == pytest.approx(SMALL, abs=1.0)
    alone = told("one.nc")
    assert "Mass 2" not in alone
    pooled = told("one.nc", "two.nc", "--pool")
    assert "map 2: another rise stands at (1" in pooled
    assert "one.nc: another rise" not in pooled


@pytest.mark.parametrize(
    ("amplitude", "sigma", "fall", "stands"),
    [
        (0.2, 8.0, 0.0, True),
        (0.2, 2.0, 0.0, True),
        (0.1, 6.0, 0.3, True),
        (0.0, 8.0, 0.25, False),
        (0.05, 8.0, 0.25, False),
    ],
)
def test_a_level_that_falls_towards_the_rim_is_no_lumps_flank(
    amplitude: float, sigma: float, fall: float, stands: bool
) -> None:
    """A fit there has the height of the fall; the map itself rises by `amplitude` only."""
    axis = np.arange(-HALF_MM, HALF_MM + 1.0)
    x, y = np.meshgrid(axis, axis)
    mean = bump_values(half_mm=HALF_MM, x=-20.0, y=16.0, sigma_x=sigma, sigma_y=sigma, amplitude=amplitude)
    mean -= fall * (np.exp(-0.5 * ((x + HALF_MM) / 7.0) ** 2) + np.exp(-0.5 * ((y - HALF_MM) / 7.0) ** 2))
    fitted = Rise(max(amplitude, 0.2 if fall and not stands else 0.0), -20.0, 16.0, 8.0, 8.0, None, 1.0)
    assert _stands_out(fitted, grid_map(mean)) == stands
