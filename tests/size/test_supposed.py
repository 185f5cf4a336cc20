"""How large a lump would be were more known of its body: against the size with that known."""

from __future__ import annotations

import numpy as np
import pytest
from test_pooling import BODY_SD, calibration, pooled, shape

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


def test_where_bodies_differ_most_what_is_known_tells_no_more() -> None:
    """The control: twice that SD of B, and no limit, is twice the shift."""
    use = knowing()
    assert use.hidden is not None
    limited = replace(use, hidden=replace(use.hidden, most_sd=BODY_SD / 2))
    found, less = (pooled([shape(2.7)], use=one).supposing["soft"] for one in (use, limited))
    assert less.log_shift == pytest.approx(found.log_shift / 2, rel=1e-6)
    assert 1.0 - less.sd_ratio**2 == pytest.approx((1.0 - found.sd_ratio**2) / 4, rel=0.05)
