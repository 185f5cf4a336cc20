"""Maps whose level far from a lump is not known: how they are fitted, and what leads to a size."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from posterior_maps import bump_values, grid_map
from settings_files import settings

from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.white import default_errors, fit_bump

UNIT = 37.0
SLOPE = 0.002 * (np.arange(41) - 20.0)


def in_other_units(*, amplitude: float = 0.3, width_mm: float = 5.0, seed: int = 1, count: int = 40) -> TactileMap:
    """A lump on a sloping level, in a unit of its own."""
    rng = np.random.default_rng(seed)
    values = bump_values(half_mm=20.0, amplitude=amplitude, sigma_x=width_mm, sigma_y=width_mm) + SLOPE
    values = UNIT * (values + 0.01 * rng.standard_normal(values.shape))
    return grid_map(values, background=None, normalise="none", count=count)


def widths(tactile_map: TactileMap, fit: SamplerSettings) -> tuple[float, float]:
    options = replace(fit, method="laplace")
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert found.map_posterior is not None, found.reason
    low, high = np.quantile(found.map_posterior.sigma_x_mm, [0.05, 0.95])
    return float(low), float(high)


def test_without_a_level_the_background_is_free_by_default() -> None:
    assert default_errors(in_other_units()) == ("free", "field")
    assert default_errors(in_other_units(count=1)) == ("free", "independent")
    assert default_errors(grid_map(bump_values())) == ("fixed", "independent")


def test_a_level_that_is_not_known_cannot_be_fixed() -> None:
    words = r"not known \(normalise none\).*give background = \"free\""
    with pytest.raises(UsageError, match=words):
        fit_bump(in_other_units(), (0.0, 0.0), options=SamplerSettings())
    with pytest.raises(UsageError, match=words):
        widths(in_other_units(), SamplerSettings(noise="field"))


@pytest.mark.long
def test_intervals_hold_without_a_level_and_not_at_the_median() -> None:
    """docs/coverage.md has 400 maps a row; a dozen tell the default from a level held at the map's median."""
    held, control = 0, 0
    for seed in range(12):
        tactile_map = in_other_units(seed=seed, width_mm=6.0)
        background, noise = default_errors(tactile_map)
        low, high = widths(tactile_map, SamplerSettings(background=background, rotation="off", noise=noise))
        held += low <= 6.0 <= high
        divided = tactile_map.mean / np.median(tactile_map.mean)
        at_median = replace(tactile_map, mean=divided, background=1.0)
        low, high = widths(at_median, SamplerSettings(rotation="off"))
        control += low <= 6.0 <= high
    assert held >= 9
    assert control <= 5


def saved(tactile_map: TactileMap, path: Path) -> str:
    write_map(path, tactile_map, provenance=Provenance("import", {}), force=True)
    return path.name


@pytest.mark.slow
def test_the_way_out_that_is_printed_leads_to_a_size(tmp_path: Path) -> None:
    rows, scatter = [], np.exp(0.08 * np.random.default_rng(3).standard_normal((9, 2)))
    for seed, d in enumerate((8.0, 10.0, 11.0, 12.0, 13.0, 14.0, 16.0, 18.0, 20.0)):
        lump = in_other_units(amplitude=0.3 * scatter[seed, 0], width_mm=d / 3.0 * scatter[seed, 1], seed=seed)
        done = run_here("estimate", saved(lump, tmp_path / "lump.nc"), "--json", "--method", "laplace", cwd=tmp_path)
        found = json.loads(done.stdout)
        rows.append([d, *(found[name]["median"] for name in ("amplitude", "sigma_x_mm", "sigma_y_mm"))])
    assert found["max_size_mm"] is None
    assert "the grid's level is not known" in found["reason"]
    with (tmp_path / "LUMPS.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["d_mm", "amplitude", "sigma_x_mm", "sigma_y_mm"], *rows])
    words = found["advice"].split("`tactile-bayes ")[1].split("`")[0].split()
    assert run_here(*words, cwd=tmp_path).returncode == 0, found["advice"]
    name = saved(in_other_units(amplitude=0.3, width_mm=13.0 / 3.0, seed=99), tmp_path / "mine.nc")
    given = ("--size-calibration", "size.json", "--method", "laplace", "--json")
    sized = json.loads(run_here("estimate", name, *given, cwd=tmp_path).stdout)
    assert sized["max_size_mm"]["low"] < 13.0 < sized["max_size_mm"]["high"]
    assert sized["max_size_mm"]["sd"] < 2.5


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ({"background": "fixed"}, 2, 'give background = "free"'),
        ({"background": "fixed", "noise": "independent"}, 2, 'give background = "free"'),
        ("--size-calibration solid", 3, "solid does not fit: the grid's level is not known"),
        ({"background": "free"}, 0, ""),
    ],
)
def test_what_does_not_go_with_an_unknown_level_is_refused(
    tmp_path: Path, words: str | dict[str, str], code: int, message: str
) -> None:
    name = saved(in_other_units(), tmp_path / "map.nc")
    given = words.split() if isinstance(words, str) else settings(tmp_path, **words)
    done = run_here("estimate", name, "--method", "laplace", *given, cwd=tmp_path)
    assert (done.returncode, message in done.stderr) == (code, True), done.stderr
    if code == 0:
        assert "What would help: if its values were divided by their level already" in done.stdout


def test_a_calibration_of_such_maps_has_no_fixed_background(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("d_mm,amplitude,sigma_x_mm\n10,9,3.4\n")
    words = ("calibrate", "size", "t.csv", "-o", "s.json", "--normalise", "none")
    refused = run_here(*words, "--background", "fixed", cwd=tmp_path)
    assert (refused.returncode, "give --background free" in refused.stderr) == (2, True)
    assert "give at least 8" in run_here(*words, cwd=tmp_path).stderr
