"""`calibrate size` as a user runs it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from in_process import run_here

import tactile_bayes
from tactile_bayes.api.size_calibration import table_recipe
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.tables import read_table
from tactile_bayes.options import LearnOptions
from tactile_bayes.size.terms import Recipe

Run = Callable[..., "CompletedProcess[str]"]
PHANTOMS = Path(tactile_bayes.__file__).parent / "demo" / "phantoms.csv"


def rows(n: int = 12, *, header: str = "d_mm,amplitude,sigma_x_mm") -> str:
    """A table by Eq 6 with m/e = 2.5, b = 1 mm, f = -0.3 and 3 % of scatter."""
    rng = np.random.default_rng(95)
    a, sigma = np.exp(rng.uniform(-3, -0.3, n)), rng.uniform(3, 9, n)
    d = (2.5 * sigma * a**0.3 + 1.0) * np.exp(0.03 * rng.standard_normal(n))
    return "\n".join([header, *(f"{x:.6g},{y:.6g},{z:.6g}" for x, y, z in zip(d, a, sigma, strict=True))]) + "\n"


@pytest.mark.long
def test_phantoms_become_a_calibration(run_cli: Run, tmp_path: Path) -> None:
    options = ("--normalise", "gain", "--background", "free", "--fit-radius-mm", 15, "--seed", 4)
    (tmp_path / "silent.csv").write_text(PHANTOMS.read_text().replace(",mean,fixed,20,independent", ",,,,"))
    done = run_cli("calibrate", "size", "silent.csv", "-o", "size.json", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for words in (
        "Eq 6: d = m sigma / (e a^f) + b",
        "r2 of ln d",
        "recipe (declared): normalise gain, background free, fit radius 15 mm",
        "Research use only",
    ):
        assert words in done.stdout
    path = tmp_path / "size.json"
    assert path.stat().st_mode & 0o777 == 0o600
    found = read_size_calibration(path)
    assert (found.recipe.normalise, found.recipe.background, found.recipe.radius_mm) == ("gain", "free", 15.0)
    assert found.recipe.declared is True
    provenance = json.loads(path.read_text())["provenance"]
    assert provenance["seed"] == 4
    assert [one["role"] for one in provenance["inputs"]] == ["table"]


def test_the_packaged_phantoms_say_how_their_maps_were_made(tmp_path: Path) -> None:
    done = run_here("calibrate", "size", PHANTOMS, "-o", "size.json", "--normalise", "gain", cwd=tmp_path)
    assert done.returncode == 3
    assert "its normalise is mean, not gain as --normalise says" in done.stderr
    table = read_table(PHANTOMS, "size_table.table.json")
    same = table_recipe(table, LearnOptions(normalise="mean", fit_radius_mm=20.0))
    assert same == Recipe("mean", "fixed", 20.0, declared=False, noise="independent", flat_field=None)


@pytest.mark.long
def test_a_small_table_without_depths_teaches_the_ratio(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(rows(30))
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "e is 1 by convention" in done.stdout
    m, b, e, f = read_size_calibration(tmp_path / "size.json").x.draws[:, :4].mean(axis=0)
    assert (m, e) == (pytest.approx(2.5, rel=0.1), 1.0)
    assert f == pytest.approx(-0.3, abs=0.04)
    assert b == pytest.approx(1.0, abs=1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (rows(5), "at least 8"),
        ("d_mm,amplitude\n1,2\n", "sigma_x_mm"),
        ("", "t.csv"),
        (rows(3).replace("\n", "\nabc,0.3,5\n", 1), "abc"),
        (rows(9).replace("\n", "\n-3,0.3,5\n", 1), "-3"),
        ("d_mm,amplitude,sigma_x_mm\n", "t.csv"),
        (
            "d_mm,amplitude,sigma_x_mm,sigma_y_mm\n" + "\n".join(f"{i + 5},0.{i + 1},{i + 3}," for i in range(8)) + "4",
            "blank in some rows",
        ),
        (  # the first row takes no part, so that its blank is none of the fault
            "d_mm,amplitude,sigma_x_mm,sigma_y_mm,detectable\n5,0.1,3,,false\n6,0.1,3,4,true\n7,0.1,3,,true\n",
            "line 4, column sigma_y_mm: is blank in some rows only",
        ),
    ],
)
def test_a_bad_table_is_named_by_its_fault(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert words in done.stderr
    assert "t.csv" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "size.json").exists()


def test_an_existing_calibration_is_left_alone_without_force(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(rows())
    (tmp_path / "size.json").write_text("mine")
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", cwd=tmp_path)
    assert done.returncode == 2
    assert (tmp_path / "size.json").read_text() == "mine"


@pytest.mark.long
def test_the_figure_is_drawn_from_the_tables_own_lumps_and_only_for_eq_6(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(rows(12))
    words = ("calibrate", "size", "t.csv", "-o", "size.json", "--figure", "fig.png")
    refused = run_here(*words, "--form", "eq6-residual", cwd=tmp_path)
    assert refused.returncode == 2
    assert "--figure is for tables of lumps" in refused.stderr
    done = run_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first = (tmp_path / "fig.png").read_bytes()
    assert first.startswith(b"\x89PNG")
    (tmp_path / "t.csv").write_text(rows(20))
    assert run_here(*words, "--force", cwd=tmp_path).returncode == 0
    assert (tmp_path / "fig.png").read_bytes() != first


def study_rows() -> str:
    """A study of five diameters at four depths for which Eq 6 holds but for 2 % of scatter."""
    rng = np.random.default_rng(98)
    lines = ["d_mm,depth_ratio,amplitude,sigma_x_mm"]
    for d in (5, 10, 15, 20, 25):
        for h, a in ((0.6, 1.1), (0.8, 0.37), (1.0, 0.6 ** (1 / 0.3)), (1.2, 0.09)):
            sigma = (d + 6.0) / 6.0 * 0.6 * a**-0.3 * np.exp(0.02 * rng.standard_normal())
            lines.append(f"{d},{h},{a:.6g},{sigma:.6g}")
    return "\n".join(lines) + "\n"


@pytest.mark.long
def test_either_fit_is_offered_and_tells_of_the_other(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(study_rows())
    said = {}
    for fit in ("joint", "two-stage"):
        done = run_here("calibrate", "size", "t.csv", "-o", f"{fit}.json", "--fit", fit, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        said[fit] = done.stdout
        x = read_size_calibration(tmp_path / f"{fit}.json").x
        assert len(x.draws) >= 1000
        assert x.draws[:, 0].mean() == pytest.approx(6.0, rel=0.15)
    assert "two-stage fit as printed: m " in said["joint"]
    assert "joint fit of all rows: m " in said["two-stage"]


def test_a_lump_in_another_unit_and_rows_that_take_no_part_are_said(tmp_path: Path) -> None:
    table = study_rows().replace("\n5,0.6,", "\n0.5,0.6,").replace("\n10,0.6,1.1,", "\n10,0.6,-0.1,")
    (tmp_path / "t.csv").write_text(table)
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", "--fit", "two-stage", cwd=tmp_path)
    assert "CAUTION: Eq 6 sizes 1 of its lumps more than 6 times too large or small" in done.stdout
    assert "left out: 1 of the table's 20 rows" in done.stdout


def test_two_stages_without_depths_are_refused(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(rows(30))
    done = run_here("calibrate", "size", "t.csv", "-o", "size.json", "--fit", "two-stage", cwd=tmp_path)
    assert done.returncode == 3
    assert "no depth_ratio" in done.stderr
    assert "--fit joint" in done.stderr
    assert not (tmp_path / "size.json").exists()
