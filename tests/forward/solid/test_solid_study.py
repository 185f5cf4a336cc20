"""The study in three dimensions: its frames, its map and fit, its table, and an independent model's phantoms."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from tactile_bayes.actions.study import study_csv
from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_BAD_DATA, EXIT_USAGE, BadDataError, UsageError
from tactile_bayes.studies.paper import Geometry, StudyRow
from tactile_bayes.studies.paper_solid import (
    RasterFrames,
    SolidSettings,
    fit_raster,
    raster_frames,
    raster_map,
)

Run = Callable[..., "CompletedProcess[str]"]
SETTINGS = SolidSettings(fineness=1)
# Maps as they are, fitted with a level of 1: how the independent programs do it.
AS_IT_IS = SolidSettings(background="fixed", flat_field=False)
COARSE = replace(AS_IT_IS, fineness=1)


@cache
def ball() -> RasterFrames:
    body = SETTINGS.body(15.0, 1.0, seat=0.0)
    return raster_frames(SETTINGS.on(body), [SETTINGS.placed(SETTINGS.condensed(body), 100.0)], SETTINGS)


@cache
def rows() -> list[StudyRow]:
    return SETTINGS.rows(Geometry(1.2, 12.0, 1.0, (1.0, 8.0, 100.0)))


def test_mirrored_frames_are_the_frames_there() -> None:
    body = SETTINGS.body(15.0, 1.0, seat=0.0)
    head, lump = SETTINGS.on(body), SETTINGS.placed(SETTINGS.condensed(body), 100.0)
    assert len(ball().x_mm) == 45 * 5
    for x, y in ((-9.0, 6.0), (3.0, -12.0), (-1.5, -6.0)):
        (i,) = np.flatnonzero((ball().x_mm == x) & (ball().y_mm == y))
        direct, contact = head.frame([lump], np.eye(3), (x, y), mean_kpa=9.5)
        np.testing.assert_allclose(ball().pressure_kpa[i], direct, rtol=1e-6)
        assert ball().depth_mm[i] == pytest.approx(contact.depth_mm, rel=1e-9)


def test_every_reading_falls_on_the_middle_of_its_cell() -> None:
    """The map against a plain average by place: every cell, to the step in which maps are summed."""
    surface = ball().head.surface_mm()
    x = np.round((ball().x_mm[:, None, None] + surface[..., 0]) / 0.75).astype(int).ravel()
    y = np.round((ball().y_mm[:, None, None] + surface[..., 1]) / 0.75).astype(int).ravel()
    share = (ball().pressure_kpa / 9.5).ravel()
    made = raster_map(replace(ball(), plain_kpa=None))
    row, column = np.nonzero(made.covered)
    for i in range(0, len(row), 97):
        at = (x == round(made.x_mm[column[i]] / 0.75)) & (y == round(made.y_mm[row[i]] / 0.75))
        assert at.sum() == made.count[row[i], column[i]]
        assert made.mean[row[i], column[i]] == pytest.approx(share[at].mean(), abs=3e-4)


def test_a_raster_over_no_lump_is_flat_once_it_is_divided() -> None:
    """To the last bits of the sums; the control is as striped as the head is uneven."""
    body = SETTINGS.body(15.0, 1.0, seat=0.0)
    plain = raster_frames(SETTINGS.on(body), [], SETTINGS)
    divided, as_it_is = raster_map(plain), raster_map(replace(plain, plain_kpa=None))
    assert np.array_equal(divided.covered, as_it_is.covered)
    assert np.abs(divided.mean[divided.covered] - 1.0).max() < 1e-6
    near = as_it_is.covered & (np.hypot(*np.meshgrid(as_it_is.x_mm, as_it_is.y_mm)) <= 20.0)
    assert np.ptp(as_it_is.mean[near]) > 0.015
    # what the control's stripes are taken for
    taken = fit_raster(as_it_is, COARSE).amplitude
    assert abs(fit_raster(divided, SETTINGS).amplitude) < 1e-6 < 0.003 < abs(taken)


def test_dividing_frames_is_nearly_dividing_maps() -> None:
    """Over the lump's map on the map of the same body without it, taxel by taxel or cell by cell."""
    body = SETTINGS.body(15.0, 1.0, seat=0.0)
    plain = raster_map(replace(raster_frames(SETTINGS.on(body), [], SETTINGS), plain_kpa=None))
    made, bare = raster_map(ball()), raster_map(replace(ball(), plain_kpa=None))
    near = made.covered & (np.hypot(*np.meshgrid(made.x_mm, made.y_mm)) <= 20.0)
    other = bare.mean[near] / plain.mean[near]
    assert np.abs(made.mean[near] - other).max() < 0.02
    assert np.corrcoef(made.mean[near], other)[0, 1] > 0.999


