"""Data, fit and residual of a window, and the titles of figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from matplotlib.figure import Figure
from posterior_maps import bump_map

import tactile_bayes as tb
from tactile_bayes.api.maps import Map
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import replace
from tactile_bayes.files.posterior_nc import read_posterior
from tactile_bayes.posterior.result import fitted_cells
from tactile_bayes.report.figure_file import exam_title
from tactile_bayes.report.map import draw_panel, map_figure

NOISE_SD = 0.004
SLOPE = 0.003


def truth(x_mm: np.ndarray, y_mm: np.ndarray, *, amplitude: float, slope: float) -> np.ndarray:
    """Eq 7 with a slope along x, as the maps here are made."""
    return 1 + slope * x_mm + amplitude * np.exp(-(x_mm**2 + y_mm**2) / (2 * 5.0**2))


def estimated(noise: str, *, slope: float) -> SizeEstimate:
    plain = bump_map(amplitude=0.0)
    x, y = np.meshgrid(plain.x_mm, plain.y_mm)
    mean = truth(x, y, amplitude=0.4, slope=slope) - 1
    mean += NOISE_SD * np.random.default_rng(117).standard_normal(mean.shape)
    made = Map(bump_map(amplitude=0.0, noise=mean))
    background = {"background": "free"} if noise == "independent" else {}
    return tb.estimate(made, size_calibration="none", method="laplace", noise=noise, **background)


@pytest.mark.parametrize(("noise", "slope"), [("field", SLOPE), ("field", 0.0), ("independent", 0.0)])
def test_the_fit_is_the_truth_to_within_its_noise_and_the_residual_is_the_noise(noise: str, slope: float) -> None:
    fitted = fitted_cells(estimated(noise, slope=slope).estimate)
    assert fitted is not None
    off = fitted.fit - truth(fitted.cells.x_mm, fitted.cells.y_mm, amplitude=0.4, slope=slope)
    assert np.abs(off).max() < NOISE_SD  # some ten parameters from over a thousand cells
    assert fitted.residual.std() == pytest.approx(NOISE_SD, rel=0.06)
    # the control: the bump alone is no fit of a sloping map
    flat = fitted.cells.value - truth(fitted.cells.x_mm, fitted.cells.y_mm, amplitude=0.4, slope=0.0)
    assert bool(flat.std() > 2 * NOISE_SD) is bool(slope)


@pytest.mark.long
def test_the_figure_is_what_its_name_says_and_the_map_stands_in_without_an_estimate(tmp_path: Path) -> None:
    found = estimated("independent", slope=0.0)
    for suffix, magic in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        found.plot_fit(tmp_path / f"fit{suffix}")
        assert (tmp_path / f"fit{suffix}").read_bytes().startswith(magic)
    drawn = found.plot_fit()
    assert [axes.get_title(loc="left") for axes in drawn.axes[:2]] == ["Data", "Fit"]
    assert drawn.axes[2].get_title(loc="left").startswith("Rest, SD 0.00")
    noise = 0.02 * np.random.default_rng(3).standard_normal((51, 51))
    nothing = tb.estimate(Map(bump_map(amplitude=0.0, noise=noise)), size_calibration="none")
    assert nothing.plot_fit().axes[0].get_title(loc="left").startswith("Tactile map")


def test_what_neighbours_share_is_drawn_apart_so_that_the_rest_is_noise() -> None:
    """White noise and a smooth swell round the lump: the level is the rim's, and the swell lies above it all over."""
    plain = bump_map(amplitude=0.0)
    x, y = np.meshgrid(plain.x_mm, plain.y_mm)
    swell = 0.02 / (1.0 + np.exp((np.hypot(x, y) - 15.0) / 1.5))
    noise = NOISE_SD * np.random.default_rng(5).standard_normal(x.shape)
    made = Map(bump_map(amplitude=0.0, noise=truth(x, y, amplitude=0.4, slope=0.0) - 1 + swell + noise))
    fitted = fitted_cells(tb.estimate(made, size_calibration="none", method="laplace", noise="field").estimate)
    assert fitted is not None
    assert fitted.shared is not None
    left = fitted.cells.value - fitted.fit
    assert np.mean(left > 0) > 0.65  # what the figure showed as one
    assert 0.47 < np.mean(fitted.residual > 0) < 0.53
    assert fitted.residual.std() == pytest.approx(NOISE_SD, rel=0.1)
    away = np.hypot(fitted.cells.x_mm, fitted.cells.y_mm)
    assert fitted.shared[away < 12].mean() > fitted.shared[away > 18].mean() + 0.5 * NOISE_SD


@pytest.mark.parametrize(
    ("name", "scans", "title"),
    [
        ("exam", [], "exam"),
        ("exam", [{"sha256": "0123456789ab", "subject": "P07"}], "P07 (exam)"),
        ("", [{"sha256": "0123456789ab"}], ""),
        ("a", [{"subject": "P", "side": "left", "mass": "1", "visit": n} for n in ("x", "x", "y")],
         "P, left, mass 1, visits x and y (a)"),
        (r"a$\frac$", [{"sha256": "$x^", "subject": "<b>$"}], r"a\$\frac\$"),
    ],
)  # fmt: skip
def test_titles_carry_what_the_scans_say_of_the_exam_and_no_digest(
    name: str, scans: list[dict[str, str]], title: str
) -> None:
    assert exam_title(name, scans) == title


def test_a_dollar_in_a_name_starts_no_formula(tmp_path: Path) -> None:
    found = replace(estimated("independent", slope=0.0), name=r"a$\frac$")
    found.plot_map(tmp_path / "map.png")
    assert (tmp_path / "map.png").exists()


def test_a_posterior_file_names_its_scans_for_the_titles_of_its_figures(tmp_path: Path) -> None:
    scans = ({"sha256": "0123456789ab", "subject": "P07"},)
    given = Map(bump_map(noise=0.004 * np.random.default_rng(5).standard_normal((51, 51))), scans=scans)
    tb.estimate(given, size_calibration="none", method="laplace").save(tmp_path / "post.nc")
    assert read_posterior(tmp_path / "post.nc").scans == scans
    done = run_here("diagnose", "post.nc", "--corner", "corner.svg", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "P07 (post), method laplace" in (tmp_path / "corner.svg").read_text()


@pytest.mark.parametrize("landmarks", [False, True])
def test_a_panel_of_the_fit_has_the_sides_of_the_maps_picture(landmarks: bool) -> None:
    """With landmarks the patient's left is on the right; a grid without any is drawn as its file reads."""
    tactile_map = replace(bump_map(), patient_from_plane=np.eye(4) if landmarks else None)
    panel, whole = Figure().subplots(), map_figure(tactile_map, None).axes[0]
    draw_panel(panel, tactile_map.mean, tactile_map, label="values", title="Data")
    assert panel.xaxis_inverted() == whole.xaxis_inverted() == landmarks
    assert panel.yaxis_inverted() == whole.yaxis_inverted() == (not landmarks)
    assert panel.get_xlabel() == whole.get_xlabel()
    assert panel.get_title(loc="left") == "Data"
