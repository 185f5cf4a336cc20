"""The calibration of a mass and of each of its maps, on tables made from a law: which noise of a map reaches the size.

In one table the figures by place move against the noise of a bump's width, so that a size by both hardly moves; in
the control they know nothing of it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.size_quadratic_json import write_log_quadratic
from tactile_bayes.inference.draws import even_replicates
from tactile_bayes.presets import BY_PLACE
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.learn.fat_process import learn_fat_process
from tactile_bayes.size.learn.log_quadratic import learn_log_quadratic
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable
from tactile_bayes.size.log_quadratic import LogQuadratic
from tactile_bayes.size.mass_calibration import MassCalibration, corrected_log_size
from tactile_bayes.size.shape_draws import ShapeDraws

RECIPE = Recipe("gain", "free", 20.0, False, "field")
NOISE, EXAM_SD, SEAT = 0.06, 0.02, 0.1
"""SD of a map's ln width by its own noise, of exams beyond it, and what a unit of the seat adds to ln d."""
USUAL = np.array([1.0, -0.4, -0.2, 0.2, -0.6, -0.3])
PROFILE = (0.01, 0.0, 0.0)


def table(*, against: bool, bodies: int = 300) -> PopulationTable:
    """Two exams a body; the figures by place move against the noise of the width, or know nothing of it."""
    rng = np.random.default_rng(1)
    body = np.repeat(np.arange(bodies), 2)
    u, v, w = rng.uniform(-1, 1, bodies), rng.normal(0, 0.35, bodies), rng.normal(0, 0.45, bodies)
    seat = rng.normal(size=bodies)
    log_d = 2.3 + 0.3 * u + v - 0.2 * w + SEAT * seat + rng.normal(0, 0.03, bodies)
    noise, wobble = rng.normal(0, NOISE, len(body)), rng.normal(0, EXAM_SD, len(body))
    figures = USUAL + 0.02 * rng.normal(size=(len(body), len(BY_PLACE)))
    figures[:, 1] += seat[body] - (noise / SEAT if against else 0.0)
    covariance = np.tile(np.diag([1e-6, NOISE**2, 1e-4]), (len(body), 1, 1))
    profile = np.column_stack([0.1 * w, rng.normal(0, 0.05, (bodies, 2))])[body]
    return PopulationTable(
        body, np.exp(log_d[body]), u[body] - 1.0, (v[body] + wobble + noise) + 1.4, np.full(len(body), 0.03),
        covariance, {"seat": seat[body]}, profile, 2.6 + w[body], figures,
    )  # fmt: skip


def learned(*, against: bool) -> LogQuadratic:
    return learn_log_quadratic(table(against=against), recipe=RECIPE, learn_fat=learn_fat_process)


@pytest.fixture(scope="module")
def with_figures_against() -> LogQuadratic:
    return learned(against=True)


def draws(log_width: float, *, figures: np.ndarray | None) -> ShapeDraws:
    """A map whose width is known to `NOISE`."""
    z = np.random.default_rng(3).normal(size=512)
    shape = ShapeDraws(np.full(512, -1.0), log_width + NOISE * (z - z.mean()), np.zeros(512), np.zeros(512))
    return replace(shape, labels=even_replicates(512), by_place=None if figures is None else tuple(figures))


def at_depth(calibration: LogQuadratic):
    return calibration.at_fat([PROFILE])


def test_noise_that_figures_by_place_move_against_hardly_reaches_the_size(with_figures_against) -> None:
    """What the table was made with; the control's figures leave all of the noise in the size."""
    usual = [tuple(USUAL)]
    found, plain = at_depth(with_figures_against).at_places(usual), at_depth(learned(against=False)).at_places(usual)
    assert found.map_factor < 0.25
    assert plain.map_factor == pytest.approx(1.0, rel=0.3)
    assert at_depth(with_figures_against).map_factor == pytest.approx(1.0, rel=0.3)
    # the spread of exams beyond it is told apart from it in both
    assert np.exp(plain.mean[-1]) == pytest.approx(EXAM_SD, rel=0.5)


