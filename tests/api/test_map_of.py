"""A map from values that Python holds: what `import` makes of a file, without a file."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

import tactile_bayes as tb
from tactile_bayes.errors import BadDataError, UsageError


def values() -> Any:
    y, x = np.mgrid[:41, :45]
    noise = 0.01 * np.random.default_rng(0).normal(size=x.shape)
    return 1 + 0.35 * np.exp(-((x - 22) ** 2 + (y - 20) ** 2) / (2 * 5.0**2)) + noise


@pytest.fixture(scope="module")
def size() -> Any:
    return tb.estimate(tb.map_of(values(), spacing_mm=1.0, normalise="gain"), method="laplace").max_size_mm


def test_an_array_is_sized_without_a_file(size: Any) -> None:
    assert 8 < size.median < 20
    low, high = size.interval(0.95)
    assert low < size.median < high


def test_pressures_with_their_level_fitted_have_that_size(size: Any) -> None:
    made = tb.map_of(8.4 * values(), spacing_mm=1.0, units="kPa", level="fit")
    assert [one.kind for one in made.findings] == ["level_fitted"]
    found = tb.estimate(made, method="laplace")
    assert found.max_size_mm.median == pytest.approx(size.median, rel=0.01)
    assert "level_fitted" in [one.kind for one in found.findings]


def test_masks_frames_of_pandas_and_files_are_taken(tmp_path: Path) -> None:
    held = values()
    hidden = np.zeros(held.shape, dtype=bool)
    hidden[0] = True
    np.savetxt(tmp_path / "a.csv", np.where(hidden, -9, held), delimiter=",")
    with warnings.catch_warnings(action="ignore"):
        import pandas as pd
        import xarray as xr
    forms = [
        (np.ma.masked_array(held, hidden), {}),
        (np.where(hidden, np.nan, held), {}),
        (np.where(hidden, -9, held), {"no_value": -9}),
        (np.where(hidden, -9, held), {"no_value": [-9.0, "-1"]}),
        (pd.DataFrame(np.where(hidden, np.nan, held)), {}),
        (xr.DataArray(np.where(hidden, np.nan, held)), {}),
        (tmp_path / "a.csv", {"no_value": "-9"}),
        (str(tmp_path / "a.csv"), {"no_value": np.float64(-9)}),
    ]
    for given, more in forms:
        made = tb.map_of(given, spacing_mm=np.float64(1.0), normalise="gain", **more).tactile_map
        np.testing.assert_allclose(made.mean, np.where(hidden, np.nan, held))


@pytest.mark.parametrize(
    ("given", "stated", "error", "words"),
    [
        (np.ones((3, 3)), {}, UsageError, r"a map is wanted, not ndarray.*spacing_mm="),
        (np.ones((3, 3)), {"units": "kPa"}, UsageError, "a grid needs spacing_mm"),
        (np.ones((3, 3, 3)), {"spacing_mm": 1}, BadDataError, r"mean has shape \(3, 3, 3\)"),
        (np.ones(3), {"spacing_mm": 1}, BadDataError, r"mean has shape \(3,\)"),
        (pandas.Series([1.0, 2.0]), {"spacing_mm": 1}, BadDataError, r"mean has shape \(2,\)"),
        (np.array([["a"]]), {"spacing_mm": 1}, BadDataError, "mean is <U1; give real numbers"),
        ([[1.0, 2.0]], {"spacing_mm": 1}, UsageError, "a map is wanted, not list.*numpy.array"),
        ([[1.0, 2.0]], {}, UsageError, "a map is wanted, not list.*numpy.array"),
        (np.ones((3, 3)), {"spacing": 1}, TypeError, "has no keyword 'spacing'; did you mean spacing_mm"),
        (np.ones((3, 3)), {"spacing_mm": "1"}, UsageError, "spacing_mm is '1'"),
        (np.ones((3, 3)), {"spacing_mm": 1, "level": "auto"}, UsageError, "level is 'auto'"),
        (np.ones((3, 3)), {"spacing_mm": 1, "normalise": "gain", "units": "kPa"}, UsageError, "^units is for values"),
        (np.where(values() > 1.3, 0, values()), {"spacing_mm": 1}, BadDataError, "give no_value=0; if all are values"),
    ],
)
def test_impossible_values_are_refused_in_the_words_of_python(
    given: Any, stated: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        tb.map_of(given, **stated)


def test_values_that_say_that_they_are_mirrored_or_turned_are_refused() -> None:
    """Left and right would be exchanged without a word."""
    with warnings.catch_warnings(action="ignore"):
        import pandas as pd
        import xarray as xr
    held, x, y = values(), np.arange(45.0), np.arange(41.0)
    placed = xr.DataArray(held, {"y": y, "x": x}, ("y", "x"))
    for given, words in (
        (placed.isel(x=slice(None, None, -1)), "the columns' own places go from 44 to 0; give the lowest first"),
        (pd.DataFrame(held, index=y[::-1]), "the rows' own places go from 40 to 0"),
        (placed.transpose("x", "y"), r"the values are \(x, y\) by their dims; give \(y, x\)"),
    ):
        with pytest.raises(UsageError, match=words):
            tb.map_of(given, spacing_mm=1, normalise="gain")
    assert tb.map_of(placed, spacing_mm=1, normalise="gain").x_mm.size == 45
    mm, gap = placed.assign_coords(x=x - 22, y=y - 20), pd.DataFrame(held, index=y).drop(index=20)
    for given, words in (
        (mm, "2 mm, and the places of the cells run in steps of 1; give spacing_mm"),
        (gap, "rows' own"),
    ):
        with pytest.raises(BadDataError, match=words):
            tb.map_of(given, spacing_mm=2, normalise="gain")
    assert tb.map_of(mm.assign_coords(x=mm.x / 10, y=mm.y / 10), spacing_mm=1, normalise="gain").x_mm.size == 45
    for counted in (pd.DataFrame(held), pd.DataFrame(held).iloc[2:]):
        assert tb.map_of(counted, spacing_mm=2, normalise="gain").tactile_map.recipe.cell_mm == 2


def test_the_path_of_a_grid_says_what_it_lacks(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.csv", values(), delimiter=",")
    with pytest.raises(UsageError, match="a grid needs spacing_mm"):
        tb.map_of(tmp_path / "a.csv")
    np.savez(tmp_path / "a.npz", mean=values(), spacing_mm=1.0)
    assert tb.map_of(tmp_path / "a.npz").tactile_map.mean.shape == (41, 45)


def test_a_map_is_returned_as_it_is() -> None:
    made = tb.map_of(values(), spacing_mm=1, normalise="gain")
    assert tb.map_of(made) is made
    assert tb.map_of(made.tactile_map).tactile_map is made.tactile_map
    for given in (made, made.tactile_map):
        with pytest.raises(UsageError, match="spacing_mm is for values and files of values; a map has its own"):
            tb.map_of(given, spacing_mm=2.0)