@pytest.mark.parametrize("background", ["free", "fixed"])
def test_the_fit_is_the_least_squares_fit_of_eq_7(background: str) -> None:
    """scipy's trust-region fit of the plain formula to the same cells."""
    made = raster_map(ball())
    x, y = np.meshgrid(made.x_mm, made.y_mm)
    inside = made.covered & (x**2 + y**2 <= 400)
    x, y, value = x[inside], y[inside], made.mean[inside]

    def residual(t: np.ndarray) -> np.ndarray:
        level = t[3] if background == "free" else 1.0
        return level + t[0] * np.exp(-(x**2) / (2 * t[1] ** 2) - y**2 / (2 * t[2] ** 2)) - value

    other = least_squares(residual, [0.3, 5.0, 4.0, 1.0], xtol=1e-14, ftol=1e-14)
    found = fit_raster(made, replace(SETTINGS, background=background))
    np.testing.assert_allclose((found.amplitude, *found.widths_mm), other.x[:3], rtol=1e-6)
    assert found.rms == pytest.approx(np.sqrt(np.mean(other.fun**2)), rel=1e-6)
    assert found.resolved


@pytest.mark.long
def test_a_lump_of_fat_does_not_show_and_a_harder_one_shows_higher() -> None:
    none, soft, hard = rows()
    plain = raster_map(raster_frames(SETTINGS.on(SETTINGS.body(12.0, 1.0, seat=1.2)), [], SETTINGS))
    assert none.amplitude == pytest.approx(fit_raster(plain, SETTINGS).amplitude, abs=1e-4)
    assert not none.detectable
    assert soft.amplitude < hard.amplitude
    assert soft.sigma_x_mm == pytest.approx(hard.sigma_x_mm, rel=0.05)  # Fig 7b


@pytest.mark.long
def test_the_table_has_a_width_for_each_axis_of_the_head() -> None:
    head, *_, last = study_csv(rows()).splitlines()
    names = "seat,d_mm,depth_ratio,stiffness_ratio,amplitude,sigma_x_mm,sigma_y_mm,fit_rms,detectable"
    names += ",thickness_mm,head_radius_mm,head,normalise,background,fit_radius_mm,noise,flat_field"
    assert head == names
    cells = dict(zip(names.split(","), last.split(","), strict=True))
    assert cells["seat"] == "1.2"
    assert float(cells["sigma_x_mm"]) > float(cells["sigma_y_mm"])  # a ball looks longer across the head
    assert cells["detectable"] == "true"
    assert (cells["thickness_mm"], cells["head_radius_mm"]) == ("70", "35")
    recipe = {"normalise": "mean", "background": "free", "fit_radius_mm": "20", "noise": "independent"}
    assert {name: cells[name] for name in (*recipe, "flat_field")} == recipe | {"flat_field": "true"}


def test_a_ball_too_small_for_the_array_is_marked() -> None:
    (row,) = SETTINGS.rows(Geometry(0.0, 5.0, 0.6, (100.0,)))
    assert row.amplitude > 0.02
    assert not row.detectable


