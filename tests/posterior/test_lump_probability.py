"""The probability of a lump: what lowers it, and that it agrees with the verdict."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_values, grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.posterior.bump import Detection
from tactile_bayes.posterior.draw import ModalBump, SamplerSettings
from tactile_bayes.posterior.verdict import LIKELY, WeighedRise, weigh
from tactile_bayes.posterior.white import Candidate, fit_bump

CLEAR = {"log_bayes_factor": 60.0, "centre_mm": (0.0, 0.0), "widths_mm": (5.0, 4.5), "fault": ""}


def weighed(**changes: object) -> WeighedRise:
    given = {**CLEAR, **changes}
    detection = Detection(given.pop("log_bayes_factor"))  # type: ignore[arg-type]
    bump = ModalBump(0.2, *given["centre_mm"], *given["widths_mm"])  # type: ignore[misc]
    met = Candidate((0.0, 0.0), None, given["fault"])  # type: ignore[arg-type]
    return weigh(grid_map(bump_values(x=0.0, y=0.0)), detection, bump, met)


def test_a_clear_round_rise_is_a_lump() -> None:
    assert weighed().probability > 0.95


@pytest.mark.parametrize(
    "changes",
    [
        {"widths_mm": (11.8, 0.59)},  # the stripe of the packaged empty scan
        {"widths_mm": (14.0, 10.6), "log_bayes_factor": 4.8},  # a rib of a simulated body
        {"centre_mm": (26.0, 26.0), "fault": "at the rim of the map (20 % of the bump is covered)"},
        {"log_bayes_factor": -5.0},
    ],
)
def test_ridges_rims_ribs_and_errors_are_none(changes: dict[str, object]) -> None:
    assert weighed(**changes).probability < LIKELY


def test_a_rise_has_the_width_of_the_bump_that_has_the_evidence() -> None:
    """At the rim of the packaged empty scan: sigma 13 mm under correlated errors, 4 mm by least squares."""
    tactile_map = grid_map(bump_values(x=-10.0, y=5.0, sigma_x=3.9, sigma_y=2.2))
    fit, _ = fit_bump(tactile_map, (-10.0, 5.0), options=SamplerSettings())
    narrow = Candidate((-10.0, 5.0), fit, "at the rim of the map (with a sigma of 13.3 mm its flank is 9 mm short)")
    wide = replace(narrow, assessed=ModalBump(0.05, -10.0, 5.0, 13.3, 11.0))
    told = []
    for one in (narrow, wide):
        assert one.bump is not None
        told.append(weigh(tactile_map, Detection(35.0), one.bump, one).probability)
    assert told[0] > LIKELY > 0.3 > told[1]


def test_more_evidence_never_lowers_it() -> None:
    found = [weighed(log_bayes_factor=value).probability for value in np.linspace(-20.0, 100.0, 25)]
    assert (np.diff(found) >= 0).all()


def test_without_the_evidence_for_a_size_it_is_never_told_as_a_lump() -> None:
    """The control: with it the same rise is."""
    assert max(weighed(log_bayes_factor=value).probability for value in (-np.inf, -3.0, 0.0, 2.9)) < LIKELY
    assert weighed(log_bayes_factor=3.0).probability > LIKELY
    assert weighed(log_bayes_factor=0.0).chance > LIKELY  # as a rise beside a measured lump is told
