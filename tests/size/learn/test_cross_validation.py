"""Errors in sizes of geometries that a calibration was not learned from, on tables that obey one form or the other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here

import tactile_bayes
from tactile_bayes.declarations import replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.size.eq6 import AxisCalibration
from tactile_bayes.size.learn import eq6 as left_out
from tactile_bayes.size.learn.eq6 import (
    AxisRows,
    SizeTable,
    StudyCases,
    axis_at_mode,
    cross_validate,
    geometry_numbers,
)
from tactile_bayes.size.learn.regression import rows_of

PHANTOMS = Path(tactile_bayes.__file__).parent / "demo" / "phantoms.csv"
D, H, K = (5.0, 10.0, 15.0, 20.0, 25.0), (0.6, 0.8, 1.0, 1.2, 1.5), (2.0, 8.0, 100.0)
Width = Callable[[np.ndarray, np.ndarray], np.ndarray]


def by_eq_6(d: np.ndarray, a: np.ndarray) -> np.ndarray:
    """d = 2 sigma / (0.7 a^-0.3) - 3 mm, solved for the width."""
    return np.asarray((d + 3.0) * 0.7 * a**-0.3 / 2.0)


def by_quadratic(d: np.ndarray, a: np.ndarray) -> np.ndarray:
    """ln d = 0.2 ln a + 1.1 ln sigma + 0.15 (ln a)^2 + 0.9, solved for the width."""
    return np.asarray(np.exp((np.log(d) - 0.2 * np.log(a) - 0.15 * np.log(a) ** 2 - 0.9) / 1.1))


def study(width: Width = by_eq_6, *, along: Width | None = None) -> SizeTable:
    """75 cases in 25 geometries, widths to 1 %; softer lumps show lower."""
    d, h, k = (column.ravel() for column in np.meshgrid(D, H, K, indexing="ij"))
    a = 0.6 * h**-3.0 * (d / 15.0) ** 0.2 * (1 - 1.5 / (k + 1))
    sigma = width(d, a) * np.exp(0.01 * np.random.default_rng(5).standard_normal(len(d)))
    cases = StudyCases(("centred",) * len(d), h, k)
    return SizeTable(d, a, sigma, None if along is None else along(d, a), None, None, cases)


@pytest.mark.long
def test_the_form_that_made_the_table_is_right_and_the_other_is_not() -> None:
    eq6 = cross_validate(study(by_eq_6))
    quadratic = cross_validate(study(by_quadratic))
    assert eq6 is not None
    assert quadratic is not None
    assert (eq6.cases, eq6.geometries, eq6.least_stiffness_ratio) == (50, 25, 8.0)
    assert eq6.eq6["both"] < 0.015
    assert quadratic.log_quadratic["both"] < 0.015
    assert quadratic.eq6["both"] > 0.1


def test_the_quadratic_is_a_plain_fit_to_the_other_geometries() -> None:
    """Against a loop of polynomial fits to a table that neither form made."""
    table = study(lambda d, a: np.asarray((d + 3.0) * a**-0.3 * (1 + 0.2 * np.sin(d * a))))
    assert table.cases is not None
    hard = table.cases.stiffness_ratio >= 8
    d, a, s, h = table.d_mm[hard], table.amplitude[hard], table.sigma_x_mm[hard], table.cases.depth_ratio[hard]
    u, v = np.log(a), np.log(s)
    terms = np.stack([u**0, u, v, u**2, u * v, v**2], axis=1)
    by_geometry, by_row = [], []
    for i in range(len(d)):
        for errors, kept in ((by_geometry, (d != d[i]) | (h != h[i])), (by_row, np.arange(len(d)) != i)):
            solved = np.linalg.solve(terms[kept].T @ terms[kept], terms[kept].T @ np.log(d[kept]))
            errors.append(abs(np.exp(terms[i] @ solved) / d[i] - 1))
    found = cross_validate(table)
    assert found is not None
    assert found.log_quadratic["both"] == pytest.approx(np.mean(by_geometry), rel=1e-6)
    # the control: leaving out single rows lets another stiffness of the same lump tell its size
    assert np.mean(by_row) < 0.97 * np.mean(by_geometry)


def test_a_geometry_is_one_seat_diameter_and_depth() -> None:
    cases = StudyCases(("centred", "centred", "resting", "centred"), np.array([1.0, 1.0, 1.0, 1.2]), np.full(4, 8.0))
    assert geometry_numbers(np.full(4, 10.0), cases).tolist() == [0, 0, 1, 2]


@pytest.mark.long
def test_each_width_and_both_have_their_errors() -> None:
    found = cross_validate(study(by_quadratic, along=lambda d, a: np.full_like(d, 4.0) + 0.1 * a))
    assert found is not None
    assert list(found.eq6) == list(found.log_quadratic) == ["x", "y", "both"]
    assert found.log_quadratic["x"] < 0.015 < 0.1 < found.log_quadratic["y"]


def test_softer_lumps_take_part_only_where_asked() -> None:
    found = cross_validate(study(), least_stiffness_ratio=2.0)
    assert found is not None
    assert (found.cases, found.least_stiffness_ratio) == (75, 2.0)


def test_tables_that_are_no_study_have_none() -> None:
    table = study()
    assert cross_validate(replace(table, cases=None)) is None
    few = table.d_mm < 8  # five geometries
    assert table.cases is not None
    cut = SizeTable(table.d_mm[few], table.amplitude[few], table.sigma_x_mm[few], None, cases=rows_of(table.cases, few))
    assert cross_validate(cut) is None
    assert cross_validate(study(), least_stiffness_ratio=1000.0) is None


@pytest.mark.long
def test_where_eq_6_has_no_mode_the_report_says_without_which_geometry(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def at_mode(rows: AxisRows) -> AxisCalibration:
        if not np.any((rows.d_mm == 10.0) & (rows.amplitude > 1.5)):
            raise NotConvergedError("the posterior has no maximum in every direction; try --method ensemble")
        return axis_at_mode(rows)

    monkeypatch.setattr(left_out, "axis_at_mode", at_mode)
    table = study()
    assert table.cases is not None
    with pytest.raises(NotConvergedError, match=r"no mode without the geometry centred, d 10 mm, h/d 0\.6"):
        cross_validate(table, fit=at_mode)
    columns = (table.d_mm, table.cases.depth_ratio, table.cases.stiffness_ratio, table.amplitude, table.sigma_x_mm)
    rows = ["seat,d_mm,depth_ratio,stiffness_ratio,amplitude,sigma_x_mm"]
    rows += [",".join(["centred", *map(str, case)]) for case in zip(*columns, strict=True)]
    (tmp_path / "study.csv").write_text("\n".join(rows))
    done = run_here("calibrate", "size", "study.csv", "-o", "size.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = "leave one geometry out: not known, Eq 6 has no mode without the geometry centred, d 10 mm, h/d 0.6"
    assert said in done.stdout.splitlines()
    assert json.loads((tmp_path / "size.json").read_text())["left_out"] is None


def test_a_left_out_geometry_is_no_reference_for_width_changes() -> None:
    """Eq 6 sees no width change of a lump whose case at one diameter depth is out, and all of the others'."""
    seen: list[AxisRows] = []

    def at_mode(rows: AxisRows) -> AxisCalibration:
        seen.append(rows)
        return axis_at_mode(rows)

    cross_validate(study(), fit=at_mode)
    assert len(seen) == 25
    for number, rows in enumerate(seen):
        assert len(rows.d_mm) == 48
        assert rows.width_change is not None
        without = rows.d_mm == D[number // 5] if H[number % 5] == 1.0 else np.zeros(48, dtype=bool)
        np.testing.assert_array_equal(np.isnan(rows.width_change), without)


@pytest.mark.long
def test_the_report_and_the_file_tell_the_errors(tmp_path: Path) -> None:
    done = run_here("calibrate", "size", str(PHANTOMS), "-o", "size.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("leave one geometry out: Eq 6 "))
    stored = json.loads((tmp_path / "size.json").read_text())["left_out"]
    assert f"Eq 6 {100 * stored['eq6']['both']:.1f} %" in line
    assert f"log-quadratic {100 * stored['log_quadratic']['both']:.1f} % of d" in line
    found = read_size_calibration(tmp_path / "size.json").left_out
    assert found is not None
    assert (found.geometries, found.eq6) == (stored["geometries"], stored["eq6"])
