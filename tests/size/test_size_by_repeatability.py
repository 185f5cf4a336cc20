"""Sizes from the draws that an estimate keeps for pooling, and by a site's repeatability."""

from __future__ import annotations

import numpy as np
import pytest

import tactile_bayes as tb
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.size.draws import SIZES, BetweenMaps
from tactile_bayes.size.pooling import Repeatability, SizePriors, size_alone

SITE = Repeatability(0.1, 0.15, 0.098, 0.07, 0.13, masses=12, maps=36)


@pytest.fixture(scope="module")
def demo() -> tb.SizeEstimate:
    return tb.estimate(tb.demo_map())


def test_sizes_from_the_kept_draws_are_the_estimates_without_fitting_the_map_again(demo: tb.SizeEstimate) -> None:
    calibration = read_size_calibration(size_calibration_path("solid"))
    shape, size = demo.answer.shape, demo.estimate.size
    again = size_alone(
        replace(shape, turn_rad=0.0), calibration=calibration, priors=SizePriors(), rng=np.random.default_rng(5)
    )
    for one, other in ((again, size), (again.another_exam, size.another_exam)):
        for name in SIZES:
            ours, theirs = (some.summarise(name, probability=0.95) for some in (one, other))
            for end in ("low", "median", "high"):
                assert getattr(ours, end) == pytest.approx(getattr(theirs, end), abs=0.05 * theirs.sd), (name, end)
    assert again.variance_share == pytest.approx(size.variance_share, abs=0.5)


def test_the_sites_spread_adds_to_the_variance_of_one_map(demo: tb.SizeEstimate) -> None:
    calibration = read_size_calibration(size_calibration_path("solid"))
    shape = replace(demo.answer.shape, turn_rad=0.0)

    def variance(between: BetweenMaps) -> float:
        priors = SizePriors(between_maps=between, another_exam=None)
        found = size_alone(shape, calibration=calibration, priors=priors, rng=np.random.default_rng(5))
        assert found.another_exam is None
        return float(np.var(np.log(found.max_size_mm)))

    assert variance(SITE.between_maps) - variance(BetweenMaps(0.0, 0.0)) == pytest.approx(0.1**2, rel=0.05)


def test_a_spread_out_of_order_or_stated_twice_is_refused() -> None:
    with pytest.raises(BadDataError, match="the spread has the median"):
        replace(SITE, median=0.01)
    with pytest.raises(UsageError, match="give one of them"):
        Settings(between_map_sd=0.1, repeatability=SITE)
    with pytest.raises(UsageError, match="a repeatability is for sizes"):
        Settings(size_calibration="none", repeatability=SITE)


def test_words_say_the_spread_its_interval_and_where_it_is_from() -> None:
    assert SITE.words() == (
        "exams of one mass differ by 9.8 % (95 %: 7.0 to 13) at this site, by 12 masses and 36 exams"
    )
