"""Whether two visits are of one mass: by their codes and by the place in the patient."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.size.visits import LEAST_SAME, PatientPlace, contradictions, place_shift


def place(x: float, y: float, sd: float = 0.1) -> PatientPlace:
    return PatientPlace(np.array([x, y]), sd**2 * np.eye(2))


def test_the_probability_is_that_of_two_normal_coordinates():
    """exp(-r^2 / 2): 0.0111 at three SDs, and the SD is the hypotenuse of posture and both maps."""
    found = place_shift(place(0, 0, 3.0), place(21.0, 0.0, 2.0), registration_mm=6.0)
    assert found.sd_mm == pytest.approx(7.0)
    assert found.distance_mm == pytest.approx(21.0)
    assert found.probability == pytest.approx(np.exp(-4.5))
    assert found.doubtful


def test_one_mass_is_refused_as_seldom_as_stated_and_another_nearly_always():
    rng = np.random.default_rng(3)
    shifts = rng.normal(0.0, 5.0, (4000, 2))
    refused = np.mean([place_shift(place(0, 0, 1e-3), place(*s, 1e-3), registration_mm=5.0).doubtful for s in shifts])
    assert refused == pytest.approx(LEAST_SAME, abs=0.007)
    others = 40.0 * np.array([[np.cos(a), np.sin(a)] for a in rng.uniform(0, 6.28, 200)]) + shifts[:200]
    assert np.mean([place_shift(place(0, 0), place(*s), registration_mm=5.0).doubtful for s in others]) > 0.98
    # the control: a registration that is believed to be better than it is refuses one mass often
    assert np.mean([place_shift(place(0, 0), place(*s), registration_mm=2.5).doubtful for s in shifts]) > 0.2


def test_a_visits_place_is_the_mean_of_its_maps():
    found = PatientPlace.mean_of([place(1, 2, 2.0), place(3, 4, 2.0)])
    assert found is not None
    assert found.centre_mm == pytest.approx([2, 3])
    assert found.covariance_mm2 == pytest.approx(2.0 * np.eye(2))
    assert PatientPlace.mean_of([]) is None


@pytest.mark.parametrize(
    ("key", "values", "words"),
    [
        ("subject", ("p1", "p2"), "different patients: p1 (visit 1), p2 (visit 2)"),
        ("side", ("left", "right"), "different sides: left (visit 1), right (visit 2)"),
        ("mass", ("m1", "m2"), "different masses: m1 (visit 1), m2 (visit 2)"),
    ],
)
def test_codes_that_differ_are_named(key, values, words):
    first, later = ([{"sha256": "0", key: value}] for value in values)
    assert contradictions({"1": first, "2": later}) == [f"the scans name {words}"]
    assert contradictions({"1": first, "2": first}) == []
    assert contradictions({"1": first, "2": [{"sha256": "1"}]}) == []


def test_a_visits_own_scans_may_not_contradict_each_other():
    assert contradictions({"1": [{"side": "left"}, {"side": "right"}], "2": [{"side": "left"}]})