def test_twice_the_fineness_is_half_the_element() -> None:
    one, two, four = (SolidSettings(fineness=fineness).mesh_size for fineness in (1, 2, 4))
    assert (two.arc, two.rings, two.core, two.grade) == (18, 6, 3, 1.45)  # what decision record 0024 measured
    assert (four.arc, one.arc) == (36, 9)
    assert four.grade**2 == pytest.approx(two.grade)


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "width"), [(AS_IT_IS, 5e-3), (SolidSettings(), 1e-2)])
@pytest.mark.parametrize(("d", "depth_ratio", "seat"), [(15.0, 1.0, 0.0), (10.0, 0.8, 1.2), (20.0, 1.2, 0.5)])
def test_half_the_cell_gives_the_same_map(
    d: float, depth_ratio: float, seat: float, settings: SolidSettings, width: float
) -> None:
    """A free level leans on the map's far parts, so the mesh moves wide bumps a little more."""
    geometry = Geometry(seat, d, depth_ratio, (100.0,))
    (usual,) = settings.rows(geometry)
    (fine,) = replace(settings, fineness=4).rows(geometry)
    assert usual.amplitude == pytest.approx(fine.amplitude, rel=1e-2)
    assert usual.sigma_x_mm == pytest.approx(fine.sigma_x_mm, rel=width)
    assert usual.sigma_y_mm == pytest.approx(fine.sigma_y_mm, rel=width)


QUICK = [("centred", 15.0, 1.0), ("resting", 20.0, 0.8)]
# The centred balls of 20 and 25 mm at h/d 1.5 do not show and are not in the table.
WHERE_TAXELS_RESOLVE = [
    (seat, d, q)
    for seat in ("centred", "resting")
    for d in (10.0, 15.0, 20.0, 25.0)
    for q in (0.8, 1.0, 1.2, 1.5)
    if (seat, q) != ("centred", 1.5) or d <= 15.0
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "d", "depth_ratio"),
    [*QUICK, *[pytest.param(*case, marks=pytest.mark.slow) for case in WHERE_TAXELS_RESOLVE if case not in QUICK]],
)
def test_an_independent_models_phantoms_are_met(shared_data: Path, name: str, d: float, depth_ratio: float) -> None:
    """Its "resting" balls lie a tenth of their diameter above the gland: seat 1.2. Faint ones a little further off.

    It fits its maps as they are with a background of 1.
    """
    with (shared_data / "phantoms.csv").open(newline="") as file:
        table = [row for row in csv.DictReader(file) if row["seat"] == name]
    (known,) = (row for row in table if (float(row["d_mm"]), float(row["depth_ratio"])) == (d, depth_ratio))
    seat = 1.2 if name == "resting" else 0.0
    (row,) = AS_IT_IS.rows(Geometry(seat, d, depth_ratio, (100.0,)))
    assert row.amplitude == pytest.approx(float(known["amplitude"]), rel=0.0125)
    assert row.sigma_x_mm == pytest.approx(float(known["sigma_x_mm"]), rel=0.01 if row.amplitude > 0.03 else 0.02)
    assert row.sigma_y_mm == pytest.approx(float(known["sigma_y_mm"]), rel=0.01)


GRID = "d_mm,depth_ratio,stiffness_ratio\n" + "".join(f"{d},{h},100\n" for d in (10, 15, 20) for h in (0.8, 1, 1.2))