def test_exams_tell_spread_and_factor_apart() -> None:
    """Normal exams of one mean, half of them with four times the noise: both are as they were drawn."""
    rng = np.random.default_rng(4)
    bodies, t, factor = 4000, 0.03, 0.4
    body = np.repeat(np.arange(bodies), 2)
    noise = np.where(body % 2, 0.08, 0.02)
    size = rng.normal(0, np.sqrt(t**2 + factor * noise**2))
    ones = np.ones((len(body), 1))
    data = BodyRegression(
        ones, size, noise**2, body, np.full(bodies, 2.0), ones[::2], np.zeros(bodies), np.zeros(bodies)
    )
    tried = np.geomspace(0.1, 6.0, 42)
    found = data.exam_spread(np.zeros(1), tried)
    assert found.map_factor == pytest.approx(factor, rel=0.15)
    assert found.sd == pytest.approx(t, rel=0.05)
    # the control: with the factor taken as 1 the spread is too small
    assert data.exam_spread(np.zeros(1)).sd < 0.9 * t


def test_each_map_of_a_mass_is_sized_at_its_own_figures(with_figures_against) -> None:
    """Two exams of a body whose widths differ by noise: their sizes agree; at the mean of their figures they do not."""
    off = 0.08
    figures = [USUAL - np.eye(6)[1] * off / SEAT, USUAL + np.eye(6)[1] * off / SEAT]
    maps = [draws(1.4 + off, figures=figures[0]), draws(1.4 - off, figures=figures[1])]
    fitted = MassCalibration.of(at_depth(with_figures_against), [one.by_place for one in maps])
    own = [float(np.mean(one)) for one in fitted.log_sizes(maps)]
    shared = [float(np.mean(corrected_log_size(fitted.mass, one))) for one in maps]
    assert abs(own[0] - own[1]) < 0.3 * off
    assert abs(shared[0] - shared[1]) > 1.5 * off
    assert np.mean(own) == pytest.approx(np.mean(shared), abs=0.02)


def test_a_map_without_figures_has_the_others_mean_and_all_of_its_noise(with_figures_against) -> None:
    maps = [draws(1.4, figures=USUAL), draws(1.4, figures=None)]
    calibration = at_depth(with_figures_against)
    fitted = MassCalibration.of(calibration, [one.by_place for one in maps])
    assert [one.knows_places for one in fitted.maps] == [True, True]
    assert [one.map_factor for one in fitted.maps] == [fitted.mass.map_factor, calibration.map_factor]
    with_them, without = fitted.log_sizes(maps)
    assert np.mean(with_them) == pytest.approx(np.mean(without), abs=1e-9)
    assert np.var(with_them) / np.var(without) == pytest.approx(fitted.mass.map_factor / calibration.map_factor)
    # where no map has them, none is given any
    bare = MassCalibration.of(calibration, [None, None])
    assert not any(one.knows_places for one in (bare.mass, *bare.maps))


def test_a_file_keeps_the_factor_and_one_of_an_earlier_version_has_none(with_figures_against, tmp_path: Path) -> None:
    write_log_quadratic(tmp_path / "s.json", with_figures_against, provenance=Provenance("test", {}, {}))
    document = json.loads((tmp_path / "s.json").read_text())
    inner = document["fat_process"]["with_places"]
    assert inner["map_factor"] == pytest.approx(with_figures_against.with_fat.with_places.map_factor)
    del inner["map_factor"]
    (tmp_path / "earlier.json").write_text(json.dumps(document))
    read = [read_size_calibration(tmp_path / name) for name in ("s.json", "earlier.json")]
    factors = [one.at_fat([PROFILE]).at_places([tuple(USUAL)]).map_factor for one in read]
    assert factors == [pytest.approx(with_figures_against.with_fat.with_places.map_factor, rel=1e-6), 1.0]
