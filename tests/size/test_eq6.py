"""Eq 6 learned from tables that it made itself, and the file that keeps it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plain_calibration import RECIPE

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration, write_size_calibration
from tactile_bayes.report.calibration import calibration_text
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.learn.eq6 import SizeTable, learn_size_calibration, width_changes
from tactile_bayes.size.terms import Recipe, outside_domain

TRUTH = {"m": 1.6, "b": 1.5, "e": 0.6, "f": -0.35}
SCATTER, CHANGE_SCATTER = 0.05, 0.05


def synthetic(
    seed: int, *, scatter: float = SCATTER, depths: bool = True, both: bool = False, lumps: int = 10
) -> SizeTable:
    """Rows of Eq 6: d_i = [m sigma_i / (e a_i^f) + b] exp(scatter), Delta sigma_i = e a_i^f exp(scatter)."""
    rng = np.random.default_rng(seed)
    n = 6 * lumps
    a = np.exp(rng.uniform(np.log(0.05), np.log(0.8), n))
    sigma = rng.uniform(3.0, 9.0, n)
    change = TRUTH["e"] * a ** TRUTH["f"]
    exact = TRUTH["m"] * sigma / change + TRUTH["b"]
    d = exact * np.exp(scatter * rng.standard_normal(n))
    seen = change * np.exp(CHANGE_SCATTER * rng.standard_normal(n)) if depths else None
    return SizeTable(d, a, sigma, sigma if both else None, seen, seen if both else None)


def learned(seed: int, **options: Any) -> SizeCalibration:
    return learn_size_calibration(synthetic(seed, **options), recipe=RECIPE, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def calibration() -> SizeCalibration:
    return learned(1, lumps=6)


@pytest.fixture(scope="module")
def without_depths() -> SizeCalibration:
    return learned(2, depths=False)


def standard_errors(calibration: SizeCalibration) -> np.ndarray:
    """Distance of m, b, e, f, ln scatter from the truth in posterior deviations."""
    draws = calibration.x.draws[:, :5].copy()
    draws[:, 4] = np.log(draws[:, 4])
    truth = np.array([*TRUTH.values(), np.log(SCATTER)])
    return np.asarray((draws.mean(axis=0) - truth) / draws.std(axis=0))


@pytest.mark.long
def test_coefficients_come_back(calibration: SizeCalibration) -> None:
    assert np.abs(standard_errors(calibration)).max() < 4
    # and the posterior is narrow enough to tell: 10 % of m, 5 % of e, 0.03 of f
    relative = calibration.x.draws.std(axis=0)[:4] / np.abs([1.6, 10.0, 0.6, 0.35])
    assert relative.max() < 0.1


@pytest.mark.long
def test_e_is_1_by_convention_without_depths(without_depths: SizeCalibration) -> None:
    x = without_depths.x
    assert (x.draws[:, 2] == 1.0).all()
    assert x.fit["e_identified"] == 0.0
    ratio = x.draws[:, 0]
    assert abs(ratio.mean() - TRUTH["m"] / TRUTH["e"]) < 4 * ratio.std()
    assert "only m/e is determined, e is 1 by convention" in calibration_text(without_depths)


@pytest.mark.long
def test_a_table_with_one_width_calibrates_both_axes(calibration: SizeCalibration) -> None:
    assert calibration.axes == ("both",)
    assert calibration.y is calibration.x
    assert "both axes" in calibration_text(calibration)


@pytest.mark.long
def test_the_domain_is_the_tables_range(calibration: SizeCalibration) -> None:
    table = synthetic(1, lumps=6)
    assert calibration.x.domain["sigma_mm"] == (table.sigma_x_mm.min(), table.sigma_x_mm.max())
    assert outside_domain(calibration.x.domain, table.amplitude.max(), table.sigma_x_mm.min()) == []
    assert len(outside_domain(calibration.x.domain, table.amplitude.max() + 0.1, table.sigma_x_mm.max() + 0.1)) == 2


@pytest.mark.slow
def test_intervals_of_the_coefficients_cover_the_truth() -> None:
    """40 tables, nominal 90 % intervals of m/e, b, e and f: the binomial error of one is 4.7 %.

    Negative control: intervals of half the width cover no more than 75 %.
    """
    hits, narrow = [], []
    for seed in range(100, 140):
        draws = learned(seed, lumps=5).x.draws
        found = np.stack([draws[:, 0] / draws[:, 2], draws[:, 1], draws[:, 2], draws[:, 3]], axis=1)
        truth = np.array([TRUTH["m"] / TRUTH["e"], TRUTH["b"], TRUTH["e"], TRUTH["f"]])
        low, high = np.quantile(found, [0.05, 0.95], axis=0)
        middle = np.median(found, axis=0)
        hits.append((low <= truth) & (truth <= high))
        narrow.append(np.abs(truth - middle) <= (high - low) / 4)
    assert np.mean(hits, axis=0).min() >= 0.76
    assert np.mean(hits) >= 0.83
    assert np.mean(narrow) <= 0.75


@pytest.mark.long
def test_faint_and_sunken_rows_are_left_out() -> None:
    table = synthetic(3, depths=False)
    sunken = table.amplitude.copy()
    sunken[:10] = [-0.1, 0.0] * 5
    changed = SizeTable(table.d_mm, sunken, table.sigma_x_mm, None)
    found = learn_size_calibration(changed, recipe=RECIPE, rng=np.random.default_rng(3))
    assert found.x.fit["rows"] == 50.0
    assert found.x.domain["amplitude"][0] > 0


def cut(table: SizeTable, rows: slice, **changes: np.ndarray) -> SizeTable:
    d, a, s = (changes.get(n, getattr(table, n))[rows] for n in ("d_mm", "amplitude", "sigma_x_mm"))
    return SizeTable(d, a, s, None)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (cut(synthetic(4), slice(7)), "7 rows with a positive amplitude; Eq 6 has 4 coefficients: give at least 8"),
        (cut(synthetic(4), slice(20), amplitude=-synthetic(4).amplitude), "0 rows with a positive amplitude"),
        (cut(synthetic(4), slice(20), d_mm=np.full(60, 9.0)), "all rows have one diameter"),
        (cut(synthetic(4), slice(20), sigma_x_mm=np.full(60, 5.0)), "all rows have one width"),
    ],
)
def test_a_table_that_cannot_teach_is_refused(table: SizeTable, words: str) -> None:
    with pytest.raises(BadDataError, match=words):
        learn_size_calibration(table, recipe=RECIPE, rng=np.random.default_rng(1))


@pytest.mark.long
def test_one_amplitude_leaves_f_to_its_prior() -> None:
    table = synthetic(5, depths=False, lumps=4)
    flat = cut(table, slice(24), amplitude=np.full(24, 0.3))
    f = learn_size_calibration(flat, recipe=RECIPE, rng=np.random.default_rng(1)).x.draws[:, 3]
    assert f.mean() == pytest.approx(-0.3, abs=0.1)
    assert f.std() == pytest.approx(0.5, rel=0.2)


def test_a_width_change_is_a_ratio_to_the_same_lump_at_one_diameter() -> None:
    sigma = np.array([4.0, 5.0, 6.0, 7.0])
    depth = np.array([0.8, 1.0, 1.5, 0.8])
    group = [("centred", 10.0), ("centred", 10.0), ("centred", 10.0), ("centred", 15.0)]
    found = width_changes(sigma, depth_ratio=depth, group=group)
    np.testing.assert_allclose(found, [0.8, 1.0, 1.2, np.nan])


def by_hand() -> SizeCalibration:
    rng = np.random.default_rng(61)
    domain = {"amplitude": (0.05, 0.8), "sigma_mm": (2.0, 9.0), "d_mm": (5.0, 25.0)}

    def axis() -> AxisCalibration:
        return AxisCalibration(rng.standard_normal((20, 6)), 0.3123456789123, domain, {"r2": 0.9})

    return SizeCalibration(axis(), axis(), 0.7123456789123, Recipe("gain", "free", 12.5, declared=False))


WRITTEN = Provenance("calibrate size", {"normalise": "gain"}, {"table": "0" * 64}, seed=3)


def test_a_calibration_survives_its_file_to_nine_digits(tmp_path: Path) -> None:
    path = tmp_path / "size.json"
    ours = by_hand()
    write_size_calibration(path, ours, provenance=WRITTEN)
    back = read_size_calibration(path)
    np.testing.assert_allclose(back.x.draws, ours.x.draws, rtol=1e-8)
    np.testing.assert_allclose(back.y.draws, ours.y.draws, rtol=1e-8)
    assert back.recipe == ours.recipe
    assert back.residual_correlation == pytest.approx(ours.residual_correlation, rel=1e-8)
    assert back.x.reference_amplitude == pytest.approx(ours.x.reference_amplitude, rel=1e-8)
    assert back.x.domain == ours.x.domain
    assert back.axes == ours.axes
    document = json.loads(path.read_text())
    assert document["recipe"]["declared"] is False
    assert document["research_use"].startswith("Research use only")
    assert document["provenance"]["seed"] == 3
    np.testing.assert_allclose(document["x"]["covariance"], np.cov(ours.x.draws.T), rtol=1e-7, atol=1e-12)
    again = tmp_path / "again.json"
    write_size_calibration(again, ours, provenance=WRITTEN)
    assert again.read_bytes() == path.read_bytes()


def drop(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda document: document.pop(name)


def put(value: Any, *where: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        for key in where[:-1]:
            document = document[key]
        document[where[-1]] = value

    return change


LEFT_OUT = {"cases": 25, "geometries": 25, "least_stiffness_ratio": 8.0, "log_quadratic": {"both": 0.1}}


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (drop("x"), "has no x"),
        (drop("recipe"), "has no recipe"),
        (lambda document: document["recipe"].pop("normalise"), "recipe has no normalise"),
        (lambda document: document["x"]["domain"].pop("d_mm"), "domain has no d_mm"),
        (put("tactile-bayes/size-calibration/2", "schema"), "schema"),
        (put("log-quadratic", "form"), "form"),
        (put("median", "recipe", "normalise"), "recipe.normalise"),
        (put(-1.0, "recipe", "radius_mm"), "recipe.radius_mm"),
        (put("yes", "recipe", "declared"), "recipe.declared"),
        (put(1.5, "residual_correlation"), "residual_correlation"),
        (put([], "x", "draws"), "x.draws"),
        (put([1.0, 2.0], "x", "draws", 0), "x.draws has rows of different lengths"),
        (put("1", "y", "draws", 3, 2), "y.draws[3][2]"),
        (put(0.0, "y", "reference_amplitude"), "y.reference_amplitude"),
        (put([1.0], "x", "domain", "sigma_mm"), "x.domain.sigma_mm"),
        (put(["m", "b", "e", "f"], "x", "coefficients"), "x.coefficients"),
        (put(1, "surprise"), "surprise"),
        (put(["z"], "axes"), "axes[0]"),
        (put(LEFT_OUT | {"eq6": {"both": 0.1, "z": 0.1}}, "left_out"), "errors by other widths than x, y and both"),
        (put(LEFT_OUT | {"eq6": {"both": 0.1, "x": 0.1}}, "left_out"), "errors by other widths than x, y and both"),
    ],
)
def test_a_broken_file_is_named_by_its_fault(
    tmp_path: Path, damage: Callable[[dict[str, Any]], None], words: str
) -> None:
    path = tmp_path / "size.json"
    write_size_calibration(path, by_hand(), provenance=WRITTEN)
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))
    with pytest.raises(BadDataError) as caught:
        read_size_calibration(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "\x00\x01", '{"schema": 1}', '{"x": NaN}'])
def test_what_is_not_a_calibration_is_not_read_as_one(tmp_path: Path, text: str) -> None:
    path = tmp_path / "size.json"
    path.write_text(text)
    with pytest.raises(BadDataError, match=r"size\.json"):
        read_size_calibration(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e400])
def test_a_draw_that_is_no_number_is_refused(tmp_path: Path, value: float) -> None:
    path = tmp_path / "size.json"
    write_size_calibration(path, by_hand(), provenance=WRITTEN)
    document = json.loads(path.read_text())
    document["x"]["draws"][2][1] = value
    path.write_text(json.dumps(document))
    with pytest.raises(BadDataError, match="finite"):
        read_size_calibration(path)
