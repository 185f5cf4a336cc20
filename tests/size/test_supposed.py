"""How large a lump would be were more known of its body: against the size with that known."""

from __future__ import annotations

import numpy as np
import pytest
from test_pooling import BODY_SD, calibration, pooled, shape

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.pooling import SizePriors
from tactile_bayes.size.terms import HiddenTerms


def knowing(*, inverted: tuple[str, ...] = ()) -> BodyCalibration:
    """A calibration whose B goes with stiffness and seat, which go with each other."""
    expected = np.zeros((2, 6))
    expected[:, 0] = 0.05 if inverted else np.log(30.0), 0.6
    covariance = np.array([[0.5, -0.05], [-0.05, 0.12]]) if not inverted else np.diag([0.001, 0.12])
    with_body = np.array([-0.02, -0.015]) if not inverted else np.array([0.0015, -0.015])
    hidden = HiddenTerms(("stiffness_ratio", "seat"), expected, covariance, with_body, BODY_SD**2, inverted=inverted)
    return replace(calibration(hidden=hidden), bodies={"stiffness_ratio": (8.0, 100.0), "seat": (0.0, 1.2)})


@pytest.mark.long_repeats
@pytest.mark.parametrize("inverted", [(), ("stiffness_ratio",)])
@pytest.mark.parametrize("known", [{}, {"seat": 0.3}])
def test_a_supposed_size_is_the_size_with_that_property_known(
    inverted: tuple[str, ...], known: dict[str, float]
) -> None:
    use, maps = knowing(inverted=inverted), [shape(2.7), shape(2.75, seed=1)]
    found = pooled(maps, use=use, priors=SizePriors(known=known))
    assert set(found.supposing) == ({"soft", "hard"} if known else {"soft", "hard", "centred", "resting"})
    size = found.summarise("max_size_mm", probability=0.95)
    for one in found.supposing.values():
        told = pooled(maps, use=use, priors=SizePriors(known={**known, one.name: one.value})).max_size_mm
        assert one.moved(size) == pytest.approx(np.quantile(told, [0.5, 0.025, 0.975]), rel=0.01)
    soft, hard = (found.supposing[name].change for name in ("soft", "hard"))
    assert soft > 0.02 > -0.01 > hard


def test_bodies_that_the_calibration_does_not_hold_are_not_supposed() -> None:
    use = knowing()
    hard_only = replace(use, bodies={"stiffness_ratio": (40.0, 100.0), "seat": (0.0, 0.4)})
    assert set(pooled([shape(2.7)], use=hard_only).supposing) == {"hard", "centred"}
    assert pooled([shape(2.7)], use=calibration()).supposing == {}


def test_what_the_map_tells_is_not_supposed_otherwise() -> None:
    """Maps of this calibration tell the seat to 0.1 about 0.6: neither 0 nor 1 can be; to 0.35 both can."""
    use = knowing()
    assert use.hidden is not None
    told = replace(use, hidden=replace(use.hidden, covariance=np.array([[0.5, -0.01], [-0.01, 0.01]])))
    assert set(pooled([shape(2.7)], use=told).supposing) == {"soft", "hard"}
    assert set(pooled([shape(2.7)], use=use).supposing) == {"soft", "hard", "centred", "resting"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "value", "contradicts"),
    [("depth_mm", 15.0, False), ("seat", 0.0, False), ("stiffness_ratio", 30.0, False), ("depth_mm", 1.5, True)],
)
def test_a_depth_in_cm_is_a_caution_and_true_properties_are_none(name: str, value: float, contradicts: bool) -> None:
    """The demo's lump lies 15 mm deep: 1.5 made a lump of 15 mm one of 2 mm, without a word."""
    size = tb.estimate(tb.demo_map(), known={name: value}, method="laplace")
    cautions = [one.text for one in size.findings if one.kind == "own_settings"]
    assert bool(cautions) == contradicts
    assert all("times its error: the map contradicts it" in one for one in cautions)


def test_what_is_known_moves_a_size_by_so_many_sds() -> None:
    """Against both sizes: the shift of ln d over the SD that it has where nothing is known."""
    use, maps = knowing(), [shape(2.7)]
    free, told = (pooled(maps, use=use, priors=SizePriors(known=known)) for known in ({}, {"stiffness_ratio": 8.0}))
    shift = np.log(told.median_mm / free.median_mm)
    assert told.known_sds == pytest.approx(abs(shift) / np.nanstd(np.log(free.max_size_mm)), rel=0.05)
    assert free.known_sds == 0.0


def test_where_bodies_differ_most_what_is_known_tells_no_more() -> None:
    """The control: twice that SD of B, and no limit, is twice the shift."""
    use = knowing()
    assert use.hidden is not None
    limited = replace(use, hidden=replace(use.hidden, most_sd=BODY_SD / 2))
    found, less = (pooled([shape(2.7)], use=one).supposing["soft"] for one in (use, limited))
    assert less.log_shift == pytest.approx(found.log_shift / 2, rel=1e-6)
    assert 1.0 - less.sd_ratio**2 == pytest.approx((1.0 - found.sd_ratio**2) / 4, rel=0.05)
