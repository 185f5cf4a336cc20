"""The smallest lump that a map without one would have shown."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_values, grid_map

from tactile_bayes.api import estimating
from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.verdict import (
    WIDTHS_MM,
    SmallestLumps,
    needed_amplitudes,
    shows_no_lump,
    smallest_lumps,
)
from tactile_bayes.report.estimate_document import smallest_lump
from tactile_bayes.scans import DEFAULT_HEAD, HeadShape

FIELD = SamplerSettings(method="laplace", draws=400, background="free", noise="field")


def noise(sd: float = 0.01) -> np.ndarray:
    return sd * np.random.default_rng(6).standard_normal((51, 51))


def empty(sd: float = 0.01) -> TactileMap:
    return grid_map(1.0 + noise(sd))


@pytest.mark.long
def test_deeper_lumps_must_be_larger_and_noisier_maps_show_only_larger_ones() -> None:
    quiet, loud = (smallest_lumps(empty(sd), fat_mm=15.0) for sd in (0.01, 0.05))
    assert list(quiet.depths_mm) == [8.0, 11.0, 15.0]
    assert (np.diff(quiet.d_mm, axis=1) >= 0).all()
    assert (quiet.d_mm[:, -1] > quiet.d_mm[:, 0]).all()
    assert (loud.d_mm > quiet.d_mm).all()


def test_places_lie_on_what_is_covered() -> None:
    values = 1.0 + noise()[:17, :17]
    values[:, 9:] = np.nan
    found = smallest_lumps(grid_map(values, cell_mm=2.0), fat_mm=15.0)
    assert (found.places_mm[:, 0] < 1.0).all()
    assert len(found.places_mm) <= 30


def test_as_plain_data_a_lump_that_nothing_shows_is_null() -> None:
    told = smallest_lump(smallest_lumps(grid_map(1.0 + noise(1.0)[:13, :13], cell_mm=2.0), fat_mm=30.0))
    assert told.worst_mm[-1] is None
    assert told.probability == 0.95


def test_what_another_head_would_have_shown_is_to_be_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = SmallestLumps(np.zeros((1, 2)), np.array([8.0]), np.full((1, 1), 9.0), 12.0)
    monkeypatch.setattr(estimating, "smallest_lumps", lambda *_, **__: shown)
    small = grid_map(1.0 + noise()[:13, :13], cell_mm=2.0)
    settings = Settings(size_calibration="none", method="optimise")
    heads = DEFAULT_HEAD, HeadShape(8, 8, 4.0, None)
    paper, other = (estimate_one(replace(small, head=head), settings).findings for head in heads)
    assert paper == ()
    assert other[0].text.endswith("this one (8 x 8 taxels, 4 mm apart, flat) may miss larger lumps")


def test_a_lump_is_excluded_where_one_would_have_shown_somewhere() -> None:
    nowhere = SmallestLumps(np.zeros((1, 2)), np.array([8.0, 15.0]), np.full((1, 2), np.inf), 12.0)
    hidden = shows_no_lump(nowhere)
    assert hidden is not None
    assert hidden.reason.endswith("not even one of 26.5 mm would rise above the map's errors")
    assert shows_no_lump(replace(nowhere, d_mm=np.array([[9.0, np.inf]]))) is None


@pytest.mark.long
def test_a_map_whose_errors_hide_every_lump_is_no_verdict_on_the_breast() -> None:
    loud = grid_map(1.0 + noise(300.0)[:13, :13], cell_mm=2.0)
    found = estimate_one(loud, Settings(size_calibration="none", method="optimise")).estimate
    assert found.code == "cannot_show"
    assert (found.smallest, found.probability) == (None, None)


@pytest.mark.long_repeats
@pytest.mark.parametrize(("times", "shown"), [(2.0, True), (0.4, False)])
def test_a_bump_well_above_the_needed_amplitude_is_found_and_one_below_is_not(times: float, shown: bool) -> None:
    width = float(WIDTHS_MM[2])
    amplitude = times * needed_amplitudes(empty(), (0.0, 0.0))[2]
    bump = bump_values(x=0.0, y=0.0, sigma_x=width, sigma_y=width, amplitude=amplitude)
    found = estimate_map(grid_map(bump + noise()), calibration=None, options=FIELD, rng=np.random.default_rng(1))
    assert (found.status == "estimate") == shown
