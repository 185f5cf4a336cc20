"""What seat, soft lumps, thickness and head do to sizes, from tables in which it was put."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here

from tactile_bayes.size.learn.body_effects import SizeTerm, size_terms
from tactile_bayes.size.learn.eq6 import SizeTable, StudyCases

TRUTH = {"seat": -0.2, "stiffness_ratio": -0.15, "thickness_mm": 0.1, "head_radius_mm": -0.3}


def study(seed: int = 1, *, own: float = 0.0, noise: float = 0.03, **effects: float) -> SizeTable:
    """Rows of Eq 6 (m 2, b -2 mm, f -0.3) times e^(effects) and noise; `own`: each lump's seat effect strays so far."""
    rng = np.random.default_rng(seed)
    levels = np.meshgrid((8.0, 14.0, 20.0), (0.7, 1.0, 1.3), (2.0, 8.0, 100.0), (0.0, 1.0), (45.0, 70.0), (25.0, 35.0))
    d, h, k, seat, thickness, radius = (level.ravel() for level in levels)
    lump = np.unique(np.stack([d, h]), axis=1, return_inverse=True)[1].ravel()
    transformed = {"seat": seat, "stiffness_ratio": np.minimum(np.log(k / 8), 0)}
    transformed |= {"thickness_mm": np.log(thickness), "head_radius_mm": np.log(radius)}
    a = 0.5 * h**-3 * (1 - 1.5 / (k + 1)) * (1 + 0.5 * seat) * np.exp(0.1 * rng.standard_normal(len(d)))
    shift = sum(effects.get(name, 0.0) * values for name, values in transformed.items())
    shift = shift + own * rng.standard_normal(lump.max() + 1)[lump] * seat + noise * rng.standard_normal(len(d))
    sigma = (d * np.exp(-shift) + 2.0) * a**-0.3 / 2.0
    names = tuple("resting" if s else "centred" for s in seat)
    others = {"thickness_mm": thickness, "head_radius_mm": radius, "seat_number": seat}
    return SizeTable(d, a, sigma, None, cases=StudyCases(names, h, k, others))


def found(table: SizeTable) -> dict[str, SizeTerm]:
    return {term.name: term for term in size_terms(table)["x"].terms}


def test_what_was_put_in_comes_out() -> None:
    terms = found(study(**TRUTH))
    assert list(terms) == list(TRUTH)
    for name, term in terms.items():
        assert abs(term.coefficient - TRUTH[name]) < 4 * term.standard_error + 0.005, name
        assert term.standard_error < 0.25 * abs(TRUTH[name]), name
    assert (terms["stiffness_ratio"].low, terms["stiffness_ratio"].high) == (2.0, 8.0)
    assert terms["seat"].change == pytest.approx(np.expm1(terms["seat"].coefficient))
    assert terms["thickness_mm"].change == pytest.approx((70 / 45) ** terms["thickness_mm"].coefficient - 1)


def test_the_scatter_that_goes_is_what_was_put_in() -> None:
    both = size_terms(study(**TRUTH))["x"]
    assert both.scatter_left == pytest.approx(0.03, rel=0.2)
    assert both.scatter > 2.5 * both.scatter_left
    seat = size_terms(study(seat=-0.2))["x"]
    by_name = {term.name: term for term in seat.terms}
    # and a property that does nothing takes away nothing
    assert by_name["seat"].share > 0.8
    assert max(by_name[name].share for name in TRUTH if name != "seat") < 0.05


def test_intervals_cover_what_was_put_in() -> None:
    """60 tables whose lumps have seat effects of their own: 95 % intervals, 2.8 % binomial error.

    Control: errors of half the size cover no more than 82 %.
    """
    distance = []
    for seed in range(60):
        term = found(study(seed, own=0.1, seat=-0.2))["seat"]
        distance.append(abs(term.coefficient + 0.2) / term.standard_error)
    # nine lumps: Student's t with 8 degrees of freedom
    assert np.mean(np.array(distance) < 2.31) >= 0.86
    assert np.mean(np.array(distance) < 2.31 / 2) <= 0.82


def test_what_does_not_vary_has_no_term() -> None:
    table = study()
    assert table.cases is not None
    hard = table.cases.stiffness_ratio >= 8
    cases = table.cases.rows(hard)
    cut = SizeTable(table.d_mm[hard], table.amplitude[hard], table.sigma_x_mm[hard], None, cases=cases)
    assert "stiffness_ratio" not in found(cut)
    assert size_terms(dataclasses.replace(cut, cases=dataclasses.replace(cases, others={}))) == {}
    assert size_terms(dataclasses.replace(table, cases=None)) == {}


def test_the_report_tells_them_and_a_blank_column_has_none(tmp_path: Path) -> None:
    table = study(**TRUTH)
    assert table.cases is not None
    columns = [table.d_mm, table.amplitude, table.sigma_x_mm, table.cases.depth_ratio, table.cases.stiffness_ratio]
    columns += list(table.cases.others.values())
    head = "d_mm,amplitude,sigma_x_mm,depth_ratio,stiffness_ratio,thickness_mm,head_radius_mm,seat"
    rows = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    (tmp_path / "t.csv").write_text("\n".join([head, *rows]) + "\n")
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = re.search(r"  seat 0 -> 1: d ([-+]\d+) % \(ln d (\S+) \+- \S+ a unit\)", done.stdout)
    assert told is not None
    # the command has width changes as well, which move f a little
    assert float(told[2]) == pytest.approx(found(table)["seat"].coefficient, abs=0.02)
    assert float(told[1]) == pytest.approx(100 * np.expm1(float(told[2])), abs=0.6)
    for words in (
        "  E2/E1 up to 8, 2 -> 8: d ",
        "  thickness in mm 45 -> 70: d ",
        "  radius of the head in mm 25 -> 35: d ",
    ):
        assert words in done.stdout
    assert "  all of them: residual SD of ln d " in done.stdout
    blank = rows[0].split(",")
    blank[5] = ""
    (tmp_path / "t.csv").write_text("\n".join([head, ",".join(blank), *rows[1:]]) + "\n")
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", "--force", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "thickness in mm" not in done.stdout
    assert "radius of the head in mm" in done.stdout
