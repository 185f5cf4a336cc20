"""Maps outside a calibration's range: sized with the caution first, without the depth of the fat, or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from posterior_files import MADE
from posterior_maps import bump_map

from tactile_bayes.actions.live_view import RiseRotation, live_estimate
from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BumpDraws, ShapeDraws, SizePosterior
from tactile_bayes.size.pooling import SizePriors, pool_maps
from tactile_bayes.size.terms import beyond_lumps

SHIPPED = size_calibration_path("solid")
EVEN = (0.0, 0.0, 0.0)
BUMP = (0.348, 5.69)
"""Amplitude and sigma in mm of a bump on an even pressure that stood for a lump of 15 mm; hardly a body gives both."""


@pytest.fixture(scope="module")
def shipped() -> BodyCalibration:
    assert SHIPPED is not None
    found = read_size_calibration(SHIPPED)
    assert isinstance(found, BodyCalibration)
    return found


def log_size(calibration: BodyCalibration, amplitude: float, sigma_mm: float) -> float:
    return float(calibration.log_size(np.log(np.array(amplitude)), np.log(np.array(sigma_mm))))


def test_a_depth_that_no_body_goes_with_is_not_used(shipped: BodyCalibration) -> None:
    told = shipped.at_fat([EVEN])
    assert told.fat_mm is not None
    assert np.exp(log_size(told, *BUMP)) < 14  # by the cubic of before 6 mm, with an interval of 3.3 to 11.2 mm
    used = told.at_depth_or_fallback(*BUMP)
    assert used.fat_mm is None
    assert np.exp(log_size(used, *BUMP)) == pytest.approx(15.0, rel=0.1)
    (words,) = used.outside(*BUMP)
    assert "mm of fat is unlike the bodies of the table, so that depth is not used" in words
    assert used.outside(*BUMP, far=True) == []
    assert used.outside(0.323, 5.1) == []  # another map of the mass, which had these figures as its own


def test_a_depth_that_goes_with_the_map_stays(shipped: BodyCalibration) -> None:
    told = shipped.at_fat([(-0.024, -0.002, 0.0)])
    assert told.fat_mm is not None
    assert told.at_depth_or_fallback(0.323, 5.1) is told
    assert told.outside(0.323, 5.1) == []


@pytest.mark.parametrize(
    ("amplitude", "sigma_mm", "outside", "far"),
    [(0.3, 5.0, "", ""), (8.0, 6.0, "amplitude 8", ""), (14.0, 6.0, "amplitude 14", "amplitude 14"),
     (0.7, 15.0, "sigma 15 mm", ""), (0.7, 18.0, "sigma 18 mm", "sigma 18 mm"), (0.01, 5.0, "0.01", "0.01")],
)  # fmt: skip
def test_the_distance_from_the_range_decides_between_caution_and_refusal(
    shipped: BodyCalibration, amplitude: float, sigma_mm: float, outside: str, far: str
) -> None:
    found = shipped.outside(amplitude, sigma_mm), shipped.outside(amplitude, sigma_mm, far=True)
    for texts, words in zip(found, (outside, far), strict=True):
        assert words in "; ".join(texts)
        assert bool(texts) == bool(words)


@pytest.mark.parametrize("name", ["solid", "eq6", "plane-strain"])
def test_many_maps_at_once_are_within_reach_as_one_by_one(name: str) -> None:
    path = size_calibration_path(name)
    assert path is not None
    calibration = read_size_calibration(path)
    rng = np.random.default_rng(3)
    amplitude, x, y = rng.normal(0.0, 2.0, 400), np.exp(rng.normal(1.7, 0.6, 400)), np.exp(rng.normal(1.7, 0.6, 400))
    told = [
        a > 0 and not calibration.outside(a, one, other, far=True)
        for a, one, other in zip(amplitude.tolist(), x.tolist(), y.tolist(), strict=True)
    ]
    assert calibration.within_reach(amplitude, x, y).tolist() == told
    assert 20 < sum(told) < 380


def gain_map(*, profile: tuple[float, ...] | None = None, **bump: float) -> TactileMap:
    noise = 0.01 * np.random.default_rng(2).standard_normal((51, 51))
    plain = bump_map(noise=noise, x=0.0, y=0.0, **bump)
    quality = {} if profile is None else dict(zip(HEAD_PROFILE, profile, strict=True))
    return replace(plain, recipe=replace(plain.recipe, normalise="gain"), quality={**plain.quality, **quality})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("range")
    maps = {
        "bump.nc": gain_map(profile=EVEN, amplitude=0.348, sigma_x=6.1, sigma_y=5.2),
        "far.nc": gain_map(amplitude=15.0, sigma_x=5.0, sigma_y=5.0),
        "sound.nc": gain_map(amplitude=0.35, sigma_x=5.0, sigma_y=5.0),
    }
    for name, tactile_map in maps.items():
        write_map(place / name, tactile_map, provenance=MADE)
    return place


def test_the_caution_is_the_first_line(folder: Path) -> None:
    done = run_here("estimate", "bump.nc", "--method", "laplace", cwd=folder)
    assert done.returncode == EXIT_DONE, done.stderr
    assert done.stdout.startswith("CAUTION: unlike the lumps that sizes were learned from: amplitude 0.3")
    row = next(line for line in done.stdout.splitlines() if line.startswith("largest size"))
    assert float(row.split()[-4]) < 15.0 < float(row.split()[-2])


def test_too_far_is_no_number_with_the_way_out(folder: Path) -> None:
    done = run_here("estimate", "far.nc", "--method", "laplace", cwd=folder)
    assert done.returncode == EXIT_NO_ESTIMATE
    assert done.stdout.startswith(
        "No estimate: too unlike the lumps that sizes were learned from for a size: amplitude 15"
    )
    assert "--size-calibration none for amplitude and widths" in done.stdout
    found = json.loads(run_here("estimate", "far.nc", "--method", "laplace", "--json", cwd=folder).stdout)
    assert (found["status"], found["reason_code"], found["max_size_mm"]) == ("no_estimate", "extrapolated", None)
    assert found["verdict"] == "no_answer"
    widths = run_here("estimate", "far.nc", "--method", "laplace", "--size-calibration", "none", cwd=folder)
    assert widths.returncode == EXIT_DONE, widths.stderr


@pytest.mark.long
def test_one_map_too_far_stops_a_pool_and_a_caution_comes_first(folder: Path, shipped: BodyCalibration) -> None:
    done = run_here("estimate", "sound.nc", "far.nc", "--pool", "--method", "laplace", cwd=folder)
    assert done.returncode == EXIT_NO_ESTIMATE
    assert "No estimate: map 2: too unlike the lumps that sizes were learned from" in done.stdout
    ones = np.ones(200)
    far = ShapeDraws.of(BumpDraws(15.0 * ones, 5.0 * ones, 5.0 * ones, 0.0 * ones))
    pooled = pool_maps([far], calibration=shipped, priors=SizePriors(), rng=np.random.default_rng(1))
    assert (pooled.status, pooled.size) == ("no_estimate", None)
    cautioned = run_here("estimate", "bump.nc", "sound.nc", "--pool", "--method", "laplace", cwd=folder)
    assert cautioned.stdout.startswith("CAUTION: unlike the lumps that sizes were learned from: map 1: amplitude 0.3")


@pytest.mark.parametrize(("sigma_mm", "told"), [(16.0, True), (5.0, False)])
def test_a_size_beyond_the_tables_lumps_is_cautioned(shipped: BodyCalibration, sigma_mm: float, told: bool) -> None:
    """The shipped table's lumps have 5 to 30 mm; what lies beyond is the form's own."""
    rng, ones = np.random.default_rng(1), np.ones(400)
    widths = sigma_mm * np.exp(0.01 * rng.standard_normal((2, 400)))
    shape = ShapeDraws.of(BumpDraws(0.12 * ones, *widths, 0.0 * ones))
    pooled = pool_maps([shape], calibration=shipped, priors=SizePriors(), rng=rng)
    assert pooled.size is not None
    assert (pooled.size.median_mm > 30.0) == told
    assert any(text.endswith("(the table's lumps: 5 to 30 mm)") for text in pooled.outside) == told


def test_a_size_far_longer_than_wide_is_cautioned(shipped: BodyCalibration) -> None:
    """A hard scar of 21 mm by 3 was sized as a lump of 13 mm without a word: sizes were learned from balls."""
    assert beyond_lumps(shipped.domain, 4.0, 1.9) == ["largest size 4 mm (the table's lumps: 5 to 30 mm)"]
    without_any = SizePosterior(*[np.full((1, 3), np.nan)] * 2, {}, 3, np.zeros(3))
    assert beyond_lumps(shipped.domain, without_any.median_mm, without_any.axis_ratio) == []
    shape = ShapeDraws.of(BumpDraws(*(np.full(400, value) for value in (0.35, 5.3, 1.8, 0.0))))
    pooled = pool_maps([shape], calibration=shipped, priors=SizePriors(), rng=np.random.default_rng(1))
    assert any(
        "times as long as wide: a scar, a fold of skin or a rib's end looks so" in text for text in pooled.outside
    )


def test_the_live_view_begins_with_the_caution() -> None:
    said = live_estimate(
        gain_map(profile=EVEN, amplitude=0.348, sigma_x=6.1, sigma_y=5.2), str(SHIPPED), RiseRotation()
    ).text
    assert said.startswith("CAUTION: unlike the lumps that sizes were learned from: amplitude 0.3")
    assert ". largest size" in said
    far = live_estimate(gain_map(amplitude=15.0, sigma_x=5.0, sigma_y=5.0), str(SHIPPED), RiseRotation()).text
    assert far.startswith("no estimate: too unlike the lumps that sizes were learned from")