@pytest.fixture(scope="module")
def folder(run_cli: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small solid study."""
    path = tmp_path_factory.mktemp("solid")
    (path / "grid.csv").write_text(GRID)
    words = ("study", "--model", "solid", "--grid", "grid.csv", "--fineness", 1, "-o", "study.csv")
    done = run_cli(*words, cwd=path)
    assert done.returncode == 0, done.stderr
    (path / "stdout.txt").write_text(done.stdout)
    return path


@pytest.mark.long
def test_the_command_writes_a_table_and_a_summary(folder: Path) -> None:
    found = list(csv.DictReader((folder / "study.csv").read_text().splitlines()))
    assert [(row["d_mm"], row["depth_ratio"]) for row in found[:2]] == [("10", "0.8"), ("10", "1")]
    said = (folder / "stdout.txt").read_text()
    assert "9 cases, 0 not detectable" in said
    assert "centred, E2/E1 = 100, across the head: d = " in said
    assert "centred, E2/E1 = 100, along it: d = " in said


@pytest.mark.slow
def test_four_figures_are_drawn(folder: Path, run_cli: Run) -> None:
    words = ("study", "--model", "solid", "--grid", "grid.csv", "--fineness", 1, "--figures", "figures")
    done = run_cli(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert [(folder / "figures" / f"figure_{n}.png").read_bytes()[:4] for n in (5, 6, 7, 8)] == [b"\x89PNG"] * 4


@pytest.mark.long
def test_a_figure_of_balls_is_the_same_bytes_each_time(tmp_path: Path) -> None:
    from tactile_bayes.report.study import figure_8

    cases = [(d, h) for d in (5.0, 15.0) for h in (0.6, 1.0)]
    known = [StudyRow("centred", d, h, 100.0, 0.3 / h**3, d * h / 4, 0.01, True, d * h / 5) for d, h in cases]
    for name in ("one.png", "two.png"):
        figure_8(known, tmp_path / name)
    figure_8([], tmp_path / "none.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


@pytest.mark.slow
def test_a_calibration_is_learned_from_the_table_by_defaults(folder: Path, run_cli: Run) -> None:
    done = run_cli("calibrate", "size", "study.csv", "-o", "size.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "background free, fit radius 20 mm" in done.stdout


@pytest.mark.long
def test_a_table_says_how_its_maps_were_made(folder: Path, run_cli: Run, tmp_path: Path) -> None:
    """An option that contradicts the study is refused: sizes would be a third off by the wrong normalising."""
    text = (folder / "study.csv").read_text()
    (tmp_path / "same.csv").write_text(text)
    (tmp_path / "mixed.csv").write_text(text.replace(",mean,free,", ",mean,fixed,", 1))
    for table, words, said in (
        ("same.csv", ("--normalise", "gain"), "same.csv: its normalise is mean, not gain as --normalise says"),
        ("same.csv", ("--normalise", "gain"), "leave out --normalise, and size maps made with `map --normalise mean`"),
        ("same.csv", ("--background", "fixed"), "its background is free, not fixed as --background says"),
        ("same.csv", ("--fit-radius-mm", 48), "its fit_radius_mm is 20.0, not 48.0 as --fit-radius-mm says"),
        ("same.csv", ("--noise", "field"), "its noise is independent, not field as --noise says"),
        ("mixed.csv", (), "mixed.csv: background differs between rows"),
    ):
        done = run_cli("calibrate", "size", table, "-o", "size.json", *words, cwd=tmp_path)
        assert done.returncode == EXIT_BAD_DATA
        assert said in done.stderr
        assert not (tmp_path / "size.json").exists()


OPTIONS: dict[tuple[str, ...], tuple[str, bool]] = {
    (): ("free", True),
    ("--background", "fixed"): ("fixed", True),
    ("--no-flat-field",): ("free", False),
    ("--background", "fixed", "--no-flat-field"): ("fixed", False),
}


@pytest.mark.long
def test_options_reach_the_map_and_the_fit(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "grid.csv").write_text("d_mm,depth_ratio,stiffness_ratio\n15,1.2,100\n")
    amplitudes = []
    for words, (background, flat_field) in OPTIONS.items():
        common = ("study", "--model", "solid", "--grid", "grid.csv", "--fineness", 1)
        done = run_cli(*common, *words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        (found,) = csv.DictReader(done.stdout.splitlines())
        assert (found["background"], found["flat_field"]) == (background, str(flat_field).lower())
        settings = replace(SETTINGS, background=background, flat_field=flat_field)
        (row,) = settings.rows(Geometry(0.0, 15.0, 1.2, (100.0,)))
        assert float(found["amplitude"]) == pytest.approx(row.amplitude, rel=1e-5)
        amplitudes.append(row.amplitude)
    assert np.diff(sorted(amplitudes)).min() > 1e-3  # all four are maps or fits of their own


def test_a_level_that_is_neither_is_refused() -> None:
    with pytest.raises(UsageError, match="background is 'open'"):
        SolidSettings(background="open")


@pytest.mark.parametrize("option", [{"background": "fixed"}, {"flat_field": False}])
def test_a_store_of_another_fit_is_refused(option: dict[str, Any], run_cli: Run, tmp_path: Path) -> None:
    from tactile_bayes.batch import open_store

    (tmp_path / "grid.csv").write_text(GRID)
    with open_store(tmp_path / "study.csv.unfinished", settings=replace(SETTINGS, **option).as_dict()):
        pass
    words = ("study", "--model", "solid", "--grid", "grid.csv", "--fineness", 1, "-o", "study.csv")
    done = run_cli(*words, cwd=tmp_path)
    assert done.returncode == EXIT_USAGE
    assert "other settings" in done.stderr


def test_a_store_of_the_other_model_is_refused(run_cli: Run, tmp_path: Path) -> None:
    from tactile_bayes.batch import open_store
    from tactile_bayes.studies.paper import StudySettings

    (tmp_path / "grid.csv").write_text(GRID)
    with open_store(tmp_path / "study.csv.unfinished", settings=StudySettings().as_dict()):
        pass
    done = run_cli("study", "--model", "solid", "--grid", "grid.csv", "-o", "study.csv", cwd=tmp_path)
    assert done.returncode == EXIT_USAGE
    assert "other settings" in done.stderr


@pytest.mark.long
def test_an_interrupted_study_goes_on_where_it_stopped(folder: Path, run_cli: Run, tmp_path: Path) -> None:
    from tactile_bayes.batch import open_store

    (tmp_path / "grid.csv").write_text("d_mm,depth_ratio,stiffness_ratio\n10,1,100\n10,0.8,100\n")
    marked = {"seat": "centred", "d_mm": 10.0, "depth_ratio": 1.0, "stiffness_ratio": 100.0, "amplitude": 0.123}
    marked |= {"sigma_x_mm": 4.5, "sigma_y_mm": 3.5, "fit_rms": 0.01, "detectable": True}
    with open_store(tmp_path / "study.csv.unfinished", settings=SETTINGS.as_dict()) as kept:
        kept.add("seat 0, d 10 mm, h/d 1, E2/E1 100", [marked])
    words = ("study", "--model", "solid", "--grid", "grid.csv", "--fineness", 1, "-o", "study.csv")
    done = run_cli(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    resumed = (tmp_path / "study.csv").read_text().splitlines()
    assert resumed[1] == "centred,10,1,100,0.123,4.5,3.5,0.01,true,,,,,,,,"
    assert resumed[2] == (folder / "study.csv").read_text().splitlines()[1]


FAULTS: dict[str, tuple[dict[str, float], float, list[str]]] = {
    "wall": ({"thickness_mm": 20.0}, 1.0, ["thickness_mm is 20", "lowest point"]),
    "skin": ({}, 0.5, ["depth_ratio is 0.5", "at least 0.52"]),
    "liquid": ({"poisson": 0.5}, 1.0, ["poisson is 0.5", "below 0.5"]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_an_impossible_study_is_refused(name: str) -> None:
    options, depth_ratio, words = FAULTS[name]
    with pytest.raises(BadDataError) as caught:
        _ = SolidSettings(**options).body(15.0, depth_ratio, seat=0.0).layers
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_head_wider_than_its_arc_is_refused(run_cli: Run, tmp_path: Path) -> None:
    done = run_cli("study", "--model", "solid", "--head-radius-mm", 5, cwd=tmp_path)
    assert done.returncode == EXIT_BAD_DATA
    assert "radius_mm of the head is 5" in done.stderr
